"""``rtee hands``: list the hands there are."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})


@app.command()
def hands(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List the hands there are, with their fingers, actuators and devices."""
    from rtee.hand.catalog import hands as all_hands

    rows = [_row(name, str(folder)) for name, folder in all_hands().items()]
    if as_json:
        print(json.dumps({"hands": rows}, indent=2))
        return
    _print(rows)


def _row(name: str, folder: str) -> dict[str, Any]:
    from pathlib import Path

    from rtee.errors import RteeError
    from rtee.hand.load import load_configured

    try:
        hand, config = load_configured(Path(folder))
    except RteeError as error:
        return {"name": name, "folder": folder, "error": str(error)}
    return {
        "name": name,
        "title": config.title,
        "folder": folder,
        "fingers": list(hand.finger_names),
        "actuators": list(hand.actuator_names),
        "joints": len(hand.joints),
        "driver": config.driver,
        "devices": {device: entry.driver for device, entry in config.devices.items()},
        "notes": list(hand.notes),
    }


def _print(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not rows:
        console.print("There are no hands yet; 'rtee new NAME --urdf FILE' makes one.")
        return
    table = Table("hand", "", "fingers", "actuators", "joints", "devices", box=None)
    for row in rows:
        if "error" not in row:
            table.add_row(
                row["name"],
                row["title"],
                str(len(row["fingers"])),
                str(len(row["actuators"])),
                str(row["joints"]),
                ", ".join(row["devices"].values()),
            )
    console.print(table)
    for row in rows:
        if "error" in row:
            console.print(f"[red]{row['name']}[/]: ", end="")
            console.print(row["error"], markup=False, highlight=False, soft_wrap=True)
