"""`rtee doctor`: say what is wrong and what to type."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import JsonOption, complete_hand

if TYPE_CHECKING:
    from rtee.drivers.diagnosis.checks import Check

app = typer.Typer()

_MODEL = "the hand"
"""No device can be called so."""


@app.command()
def doctor(
    hand: Annotated[
        str | None,
        typer.Argument(
            metavar="[HAND]",
            help="Name of a hand, or its folder; else only this computer is looked at.",
            autocompletion=complete_hand,
        ),
    ] = None,
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="One device of the hand; else all.")
    ] = None,
    emulated: Annotated[
        bool, typer.Option("--emulated", help="Ask emulators instead of the real devices.")
    ] = False,
    files: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Only write the files for a robot PC: udev rule, limits, service."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check this computer and a hand's devices; each line is ok, or says what to type."""
    import asyncio

    if files is not None:
        from rtee.drivers.diagnosis.machine import write_files

        for path in write_files(files):
            print(path)
        return

    from rtee.buses.pool import BusPool
    from rtee.cli._devices import devices_of
    from rtee.drivers.diagnosis.checks import Verdict
    from rtee.drivers.diagnosis.device import check_device
    from rtee.drivers.diagnosis.machine import check_machine
    from rtee.drivers.diagnosis.model import check_model, has_devices

    async def execute() -> dict[str, list[Check]]:
        found = {"computer": check_machine()}
        if hand:
            found[_MODEL] = check_model(hand)
        looked_at = hand is not None and (device is not None or has_devices(hand))
        async with BusPool() as pool:
            for spec in devices_of(hand, device, emulated=emulated) if hand and looked_at else ():
                found[spec.name] = await check_device(spec, pool)
        return found

    found = asyncio.run(execute())
    if as_json:
        print(json.dumps({k: [asdict(c) for c in v] for k, v in found.items()}, indent=2))
    else:
        for name, checks in found.items():
            _print(name, checks)
    wrong = any(check.verdict is Verdict.WRONG for checks in found.values() for check in checks)
    raise typer.Exit(1 if wrong else 0)


def _print(name: str, checks: list[Check]) -> None:
    print(name)
    for check in checks:
        print(f"  {check.verdict:8} {check.subject}: {check.text}")
        if check.remedy:
            print(f"  {'':8} -> {check.remedy}")
