"""`rtee emulate`: emulate a device for other software."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import IdealOption, named_values

if TYPE_CHECKING:
    from rtee.drivers.emulator_server import Player


def _complete_device(incomplete: str) -> list[str]:
    from rtee.drivers.emulators import emulator_names

    return [name for name in emulator_names() if name.startswith(incomplete)]


def emulate(
    device: Annotated[str, typer.Argument(autocompletion=_complete_device)],
    *,
    link: Path | None = None,
    tcp: int | None = None,
    host: str = "127.0.0.1",
    raw: bool = False,
    can: str | None = None,
    interface: str = "udp_multicast",
    baudrate: int | None = None,
    strict_rate: bool = False,
    set_: list[str] | None = None,
    object_: str | None = None,
    ideal: IdealOption = False,
    fault: list[str] | None = None,
) -> None:
    """Emulate a device for other software until Ctrl-C; typed lines cause faults.

    Arguments and options:
        device (DEVICE): Name of a driver.
        link (PATH): Make a link to the port at this path.
        tcp (0..65535; PORT): Listen on a TCP port.
        host: With --tcp: address to listen on.
        raw: With --tcp: the port carries a serial line's bytes.
        can (CHANNEL): Be a node on a CAN channel.
        interface: With --can: python-can interface of the channel.
        baudrate (1..): Bits per second.
        strict_rate: Without --tcp or --can: on the tty, receive only at that rate.
        set_ (NAME=VALUE): A property of the emulated device, written as in YAML: unit=9, 'ids=[1,
            2, 3]'.
        object_ (SIZE): Object between its fingers: 50mm, or the fraction of the closing travel,
            0.4.
        ideal: As on its data sheet, without lag, backlash or noise.
        fault (NAME): A fault that it has from the start.
    """
    from rtee.drivers.emulator_server import Player
    from rtee.drivers.objects import IDEAL_STATE, WEAR, WORN_STATE, ObjectInHand, grasping

    properties = named_values(set_ or [], "--set", "the property")
    player = Player(
        device,
        {WEAR: IDEAL_STATE if ideal else WORN_STATE, **properties},
        link=link,
        tcp=tcp,
        raw=raw,
        host=host,
        can=can,
        interface=interface,
        baudrate=baudrate,
        strict=strict_rate,
    )
    if object_ is not None:
        grasping(player.emulator).place_object(ObjectInHand.parse(object_))
    # Before the port opens, so that no program sees the device without its faults.
    for name in fault or []:
        player.emulator.inject(name)
    with player:
        print(f"{device} at {player.address}", flush=True)
        _converse(player)


def _converse(player: Player) -> None:
    """Carry out typed lines; at the end of the input, wait for Ctrl-C."""
    import signal
    import sys

    # systemd ends a service by SIGTERM; exiting by exception removes the link to the port.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    for line in sys.stdin:
        if line.strip() in ("quit", "exit"):
            return
        answer = player.command(line)
        if answer:
            print(answer, flush=True)
    # A service has no input, but its device has to stay.
    signal.pause()
