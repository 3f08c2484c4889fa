"""`rtee open`: open the hand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from rtee.cli._common import (
    ConnectOption,
    JsonOption,
    RunningOption,
    WaitingCommand,
    WaitOption,
)

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand
    from rtee.types import Result

app = typer.Typer()


@app.command(name="open", cls=WaitingCommand)
def open_(
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring the hand to its rest posture, or do its action "open" if it has one."""
    from rtee.cli._online import result_json, sentence, with_hand
    from rtee.cli._progress import follow

    async def execute(remote: RemoteHand) -> Result:
        return await follow(await remote.start("open"), "open")

    result = with_hand(hand, connect, "open", execute, wait=wait)
    print(result_json(result) if as_json else sentence(result))
    raise typer.Exit(0 if result.succeeded else 1)
