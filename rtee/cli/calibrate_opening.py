"""`rtee calibrate HAND --opening`: the openings of a real hand, measured with gauge blocks.

The running hand closes gently on a block whose width is known. The intensity at which the hand
stops and the width of the block are a pair. Each pair is written into hand.yaml at once, so that
an interrupted command loses none, and the next one goes on from there.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rtee.cli._common import actions_of, hand_folder, owned
from rtee.errors import ActionError, ConfigError, GoalRejected, RequestRejected

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.actions.openings import Opening
    from rtee.actions.types import Action
    from rtee.remote.client import RemoteHand

_SPEED: Final = 0.2
"""Share of the velocity limits: slow enough that a block is not pushed away."""

_EFFORT: Final = 0.25
"""Share of the effort limits: enough to overcome friction, too little to bend the fingers."""

_UNLIMITED: Final = "takes no effort limit"
"""Words by which a refusal says that a device cannot limit its effort."""

_SAME: Final = 1e-4
"""Two blocks whose widths differ by less than this are the same [m]: gauge blocks are ground."""

_BEYOND: Final = 0.01
"""Excess of a real hand's widest opening over its model's that is still believed [m]."""


def calibrate_opening(name: str, words: Sequence[str]) -> None:
    """Measure the openings of actions of a running hand, block by block.

    The actions are given as for `rtee compose`; without any, all that have an opening are measured.
    Raises `UserError` if an action has none, or hand.yaml cannot be changed.
    """
    from rtee.cli._online import with_hand
    from rtee.hand.own_copy import own_place

    folder = hand_folder(name)
    own_place(folder)  # a folder that cannot be written is refused before the work
    library = actions_of(name)
    chosen = _chosen(library, words)
    # Before the first block, since each pair is stored as soon as it is measured.
    home = owned(folder)

    async def execute(remote: RemoteHand) -> None:
        # A person's fingers are at the hand: no other client may move it between blocks.
        async with remote.lease():
            for action, opening in chosen:
                await _Blocks(remote, library, home, action, opening).measure()

    with_hand(library.hand.name, None, "calibrate", execute)
    print("goals use what was measured from the next `rtee run` on")


def _chosen(library: ActionLibrary, words: Sequence[str]) -> list[tuple[Action, Opening]]:
    """Return the actions given on the command line, with their openings by the model."""
    from rtee.actions.types import ActionReference

    openings, chosen = library.openings, []
    reason = f"there are none; 'rtee extract {library.hand.name} --save' finds them"
    if words:
        uses = [ActionReference.of(word) for word in words]
        named = [library.find(use.action, use.elements) for use in uses]
        return [(action, openings.of(action)) for action in named]
    for action in library:
        try:
            chosen.append((action, openings.of(action)))
        except ActionError as error:
            reason = str(error)
    if not chosen:
        raise ConfigError(f"no action of '{library.hand.name}' has an opening: {reason}")
    return chosen


class _Blocks:
    """Measurement of one action with one block after another."""

    def __init__(
        self,
        remote: RemoteHand,
        library: ActionLibrary,
        home: Path,
        action: Action,
        opening: Opening,
    ) -> None:
        self._remote, self._hand, self._home = remote, library.hand, home
        self._action, self._opening = action, opening
        self._pairs = list(library.openings.measured(action))
        self._limited = True

    async def measure(self) -> None:
        """Ask for blocks and measure them until the user enters an empty line."""
        label = self._opening.label
        words = " ".join((self._action.name, *self._action.elements))
        for at, known in self._pairs:
            print(f"{label}: measured before: {1e3 * known:g} mm at {at:.4f}")
        while True:
            width = await self._width()
            if width is None:
                return
            # Open, so that the block fits in.
            await self._go(0.0)
            await typed_line(f"{label}: hold the block between the fingertips, then press Enter. ")
            intensity = await self._contact()
            await self._go(0.0)
            if intensity is None:
                print(f"{label}: the fingertips met nothing; this block is not taken", flush=True)
                continue
            kept = [pair for pair in self._pairs if abs(pair[1] - width) > _SAME]
            self._pairs = sorted([*kept, (round(intensity, 5), round(width, 6))])
            path = write_pairs(self._home, words, self._pairs)
            print(f"{label}: {1e3 * width:g} mm at {intensity:.4f}; stored in {path}", flush=True)

    async def _width(self) -> float | None:
        """Ask for the width of the next block [m] until it is valid; ``None``: no more blocks."""
        from rtee.units import LENGTH, quantity

        label, widest = self._opening.label, self._opening.widest
        while True:
            line = await typed_line(
                f"{label}: width of the next block, such as 30mm; Enter to end: "
            )
            if not line:
                return None
            try:
                width = quantity(line, LENGTH, "width")
            except GoalRejected as error:
                print(error, flush=True)
                continue
            if 0.0 < width <= widest + _BEYOND:
                return width
            print(f"{label} opens to {1e3 * widest:.1f} mm, not {1e3 * width:g} mm", flush=True)

    async def _contact(self) -> float | None:
        """Close gently; return the intensity at which the fingertips stopped, if they did."""
        result = await self._go(1.0)
        if not result:
            return None
        measured, last = (await self._remote.state()).positions, self._action.waypoints[-1]
        moved = [(self._hand.actuator(name), measured[name]) for name in last.involved]
        path = [(last.position[spec.name] - spec.rest, at - spec.rest) for spec, at in moved]
        # Project the measured posture onto the straight path from rest to the last waypoint.
        return sum(whole * part for whole, part in path) / sum(whole * whole for whole, _ in path)

    async def _go(self, intensity: float) -> bool:
        """Go to an intensity of the action; return whether the fingers met an obstacle."""
        name, elements = self._action.name, self._action.elements
        limits: Mapping[str, float] = {}
        if self._limited:
            limits = await self._remote.effort_limits(_EFFORT, self._action.waypoints[-1].involved)
        try:
            result = await self._remote.do(
                name, *elements, intensity=intensity, speed=_SPEED, effort=limits
            )
        except RequestRejected as error:
            if not limits or _UNLIMITED not in str(error):
                raise
            # Remembered, so that the limit is not requested in vain for each block.
            self._limited = False
            print(f"{error}; it closes with its own force, at {_SPEED:.0%} speed", flush=True)
            return await self._go(intensity)
        return result.grasped or result.stalled


async def _readable(descriptor: int) -> None:
    """Wait until a file descriptor has bytes to read."""
    loop, ready = asyncio.get_running_loop(), asyncio.Event()
    try:
        loop.add_reader(descriptor, ready.set)
    except PermissionError:  # a file is always readable
        return
    try:
        await ready.wait()
    finally:
        loop.remove_reader(descriptor)


_typed = bytearray()
"""Bytes that were typed ahead of the question."""


async def typed_line(text: str) -> str:
    """Print a prompt and return the line typed; an empty line at the end of the input.

    Reads without a thread: a thread that reads the terminal would keep Ctrl-C from ending the
    command.
    """
    print(text, end="", flush=True)
    # Not through `sys.stdin`: the event loop would not notice lines in its buffer.
    stdin = sys.stdin.fileno()
    while b"\n" not in _typed:
        await _readable(stdin)
        # Ctrl-C takes back what a terminal has not handed on yet: a read that waits would then keep
        # the command from ending.
        blocking = os.get_blocking(stdin)
        os.set_blocking(stdin, False)
        try:
            chunk = os.read(stdin, 4096)  # a terminal's line has at most 4095 bytes
        except BlockingIOError:
            continue
        finally:
            os.set_blocking(stdin, blocking)
        if not chunk:
            break
        _typed.extend(chunk)
    line, _, rest = bytes(_typed).partition(b"\n")
    _typed[:] = rest
    # A byte that is not UTF-8 makes an invalid width, and the question is repeated.
    return line.decode(errors="replace").strip()


def write_pairs(home: Path, words: str, pairs: Sequence[tuple[float, float]]) -> Path:
    """Write the intensities and openings [m] measured for an action into hand.yaml; comments stay.

    The words are the action and its elements. Raises `ConfigError` if the file cannot be changed;
    its message has the line to type.
    """
    from rtee.actions.comments import rewritten
    from rtee.hand.catalog import FILE_NAME
    from rtee.hand.files import write_atomically
    from rtee.hand.yamlfile import parse_yaml, read_text

    path = home / FILE_NAME
    text = read_text(path, FILE_NAME)
    data = dict(parse_yaml(text, path, FILE_NAME).data)
    # The file may name the same elements in another order.
    before = dict(data.get("openings") or {})
    key = next((each for each in before if _key(each) == _key(words)), words)
    data["openings"] = {**before, key: [list(pair) for pair in pairs]}
    changed = rewritten(text, data)
    if changed is None:
        line = f"openings: {{{key}: {data['openings'][key]}}}"
        raise ConfigError(f"cannot be changed with its comments kept; type: {line}", path=path)
    write_atomically(path, changed)
    return path


def _key(words: str) -> tuple[str, frozenset[str]]:
    from rtee.actions.naming import normalise

    name, *elements = words.split()
    return normalise(name), frozenset(elements)
