"""Ask an EGU or EGK what it is and what it can do."""

from __future__ import annotations

from dataclasses import dataclass

from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.drivers.register_blocks import PATIENT
from rtee.drivers.schunk_egu.codec import MODULES, TEXTS, Parameter, float_of, text_of
from rtee.errors import HandshakeError

_WHAT = "an EGU or EGK"


@dataclass(frozen=True, slots=True)
class Identity:
    """A gripper.

    Attributes:
        name: Its model.
        serial: Its serial number.
        firmware: The version of its software.
        least: Smallest distance between the fingers [mm].
        most: Largest distance between the fingers [mm].
        force: Largest grip force [N].
        speed: Largest speed of that distance [mm/s].
        grip_speed: Largest speed of a grip [mm/s]; that of motions where it says none.
    """

    name: str
    serial: str
    firmware: str
    least: float
    most: float
    force: float
    speed: float
    grip_speed: float


async def identify(bus: ModbusBus, unit: int, device: str) -> Identity:
    """Read what the gripper of a number on a line says of itself.

    Args:
        bus: The line.
        unit: The gripper's number.
        device: Its name in errors.

    Raises:
        HandshakeError: if it is another device.
        BusError: if it does not answer, or refuses.
    """

    async def read(what: Parameter, count: int) -> tuple[int, ...]:
        return await bus.read(unit, what.register, count, deadline=PATIENT)

    async def number(what: Parameter) -> float:
        return float_of(await read(what, 2))

    # The bytes of the register are in the gripper's order, low byte first.
    module = (await read(Parameter.MODULE, 1))[0].to_bytes(2, "big")
    name = MODULES.get(int.from_bytes(module, "little"))
    if name is None:
        raise HandshakeError(
            device, _WHAT, f"a device of module type {int.from_bytes(module, 'little')}"
        )
    least, most = await number(Parameter.LEAST_POSITION), await number(Parameter.MOST_POSITION)
    force, speed = await number(Parameter.MOST_FORCE), await number(Parameter.MOST_SPEED)
    # Another device may return zeros for registers that it does not have.
    if not (least < most and force > 0.0 and speed > 0.0):
        raise HandshakeError(
            device, _WHAT, f"positions {least} to {most} mm, {force} N, {speed} mm/s"
        )
    texts = {what: text_of(await read(what, count)) for what, count in TEXTS.items()}
    try:
        grip_speed = await number(Parameter.MOST_GRIP_SPEED)
    except ModbusRefusal:
        grip_speed = speed
    return Identity(
        name,
        texts[Parameter.SERIAL],
        texts[Parameter.SOFTWARE],
        least,
        most,
        force,
        speed,
        grip_speed if 0.0 < grip_speed < speed else speed,
    )
