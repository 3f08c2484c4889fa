"""`rtee hands`: list the configured hands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from rtee.cli._common import JsonOption, to_json
from rtee.cli._fleet import ConnectOptions, WatchOption, show_fleet
from rtee.cli._table import Column, table_of
from rtee.errors import RteeError
from rtee.hand.catalog import hands as all_hands


def hands(
    *,
    running: bool = False,
    connect: ConnectOptions = None,
    watch: WatchOption = False,
    as_json: JsonOption = False,
) -> None:
    """List the configured hands with their fingers, actuators and devices.

    Arguments and options:
        running: Show the hands that run, as 'rtee status --all'.
        connect (--connect): With --running or --watch: where hands run, or a router of theirs, such
            as tls/router:7447; may be repeated.
        watch: Show the hands that run, every two seconds, until Ctrl-C.
    """
    if running or watch:
        show_fleet(connect or [], as_json=as_json, watch=watch)
        return
    rows = [_row(name, folder) for name, folder in all_hands().items()]
    if as_json:
        print(to_json({"hands": rows}, indent=2))
        return
    _print(rows)


def _row(name: str, folder: Path) -> dict[str, Any]:
    from rtee.hand.load import load_configured

    try:
        hand, config = load_configured(folder)
    # A mistake in one hand must not keep the others from being listed.
    except RteeError as error:
        return {"name": name, "folder": str(folder), "error": str(error)}
    return {
        "name": name,
        "title": config.title,
        "folder": str(folder),
        "fingers": list(hand.finger_names),
        "actuators": list(hand.actuator_names),
        "joints": len(hand.joints),
        "driver": config.driver,
        "devices": {device: entry.driver for device, entry in config.devices.items()},
        "notes": list(hand.notes),
    }


def _print(rows: list[dict[str, Any]]) -> None:
    if not rows:
        print("There are no hands yet; 'rtee new NAME --urdf FILE' makes one.")
        return
    columns: tuple[str | Column, ...] = (
        Column("hand", whole=True),
        "title",
        *(Column(name, right=True) for name in ("fingers", "actuators", "joints")),
        "devices",
    )
    table_of(columns, (_cells(row) for row in rows if "error" not in row)).show()
    for row in rows:
        if "error" in row:
            print(f"{row['name']}: {row['error']}", file=sys.stderr)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    counts = (len(row["fingers"]), len(row["actuators"]), row["joints"])
    return (row["name"], row["title"], *map(str, counts), ", ".join(row["devices"].values()))
