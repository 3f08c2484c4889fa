"""`rtee recover`: bring devices out of a fault."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import ConnectOption, JsonOption, RunningOption

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand
    from rtee.remote.monitoring import HandStatus

app = typer.Typer()


@app.command()
def recover(
    device: Annotated[
        str | None, typer.Argument(metavar="[DEVICE]", help="One device; else all.")
    ] = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring devices out of a fault, or connect them; moves only one that must be homed."""
    from rtee.cli._online import to_json, with_hand

    async def execute(remote: RemoteHand) -> HandStatus:
        await remote.recover(device)
        return await remote.status()

    status = with_hand(hand, connect, "recover", execute)
    now = {one.name: one.lifecycle for one in status.devices if device in (None, one.name)}
    if as_json:
        print(to_json({status.hand: now}))
        return
    for name, lifecycle in now.items():
        print(f"{status.hand}: {name} is {lifecycle}")
