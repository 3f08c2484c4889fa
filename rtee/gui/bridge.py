"""Bridge from the threads of the browser's server to the event loop of the hand's client."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Final

import viser

from rtee.errors import RteeError
from rtee.gui.visitors import Visitors
from rtee.messages.requests import Role

log = logging.getLogger(__name__)

Work = Callable[[], Awaitable[object]]

_SECONDS: Final = 6.0
"""Time for which a notification is shown [s]: enough to read two lines."""


class Bridge:
    """Runs the work of clicks in the event loop, and shows errors as notifications."""

    def __init__(self, server: viser.ViserServer, visitors: Visitors | None = None) -> None:
        """Use the running event loop; must be called in it."""
        self.server = server
        self.role = Role.MAINTAINER
        self._visitors = visitors
        self._loop = asyncio.get_running_loop()
        self._working: set[asyncio.Task[None]] = set()

    def call(self, work: Work) -> None:
        """Run a function in the event loop; may be called from any thread."""
        self._loop.call_soon_threadsafe(self._start, work)

    def clicked(self, work: Work) -> Callable[[object], Coroutine[None, None, None]]:
        """Return a callback for a control that runs a function in the event loop.

        The callback is a coroutine function, which viser calls at once; for a plain function it
        would start a thread.
        """

        async def follow(_: object) -> None:
            self.call(work)

        return follow

    def _start(self, work: Work) -> None:
        task = asyncio.ensure_future(self._guarded(work))
        self._working.add(task)  # the event loop itself keeps only a weak reference
        task.add_done_callback(self._working.discard)

    async def _guarded(self, work: Work) -> None:
        try:
            await work()
        except RteeError as error:
            self.notify("Refused", str(error), "orange")
        except OSError as error:
            self.notify("Failed", str(error), "red")
        except Exception as error:
            log.exception("a click failed")
            self.notify("Failed", f"{type(error).__name__}: {error}", "red")

    def leave_to_everybody(self, *controls: object) -> None:
        """Let observers use these controls and no others."""
        if self._visitors is not None:
            self._visitors.leave_to_everybody(*controls)

    def may(self, role: Role) -> bool:
        """Return whether the hand grants this GUI at least a role."""
        return self.role >= role

    def need(self, role: Role, *controls: Any) -> None:
        """Disable controls unless the hand grants this GUI at least a role."""
        for control in () if self.may(role) else controls:
            if isinstance(control, viser.GuiButtonGroupHandle):  # viser cannot disable one
                control.visible = False
            else:
                control.disabled = True

    @property
    def watched(self) -> bool:
        """Whether the page is open in any window."""
        return bool(self.server.get_clients())

    @property
    def attended(self) -> bool:
        """Whether the page is open in a window that may move the hand."""
        return self.watched if self._visitors is None else self._visitors.attended

    def notify(self, title: str, text: str, colour: Any = "blue") -> None:
        """Show a notification in every window."""
        for client in self.server.get_clients().values():
            client.add_notification(title, text, color=colour, auto_close_seconds=_SECONDS)

    async def close(self) -> None:
        """Cancel the work of clicks; requests of earlier clicks still reach the hand."""
        # Let new tasks take their first step; cancelled before it, they would send nothing.
        await asyncio.sleep(0)
        working = list(self._working)
        for task in working:
            task.cancel()
        await asyncio.gather(*working, return_exceptions=True)
