"""`rtee teleop` and `rtee stream`: move a hand from a gamepad, the keyboard or a recording."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import AsyncIterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rtee.cli._common import (
    Commands,
    ConnectOption,
    EffortOption,
    RunningOption,
    WaitOption,
    effort_limits,
    with_hand,
)
from rtee.errors import ConfigError, needing_extra

if TYPE_CHECKING:
    from rtee.actions.cli_syntax import Efforts
    from rtee.remote.client import RemoteHand
    from rtee.retarget.frames import TrackerFrame
    from rtee.retarget.layouts import Side
    from rtee.retarget.retargeter import Retargeter
    from rtee.teleop.inputs import Input


_PASS = 0.05
"""Wait after the last sample, so that the status counts it, too [s]: several ticks of any hand."""

app = Commands()


def teleop(
    actions: list[str] | None = None,
    *,
    gamepad: bool = False,
    keyboard: bool = False,
    landmarks: str | None = None,
    layout: str = "mediapipe",
    side: str = "right",
    device: str | None = None,
    rate: float = 50.0,
    effort: EffortOption = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
) -> None:
    """Move a hand by actions, from a gamepad or the keyboard, or as a person's hand moves.

    Ends with Ctrl-C, or when the points end.

    Example: rtee teleop --gamepad "rt=PinchTight index thumb" "lt=Trig ring"

    Arguments and options:
        actions ([AXIS=]ACTION…): Actions with their elements, each quoted: 'PinchTight index
            thumb'; with an axis before it, otherwise on the next free axis: rt lt up right right_up
            right_right a b x y rb lb.
        gamepad: From a gamepad.
        keyboard: From the keyboard: q/a, w/s, e/d, …; space opens.
        landmarks (FILE|-): Points of a person's hand: lines of JSON, or .npz; - reads them from
            standard input.
        layout: With --landmarks: their order and unit: mediapipe webxr leap manus manus21 mano.
        side: With --landmarks: which of the person's hands: right or left.
        device (PATH): With --gamepad: which one, such as /dev/input/event5.
        rate: Samples per second.
    """
    if gamepad + keyboard + (landmarks is not None) != 1:
        raise ConfigError("give one of --gamepad, --keyboard and --landmarks")
    if landmarks is not None:
        if actions:
            raise ConfigError("--landmarks moves the whole hand: leave out the actions")

        follow_landmarks(landmarks, layout, side, rate, effort or [], hand, connect, wait)
        return
    if not actions:
        raise ConfigError("give the actions that the axes move, such as 'PinchTight index thumb'")
    from rtee.actions.cli_syntax import read_efforts
    from rtee.teleop.drive import assigned
    from rtee.teleop.inputs import Keyboard, open_gamepad

    efforts = read_efforts(effort or [])
    with contextlib.ExitStack() as stack:
        # The context of the keyboard turns the terminal's echo on again, however this ends.
        source: Input = (
            open_gamepad(device) if gamepad else stack.enter_context(Keyboard(len(actions)))
        )
        by_axis = assigned(actions, source.axes)
        for axis, action in by_axis.items():
            print(f"{axis}: {action}", file=sys.stderr)
        # Ctrl-C and Escape are the usual end, not a failure.
        with contextlib.suppress(KeyboardInterrupt):
            with_hand(
                hand,
                connect,
                "teleop",
                lambda remote: _drive(remote, source, by_axis, rate, efforts),
                wait=wait,
            )


async def _drive(
    remote: RemoteHand, source: Input, by_axis: dict[str, str], rate: float, efforts: Efforts
) -> None:
    from rtee.teleop.drive import samples_of

    async with remote.stream(rate=rate, effort=await effort_limits(remote, efforts)) as stream:
        try:
            async for targets in samples_of(source, by_axis, rate):
                await stream.send(targets)
        except OSError as error:
            raise ConfigError(f"the gamepad was disconnected: {error}") from None


@app.command()
def play(
    file: Path,
    *,
    speed: float = 1.0,
    effort: EffortOption = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
) -> None:
    """Play the samples of a recorded stream, or of a table, to a running hand.

    Example: rtee stream play logs

    Arguments and options:
        file (FILE): A recording (.mcap, or its folder), or a .csv.
        speed: Scale of time: 2 is twice as fast.
    """
    import anyio

    from rtee.actions.cli_syntax import read_efforts
    from rtee.teleop.drive import check_units, rate_of, recorded
    from rtee.teleop.drive import play as play_samples

    # Read before the hand is connected, so that a wrong file moves nothing.
    samples, efforts = recorded(file), read_efforts(effort or [])
    if not 0.0 < speed < math.inf:
        raise ConfigError(f"the speed must be above 0, not {speed:g}")

    async def run(remote: RemoteHand) -> None:
        info = await remote.info()
        limits_of = dict.fromkeys(info.joints, (-math.inf, math.inf))
        check_units(samples, limits_of | {a.name: (a.lower, a.upper) for a in info.actuators})
        rate = rate_of(samples) * speed
        limits = await effort_limits(remote, efforts)
        # Three periods, so that one or two late samples do not make the hand brake.
        async with remote.stream(rate, deadline=max(0.1, 3.0 / rate), effort=limits) as stream:
            await play_samples(samples, stream, speed)
            await anyio.sleep(_PASS)
            sent = await stream.status()
        print(f"{sent.samples} samples in {samples[-1].time / speed:.1f} s, ", end="")
        print(f"lag {sent.lag * 1e3:.1f} ms, {sent.late} late")

    with_hand(hand, connect, "stream", run, wait=wait)


@app.callback()
def _streams() -> None:
    """Stream set-points to a running hand."""


_HEADSET = 60.0
"""Samples per second that a headset sends at least [Hz]."""


def follow_landmarks(
    source: str,
    layout: str,
    side: str,
    rate: float,
    effort: Sequence[str],
    hand: str | None,
    connect: str | None,
    wait: float | None,
) -> None:
    """Move a hand by points in a file, or by those on the standard input (``-``).

    Raises:
        UserError: if the points, the hand or an option cannot be used.
    """
    import anyio

    from rtee.actions.cli_syntax import read_efforts

    with needing_extra("retargeting", "retarget"):
        from rtee.retarget import frames as tracker
        from rtee.retarget.layouts import layout_named, side_named
    efforts, known, chosen = read_efforts(list(effort)), layout_named(layout), side_named(side)
    # Read before the hand is connected, so that a wrong file moves nothing.
    frames: Sequence[TrackerFrame] = ()
    if source != "-":
        frames = tracker.read_frames(Path(source), known, chosen)
        rate = (len(frames) - 1) / max(frames[-1].stamp - frames[0].stamp, 1e-3) or rate

    async def run(remote: RemoteHand) -> None:
        reader = tracker.FrameReader(known, chosen, "the standard input")
        coming: AsyncIterable[TrackerFrame] = (
            tracker.due(frames) if frames else tracker.live(anyio.wrap_file(sys.stdin), reader)
        )
        limits = await effort_limits(remote, efforts)
        sent, retargeter = await _follow(remote, coming, chosen, rate, limits)
        print(f"{sent} frames followed, {retargeter.dropped} dropped as outliers", file=sys.stderr)

    # Ctrl-C is the usual end, not a failure.
    with contextlib.suppress(KeyboardInterrupt):
        with_hand(hand, connect, "teleop", run, wait=wait)


async def follow_headset(
    lines: AsyncIterable[str], side: str, hand: str | None, endpoint: str | None
) -> None:
    """Move a running hand by the joints of a hand in WebXR, a frame of them in each line.

    Raises:
        UserError: if there are no joints, or not those of that side.
        RemoteError: if the hand does not run, or refuses the stream.
    """
    from rtee.remote.client import connect

    with needing_extra("retargeting", "retarget"):
        from rtee.retarget import frames as tracker
        from rtee.retarget.layouts import LAYOUTS, side_named
    reader = tracker.FrameReader(LAYOUTS["webxr"], side_named(side), "the headset")
    async with connect(hand, endpoint=endpoint, client="rtee-headset") as remote:
        await _follow(remote, tracker.live(lines, reader), side_named(side), _HEADSET, {})


async def _follow(
    remote: RemoteHand,
    frames: AsyncIterable[TrackerFrame],
    side: Side,
    rate: float,
    efforts: Mapping[str, float],
) -> tuple[int, Retargeter]:
    """Stream the postures for the frames; return the number of frames, and the retargeter."""
    import anyio.to_thread

    from rtee.retarget.frames import follow as follow_frames
    from rtee.retarget.retargeter import Retargeter

    info = await remote.info()
    # It reads meshes: in a thread, so that others are served at the same time.
    retargeter = await anyio.to_thread.run_sync(partial(Retargeter.of, info.name, side=side))
    _check_actuators(retargeter, [actuator.name for actuator in info.actuators])
    retargeter.begin((await remote.state()).positions)
    async with remote.stream(rate, effort=efforts) as stream:

        async def send(positions: Mapping[str, float], stamp: float) -> None:
            await stream.send(positions, stamp=stamp)

        return await follow_frames(frames, retargeter, send), retargeter


def _check_actuators(retargeter: Retargeter, actuators: Sequence[str]) -> None:
    if list(retargeter.hand.actuator_names) != list(actuators):
        raise ConfigError(
            f"the running {retargeter.hand.name} differs in its actuators from the hand of that "
            "name "
            "here: its folder should be the same"
        )
