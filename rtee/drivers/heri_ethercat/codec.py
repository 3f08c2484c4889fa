"""Process data and objects of HERI II's two-motor boards. No I/O.

The layouts come from a public packet header and from a program that ran on the hand; units marked
uncertain there are uncertain here.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag

from rtee.buses.parser import CodecError
from rtee.drivers.packed import Packed, part

MOTORS = 2  # per board
PHALANXES = 3  # per finger, each with a pressure sensor

TORQUE_CONSTANT = 0.0418
"""Motor torque per current [N·m/A]."""
GEAR = 138.0  # motor turns per turn of the output shaft
EFFICIENCY = 0.9  # gear efficiency at best
TORQUE_PER_AMPERE = TORQUE_CONSTANT * GEAR * EFFICIENCY
"""Torque at the output shaft per motor current [N·m/A], at the gear's best efficiency."""

# Objects, by index and subindex.
COMMAND_OBJECT = (0x8001, 3)
ACKNOWLEDGE_OBJECT = (0x8001, 4)
FIRMWARE_OBJECT = (0x8001, 1)
ORDER_SIZE = 2
"""Bytes of a command and of its acknowledgement."""
# The high byte of an acknowledgement; the low one repeats the command.
_DONE = 0x7800
_REFUSED = 0xAA00  # the board did not accept the command


_MILLI = 1e3  # counts of a velocity, torque or current per unit


class Order(IntEnum):
    """Commands to a board's controller."""

    POWER_ON = 0xA5
    POWER_OFF = 0x5A
    DIRECT = 0x4F
    POSITION = 0x3B


class Fault(IntFlag):
    """Bits of the fault word."""

    POSITION_RANGE = 1 << 0
    TORQUE_OFFSET_RANGE = 1 << 1
    KP_RANGE = 1 << 2
    KI_RANGE = 1 << 3
    KD_RANGE = 1 << 4
    ENCODER_1 = 1 << 5
    ENCODER_2 = 1 << 6
    HARDWARE = 1 << 7
    PARAMETERS = 1 << 8
    CURRENT_LIMITED = 1 << 9
    ALIVE = 1 << 15


ACKNOWLEDGE = 0x7FFF
"""Bits of the fault word that an acknowledgement clears; the last bit is only a heartbeat."""
WARNINGS = Fault.CURRENT_LIMITED
"""Bits that are not faults: the board limits the current because it is hot."""

LEAST_TORQUE = 1e-3
"""Smallest torque that can be sent to a board [N·m]."""


def faults_of(word: int) -> Fault:
    """Return the faults in a fault word."""
    # Bits 10 to 14 have no published meaning; treated as faults, they could stop a healthy hand.
    return Fault(word & ACKNOWLEDGE) & ~WARNINGS & Fault(0x1FF)


_CURES = {
    Fault.POSITION_RANGE: "compare the actuators' limits with those stored in the board",
    Fault.TORQUE_OFFSET_RANGE: "see which torque offset the board stores",
    Fault.KP_RANGE | Fault.KI_RANGE | Fault.KD_RANGE: "check `gains` in its options",
    Fault.ENCODER_1 | Fault.ENCODER_2: "check the encoders' cables",
    Fault.HARDWARE: "switch the boards off and on",
    Fault.PARAMETERS: "restore the parameters that the board stores",
}


def cure(fault: Fault) -> str:
    """Return what removes the cause of faults, in words."""
    return " and ".join(text for bits, text in _CURES.items() if fault & bits)


def words(fault: Fault) -> str:
    """Return the names of faults, in words."""
    names = [bit.name.lower().replace("_", " ") for bit in fault if bit.name]
    return ", ".join(names) or "unknown"


class Command(Packed):
    """The output process data of a board: 32 bytes per cycle.

    Attributes:
        positions: References of its two motors [rad].
        velocity: Velocity reference of both [rad/s].
        torque: Torque reference of both [N·m]; in position control a limit, 0: none.
        gains: Five raw gains.
        acknowledge: Bits of the fault word to clear.
        stamp: The host's time, low 16 bits [µs]; the board returns it.
        operation: Operation and index of the auxiliary value.
        value: The auxiliary value.
    """

    WHAT = "a command of a board"

    positions: tuple[float, float] = part("f", 2)
    velocity: float = part("h", per=_MILLI, default=0.0)
    torque: float = part("h", per=_MILLI, default=0.0)
    gains: tuple[int, int, int, int, int] = part("H", 5, default=(0, 0, 0, 0, 0))
    acknowledge: int = part("H", default=0)
    stamp: int = part("H", default=0)
    operation: int = part("H", default=0)
    value: float = part("f", default=0.0)


class Reply(Packed):
    """The input process data of a board: 38 bytes per cycle.

    Attributes:
        positions: Positions of its two motors [rad].
        velocities: Velocities of its two motors [rad/s].
        pressures: Raw pressures on the three phalanxes of each motor's finger.
        currents: Currents of its two motors [A]; the unit on the wire is assumed to be mA.
        fault: The fault word.
        round_trip: The stamp of the newest command.
        acknowledged: Answer to the auxiliary operation.
        value: The auxiliary value.
    """

    WHAT = "a reply of a board"

    positions: tuple[float, float] = part("f", 2)
    velocities: tuple[float, float] = part("h", 2, per=_MILLI, default=(0.0, 0.0))
    pressures: tuple[int, int, int, int, int, int] = part("H", 6, default=(0, 0, 0, 0, 0, 0))
    currents: tuple[float, float] = part("h", 2, per=_MILLI, default=(0.0, 0.0))
    fault: int = part("H", default=0)
    round_trip: int = part("H", default=0)
    acknowledged: int = part("H", default=0)
    value: float = part("f", default=0.0)


def order(code: Order) -> bytes:
    """Return the value of the command object for a command."""
    return struct.pack("<H", code)


def acknowledged(raw: bytes, code: Order) -> bool | None:
    """Return a board's answer to a command: done, refused, or ``None`` while there is none.

    Raises `CodecError` if it is not an acknowledgement.
    """
    if len(raw) < ORDER_SIZE:
        raise CodecError("an acknowledgement must have two bytes")
    word = raw[0] | raw[1] << 8
    # The acknowledgement of the previous command stays until the board accepts this one.
    if word & 0xFF != code:
        return None
    if word & 0xFF00 == _DONE:
        return True
    return False if word & 0xFF00 == _REFUSED else None


def acknowledgement(code: int, done: bool) -> bytes:
    """Return a board's answer to a command."""
    return struct.pack("<H", (_DONE if done else _REFUSED) | code & 0xFF)
