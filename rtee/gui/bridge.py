"""Bridge from the threads of the web server to the event loop of the hand's client."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Final, TypeAlias

import viser

from rtee.errors import RequestRejected, RteeError
from rtee.messages.requests import Role
from rtee.remote.truth import Truth

log = logging.getLogger(__name__)

Work = Callable[[], Awaitable[object]]

Stage: TypeAlias = viser.ViserServer | viser.ClientHandle
"""Container of panels: one window, or all open windows."""

_SECONDS: Final = 6.0
"""Time for which a notification is shown [s]: enough to read two lines."""


class Bridge:
    """Runs the callbacks of a window's controls in the event loop; shows errors as notifications.

    Attributes:
        stage: The window.
        truth: The known state of the hand that the window shows.
        role: Permissions of this window's client.
        refused: Why commands of this window are refused now, or an empty string.
    """

    def __init__(self, stage: Stage) -> None:
        """Use the running event loop; must be called in it."""
        self.stage = stage
        self.truth = Truth()
        self.role = Role.MAINTAINER
        self.refused = ""
        self._loop = asyncio.get_running_loop()
        self._working: set[asyncio.Task[None]] = set()

    def call(self, work: Work, *, always: bool = False) -> None:
        """Run a function in the event loop; may be called from any thread.

        While commands of this window are refused, only functions marked ``always`` run.
        """
        self._loop.call_soon_threadsafe(self._start, work, always)

    def clicked(self, work: Work) -> Callable[[object], Coroutine[None, None, None]]:
        """Return a callback for a control that runs a function in the event loop.

        The callback is a coroutine function, which viser calls at once; for a plain function it
        would start a thread.
        """

        async def follow(_: object) -> None:
            self.call(work)

        return follow

    def entered(self, use: Callable[[Any], None]) -> Callable[[Any], Coroutine[None, None, None]]:
        """Return a callback for a control that passes on the values that a person enters.

        Values that the program itself sets are ignored. The callback reads the value at once, in
        viser's own thread, before the next displayed value replaces it.
        """

        async def follow(event: viser.GuiEvent[Any]) -> None:
            if event.client_id is not None:
                use(event.target.value)

        return follow

    def _start(self, work: Work, always: bool) -> None:
        task = asyncio.ensure_future(self._guarded(work, always))
        self._working.add(task)  # the event loop itself keeps only a weak reference
        task.add_done_callback(self._working.discard)

    async def _guarded(self, work: Work, always: bool) -> None:
        try:
            if self.refused and not always:
                raise RequestRejected(self.refused)
            await work()
        except RteeError as error:
            self.notify("Refused", str(error), "orange")
        except OSError as error:
            self.notify("Failed", str(error), "red")
        except Exception as error:
            log.exception("a click failed")
            self.notify("Failed", f"{type(error).__name__}: {error}", "red")

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

    def notify(self, title: str, text: str, colour: Any) -> None:
        """Show a notification."""
        stage = self.stage
        windows = [stage] if isinstance(stage, viser.ClientHandle) else stage.get_clients().values()
        for window in windows:
            window.add_notification(title, text, color=colour, auto_close_seconds=_SECONDS)

    async def done(self) -> None:
        """Wait until the tasks of all clicks are done."""
        while self._working:
            await asyncio.wait(self._working)

    async def close(self) -> None:
        """Cancel the tasks of clicks; requests of earlier clicks still reach the hand."""
        # Let new tasks run their first step, in which they send their request.
        await asyncio.sleep(0)
        working = list(self._working)
        for task in working:
            task.cancel()
        await asyncio.gather(*working, return_exceptions=True)
