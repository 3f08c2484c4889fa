"""Gamepad, keyboard and recorded samples, into a hand that runs."""

from __future__ import annotations

import math
import os
import pty
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import anyio
import pytest
from remote.serving import make_hand, make_library, serving, until

import rtee
from rtee.errors import ConfigError, LogError
from rtee.hand.model import Hand
from rtee.log import Recorder, RecorderSettings
from rtee.teleop.drive import (
    Played,
    assigned,
    check_units,
    play,
    rate_of,
    recorded,
    samples_of,
)
from rtee.teleop.inputs import (
    BUTTONS,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    SYN_DROPPED,
    Gamepad,
    Keyboard,
)

pytestmark = pytest.mark.anyio


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    monkeypatch.delenv("RTEE_HAND", raising=False)


@pytest.fixture
def hand(tmp_path: Path) -> Hand:
    return make_hand(tmp_path)


@dataclass
class Moved:
    type: int
    code: int
    value: int


@dataclass
class Range:
    min: int
    max: int
    value: int = 0


class Pad:
    """A device of input events: triggers of 0 to 255, sticks of -32768 to 32767."""

    def __init__(self) -> None:
        self.waiting: list[Moved] = []
        self.gone = False
        self.values: dict[int, int] = {}
        self.pressed: list[int] = []

    def read(self) -> Iterator[Moved]:
        if self.gone:
            raise OSError(19, "No such device")
        if not self.waiting:
            raise BlockingIOError
        waiting, self.waiting = self.waiting, []
        return iter(waiting)

    def absinfo(self, axis_num: int) -> Range:
        low, high = (0, 255) if axis_num in (2, 5, 9, 10) else (-32768, 32767)
        return Range(low, high, self.values.get(axis_num, 0))

    def active_keys(self) -> list[int]:
        return self.pressed


def test_what_was_let_go_while_events_were_lost_is_asked_for() -> None:
    pad = Pad()
    gamepad = Gamepad(pad)
    pad.waiting = [Moved(EV_ABS, 5, 255), Moved(EV_KEY, BUTTONS["a"], 1)]
    assert dict(gamepad.read()) == {"rt": 1.0, "a": 1.0}
    # The kernel's buffer was full: this event alone tells that others are gone.
    pad.waiting = [Moved(EV_SYN, SYN_DROPPED, 0)]
    pad.values, pad.pressed = {5: 0}, []
    assert dict(gamepad.read()) == {"rt": 0.0, "a": 0.0}


def test_a_gamepads_axes() -> None:
    pad = Pad()
    gamepad = Gamepad(pad)
    assert dict(gamepad.read()) == {}
    pad.waiting = [
        Moved(EV_ABS, 5, 255),
        Moved(EV_ABS, 2, 10),  # nearly at rest
        Moved(EV_ABS, 1, -32768),
        Moved(EV_ABS, 3, 0),
        Moved(EV_KEY, 304, 1),
        Moved(EV_KEY, 999, 1),
        Moved(0, 0, 0),
    ]
    found = dict(gamepad.read())
    assert found["rt"] == found["up"] == found["a"] == 1.0
    assert found["lt"] == found["right_right"] == 0.0
    pad.waiting = [Moved(EV_ABS, 9, 128), Moved(EV_KEY, 304, 0)]
    assert gamepad.read()["rt"] == pytest.approx((128 / 255 - 0.08) / 0.92)
    assert gamepad.read()["a"] == 0.0


@pytest.mark.parametrize(
    ("actions", "found"),
    [
        (["Grasp"], {"rt": "Grasp"}),
        (["lt=Trig ring", "Grasp"], {"lt": "Trig ring", "rt": "Grasp"}),
        (["a", "b"], {"rt": "a", "lt": "b"}),
    ],
)
def test_axes_are_assigned(actions: list[str], found: dict[str, str]) -> None:
    assert assigned(actions, ["rt", "lt", "up"]) == found


