"""Recognise a servo, and change its id before it shares a line with others."""

from __future__ import annotations

from functools import partial

from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.feetech import table
from rtee.drivers.feetech.link import FeetechLink
from rtee.drivers.feetech.table import FAMILIES, MODELS, Model
from rtee.drivers.servo_identity import claim, model_of, renumber
from rtee.errors import DriverError

_OWNER = "set-id"
_DEADLINE = 0.03
"""Longest time for the answer of a servo [s]: an adapter holds bytes back for up to 16 ms."""


def recognise(data: bytes) -> Model | None:
    """Return the model for two raw bytes in its family's byte order, ``None`` if unknown."""
    for family in FAMILIES.values():
        # In the other byte order, they may be the number of a model of another family.
        model = MODELS.get(int.from_bytes(data, family.order))
        if model is not None and model.family == family.name:
            return model
    return None


async def is_there(pool: BusPool, port: str, baudrate: int, number: int) -> bool:
    """Return whether a servo of any family answers to an id; raises `BusError`."""
    bus = await pool.serial(port, owner=_OWNER, baudrate=baudrate, fresh=True)
    try:
        return await model_of(FeetechLink(bus, FAMILIES["sts"], _DEADLINE, 2), number) is not None
    finally:
        await bus.detach(_OWNER)


async def set_id(pool: BusPool, port: str, baudrate: int, old: int, new: int) -> Model:
    """Store another id in a servo; this disables its torque. Returns the servo's model.

    Raises:
        BusError: if the line fails.
        ConfigError: if another servo has the new id.
        DriverError: if its model is not known, or it does not accept the id.
        NotConnected: if no servo answers to the old id.
    """
    bus = await pool.serial(port, owner=_OWNER, baudrate=baudrate, fresh=True)
    try:
        # Any family will do: only whether a servo answers and its model bytes count.
        link = FeetechLink(bus, FAMILIES["sts"], _DEADLINE, 2)
        await claim(link, port, old, new)
        data = await patiently(partial(link.data, old, table.MODEL.address, table.MODEL.size))
        model = recognise(data)
        if model is None:
            raise DriverError(
                port,
                f"servo {old} is of an unknown model "
                f"({data.hex(' ').upper()}), so its settings cannot be unlocked",
            )
        family = FAMILIES[model.family]
        link = FeetechLink(bus, family, _DEADLINE, 2)
        await patiently(partial(link.set_all, table.TORQUE, {old: 0}))
        # An unlocked servo stores what is written.
        await patiently(partial(link.set_all, family.lock, {old: 0}))
        has = old
        try:
            stored = {old: bytes([new])}
            write = partial(link.write_all, table.ID.address, stored)
            await renumber(link, port, old, new, write)
            # The servo uses the new id at once, so the lock is set with that.
            has = new
        finally:
            await patiently(partial(link.set_all, family.lock, {has: 1}))
        return model
    finally:
        await bus.detach(_OWNER)
