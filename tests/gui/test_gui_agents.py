"""What a person answers agents in the page, without a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest
import viser
from remote.serving import make_hand, make_library, serving, until

import rtee
from rtee.errors import GoalRejected
from rtee.gui.app import App
from rtee.remote import approval
from rtee.remote.agents import AGENT
from rtee.remote.approval import approve

from .test_gui_app import apart, server, shows

__all__ = ["apart", "server"]

pytestmark = pytest.mark.anyio


def button(server: viser.ViserServer, label: str) -> Any:
    """Return a visible button of the page, or None."""
    handles = server.gui._gui_input_handle_from_uuid.values()
    found = [h for h in handles if getattr(h, "label", "") == label and h.visible]
    return found[0] if found else None


async def pressed(server: viser.ViserServer, label: str) -> None:
    """Wait for a button, and press it."""
    await until(lambda: button(server, label) is not None)
    for callback in button(server, label)._impl.update_cb:
        await callback(None)


async def test_a_person_answers_in_the_page(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(App, "_attended", lambda app: True)
    monkeypatch.setattr(approval, "CALM", 0.0)
    asked: list[str] = []

    async def ask(question: str) -> None:
        try:
            await approve(question)
            asked.append("yes")
        except GoalRejected as error:
            asked.append(str(error))

    async with anyio.create_task_group() as group:
        app = App(server, None, None)
        await ask("before the page answers")
        group.start_soon(app.run)
        await until(lambda: app.approval.listens)
        for label in ("Do it", "No"):
            group.start_soon(ask, "small: an agent asks to <b>open</b> the hand.")
            await pressed(server, label)
            await until(lambda: button(server, "Do it") is None)
        # Whoever gives up takes the question away.
        with anyio.CancelScope() as scope:
            group.start_soon(pressed_when_shown, server, scope)
            await approve("too late")
        await until(lambda: button(server, "Do it") is None)
        group.cancel_scope.cancel()
    assert "no one is available to approve" in asked[0]
    assert asked[1:] == ["yes", "a person refused it"]


async def pressed_when_shown(server: viser.ViserServer, scope: anyio.CancelScope) -> None:
    await until(lambda: button(server, "Do it") is not None)
    scope.cancel()


async def test_a_person_lets_agents_in(server: viser.ViserServer, tmp_path: Path) -> None:
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)), anyio.create_task_group() as group:
        app = App(server, "small", None)
        group.start_soon(app.run)
        await shows(app, "small: connected")
        async with rtee.connect("small") as person:
            assert button(server, "Let agents in") is None
            await person.stop()
            # Where no agent has ever been, there is nothing to tell.
            assert (await person.status()).agents_out == ""
            async with rtee.connect("small", client=AGENT):
                assert "stopped" in (await person.status()).agents_out
            await pressed(server, "Let agents in")
            await until(lambda: button(server, "Let agents in") is None)
            assert (await person.status()).agents_out == ""
        group.cancel_scope.cancel()
