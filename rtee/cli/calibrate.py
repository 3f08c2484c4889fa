"""`rtee calibrate`: calibrate a device that has offsets or end stops."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import Hand, report_copy

if TYPE_CHECKING:
    from rtee.types import DeviceSpec

app = typer.Typer()


@app.command()
def calibrate(
    hand: Hand,
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="One device of the hand; else all.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File to write; else as in hand.yaml, or beside it."),
    ] = None,
    emulated: Annotated[
        bool, typer.Option("--emulated", help="Calibrate emulators instead of the real devices.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't wait for Enter.")] = False,
) -> None:
    """Find a device's offsets or end stops and store them; it may move fully."""
    import asyncio

    from rtee.buses.pool import BusPool
    from rtee.cli._devices import devices_of, folder_of, with_options
    from rtee.drivers import calibration
    from rtee.drivers.registry import find_driver
    from rtee.hand.own_copy import own

    specs = devices_of(hand, device, emulated=emulated)

    async def ready(text: str) -> None:
        print(text, flush=True)
        if not yes:
            await asyncio.to_thread(input, "Press Enter when it is so, Ctrl-C to end. ")

    def file_of(spec: DeviceSpec) -> Path:
        """Return where a device's values go; a hand that is not to be changed is copied first."""
        stored, folder = spec.options.get("calibration"), folder_of(hand)
        path = Path(str(stored)) if stored else folder / "calibration" / f"{spec.name}.json"
        if out is not None or not path.resolve().is_relative_to(folder.resolve()):
            return out or path
        copy = own(folder)
        report_copy(folder, copy)
        return copy / path.resolve().relative_to(folder.resolve())

    async def execute() -> None:
        async with BusPool() as pool:
            for spec in specs:
                stored = spec.options.get("calibration")
                path = file_of(spec)
                made = with_options(spec, calibration=None)
                driver = find_driver(spec.driver, source=spec.source)(made, pool)
                found = await calibration.calibrate(driver, path, ready)
                print(f"{spec.name}: {_text(found)}")
                print(f"{spec.name}: stored in {path}")
                if not stored:
                    print(f"  to use it, add to the device's options: calibration: {path}")

    asyncio.run(execute())


def _text(found: object) -> str:
    if isinstance(found, list | tuple):
        return "; ".join(str(one) for one in found)
    return str(found)
