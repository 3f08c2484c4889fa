"""Prepare servos before they are driven: find, check and set up; and their faults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from rtee.drivers.feetech import table
from rtee.drivers.feetech.codec import Status
from rtee.drivers.feetech.identity import recognise
from rtee.drivers.feetech.link import FeetechLink
from rtee.drivers.feetech.options import FeetechOptions, ServoOptions
from rtee.drivers.feetech.table import FULL, MODELS, RAM, Family, Register, model_name
from rtee.drivers.servo_lines import check_present, fault_of
from rtee.errors import DeviceFault, DriverError, HandshakeError

POWERED = 1
"""Value of the torque register that lets a servo drive; 2 damps, 0 leaves it limp."""
TORQUE_LOST = 0x100
RESTARTED = 0x200
"""Codes of the driver's own faults, above the bits of the status."""
_MARK = 0x80
"""Unused bit of the register of errors that the LED shows. It is written but not stored, so a servo
without it has had a power cycle."""


@dataclass(frozen=True, slots=True)
class Found:
    """The registers of a servo as found.

    Attributes:
        model: Its model number.
        firmware: Its firmware's version.
        phase: Its phase bits; 0 if they have another meaning.
        offset: Its position offset [counts].
        mode: Its operating mode; 0: position.
        return_delay: Its return delay [2 µs].
        limits: Its smallest and largest position [counts]; both 0: it counts turns.
        most: Its largest torque [0.1 %], or current [6.5 mA] (HLS).
        gains: Its P, I and D.
        alarm: The errors that its LED shows, and the mark.
        powered: Whether it has torque.
    """

    id: int
    model: int
    firmware: str
    phase: int
    offset: int
    mode: int
    return_delay: int
    limits: tuple[int, int]
    most: int
    gains: tuple[int, int, int]
    alarm: int
    powered: bool

    @property
    def marked(self) -> bool:
        """Whether it has the mark, which a power cycle removes."""
        return bool(self.alarm & _MARK)

    @classmethod
    def from_table(cls, family: Family, number: int, data: bytes, powered: bool) -> Found:
        """Read it from the registers that are stored."""

        def get(register: Register) -> int:
            return family.unpack(register, data)

        limited = family.limits_torque == "current"
        return cls(
            number,
            get(table.MODEL),
            f"{data[0]}.{data[1]}",
            0 if family.offset is None else get(table.PHASE),
            0 if family.offset is None else get(family.offset),
            0 if family.offset is None else get(table.MODE),
            # To HLS servos the register is a second id, which cannot be read.
            0 if limited else get(table.RETURN_DELAY),
            (get(table.MIN_ANGLE), get(table.MAX_ANGLE)),
            get(table.PROTECTION_CURRENT if limited else table.MAX_TORQUE),
            (get(table.P), get(table.I), get(table.D)),
            get(table.ALARM),
            powered,
        )


async def find(
    link: FeetechLink, family: Family, device: str, servos: Mapping[str, ServoOptions], port: str
) -> dict[int, Found]:
    """Find all servos, by id; writes nothing.

    Raises:
        NotConnected: if none answers.
        HandshakeError: if some are missing or differ from what is expected.
        BusError: if the line fails.
    """
    # All models are read first, so that one message names all missing servos.
    models = {servo.id: await link.model(servo.id) for servo in servos.values()}
    expected = {name: (servo.id, servo.model) for name, servo in servos.items()}
    check_present(device, port, expected, models, model_name)
    for name, servo in servos.items():
        number = models[servo.id]
        known = None if number is None else MODELS.get(number)
        if servo.model is None and (known is None or known.family != family.name):
            raise HandshakeError(
                device,
                f"an {family.name.upper()} servo as {servo.id} ({name})",
                _found(family.pack(table.MODEL, number or 0)),
                hint="is `family` right? If it has the same registers, say so by 'model'",
            )
    found = {}
    for number in models:
        registers = await link.read(number, 0, RAM)
        powered = await link.value(number, table.TORQUE) == POWERED
        found[number] = Found.from_table(family, number, registers.params, powered)
    for name, servo in servos.items():
        if found[servo.id].limits == (0, 0) and family.offset is None:
            raise HandshakeError(
                device,
                f"servo {servo.id} ({name}) with limits of its position",
                "limits of 0 and 0, with which it turns without end",
                hint="give it its limits back; from the factory they are 20 and 1003",
            )
    return found


def _found(data: bytes) -> str:
    """Return the name for the bytes of a model number, in any family."""
    model = recognise(data)
    return (
        f"model {data.hex(' ').upper()}"
        if model is None
        else f"{model.name}, of family {model.family}"
    )


