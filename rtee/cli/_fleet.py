"""The hands of a computer and of a site as a table: `rtee status`, `rtee hands --running`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtee.cli._common import to_json, waiting
from rtee.cli._table import Column, Row, TextTable, on_terminal, table_of
from rtee.errors import NoHand

if TYPE_CHECKING:
    from rtee.remote.fleet import Look

_EVERY = 2.0
"""Interval of the updates [s]: as often as a person reads a table."""

ConnectOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        envvar="RTEE_CONNECT",
        metavar="ENDPOINT",
        help="Where hands run, or a router of theirs, such as tls/router:7447; may be repeated.",
    ),
]
WatchOption = Annotated[
    bool, typer.Option("--watch", help="Go on, every two seconds, until Ctrl-C.")
]


def show_fleet(
    connect: Sequence[str], names: Sequence[str] = (), *, as_json: bool, watch: bool
) -> None:
    """Show all hands of this computer, or those at endpoints."""
    import anyio

    from rtee.remote.fleet import following

    where = f"at {', '.join(connect)}" if connect else "on this computer"

    async def main() -> None:
        async with following(connect, names, here=not connect) as fleet:
            await fleet.known()
            nobody = f"no hand is running {where}; start one with 'rtee run HAND'"
            if watch and not as_json and not await fleet.look():
                waiting(nobody)
            if watch and on_terminal() and not as_json:
                from rich.console import Console
                from rich.live import Live

                with Live(console=Console(), auto_refresh=False) as live:
                    while True:
                        drawn = _table(await fleet.look()).drawn(live.console.width)
                        live.update(drawn, refresh=True)
                        await anyio.sleep(_EVERY)
            while True:
                looks = await fleet.look()
                if as_json:
                    print(to_json({"hands": [_plain(look) for look in looks]}), flush=True)
                elif looks:
                    _table(looks).show()
                if not watch:
                    break
                await anyio.sleep(_EVERY)
        if not looks and not as_json:
            raise NoHand(nobody)

    anyio.run(main)


def _plain(look: Look) -> dict[str, Any]:
    status = asdict(look.status) if look.status else {}
    place = {"hand": look.place.hand, "endpoint": look.place.endpoint}
    own = {"condition": look.condition, "temperature": look.temperature, "trouble": look.trouble}
    return {**status, **place, **own}


def _table(looks: Sequence[Look]) -> TextTable:
    columns: tuple[str | Column, ...] = (
        Column("hand", whole=True),
        *(["at"] if any(look.place.endpoint for look in looks) else []),
        Column("state", whole=True),
        "goal",
        "last",
        *(Column(name, right=True, whole=True) for name in ("Hz", "missed", "°C")),
        Column("version", whole=True),
        "recording",
        "remarks",
    )
    places = len(columns) > 10
    return table_of(columns, (_row(look, places) for look in looks))


def _row(look: Look, places: bool) -> Row:
    place = (look.place.hand, *([look.place.endpoint] if places else []), look.condition)
    status = look.status
    if status is None:
        return Row((*place, *[""] * 7, look.trouble), faint=True)
    clock, counts = status.statistics, status.counts
    warm = "" if math.isnan(look.temperature) else f"{look.temperature:.0f}"
    faults = [device.trouble for device in look.idle]
    return Row(
        (
            *place,
            status.action or ("stream" if status.stream.stream else ""),
            counts.result,
            f"{clock.measured_rate:.0f}" if clock.measured_rate else "",
            str(clock.missed),
            warm,
            counts.version,
            status.recording.rpartition("/")[2] or "off",
            "; ".join([*faults, *filter(None, [status.recording_trouble, status.agents_out])]),
        )
    )
