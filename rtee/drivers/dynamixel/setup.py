"""Prepare servos before they are driven: find, check, set up and power them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.codec import ALERT, Hardware
from rtee.drivers.dynamixel.link import DynamixelLink
from rtee.drivers.dynamixel.options import DynamixelOptions, ServoOptions
from rtee.drivers.dynamixel.table import MODELS, Mode, Register, model_of
from rtee.drivers.servo_lines import check_present, fault_of
from rtee.errors import BusTimeout, FrameError, HandshakeError

MODES: Mapping[str, Mode] = {
    "current_based_position": Mode.CURRENT_BASED_POSITION,
    "extended_position": Mode.EXTENDED_POSITION,
    "position": Mode.POSITION,
}
TORQUE_LOST = 0x100
WATCHDOG_TRIPPED = 0x101
"""Codes of the driver's own faults, above the eight bits of the hardware error status."""

NEAR = 16
"""Tolerance of the goal read back from a servo without torque [pulse], 1.4°: too small for a jump.
No source says whether such a goal follows the shaft."""

_EEPROM = 64  # bytes of the table that survive a power cycle, identity included


@dataclass(frozen=True, slots=True)
class Found:
    """The registers of a servo as found.

    Attributes:
        model: Its model number.
        firmware: Its firmware's version.
        mode: Its operating mode.
        homing_offset: Its homing offset [pulse].
        return_delay: Its return delay [2 µs].
        current_limit: Its current limit [counts].
        lowest: Smallest goal that it accepts in the mode `position` [pulse].
        highest: Largest goal that it accepts in that mode [pulse].
        torque: Whether it has torque.
    """

    id: int
    model: int
    firmware: int
    drive_mode: int
    mode: int
    homing_offset: int
    return_delay: int
    current_limit: int
    lowest: int
    highest: int
    torque: bool

    @classmethod
    def from_table(cls, number: int, eeprom: bytes, torque: int) -> Found:
        """Read the registers from the first bytes of a control table."""

        def get(register: Register) -> int:
            return register.unpack(eeprom[register.address :])

        return cls(
            number,
            get(table.MODEL),
            get(table.FIRMWARE),
            get(table.DRIVE_MODE),
            get(table.OPERATING_MODE),
            get(table.HOMING_OFFSET),
            get(table.RETURN_DELAY),
            get(table.CURRENT_LIMIT),
            get(table.MIN_POSITION),
            get(table.MAX_POSITION),
            bool(torque),
        )


def find(
    link: DynamixelLink, device: str, servos: Mapping[str, ServoOptions], port: str
) -> dict[int, Found]:
    """Find all servos, by id; in the worker thread; writes nothing.

    Raises:
        NotConnected: if none answers.
        HandshakeError: if some are missing or differ from what is expected.
        BusError: if the line fails.
    """
    # All are pinged first, so that one message names all missing servos.
    models = {servo.id: link.ping(servo.id) for servo in servos.values()}
    expected = {name: (servo.id, servo.model) for name, servo in servos.items()}
    check_present(device, port, expected, models, _named)
    for name, servo in servos.items():
        if servo.model is None and models[servo.id] not in MODELS:
            raise HandshakeError(
                device,
                f"an X-series servo as {servo.id} ({name})",
                f"model {models[servo.id]}",
                hint="if it has the same control table, say so by 'model'",
            )
    found: dict[int, Found] = {}
    for number in models:
        eeprom, _ = link.read_group(0, _EEPROM, [number])
        torque, _ = link.read_group(table.TORQUE.address, 1, [number])
        found[number] = Found.from_table(number, eeprom[number], torque[number][0])
    for name, servo in servos.items():
        if found[servo.id].drive_mode & table.REVERSE != servo.drive_mode & table.REVERSE:
            raise HandshakeError(
                device,
                f"servo {servo.id} ({name}) with drive mode {servo.drive_mode}",
                f"drive mode {found[servo.id].drive_mode}",
                hint="its sense of rotation is reversed; set it back, or say so by 'drive_mode'",
            )
    return found


