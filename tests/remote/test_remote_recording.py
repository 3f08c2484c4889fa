from __future__ import annotations

from pathlib import Path

import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import RequestRejected
from rtee.hand.model import Hand

from .serving import Told, serving, until

pytestmark = pytest.mark.anyio


async def test_a_recording_is_started_marked_and_stopped(
    hand: Hand, library: ActionLibrary
) -> None:
    told = Told()
    async with serving(hand, library, recorder=told), rtee.connect("small") as remote:
        await remote.record("start")
        assert (await remote.status()).recording == "/logs/small.mcap"
        await remote.record("mark", "the drill slipped")
        await remote.record("stop")
        assert (await remote.status()).recording == ""
    assert told.calls == ["start", "the drill slipped", "stop"]


@pytest.mark.parametrize(
    ("what", "text", "reason"),
    [
        ("delete", "", "unknown request 'delete' for the recording"),
        ("mark", "", "a mark must be one line"),
        ("mark", "two\nlines", r"one line without control characters, not 'two\\nlines'"),
        ("mark", "x" * 1001, "not 1001"),
        ("mark", "nobody would find it", "is not recording"),
    ],
)
async def test_nonsense_does_not_reach_the_recorder(
    hand: Hand, library: ActionLibrary, what: str, text: str, reason: str
) -> None:
    told = Told()
    async with serving(hand, library, recorder=told), rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match=reason):
            await remote.record(what, text)
    assert told.calls == []


async def test_a_mark_on_a_full_disk_names_the_disk(hand: Hand, library: ActionLibrary) -> None:
    told = Told(Path("/logs/small.mcap"))
    told.problem = "no space left on device"
    async with serving(hand, library, recorder=told), rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match=r"not written, .* lost: no space left on device"):
            await remote.record("mark", "the cup slipped")
    assert told.calls == []


async def test_without_a_recorder_that_is_said(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match="has no recorder"):
            await remote.record("start")


async def test_the_grip_effort_can_be_changed(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        before = (await remote.status()).grip_effort
        assert before == served.loop.settings.grasp.grip_effort
        await remote.set_gains({"grip_effort": 0.25})
        await until(lambda: served.loop.controller.grip_effort == 0.25)
        assert (await remote.status()).grip_effort == 0.25
        for bad in (1.5, -0.1, float("nan")):
            with pytest.raises(RequestRejected, match=r"must be (0 to 1|a finite number)"):
                await remote.set_gains({"grip_effort": bad})
