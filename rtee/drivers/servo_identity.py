"""Change a servo's id before it shares a line with others, in the same way for all families."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from rtee.drivers.servos import ServoLink
from rtee.errors import ConfigError, DriverError, NotConnected

ATTEMPTS = 4
"""Attempts to write an id or a rate until the servo uses it."""

SETTLES = 0.02
"""Time for a servo to store a value [s]; no source gives one."""

_ASKED = 3
"""Unanswered pings after which an id counts as free."""


async def model_of(link: ServoLink, number: int) -> int | None:
    """Return the model number of the servo with an id, or ``None`` if no servo answers."""
    for _ in range(_ASKED):
        model = await link.model(number)
        if model is not None:
            return model
    return None


async def claim(link: ServoLink, port: str, old: int, new: int) -> int:
    """Return the model number of the servo that is to have the id ``new``; raises `BusError`.

    Raises:
        ConfigError: if another servo has that id.
        NotConnected: if no servo answers to the old id.
    """
    if new != old and await model_of(link, new) is not None:
        raise ConfigError(f"a servo {new} is already at {port}; disconnect it")
    model = await model_of(link, old)
    if model is None:
        hint = "`rtee scan` lists the servos it finds"
        raise NotConnected(port, f"no servo {old} answers", hint=hint)
    return model


async def renumber(
    link: ServoLink, port: str, old: int, new: int, store: Callable[[], Awaitable[None]]
) -> None:
    """Call ``store`` to write the new id until the servo answers to it; raises `BusError`.

    Raises `DriverError` if the servo does not accept the id.
    """
    for _ in range(ATTEMPTS):
        await store()
        await asyncio.sleep(SETTLES)
        if await model_of(link, new) is not None:
            return
    raise DriverError(port, f"servo {old} does not accept the id {new}")
