"""Input devices: gamepads, through evdev, and the keyboard of a terminal.

Both are read without blocking, at the rate of a stream. Axes range from 0 (released) to 1.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, Self

from rtee.errors import ConfigError, needing_extra

EV_SYN, SYN_DROPPED = 0, 3
"""Type and code of the evdev event that follows lost events."""

EV_KEY: Final = 1
"""Type of evdev's button events (linux/input-event-codes.h)."""

EV_ABS: Final = 3
"""Type of evdev's axis events."""

TRIGGERS: Final[Mapping[str, tuple[int, ...]]] = {"rt": (5, 9), "lt": (2, 10)}
"""Codes of the triggers by name: ABS_RZ or ABS_GAS, and ABS_Z or ABS_BRAKE."""

STICKS: Final[Mapping[str, tuple[int, int]]] = {
    "up": (1, -1),  # evdev's y grows downwards
    "right": (0, 1),
    "right_up": (4, -1),
    "right_right": (3, 1),
}
"""Directions of the sticks from their centres: code (ABS_Y, ABS_X, ABS_RY, ABS_RX) and sign."""

BUTTONS: Final[Mapping[str, int]] = {"a": 304, "b": 305, "x": 307, "y": 308, "rb": 311, "lb": 310}
"""Buttons by name: BTN_SOUTH, BTN_EAST, BTN_NORTH, BTN_WEST, BTN_TR, BTN_TL."""

_DEAD: Final = 0.08
"""Dead zone of a stick or trigger around its released position, as a share of its range: sticks
rarely return to exactly the same value."""

_STEP: Final = 0.05
"""Change of an axis per key press; a terminal repeats a held key about 30 times per second."""

