"""Change the id and the rate of a servo before it shares a line with others."""

from __future__ import annotations

import asyncio
from functools import partial

from rtee.buses.dynamixel import DynamixelBus
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.link import DynamixelLink
from rtee.drivers.dynamixel.table import Model, model_of
from rtee.drivers.servo_identity import ATTEMPTS, SETTLES, claim, renumber
from rtee.errors import DriverError

_OWNER = "set-id"
_DEADLINE = 0.1
"""Longest time for the answer of a servo [s]: an adapter holds bytes back for up to 16 ms."""


async def model_at(pool: BusPool, port: str, baudrate: int, number: int) -> Model | None:
    """Return the model of the servo with an id, ``None`` if none answers; raises `BusError`."""
    bus = await _line(pool, port, baudrate)
    try:
        model = await _link(bus, number).model(number)
        return None if model is None else model_of(model)
    finally:
        await bus.detach(_OWNER)


async def set_id(
    pool: BusPool, port: str, baudrate: int, old: int, new: int, new_baudrate: int | None = None
) -> Model:
    """Store another id in a servo, and another rate, if given; this disables its torque.

    Returns the servo's model. The new id may be the old one.

    Raises:
        BusError: if the line fails.
        ConfigError: if another servo has the new id.
        DriverError: if it does not accept the id or the rate.
        NotConnected: if no servo answers to the old id.
    """
    bus = await _line(pool, port, baudrate)
    try:
        link = _link(bus, old)
        model = model_of(await claim(link, port, old, new))
        # With its torque on, a servo refuses writes to its EEPROM.
        await patiently(partial(link.run, partial(link.write, old, table.TORQUE, 0)))
        if new != old:
            await renumber(link, port, old, new, partial(_store, link, old, table.ID, new))
    finally:
        await bus.detach(_OWNER)
    if new_baudrate is not None and new_baudrate != baudrate:
        await _set_rate(pool, port, baudrate, new, new_baudrate)
    return model


async def _set_rate(pool: BusPool, port: str, old: int, number: int, new: int) -> None:
    for _ in range(ATTEMPTS):
        # Opened for each attempt, as `model_at` below opens the same line at the new rate.
        bus = await _line(pool, port, old)
        try:
            rate = table.BAUD_RATES.index(new)
            await _store(_link(bus, number), number, table.BAUD_RATE, rate)
            await asyncio.sleep(SETTLES)
        finally:
            await bus.detach(_OWNER)
        # A servo with the new rate does not answer at the old one.
        if await model_at(pool, port, new, number) is not None:
            return
    raise DriverError(port, f"servo {number} does not accept {new} baud")


async def _store(link: DynamixelLink, number: int, register: table.Register, value: int) -> None:
    """Write a register and expect no answer: an answer may have the new id or rate."""
    await link.run(partial(link.write_group, register, {number: value}))


def _link(bus: DynamixelBus, number: int) -> DynamixelLink:
    link = DynamixelLink(bus, [number], _DEADLINE, 3)
    link.patient = True
    return link


async def _line(pool: BusPool, port: str, baudrate: int) -> DynamixelBus:
    return await pool.dynamixel(port, owner=_OWNER, baudrate=baudrate)
