"""`rtee set-id`: give a serial bus servo its id before it shares a line with others."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.errors import ConfigError, NotConnected

if TYPE_CHECKING:
    from rtee.buses.pool import BusPool
    from rtee.drivers.diagnosis.probes import Probe

_LARGEST = 253
"""Largest id of any servo, that of Feetech; 254 is the broadcast address."""


class FamilyName(StrEnum):
    """Families of servos whose id can be set."""

    FEETECH = "feetech"
    DYNAMIXEL = "dynamixel"


@dataclass(frozen=True, slots=True)
class _Family:
    """Servos that share a protocol.

    Attributes:
        name: Name of the family.
        factory_rate: Rate of a new servo [baud].
        rates: Rates that a servo can be set to [baud].
        largest_id: Largest id of a servo.
        probe: Function that returns the probe which finds all servos, at a rate [baud].
        there: Function that returns whether a servo answers, by pool, port, rate [baud] and id.
        set_id: Function that stores a new id and optionally a new rate [baud], by pool, port,
            rate, old id, new id and new rate; returns the model's name.
    """

    name: FamilyName
    factory_rate: int
    rates: Sequence[int]
    largest_id: int
    probe: Callable[[int], Probe]
    there: Callable[[BusPool, str, int, int], Awaitable[bool]]
    set_id: Callable[[BusPool, str, int, int, int, int | None], Awaitable[str]]


def _families() -> list[_Family]:
    from rtee.drivers.diagnosis import probes
    from rtee.drivers.dynamixel import identity as dynamixel
    from rtee.drivers.dynamixel import table as dynamixel_table
    from rtee.drivers.feetech import identity as feetech
    from rtee.drivers.feetech import table as feetech_table

    async def dynamixel_there(pool: BusPool, port: str, rate: int, number: int) -> bool:
        return await dynamixel.model_at(pool, port, rate, number) is not None

    async def set_dynamixel(
        pool: BusPool, port: str, rate: int, old: int, new: int, new_rate: int | None
    ) -> str:
        return (await dynamixel.set_id(pool, port, rate, old, new, new_rate)).name

    async def set_feetech(
        pool: BusPool, port: str, rate: int, old: int, new: int, new_rate: int | None
    ) -> str:
        if new_rate is not None:
            raise ConfigError(
                "--new-baudrate works for Dynamixel servos only; Feetech servos keep their rate"
            )
        return (await feetech.set_id(pool, port, rate, old, new)).name

    return [
        _Family(
            FamilyName.FEETECH,
            1_000_000,
            feetech_table.BAUD_RATES,
            253,
            probes.feetech,
            feetech.is_there,
            set_feetech,
        ),
        _Family(
            FamilyName.DYNAMIXEL,
            57_600,
            dynamixel_table.BAUD_RATES,
            252,
            probes.dynamixel,
            dynamixel_there,
            set_dynamixel,
        ),
    ]


def set_id(
    new: Annotated[int, typer.Argument(metavar="ID", min=0, max=_LARGEST, help="The new id.")],
    *,
    port: str,
    old: Annotated[
        int | None,
        typer.Option(
            "--from",
            metavar="ID",
            min=0,
            max=_LARGEST,
            help="Its present id; not needed where one servo is alone on the line.",
        ),
    ] = None,
    baudrate: int | None = None,
    new_baudrate: int | None = None,
    family: FamilyName | None = None,
) -> None:
    """Store another id in a Feetech or Dynamixel servo; its torque is switched off.

    Examples: rtee set-id 3 --port /dev/ttyUSB0

    rtee set-id 3 --port /dev/ttyUSB0 --new-baudrate 4000000

    Arguments and options:
        port (PORT): A tty, or socket://host:port.
        baudrate: Rate of the line [baud]; else that of new servos, 1000000 (Feetech) and 57600
            (Dynamixel).
        new_baudrate: Also store this rate in a Dynamixel servo [baud].
        family: Servo family to query; by default, both.
    """
    import asyncio

    from rtee.buses.pool import BusPool

    async def execute() -> str:
        async with BusPool() as pool:
            servo, rate, number = await _find(pool, port, families, old)
            if new > servo.largest_id:
                raise ConfigError(
                    f"the id of a {servo.name} servo must be at most {servo.largest_id}, not {new}"
                )
            if number == new and new_baudrate is None:  # no change at all
                raise ConfigError(f"the servo at {port} has the id {new} already")
            model = await servo.set_id(pool, port, rate, number, new, new_baudrate)
            faster = f", at {new_baudrate} baud" if new_baudrate is not None else ""
            return f"{model}: {number} is now {new}{faster}"

    families = _chosen(family, baudrate, new_baudrate)
    print(asyncio.run(execute()))


def _chosen(
    family: FamilyName | None, baudrate: int | None, new_baudrate: int | None
) -> list[tuple[_Family, int]]:
    """Return the families to query, each with the rate of the line [baud].

    Raises `ConfigError` if no family has a rate that was given.
    """
    families = [servos for servos in _families() if family in (None, servos.name)]
    for option, rate in (("--baudrate", baudrate), ("--new-baudrate", new_baudrate)):
        known = sorted({known for servos in families for known in servos.rates})
        if rate is not None and rate not in known:
            raise ConfigError(f"{option} must be one of {', '.join(map(str, known))}, not {rate}")
    return [
        (servos, baudrate or servos.factory_rate)
        for servos in families
        if baudrate is None or baudrate in servos.rates
    ]


async def _find(
    pool: BusPool, port: str, families: Sequence[tuple[_Family, int]], old: int | None
) -> tuple[_Family, int, int]:
    """Return the family, rate [baud] and id of the servo at a port.

    Raises `BusError` if the line fails, `NotConnected` if none has the id that was given, and
    `ConfigError` if no id is given and there is no servo, or more than one.
    """
    asked = ", ".join(f"{servos.name} at {rate} baud" for servos, rate in families)
    if old is not None:
        for servos, rate in families:
            if old <= servos.largest_id and await servos.there(pool, port, rate, old):
                return servos, rate, old
        raise NotConnected(
            port,
            f"no servo {old} answers ({asked})",
            hint="`rtee scan` lists the servos it finds",
        )
    present = []
    for servos, rate in families:
        answers = await servos.probe(rate).ask(pool, port)
        present += [(servos, rate, int(servo.options["id"])) for servo in answers]
    if not present:
        raise ConfigError(
            f"there is no servo at {port} ({asked}); --baudrate searches at another rate"
        )
    if len(present) > 1:
        ids = ", ".join(str(number) for _, _, number in present)
        raise ConfigError(
            f"there are servos {ids} at {port}; connect only one, or choose one by --from"
        )
    return present[0]
