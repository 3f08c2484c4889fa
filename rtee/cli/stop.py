"""`rtee stop` and `rtee recover`: stop a hand, and bring its devices out of a fault."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import typer

from rtee.cli._common import ConnectOption, JsonOption, RunningOption, to_json, with_hand
from rtee.errors import RteeError

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand
    from rtee.remote.monitoring import HandStatus


def stop(
    hand: RunningOption = None, connect: ConnectOption = None, as_json: JsonOption = False
) -> None:
    """Stop a hand now, whichever client holds its lease; without a name all on this computer.

    Example: rtee stop schunk_svh
    """
    import anyio

    from rtee.remote.client import stop_hand
    from rtee.remote.directory import hands_running

    names: list[str | None] = [hand]
    if hand is None and connect is None:
        # If none runs, looking for one raises the error that says so.
        names = list(hands_running()) or [None]
    confirmed: dict[str, dict[str, bool]] = {}
    errors: list[RteeError] = []

    async def stop_one(name: str | None) -> None:
        try:
            stopped, devices = await stop_hand(name, endpoint=connect, client="rtee-stop")
            confirmed[stopped] = devices
            if as_json:
                return
            for device, done in devices.items():  # printed now: another hand may not answer
                words = "has stopped" if done else "did NOT confirm the stop"
                print(f"{stopped}: {device} {words}", flush=True)
        # Raised here, it would cancel the stop of the other hands.
        except RteeError as error:
            errors.append(error)

    async def stop_all() -> None:
        async with anyio.create_task_group() as group:
            for name in names:
                # All at once, so that no hand moves on while another is slow to answer.
                group.start_soon(stop_one, name)

    anyio.run(stop_all)
    if as_json:
        print(to_json(confirmed))
    # The first one is raised below, and printed where it is caught.
    for error in errors[1:]:
        print(f"rtee: {error}", file=sys.stderr)
    if errors:
        raise errors[0]
    raise typer.Exit(0 if all(all(devices.values()) for devices in confirmed.values()) else 1)


def recover(
    device: str | None = None,
    *,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring devices out of a fault, or connect them; only a device that must be homed moves.

    Arguments and options:
        device ([DEVICE]): One device; by default all.
    """

    async def execute(remote: RemoteHand) -> HandStatus:
        await remote.recover(device)
        return await remote.status()

    status = with_hand(hand, connect, "recover", execute)
    now = {entry.name: entry.lifecycle for entry in status.devices if device in (None, entry.name)}
    if as_json:
        print(to_json({status.hand: now}))
        return
    for name, lifecycle in now.items():
        print(f"{status.hand}: {name} is {lifecycle}")