async def prepare(
    link: FeetechLink,
    family: Family,
    device: str,
    options: FeetechOptions,
    found: Mapping[int, Found],
) -> None:
    """Set up servos that were found without torque; the settings are not stored.

    Raises `DriverError` if one does not accept a setting, and `BusError`.
    """

    async def write(register: Register, values: Mapping[int, int]) -> None:
        for number, kept in (await link.set_all(register, values)).items():
            raise DriverError(
                device,
                f"servo {number} does not take {values[number]} at address {register.address}; "
                f"it has {kept}",
            )

    # Locked servos accept settings without storing them, so that their memory does not wear out.
    await write(family.lock, dict.fromkeys(found, 1))
    for register, wanted, present in _settings(family, options, found):
        # Only differences, since values are read back one by one.
        await write(register, {n: v for n, v in wanted.items() if v != present[n]})
    if options.acceleration is not None and family.offset is not None:
        await write(table.ACCELERATION, dict.fromkeys(found, options.acceleration))
    # In HLS servos, the register of the return delay has another meaning.
    if options.return_delay is not None and family.name != "hls":
        slow = [n for n, servo in found.items() if servo.return_delay != options.return_delay]
        # Not an error if a servo keeps its delay: it is only slower.
        await link.set_all(table.RETURN_DELAY, dict.fromkeys(slow, options.return_delay))
    # A servo that does not accept the mark is driven, too, but its power cycles go unnoticed.
    new = {n: servo.alarm | _MARK for n, servo in found.items() if not servo.marked}
    await link.set_all(table.ALARM, new)


async def condition(link: FeetechLink, family: Family, number: int) -> tuple[int, bool]:
    """Return a servo's torque register and whether it has the mark; raises `BusError`."""
    first = table.ALARM.address
    answer = await link.read(number, first, table.TORQUE.address + 1 - first)

    def get(register: Register) -> int:
        return family.unpack(register, answer.params, first)

    return get(table.TORQUE), bool(get(table.ALARM) & _MARK)


def _settings(
    family: Family, options: FeetechOptions, found: Mapping[int, Found]
) -> Iterator[tuple[Register, Mapping[int, int], Mapping[int, int]]]:
    """Yield registers with their wanted and their present values, by id."""
    servos = {servo.id: servo for servo in options.servos.values() if servo.id in found}
    for i, (register, own, common) in enumerate(
        (
            (table.P, {n: servo.p for n, servo in servos.items()}, options.p),
            (table.I, {n: servo.i for n, servo in servos.items()}, options.i),
            (table.D, {n: servo.d for n, servo in servos.items()}, options.d),
        )
    ):
        given = {n: common if gain is None else gain for n, gain in own.items()}
        wanted = {n: gain for n, gain in given.items() if gain is not None}
        yield register, wanted, {n: servo.gains[i] for n, servo in found.items()}
    if family.offset is not None:
        # SCS servos have no such register; their limits choose between position and turning.
        yield table.MODE, dict.fromkeys(found, 0), {n: servo.mode for n, servo in found.items()}
    if options.torque is not None and not family.limits_torque:
        most = round(options.torque * FULL)
        yield table.MAX_TORQUE, dict.fromkeys(found, most), {n: s.most for n, s in found.items()}


def refuse(device: str, names: Mapping[int, str], statuses: Mapping[int, Status]) -> None:
    """Raise a `DeviceFault` if servos report errors in their status, by id."""
    reported = {number: status for number, status in statuses.items() if status}
    if reported:
        hint = "free the hand and check its supply, then `rtee recover` powers it again"
        raise fault_of(device, names, reported, hint)


def lost(device: str, names: Mapping[int, str], numbers: Sequence[int]) -> DeviceFault:
    """Return the fault of servos that have lost their torque."""
    named = ", ".join(f"{n} ({names[n]})" for n in numbers)
    return DeviceFault(
        device,
        TORQUE_LOST,
        f"torque lost: servo {named}",
        hint="the supply was cut, or the servo has switched off; `rtee recover` powers it again",
    )


def restarted(device: str, names: Mapping[int, str], number: int) -> DeviceFault:
    """Return the fault of a servo that has lost its settings and was powered again by a goal."""
    return DeviceFault(
        device,
        RESTARTED,
        f"restarted: servo {number} ({names[number]})",
        hint="its supply was cut, or a damaged frame has changed its settings; `rtee recover` sets"
        " it up again where it stands",
    )
