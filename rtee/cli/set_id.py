"""`rtee set-id`: give a serial bus servo its id before it shares a line with others."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rtee.drivers.feetech.table import Model

_LARGEST = 253
"""Largest id of a Feetech servo; 254 are all of them."""


def set_id(
    new: Annotated[int, typer.Argument(metavar="ID", min=0, max=_LARGEST, help="The new id.")],
    port: Annotated[str, typer.Option(metavar="PORT", help="A tty, or socket://host:port.")],
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
    baudrate: Annotated[int, typer.Option(help="Rate of the line [baud].")] = 1_000_000,
) -> None:
    """Store another id in a Feetech servo; its torque is taken away.

    Example: rtee set-id 3 --port /dev/ttyUSB0
    """
    import asyncio

    from rtee.buses.pool import BusPool
    from rtee.drivers.diagnosis.probes import feetech
    from rtee.drivers.feetech import identity
    from rtee.drivers.feetech.table import BAUD_RATES
    from rtee.errors import ConfigError

    async def execute() -> tuple[int, Model]:
        async with BusPool() as pool:
            number = old
            if number is None:
                found = await feetech(baudrate).ask(pool, port)
                ids = [int(one.options["id"]) for one in found]
                # Among several, nobody knows which one is meant.
                if len(ids) != 1:
                    listed = f"are servos {', '.join(map(str, ids))}" if ids else "is no servo"
                    raise ConfigError(
                        f"there {listed} at {port}: plug in one alone, or say which by --from"
                    )
                number = ids[0]
            if number == new:
                raise ConfigError(f"the servo at {port} has the id {new} already")
            return number, await identity.set_id(pool, port, baudrate, number, new)

    if baudrate not in BAUD_RATES:
        rates = ", ".join(str(rate) for rate in BAUD_RATES)
        raise ConfigError(f"--baudrate is one of {rates}, not {baudrate}")
    number, model = asyncio.run(execute())
    print(f"{model.name}: {number} is now {new}")
