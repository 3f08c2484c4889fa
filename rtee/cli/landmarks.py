"""`rtee teleop --landmarks`: a running hand follows the points of a person's hand."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import AsyncIterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rtee.cli._online import effort_limits, with_hand
from rtee.errors import ConfigError

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand
    from rtee.retarget.frames import TrackerFrame
    from rtee.retarget.layouts import Side
    from rtee.retarget.retargeter import Retargeter

_HEADSET = 60.0
"""Samples per second that a headset sends at least [Hz]."""


def follow(
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
        UserError: The points, the hand or an option can't be used.
    """
    import anyio

    from rtee.actions.cli_syntax import read_efforts
    from rtee.errors import needing_extra

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
        sent, retargeter = await _drive(remote, coming, chosen, rate, limits)
        print(f"{sent} frames followed, {retargeter.dropped} dropped as outliers", file=sys.stderr)

    # Ctrl-C is the usual end, not a failure.
    with contextlib.suppress(KeyboardInterrupt):
        with_hand(hand, connect, "teleop", run, wait=wait)


async def follow_headset(
    lines: AsyncIterable[str], side: str, hand: str | None, endpoint: str | None
) -> None:
    """Move a running hand by the joints of a hand in WebXR, a frame of them in each line.

    Raises:
        UserError: There are no joints, or not those of that side.
        RemoteError: The hand does not run, or refuses the stream.
    """
    from rtee.errors import needing_extra
    from rtee.remote.client import connect

    with needing_extra("retargeting", "retarget"):
        from rtee.retarget import frames as tracker
        from rtee.retarget.layouts import LAYOUTS, side_named
    reader = tracker.FrameReader(LAYOUTS["webxr"], side_named(side), "the headset")
    async with connect(hand, endpoint=endpoint, client="rtee-headset") as remote:
        await _drive(remote, tracker.live(lines, reader), side_named(side), _HEADSET, {})


async def _drive(
    remote: RemoteHand,
    frames: AsyncIterable[TrackerFrame],
    side: Side,
    rate: float,
    efforts: Mapping[str, float],
) -> tuple[int, Retargeter]:
    """Send the answers to frames, and return how many, and what answered."""
    import anyio.to_thread

    from rtee.retarget.frames import follow as follow_frames
    from rtee.retarget.retargeter import Retargeter

    info = await remote.info()
    # It reads meshes: in a thread, so that others are served at the same time.
    retargeter = await anyio.to_thread.run_sync(partial(Retargeter.of, info.name, side=side))
    _check(retargeter, [actuator.name for actuator in info.actuators])
    retargeter.begin((await remote.state()).positions)
    async with remote.stream(rate, effort=efforts) as stream:

        async def send(positions: Mapping[str, float], stamp: float) -> None:
            await stream.send(positions, stamp=stamp)

        return await follow_frames(frames, retargeter, send), retargeter


def _check(retargeter: Retargeter, actuators: Sequence[str]) -> None:
    if list(retargeter.hand.actuator_names) != list(actuators):
        raise ConfigError(
            f"the running {retargeter.hand.name} has other actuators than the hand of that name "
            "here: its folder should be the same"
        )
