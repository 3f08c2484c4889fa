"""`rtee scan`: find devices on all buses."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING

import typer

from rtee.cli._common import JsonOption, to_json

if TYPE_CHECKING:
    from rtee.drivers.diagnosis.scan import Address, ScanPlan


def scan(
    *,
    port: list[str] | None = None,
    host: list[str] | None = None,
    can: list[str] | None = None,
    interface: str = "socketcan",
    bitrate: int = 1_000_000,
    unit: list[int] | None = None,
    wait: float = 0.04,
    as_json: JsonOption = False,
) -> None:
    """Find devices: their ports, rates and numbers. Nothing moves.

    The exit status is 1 if a port could not be scanned.

    Arguments and options:
        port (PORT): A tty, or socket://host:port; by default, all serial ports.
        host (HOST): A Modbus TCP address, host[:port].
        can (CHANNEL): A CAN channel, such as can0.
        interface: With --can: python-can interface.
        bitrate (1..): With --can: bits per second of the bus.
        unit (0..255; N): Modbus number to query; by default, the usual ones.
        wait (0.001..60; SECONDS): Longest time for an answer; more on a busy computer or over a
            network.
    """
    import asyncio

    from rtee.buses.pool import BusPool
    from rtee.drivers.diagnosis import scan as scanning
    from rtee.drivers.diagnosis.slaves import ANSWER

    ANSWER.set(wait)

    async def execute() -> list[Address]:
        async with BusPool() as pool:
            return await scanning.scan(plans, pool, report)

    # On a terminal only: lines that are overwritten are of no use in a file.
    def report(line: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)

    plans = _plans(port, host, can, interface, bitrate, unit)
    results = asyncio.run(execute())
    # Erase the last line of progress.
    report("")
    if as_json:
        print(to_json({"addresses": [asdict(address) for address in results]}, indent=2))
    else:
        _print(results)
    raise typer.Exit(1 if any(address.problem for address in results) else 0)


def _plans(
    ports: list[str] | None,
    hosts: list[str] | None,
    channels: list[str] | None,
    interface: str,
    bitrate: int,
    units: list[int] | None,
) -> list[ScanPlan]:
    from rtee.drivers.diagnosis.can_probe import can as can_probe
    from rtee.drivers.diagnosis.scan import ScanPlan, network_probes, serial_ports, serial_probes

    # Where an address is given, the other ports of this computer are left alone.
    given = ports or hosts or channels
    described = [(port, "") for port in ports or ()] if given else serial_ports()
    plans = [ScanPlan(port, about, serial_probes(units)) for port, about in described]
    plans += [ScanPlan(f"tcp://{host}", probes=network_probes(units)) for host in hosts or ()]
    plans += [ScanPlan(c, probes=(can_probe(interface, bitrate),)) for c in channels or ()]
    return plans


def _print(results: list[Address]) -> None:
    if not results:
        print("no serial ports; give --host or --can for devices elsewhere")
    for address in results:
        about = f" ({address.about})" if address.about else ""
        print(f"{address.address}{about}")
        if address.problem:
            print(f"  not asked: {address.problem}")
        for device in address.found:
            settings = ", ".join(f"{name}: {value}" for name, value in device.options.items())
            driver = f"driver: {device.driver}, " if device.driver else ""
            print(f"  {device.what}   {{{driver}options: {{{settings}}}}}")
        if not address.found and not address.problem:
            print("  nobody answers")
