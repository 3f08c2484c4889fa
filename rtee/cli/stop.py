"""`rtee stop`: stop the hand, whoever holds it."""

from __future__ import annotations

import sys

import typer

from rtee.cli._common import ConnectOption, JsonOption, RunningOption
from rtee.errors import RteeError

app = typer.Typer()


@app.command()
def stop(
    hand: RunningOption = None, connect: ConnectOption = None, as_json: JsonOption = False
) -> None:
    """Stop a hand now, whoever holds it; without --hand all that run on this computer."""
    import anyio

    from rtee.cli._online import to_json
    from rtee.remote.client import RemoteHand
    from rtee.remote.client import connect as connected
    from rtee.remote.find import hands_running

    names: list[str | None] = [hand]
    if hand is None and connect is None:
        names = list(hands_running()) or [None]
    confirmed: dict[str, dict[str, bool]] = {}
    errors: list[RteeError] = []

    async def one(name: str | None) -> None:
        try:
            async with connected(name, endpoint=connect, client="rtee-stop") as remote:
                remote_hand: RemoteHand = remote
                devices = confirmed[remote_hand.name] = await remote_hand.stop()
            if as_json:
                return
            for device, done in devices.items():  # at once: another hand may not answer
                words = "has stopped" if done else "did NOT confirm the stop"
                print(f"{remote_hand.name}: {device} {words}", flush=True)
        except RteeError as error:
            errors.append(error)

    async def everyone() -> None:
        async with anyio.create_task_group() as group:
            for name in names:
                group.start_soon(one, name)

    anyio.run(everyone)
    if as_json:
        print(to_json(confirmed))
    for error in errors[1:]:
        print(f"rtee: {error}", file=sys.stderr)
    if errors:
        raise errors[0]
    raise typer.Exit(0 if all(all(devices.values()) for devices in confirmed.values()) else 1)
