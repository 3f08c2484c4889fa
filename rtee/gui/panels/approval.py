"""Questions from agents, which a person answers in the page; see `rtee mcp`."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Final

import anyio

from rtee.errors import ConfigError
from rtee.gui.bridge import Bridge
from rtee.gui.colours import APPROVE
from rtee.gui.wording import WRAPS
from rtee.remote.approval import answer_all, listening

_LOOK_EVERY: Final = 0.5
"""Time between two checks for an operator's window [s]: a question waits for two minutes."""


class Approval:
    """Shows questions one after the other, each with a button for yes and one for no.

    The page receives questions while an operator has it open and no terminal answers them.

    Attributes:
        listens: Whether the page receives questions.
    """

    def __init__(self, bridge: Bridge, attended: Callable[[], bool]) -> None:
        self._bridge, self._attended = bridge, attended
        self.listens = False

    async def run(self) -> None:
        """Answer questions until cancelled."""
        while True:
            await anyio.sleep(_LOOK_EVERY)
            if self._attended():
                try:
                    await self._answer()
                except ConfigError:  # a terminal answers them
                    continue

    async def _answer(self) -> None:
        async with listening() as listener, anyio.create_task_group() as group:
            group.start_soon(answer_all, listener, self.ask)
            self.listens = True
            while self._attended():  # noqa: ASYNC110 - there is no event for it
                await anyio.sleep(_LOOK_EVERY)
            self.listens = False
            group.cancel_scope.cancel()

    async def ask(self, question: str) -> bool:
        """Show a question until it is answered or this call is cancelled; return the answer."""
        gui, answered, said = self._bridge.stage.gui, anyio.Event(), False

        async def answer(yes: bool) -> None:
            nonlocal said
            said = yes
            answered.set()

        folder = gui.add_folder("An agent asks", order=-0.5)
        with folder:
            style = f"padding:0 0.75em;{WRAPS}"
            gui.add_html(f'<div role="alert" style="{style}">{escape(question)}</div>')
            yes = gui.add_button("Do it", color=APPROVE, hint="Let the agent do this, once")
            no = gui.add_button("No", hint="Refuse; the agent learns that a person refused")
        yes.on_click(self._bridge.clicked(lambda: answer(True)))
        no.on_click(self._bridge.clicked(lambda: answer(False)))
        try:
            await answered.wait()
        finally:
            folder.remove()
        return said