def _named(model: int | None) -> str:
    return "unknown" if model is None else model_of(model).name


def prepare(
    link: DynamixelLink,
    options: DynamixelOptions,
    found: Mapping[int, Found],
    positions: Mapping[int, int],
    currents: Mapping[int, int],
) -> None:
    """Set up servos without torque, and power them at their positions; in the worker thread.

    Raises `BusError` if the line fails, or a servo does not accept a value.

    Args:
        link: The line.
        options: Their settings.
        found: The servos without torque, by id.
        positions: Their present positions, as goals [pulse].
        currents: Their current limits [counts].
    """
    # The mode before gains and goals: a servo that changes its mode resets its goals.
    mode = MODES[options.mode]
    for number, servo in found.items():
        if servo.mode != mode:
            # Only if it differs, since EEPROM wears out.
            link.write(number, table.OPERATING_MODE, mode)
        # From the factory it is 0.5 ms, so 16 servos would delay every read by 8 ms.
        delay = options.return_delay
        if delay is not None and servo.return_delay != delay:
            link.write(number, table.RETURN_DELAY, delay)
    by_id = {servo.id: servo for servo in options.servos.values()}
    gains: tuple[tuple[Register, Callable[[Any], int | None]], ...] = (
        (table.POSITION_P, lambda o: o.p),
        (table.POSITION_I, lambda o: o.i),
        (table.POSITION_D, lambda o: o.d),
    )
    for register, pick in gains:
        values = {n: pick(by_id[n]) if pick(by_id[n]) is not None else pick(options) for n in found}
        link.write_confirmed(register, {n: v for n, v in values.items() if v is not None})
    if mode is Mode.CURRENT_BASED_POSITION:
        link.write_confirmed(table.GOAL_CURRENT, {n: currents[n] for n in found})
    # Before the torque: an old goal would make the servo jump to it.
    goals = {n: positions[n] for n in found}
    link.write_confirmed(table.GOAL_POSITION, goals, within=NEAR)
    # One by one, since a servo answers only its own write and so can refuse it.
    for number in found:
        link.write(number, table.TORQUE, 1)


def arm(link: DynamixelLink, seconds: float) -> None:
    """Set all bus watchdogs, clear a tripped one; in the worker thread; raises `BusError`."""
    # 0 clears a watchdog that has tripped; any other value is refused until then.
    link.write_confirmed(table.BUS_WATCHDOG, dict.fromkeys(link.ids, 0))
    if seconds > 0.0:
        count = min(max(round(seconds / table.WATCHDOG_UNIT), 1), 127)
        link.write_confirmed(table.BUS_WATCHDOG, dict.fromkeys(link.ids, count))


def refuse(
    link: DynamixelLink, device: str, names: Mapping[int, str], errors: Mapping[int, int]
) -> None:
    """Raise the hardware errors of servos whose answer has the alert bit; in the worker thread.

    Raises `DeviceFault` if a servo has a hardware error, and `BusError`.
    """
    alerted = [number for number, error in errors.items() if error & ALERT]
    if not alerted:
        return
    # The alert bit says that there is an error; this register says which.
    hardware = {}
    for number in alerted:
        data, _ = link.read_group(table.HARDWARE_ERROR.address, 1, [number])
        hardware[number] = Hardware(data[number][0])
    hint = "free the hand and check its supply, then `rtee recover` reboots the servo"
    raise fault_of(device, names, hardware, hint)


def hurt(link: DynamixelLink) -> list[int]:
    """Return the servos that have a hardware error or do not answer; in the worker thread."""
    numbers = []
    for number in link.ids:
        try:
            data, _ = link.read_group(table.HARDWARE_ERROR.address, 1, [number])
        except (BusTimeout, FrameError):
            numbers.append(number)
            continue
        if data[number][0]:
            numbers.append(number)
    return numbers
