"""What a person moves: gamepads as evdev has them, and keys of a terminal.

Both are read without waiting, as often as a stream has samples. Axes are 0 (let go) to 1.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Protocol, Self

from rtee.errors import ConfigError, needing_extra

EV_SYN, SYN_DROPPED = 0, 3
"""Type and code of evdev's event that says that others before it were lost."""

EV_KEY: Final = 1
"""Type of evdev's events of buttons (linux/input-event-codes.h)."""

EV_ABS: Final = 3
"""Type of evdev's events of axes."""

TRIGGERS: Final[Mapping[str, tuple[int, ...]]] = {"rt": (5, 9), "lt": (2, 10)}
"""Triggers by name, with the codes they may have: ABS_RZ or ABS_GAS, ABS_Z or ABS_BRAKE."""

STICKS: Final[Mapping[str, tuple[int, int]]] = {
    "up": (1, -1),  # evdev's y grows downwards
    "right": (0, 1),
    "right_up": (4, -1),
    "right_right": (3, 1),
}
"""Halves of sticks from their centre outwards: code (ABS_Y, ABS_X, ABS_RY, ABS_RX) and sign."""

BUTTONS: Final[Mapping[str, int]] = {"a": 304, "b": 305, "x": 307, "y": 308, "rb": 311, "lb": 310}
"""Buttons by name: BTN_SOUTH, BTN_EAST, BTN_NORTH, BTN_WEST, BTN_TR, BTN_TL."""

_DEAD: Final = 0.08
"""Part of a stick's or trigger's way around its rest that counts as nothing: they rarely come back
to the very same value."""

_STEP: Final = 0.05
"""A key press changes an axis by this much; held, a terminal repeats it 30 times a second."""

KEYS: Final = (("q", "a"), ("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("z", "h"))
"""The keys of each axis: more and less."""


class Input(Protocol):
    """Something that a person moves."""

    @property
    def axes(self) -> Sequence[str]:
        """Names of its axes, the best one first."""

    def read(self) -> Mapping[str, float]:
        """Return the axes that have been moved so far, 0 to 1; does not wait.

        Raises:
            OSError: if the device is gone.
            KeyboardInterrupt: if the person wants to leave.
        """


class InputEvent(Protocol):
    """An event as evdev has it."""

    type: int
    code: int
    value: int


class EventDevice(Protocol):
    """A device of input events, as ``evdev.InputDevice`` is one."""

    def read(self) -> Iterable[Any]:
        """Return the events since the last call; raises `BlockingIOError` if there are none."""

    def absinfo(self, axis_num: int) -> Any:
        """Return an axis: its range, ``min`` and ``max``, and where it is now, ``value``."""

    def active_keys(self) -> Iterable[Any]:
        """Return the codes of the buttons that are pressed now."""


@dataclass(slots=True)
class _Seen:
    """Where an axis is, as an event would tell it."""

    type: int
    code: int
    value: int


class Gamepad:
    """A gamepad, read from its input events.

    Args:
        device: The device, opened without waiting.
    """

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
        """Take where all is that was moved before: what was let go may be among what was lost."""
        for code in tuple(self._ranges):
            self._take(_Seen(EV_ABS, code, self._device.absinfo(code).value))
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
        """Return where an axis is in its range, 0 to 1."""
        # A range never changes, and asking for it is a system call.
        if event.code not in self._ranges:
            info = self._device.absinfo(event.code)
            self._ranges[event.code] = (float(info.min), float(info.max))
        low, high = self._ranges[event.code]
        return min(max((event.value - low) / (high - low), 0.0), 1.0) if high > low else 0.0


def _beyond_rest(share: float) -> float:
    return min(max((share - _DEAD) / (1.0 - _DEAD), 0.0), 1.0)


def open_gamepad(path: str | None = None) -> Gamepad:
    """Return a gamepad.

    Args:
        path: Its device, such as ``/dev/input/event5``; ``None``: the first one that there is.

    Raises:
        ConfigError: if there is none, or it cannot be read; `MissingExtra` without evdev.
    """
    with needing_extra("a gamepad", "teleop"):
        import evdev
    try:
        for each in [path] if path else sorted(evdev.list_devices()):
            device = evdev.InputDevice(each)
            axes = {axis for axis, _ in device.capabilities().get(EV_ABS, ())}
            # Touchpads and tablets have axes, too; what has a trigger is taken for a gamepad.
            if path or axes.intersection(code for codes in TRIGGERS.values() for code in codes):
                # Reading must not wait for an event: samples are due while nothing moves, too.
                os.set_blocking(device.fd, False)
                return Gamepad(device)
            device.close()
    except OSError as error:
        raise ConfigError(f"the gamepad cannot be read: {error}") from None
    raise ConfigError(
        "there is no gamepad among the input devices that can be read here; your user may have to "
        "be in the group 'input'"
    )


class Keyboard:
    """Keys of the terminal: pairs of them move axes up and down; a context.

    Args:
        axes: Number of axes, up to six.

    Raises:
        ConfigError: if there are more, or the input is not a terminal.
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
        """Have keys arrive one by one, and unseen; Ctrl-C still interrupts."""
        tty.setcbreak(self._file)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)

    def read(self) -> Mapping[str, float]:
        """See `Input.read`."""
        while select.select([self._file], [], [], 0.0)[0]:
            keys = os.read(self._file, 256)
            # Escape only if it came alone: the codes of arrow keys begin with it.
            if not keys or keys == b"\x1b" or b"\x04" in keys:  # closed, Escape or Ctrl-D
                raise KeyboardInterrupt
            # What was read may end within a character; the keys of axes are all ASCII.
            for key in keys.decode("utf-8", "ignore"):
                self._press(key)
        return self._moved

    def _press(self, key: str) -> None:
        if key == " ":  # lets go of everything
            self._moved = dict.fromkeys(self.axes, 0.0)
        for axis, pair in zip(self.axes, KEYS, strict=False):
            if key in pair:
                change = _STEP if key == pair[0] else -_STEP
                self._moved[axis] = min(max(self._moved.get(axis, 0.0) + change, 0.0), 1.0)
