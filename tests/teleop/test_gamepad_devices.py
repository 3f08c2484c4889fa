"""Gamepads as Linux has them: a virtual one (uinput), and events as the kernel writes them."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtee.errors import ConfigError
from rtee.teleop.inputs import EV_ABS, EV_KEY, Gamepad, open_gamepad

EVENT = struct.Struct("llHHi")
"""``struct input_event`` of linux/input.h on 64-bit systems: seconds, microseconds, type, code,
value."""

RANGES = {2: (0, 1023), 5: (0, 1023), 0: (-32768, 32767), 1: (-32768, 32767)}
"""Ranges of ABS_Z, ABS_RZ, ABS_X and ABS_Y as the kernel's xpad driver declares them."""

UINPUT = "/dev/uinput"


def packets() -> list[list[tuple[int, int, int]]]:
    """Return what a person does: presses the right trigger, a stick, a button; lets go of all."""
    return [
        [(EV_ABS, 5, value) for value in (130, 512, 1023)],
        [(EV_ABS, 1, -32768), (EV_KEY, 304, 1), (EV_ABS, 2, 40)],
        [(EV_ABS, 5, 0), (EV_ABS, 1, 0), (EV_KEY, 304, 0)],
    ]


def raw(packet: list[tuple[int, int, int]], at: float = 1.5) -> bytes:
    """Return the bytes of events, with the report (EV_SYN) that ends them."""
    seconds, micros = int(at), int(1e6 * (at % 1.0))
    return b"".join(EVENT.pack(seconds, micros, *event) for event in (*packet, (0, 0, 0)))


class Raw:
    """Reads the bytes of events, as `evdev.InputDevice` does."""

    def __init__(self, fd: int) -> None:
        self.fd = fd

    def read(self) -> Iterator[Any]:
        for _, _, kind, code, value in EVENT.iter_unpack(os.read(self.fd, 64 * EVENT.size)):
            yield SimpleNamespace(type=kind, code=code, value=value)

    def absinfo(self, axis_num: int) -> Any:
        low, high = RANGES[axis_num]
        return SimpleNamespace(min=low, max=high)


def through_evdev(fd: int) -> Any:
    """Return evdev's own reader of a pipe: the constructor would ask it which device it is."""
    evdev = pytest.importorskip("evdev", reason="needs the extra 'teleop'")

    class Piped(evdev.InputDevice):  # type: ignore[misc]
        def __new__(cls, *_: Any) -> Any:
            return object.__new__(cls)

        def __init__(self, fd: int) -> None:
            self.fd = fd

        def close(self) -> None:
            """The pipe is not its own."""

        __del__ = close
        absinfo = Raw.absinfo

    return Piped(fd)


def read_on(gamepad: Gamepad) -> None:
    while True:
        gamepad.read()


@pytest.mark.parametrize("reader", [Raw, through_evdev], ids=["bytes", "evdev"])
def test_the_events_of_the_kernel_are_read(reader: Any) -> None:
    ours, theirs = os.pipe()
    os.set_blocking(ours, False)
    try:
        gamepad = Gamepad(reader(ours))
        assert dict(gamepad.read()) == {}
        pressed, more, let_go = packets()
        os.write(theirs, raw(pressed))
        assert dict(gamepad.read()) == {"rt": 1.0}
        os.write(theirs, raw(more))
        assert dict(gamepad.read()) == {"rt": 1.0, "up": 1.0, "a": 1.0, "lt": 0.0}
        assert dict(gamepad.read()) == {"rt": 1.0, "up": 1.0, "a": 1.0, "lt": 0.0}
        os.write(theirs, raw(let_go))
        found = dict(gamepad.read())
        assert found["rt"] == found["up"] == found["a"] == 0.0
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.skipif(
    not os.access(UINPUT, os.W_OK), reason=f"{UINPUT} is not there, or not for this user"
)
def test_a_virtual_gamepad_is_found_and_read() -> None:
    evdev = pytest.importorskip("evdev", reason="needs the extra 'teleop'")
    axes = [(code, evdev.AbsInfo(0, low, high, 0, 0, 0)) for code, (low, high) in RANGES.items()]
    with evdev.UInput({EV_ABS: axes, EV_KEY: [304, 305]}, name="rtee test pad") as pad:
        gamepad = open_gamepad(pad.device.path)
        assert dict(gamepad.read()) == {}
        for packet in packets()[:2]:
            for event in packet:
                pad.write(*event)
            pad.syn()
        while len(gamepad.read()) < 3:
            time.sleep(0.01)
        found = dict(gamepad.read())
        assert (found["rt"], found["up"], found["a"]) == (1.0, 1.0, 1.0)
    with pytest.raises(OSError, match=r"\[Errno 19\]"):  # ENODEV: it was pulled out
        read_on(gamepad)


def test_what_is_no_input_device_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("evdev", reason="needs the extra 'teleop'")
    file = tmp_path / "event0"
    file.write_bytes(b"")
    for path in (file, tmp_path / "missing"):
        with pytest.raises(ConfigError, match="the gamepad cannot be read"):
            open_gamepad(str(path))
