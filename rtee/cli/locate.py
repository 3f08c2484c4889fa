"""`rtee locate`: twitch a hand to see which one it is."""

from __future__ import annotations

from typing import Annotated

import typer

from rtee.cli._common import Hand

app = typer.Typer()


@app.command()
def locate(
    hand: Hand,
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="One device of the hand; else all.")
    ] = None,
    times: Annotated[int, typer.Option(min=1, max=50, help="How often it twitches.")] = 3,
    share: Annotated[
        float, typer.Option(min=0.01, max=0.3, help="Part of the range that it moves.")
    ] = 0.06,
    home: Annotated[
        bool, typer.Option("--home", help="Home a device that needs it, which moves it fully.")
    ] = False,
    emulated: Annotated[
        bool, typer.Option("--emulated", help="Move emulators instead of the real devices.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't ask.")] = False,
) -> None:
    """Move a hand's actuators a little and back, one device after the other."""
    import asyncio

    from rtee.buses.pool import BusPool
    from rtee.cli._devices import devices_of, with_options
    from rtee.drivers.diagnosis.locate import twitch
    from rtee.drivers.registry import find_driver

    specs = devices_of(hand, device, emulated=emulated)
    if not yes:
        typer.confirm(f"{hand} will move; is it free?", abort=True)

    async def execute() -> None:
        async with BusPool() as pool:
            for spec in specs:
                made = with_options(spec, home="on_connect") if home else spec
                driver = find_driver(spec.driver, source=spec.source)(made, pool)
                print(f"{spec.name}: twitching", flush=True)
                await twitch(driver, times=times, share=share)
                told = driver.capabilities.identity
                print(f"{spec.name}: that was {', '.join(told.values()) or 'it'}")

    asyncio.run(execute())