KEYS: Final = (("q", "a"), ("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("z", "h"))
"""Keys of each axis: the first increases it, the second decreases it."""


class Input(Protocol):
    """An input device."""

    @property
    def axes(self) -> Sequence[str]:
        """Names of the axes, in the order in which actions are assigned to them."""

    def read(self) -> Mapping[str, float]:
        """Return the values, 0 to 1, of the axes moved so far, without blocking.

        Raises `OSError` if the device is gone, and `KeyboardInterrupt` if the person ends the
        input.
        """


class InputEvent(Protocol):
    """An evdev event."""

    type: int
    code: int
    value: int


class EventDevice(Protocol):
    """A source of input events, such as ``evdev.InputDevice``."""

    def read(self) -> Iterable[Any]:
        """Return the events since the last call; raise `BlockingIOError` if there are none."""

    def absinfo(self, axis_num: int) -> Any:
        """Return the range of an axis, ``min`` and ``max``, and its current ``value``."""

    def active_keys(self) -> Iterable[Any]:
        """Return the codes of the pressed buttons."""


@dataclass(slots=True)
class _AxisEvent:
    """The current value of an axis, in the form of an event."""

    type: int
    code: int
    value: int


class Gamepad:
    """A gamepad, read from its input events; the device must be in non-blocking mode."""

    axes: Sequence[str] = (*TRIGGERS, *STICKS, *BUTTONS)

    def __init__(self, device: EventDevice) -> None:
        self._device = device
        self._ranges: dict[int, tuple[float, float]] = {}
        self._moved: dict[str, float] = {}

    def read(self) -> Mapping[str, float]:
        """See `Input.read`."""
        lost = False
        try:
            for event in self._device.read():
                lost |= (event.type, event.code) == (EV_SYN, SYN_DROPPED)
                self._take(event)
        except BlockingIOError:
            pass
        if lost:
            self._look()
        return self._moved

    def _look(self) -> None:
        """Read the current values of all moved axes, since lost events may have released some."""
        for code in tuple(self._ranges):
            self._take(_AxisEvent(EV_ABS, code, self._device.absinfo(code).value))
        pressed = set(self._device.active_keys())
        for name, code in BUTTONS.items():
            if name in self._moved:
                self._moved[name] = float(code in pressed)

    def _take(self, event: InputEvent) -> None:
        if event.type == EV_KEY:
            for name, code in BUTTONS.items():
                if event.code == code:
                    self._moved[name] = float(bool(event.value))
        elif event.type == EV_ABS:
            share = self._share(event)
            for name, codes in TRIGGERS.items():
                if event.code in codes:
                    self._moved[name] = _beyond_rest(share)
            for name, (code, sign) in STICKS.items():
                if event.code == code:
                    self._moved[name] = _beyond_rest(sign * (2.0 * share - 1.0))

    def _share(self, event: InputEvent) -> float:
        """Return the value of an axis as a share of its range, 0 to 1."""
        # Cached, since a range never changes and reading it is a system call.
        if event.code not in self._ranges:
            info = self._device.absinfo(event.code)
            self._ranges[event.code] = (float(info.min), float(info.max))
        low, high = self._ranges[event.code]
        return min(max((event.value - low) / (high - low), 0.0), 1.0) if high > low else 0.0


def _beyond_rest(share: float) -> float:
    return min(max((share - _DEAD) / (1.0 - _DEAD), 0.0), 1.0)


def open_gamepad(path: str | None = None) -> Gamepad:
    """Return the first gamepad, or the one at a path such as ``/dev/input/event5``.

    Raises `ConfigError` if there is none, or it cannot be read, and `MissingExtra` if evdev is not
    installed.
    """
    with needing_extra("a gamepad", "teleop"):
        import evdev
    try:
        for each in [path] if path else sorted(evdev.list_devices()):
            device = evdev.InputDevice(each)
            axes = {axis for axis, _ in device.capabilities().get(EV_ABS, ())}
            # Touchpads and tablets also have axes, but only gamepads have triggers.
            if path or axes.intersection(code for codes in TRIGGERS.values() for code in codes):
                # Non-blocking, since samples are also due while nothing moves.
                os.set_blocking(device.fd, False)
                return Gamepad(device)
            device.close()
    except OSError as error:
        raise ConfigError(f"the gamepad cannot be read: {error}") from None
    raise ConfigError(
        "no gamepad can be read here; if one is connected, your user may need to be in the group "
        "'input'"
    )


class Keyboard:
    """The keyboard of the terminal: pairs of keys move up to six axes; use it as a context.

    Raises `ConfigError` for more axes, or if the input is not a terminal.
    """

    def __init__(self, axes: int) -> None:
        if axes > len(KEYS):
            raise ConfigError(f"the keyboard has keys for {len(KEYS)} actions, not {axes}")
        if not sys.stdin.isatty():
            raise ConfigError("the keyboard is read from a terminal; the standard input is not one")
        self.axes: Sequence[str] = tuple(f"{more}/{less}" for more, less in KEYS[:axes])
        self._file = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._file)
        self._moved: dict[str, float] = {}

    def __enter__(self) -> Self:
        """Turn off the terminal's line mode and echo; Ctrl-C still interrupts."""
        tty.setcbreak(self._file)
        return self

    def __exit__(self, *_: object) -> None:
        termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)

    def read(self) -> Mapping[str, float]:
        """See `Input.read`."""
        while select.select([self._file], [], [], 0.0)[0]:
            keys = os.read(self._file, 256)
            # Escape only if it is alone, since the codes of arrow keys start with it.
            if not keys or keys == b"\x1b" or b"\x04" in keys:  # closed, Escape or Ctrl-D
                raise KeyboardInterrupt
            # The bytes may end inside a character; the keys of axes are ASCII.
            for key in keys.decode("utf-8", "ignore"):
                self._press(key)
        return self._moved

    def _press(self, key: str) -> None:
        if key == " ":  # releases all axes
            self._moved = dict.fromkeys(self.axes, 0.0)
        for axis, pair in zip(self.axes, KEYS, strict=False):
            if key in pair:
                change = _STEP if key == pair[0] else -_STEP
                self._moved[axis] = min(max(self._moved.get(axis, 0.0) + change, 0.0), 1.0)
