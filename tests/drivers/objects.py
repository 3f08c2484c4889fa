"""Objects in the way of emulated motors, and grips as another program may have left them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rtee.drivers.axis import VirtualObject
from rtee.drivers.inspire_rh56.codec import OPEN
from rtee.drivers.onrobot_3fg.codec import Control as Control3FG
from rtee.drivers.onrobot_rg.codec import Control as ControlRG
from rtee.drivers.schunk_egu.codec import Control as ControlEgu
from rtee.drivers.schunk_egu.codec import Output
from rtee.drivers.wsg50.codec import Command as WsgCommand

LONG = 10.0
"""Time in which every emulated gripper has arrived and built up its force [s]."""


def obstruct(motor: Any, contact: float, stiffness: float, closing: float = 1.0) -> None:
    """Put an object in a motor's way, in the motor's units."""
    motor.obstacle = VirtualObject(contact, stiffness, closing)


def pass_time(advance: Callable[[float], Any]) -> None:
    """Let `LONG` pass in steps."""
    for _ in range(100):
        advance(LONG / 100)


def close_robotiq(emulator: Any, command: Any, count: float, stiffness: float) -> None:
    """Close an active Robotiq gripper by a command on an object met at a count."""
    for one in emulator.closings():
        obstruct(one.motor, count, stiffness)
    emulator._power_up(True)
    emulator._order(command)
    for axis in emulator.axes:
        axis.advance(LONG)


def close_onrobot_rg(emulator: Any) -> None:
    """Grip an object 60 mm wide with 20 N."""
    obstruct(
        emulator.axis, emulator.model.angle(0.06 + 2.0 * emulator.properties.fingertip), 1e4, -1
    )
    emulator._targets = [200, 0, ControlRG.GRIP]
    emulator._start(0.0)
    pass_time(emulator._advance_by)
    emulator.moves = 0


def close_onrobot_3fg(emulator: Any) -> None:
    """Grip an object of 80 mm with half of the force."""
    obstruct(emulator.axis, 0.08, 4e4, -1.0)
    smallest = round(emulator.properties.smallest * 1e4)
    emulator._targets = [500, smallest, 0, Control3FG.GRIP]
    emulator._start(Control3FG.GRIP)
    pass_time(emulator._advance_by)
    emulator.moves = 0


def close_wsg50(emulator: Any) -> None:
    """Grasp an object 50 mm wide."""
    emulator._referenced = True
    obstruct(emulator.axis, 50.0, 200.0, -1.0)
    emulator._begin(WsgCommand.GRASP, (50.0, 100.0))
    pass_time(emulator._advance)
    emulator.moves = 0


def close_schunk_egu(emulator: Any) -> None:
    """Grip an object 30 mm wide."""
    emulator._start(True)
    # Open enough that the fingers close on the object.
    emulator.axis.position = max(emulator.axis.position, 40.0)
    obstruct(emulator.axis, 30.0, 200.0, -1.0)
    emulator._obey(Output(ControlEgu.RUN | ControlEgu.GRIP, force=50))
    pass_time(emulator._advance_by)
    emulator.moves = 0


def place_in_rh56(emulator: Any) -> None:
    """Put an object between the fingers of an RH56, met halfway."""
    for closing in emulator.closings():
        obstruct(closing.motor, 0.5 * OPEN, 50.0, -1.0)