@pytest.mark.parametrize(
    ("actions", "said"),
    [
        (["zz=Grasp"], "unknown axis 'zz'"),
        (["rt=a", "rt=b"], "given twice"),
        (["rt=a", "lt=a"], "given twice"),
        (["a", "b", "c", "d"], "no axis is left for 'd'"),
    ],
)
def test_axes_that_cannot_be_assigned(actions: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        assigned(actions, ["rt", "lt", "up"])


async def test_a_trigger_moves_an_action(hand: Hand) -> None:
    pad = Pad()
    async with serving(hand, make_library(hand)) as served, rtee.connect("small") as remote:
        rest = list(served.loop.controller.reference_position)

        async def drive() -> None:
            async with remote.stream(rate=50) as stream:
                async for targets in samples_of(Gamepad(pad), {"rt": "Trig index"}):
                    await stream.send(targets)

        async with anyio.create_task_group() as group:
            group.start_soon(drive)
            await anyio.sleep(0.15)
            assert served.loop.controller.reference_position == rest  # nothing was moved yet
            pad.waiting = [Moved(EV_ABS, 5, 128)]
            share = (128 / 255 - 0.08) / 0.92
            controller = served.loop.controller
            await until(lambda: abs(controller.reference_position[0] - 1.5 * share) < 1e-3)
            group.cancel_scope.cancel()
        await until(lambda: controller.stream is None)


def left(keyboard: Keyboard) -> None:
    while True:
        keyboard.read()


async def test_the_keyboard_moves_an_action(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        with Keyboard(2) as keyboard:
            assert list(keyboard.axes) == ["q/a", "w/s"]
            assert dict(keyboard.read()) == {}
            os.write(ours, b"qqqqa?w")
            found: dict[str, float] = {}
            while len(found) < 2:
                found = dict(keyboard.read())
            assert found == pytest.approx({"q/a": 0.15, "w/s": 0.05})
            os.write(ours, b" ")
            while any(found.values()):
                found = dict(keyboard.read())
            os.write(ours, b"\x1b")
            with pytest.raises(KeyboardInterrupt):
                left(keyboard)
        with pytest.raises(ConfigError, match="keys for 6"):
            Keyboard(7)
    os.close(ours)


async def test_a_recorded_stream_is_played_again(hand: Hand, tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    async with serving(hand, make_library(hand)) as served:
        recorder = Recorder(hand, RecorderSettings(folder), rate=200.0, loop=served.loop.settings)
        async with recorder:
            served.loop.add_observer(recorder)
            # As fast as the hand ticks, since each sample follows as soon as the last is taken.
            async with rtee.connect("small") as remote, remote.stream(rate=200) as stream:
                for k in range(40):
                    await stream.send({"Trig index": k / 40}, {"Trig index": 1.25}, stamp=k / 50)
                    await until(lambda k=k: served.loop.streams.status().samples > k)
            await until(lambda: served.loop.controller.stream is None)
            served.loop.remove_observer(recorder)
        samples = recorded(folder)
        assert [each.time for each in samples] == pytest.approx([k / 50 for k in range(40)])
        assert samples[20] == Played(samples[20].time, {"Trig index": 0.5}, {"Trig index": 1.25})
        assert rate_of(samples) == pytest.approx(50.0)
        async with rtee.connect("small") as remote:
            await remote.do("open")
            async with remote.stream(rate=100) as stream:
                await play(samples, stream, speed=2.0)
                await until(lambda: served.loop.streams.status().samples == 40)
                with pytest.raises(ConfigError, match="speed"):
                    await play(samples, stream, speed=0.0)


def test_a_table_of_samples(tmp_path: Path) -> None:
    table = tmp_path / "wave.csv"
    table.write_text("t,near,Trig thumb\n5.0,0.1,0.2\n5.02,0.3,\n5.5,,0.4\n")
    assert recorded(table) == [
        Played(0.0, {"near": 0.1, "Trig thumb": 0.2}, {}),
        Played(pytest.approx(0.02), {"near": 0.3}, {}),
        Played(pytest.approx(0.5), {"Trig thumb": 0.4}, {}),
    ]


def test_a_table_of_a_spreadsheet(tmp_path: Path) -> None:
    """With a byte-order mark; and where numbers have a comma, with semicolons."""
    table = tmp_path / "wave.csv"
    table.write_bytes(b"\xef\xbb\xbft,near\r\n0.00,0.1\r\n0.02,0.3\r\n")
    assert [each.targets for each in recorded(table)] == [{"near": 0.1}, {"near": 0.3}]
    table.write_bytes("\ufefft;near;push\r\n0,00;0,1;\r\n0,02;0,3;1,5\r\n".encode())
    assert [each.targets for each in recorded(table)] == [
        {"near": 0.1},
        {"near": 0.3, "push": 1.5},
    ]


def test_targets_in_another_unit_are_refused() -> None:
    limits = {"near": (-0.5, 1.2), "free": (-math.inf, math.inf)}
    fine = {"near": 1.3, "free": 99.0, "fist": -0.01}
    check_units([Played(0.0, fine, {})], limits)
    for targets, said in (
        ({"near": 45.0}, "'near' goes to 45 after 2 s, far beyond -0.5 to 1.2; .* radians"),
        ({"fist": 60.0}, "'fist' goes to 60 after 2 s, far beyond 0 to 1; .* from 0 to 1"),
    ):
        with pytest.raises(ConfigError, match=said):
            check_units([Played(0.0, fine, {}), Played(2.0, targets, {})], limits)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "'t'"),
        ("near,t\n0,0\n", "'t'"),
        ("t,near\n", "contains no samples"),
        ("t,near\n0,0.1\n0,0.2\n", "wave.csv:3: is not valid: the times must increase"),
        ("t,near\n0,0.1,5\n", "3 cells for 2 names"),
        ("t,near\n0,much\n", "wave.csv:2: is not valid: 'much' in the column 'near' is not"),
        ("t,near\n0,nan\n", "'nan' in the column 'near' is not a finite number"),
        ("t,near\n0,0\n0.02,\n", "wave.csv:3: is not valid: it has no value in the columns near"),
        ("t,near\n0,0\n20,0\n40,0\n", "wave.csv:3: has rows 20 s apart; times must be in seconds"),
    ],
)
def test_tables_that_make_no_sense(tmp_path: Path, text: str, said: str) -> None:
    table = tmp_path / "wave.csv"
    table.write_text(text)
    with pytest.raises(LogError, match=said):
        recorded(table)


async def test_a_gap_is_filled(hand: Hand) -> None:
    """A pause of the person is not a pause of the stream."""
    times = (0.0, 0.02, 0.04, 0.06, 1.3)
    samples = [Played(time, {"near": 0.1}, {}) for time in times]
    async with (
        serving(hand, make_library(hand)) as served,
        rtee.connect("small") as remote,
        remote.stream(rate=50, deadline=1.0) as stream,
    ):
        await play(samples, stream)
        assert (await stream.status()).samples >= 8
    assert "stream_paused" not in [event.kind for event in served.watcher.events]


async def test_slow_samples_are_no_gaps() -> None:
    sent: list[tuple[dict[str, float], float]] = []

    class Kept:
        async def send(
            self, targets: Any, velocity: Any = None, stamp: float | None = None
        ) -> None:
            assert stamp is not None
            sent.append((dict(targets), stamp))

    samples = [Played(k / 20, {"near": k / 10}, {}) for k in range(4)]
    await play(samples, Kept(), speed=0.4)
    assert [targets for targets, _ in sent] == [each.targets for each in samples]
    steps = [after[1] - before[1] for before, after in pairwise(sent)]
    assert steps == pytest.approx([0.125] * 3)
