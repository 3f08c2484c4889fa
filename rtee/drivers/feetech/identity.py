"""Recognise a servo, and change its id before it shares a line with others."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.feetech import table
from rtee.drivers.feetech.link import FeetechLink
from rtee.drivers.feetech.table import FAMILIES, MODELS, Model
from rtee.errors import BusTimeout, ConfigError, DriverError, FrameError, NotConnected

_OWNER = "set-id"
_DEADLINE = 0.03
"""Longest time for the answer of a servo [s]: an adapter keeps bytes back for up to 16 ms."""
_ATTEMPTS = 4
"""Attempts to write an id that the servo does not use afterwards."""
_SETTLES = 0.02
"""Time for a servo to store its id [s]; no source gives one."""

T = TypeVar("T")


def recognise(data: bytes) -> Model | None:
    """Return the model for the two bytes of a model number, in its family's byte order."""
    for family in FAMILIES.values():
        # In the other byte order they may be the number of another family's model.
        model = MODELS.get(int.from_bytes(data, family.order))
        if model is not None and model.family == family.name:
            return model
    return None


async def is_there(pool: BusPool, port: str, baudrate: int, number: int) -> bool:
    """Return whether a servo of any family answers to an id; raises `BusError`."""
    bus = await pool.serial(port, owner=_OWNER, baudrate=baudrate, fresh=True)
    try:
        link = FeetechLink(bus, FAMILIES["sts"], _DEADLINE, 2)
        return await _heard(lambda: link.model(number)) is not None
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
        # Any family will do: only whether a servo answers counts.
        link = FeetechLink(bus, FAMILIES["sts"], _DEADLINE, 2)
        if await _heard(lambda: link.model(new)) is not None:
            raise ConfigError(f"there is a servo {new} at {port} already; take it off the line")
        model = await _model(link, port, old)
        family = FAMILIES[model.family]
        link = FeetechLink(bus, family, _DEADLINE, 2)
        await patiently(lambda: link.set_all(table.TORQUE, {old: 0}))
        # An unlocked servo stores what is written.
        await patiently(lambda: link.set_all(family.lock, {old: 0}))
        for _ in range(_ATTEMPTS):
            await link.write_all(table.ID.address, {old: bytes([new])})
            await asyncio.sleep(_SETTLES)
            if await link.model(new) is not None:
                # It uses the new id at once, so the lock is set with that one.
                await patiently(lambda: link.set_all(family.lock, {new: 1}))
                return model
        await patiently(lambda: link.set_all(family.lock, {old: 1}))
        raise DriverError(port, f"servo {old} does not take the id {new}")
    finally:
        await bus.detach(_OWNER)


async def _heard(ask: Callable[[], Awaitable[T | None]], times: int = 3) -> T | None:
    """Return an answer; without one, ask again."""
    for _ in range(times):
        answer = await ask()
        if answer is not None:
            return answer
    return None


async def _model(link: FeetechLink, port: str, number: int) -> Model:
    try:
        answer = await patiently(lambda: link.read(number, table.MODEL.address, table.MODEL.size))
    except (BusTimeout, FrameError) as error:
        raise NotConnected(
            port, f"no servo {number} answers", hint="`rtee scan` lists the servos there are"
        ) from error
    model = recognise(answer.params)
    if model is None:
        raise DriverError(
            port,
            f"servo {number} is of a model that is not known "
            f"({answer.params.hex(' ').upper()}), nor where its settings are locked",
        )
    return model
