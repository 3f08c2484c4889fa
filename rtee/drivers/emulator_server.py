"""Serve an emulated device to other software: on a pty, a TCP port or a CAN channel."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtee import monotonic
from rtee.buses.emulator import Emulator
from rtee.buses.faults import Faults
from rtee.buses.link import Line
from rtee.buses.simulated import SimulatedLine, Simulation
from rtee.buses.simulated_can import SimulatedCan
from rtee.buses.simulated_zmq import Serves, SimulatedZmq
from rtee.drivers.emulators import make_emulator
from rtee.drivers.objects import Grasps, ObjectInHand, grasping
from rtee.drivers.options import CanRate, Rate
from rtee.errors import ConfigError, RteeError, suggestion
from rtee.hand.validation import Invalid, validated

WIRE_FAULTS = ("drop", "corrupt", "duplicate", "delay", "split", "noise")
"""The faults that a wire can have."""
_ZMQ_PORT = 5556
"""TCP port where a ZeroMQ server publishes; the next one takes requests, the third one commands."""
HELP = """\
fault NAME        put a fault into the device
clear [NAME]      clear that fault, or all
wire NAME=SHARE   let the wire drop, corrupt, duplicate, delay or split a share of the traffic,
                  or put noise before it: wire drop=0.05 noise=0.01
unplug, replug    pull the cable, put it back
power             cut the supply for a moment
object SIZE       put an object between the fingers: 50mm wide, or met at 0.4 of the travel
object            remove the object
state             show the device
quit              end
"""


class Player:
    """An emulated device on a transport that other programs can open; a context manager.

    Without ``tcp`` and ``can``, the transport is a pty.

    Args:
        name: Name of the device's driver.
        properties: Properties of the emulated device.
        link: Path of a symbolic link to the pty; by default in a temporary folder.
        tcp: TCP port to listen on; the first of three for a ZeroMQ server.
        raw: Whether the port carries the bytes of a serial line instead of Modbus TCP.
        host: Address to listen on.
        can: Channel of a CAN bus.
        interface: The python-can interface of that channel.
        baudrate: Bit rate of the line or bus [bit/s]; by default the device's.
        strict: Whether the device ignores programs that use another bit rate, as a real one does.

    Raises:
        ConfigError: if there is no such device or property.
        BusBroken: if the port cannot be opened.
    """

    def __init__(
        self,
        name: str,
        properties: Mapping[str, Any] | None = None,
        *,
        link: Path | None = None,
        tcp: int | None = None,
        raw: bool = False,
        host: str = "127.0.0.1",
        can: str | None = None,
        interface: str = "udp_multicast",
        baudrate: int | None = None,
        strict: bool = False,
    ) -> None:
        if sum(one is not None for one in (link, tcp, can)) > 1:
            raise ConfigError("give one of --link, --tcp and --can")
        modbus_tcp = tcp is not None and not raw
        options: dict[str, Any] = {"emulator": dict(properties or {})}
        # Only the scheme matters: the emulator of a Modbus device chooses RTU or TCP frames by it.
        options["port"] = "tcp://" if modbus_tcp else "/dev/emulated"
        if baudrate is not None and can is None:
            options["baudrate"] = baudrate
        self.emulator: Emulator = make_emulator(name, options)
        _check_wire(name, self.emulator, can is not None, link is not None)
        _check_rate(name, self.emulator, baudrate, can=can is not None)
        self.emulator.baudrate = rate = baudrate or self.emulator.baudrate
        self.simulation: Simulation
        if isinstance(self.emulator, Serves):
            # States, commands, requests: by default xbot2_zmq has 5556, 5558 and 5557 for them.
            base = tcp or _ZMQ_PORT
            ports = (base, base + 2, base + 1)
            self.simulation = SimulatedZmq(name=name, host=host, ports=ports)
            self.simulation.emulators.append(self.emulator)
        elif can is not None:
            self.simulation = SimulatedCan(
                [self.emulator],
                name=name,
                channel=can,
                interface=interface,
                bitrate=baudrate or 1_000_000,
            )
        else:
            self.simulation = SimulatedLine(
                [self.emulator],
                name=name,
                tcp=tcp is not None,
                host=host,
                port=tcp or 0,
                scheme=self.emulator.SCHEME if modbus_tcp else "socket",
                link=link,
                line=Line(rate),
                strict=strict,
            )

    def __enter__(self) -> Player:
        self.simulation.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.simulation.close()

    @property
    def address(self) -> str:
        """The address at which other programs find the device."""
        return self.simulation.address

    def command(self, text: str) -> str:
        """Execute a command line and return the text to print; `HELP` lists the commands."""
        verb, _, rest = text.strip().partition(" ")
        try:
            return self._do(verb, rest.strip())
        except RteeError as error:
            return str(error)

    def _do(self, verb: str, rest: str) -> str:
        # The simulation steps the emulator in a thread, so it may only be accessed in that thread.
        call = self.simulation.call
        if verb == "fault":
            call(lambda: self.emulator.inject(rest))
        elif verb == "clear":
            call(lambda: self.emulator.clear(rest or None))
        elif verb == "wire":
            self.simulation.faults = self._wire(rest)
        elif verb == "unplug":
            self.simulation.unplug()
        elif verb == "replug":
            self.simulation.replug()
            return f"at {self.address}"
        elif verb == "power":
            self.simulation.power_cycle()
        elif verb == "object":
            call(lambda: self._object(rest))
        elif verb == "state":
            return str(call(self._state))
        elif verb:
            return HELP + f"faults: {', '.join(sorted(self.emulator.FAULTS))}"
        return ""

    def _wire(self, text: str) -> Faults:
        # A new seed for every command, so that manual trials do not repeat the same losses.
        faults = Faults(seed=int(time.time()))
        for part in text.split():
            name, _, share = part.partition("=")
            if name not in WIRE_FAULTS:
                raise ConfigError(f"unknown wire fault '{name}'; {suggestion(name, WIRE_FAULTS)}")
            try:
                probability = float(share)
            except ValueError:
                probability = math.nan
            if not 0.0 <= probability <= 1.0:
                raise ConfigError(f"'{part}' should look like {name}=0.05, a share from 0 to 1")
            setattr(faults, name, probability)
        return faults

    def _object(self, text: str) -> None:
        if text:
            grasping(self.emulator).place_object(ObjectInHand.parse(text))
        else:
            grasping(self.emulator).remove_object()

    def _state(self) -> str:
        """Return the device's state and its faults as text."""
        # Without traffic, nothing has advanced the device since the last exchange.
        self.emulator.step(monotonic.now())
        status = getattr(self.emulator, "status", None)
        state = status() if callable(status) else None
        text = ""
        if dataclasses.is_dataclass(state) and not isinstance(state, type):
            text = ", ".join(f"{k} {v}" for k, v in dataclasses.asdict(state).items())
        faults = ", ".join(sorted(self.emulator.faults)) or "none"
        return "\n".join(line for line in (text, self._closed(), f"faults: {faults}") if line)

    def _closed(self) -> str:
        closings = self.emulator.closings() if isinstance(self.emulator, Grasps) else ()
        parts = ", ".join(f"{one.part:.0%}" for one in closings)
        return f"closed: {parts}" if parts else ""


def _check_wire(name: str, emulator: Emulator, can: bool, link: bool) -> None:
    """Refuse a transport that the device does not have."""
    kind = type(emulator)
    if isinstance(emulator, Serves):
        if can or link:
            raise ConfigError(f"'{name}' is a server on the network: give --tcp PORT, or nothing")
        return
    # An emulator overrides the handlers of the transports that its device has.
    hears = kind.on_frame is not Emulator.on_frame
    reads = kind.feed is not Emulator.feed or kind.answers is not Emulator.answers
    if hears and not (reads or can):
        raise ConfigError(f"'{name}' is a device on a CAN bus: give --can CHANNEL")
    if reads and can and not hears:
        raise ConfigError(
            f"'{name}' is not a device on a CAN bus: give --link or --tcp, or neither"
        )
    if not (hears or reads):
        raise ConfigError(
            f"'{name}' is emulated without its wire, at the level of process data, so no other "
            "program can reach it; its own driver can: rtee run HAND --driver devices --emulated"
        )


def _check_rate(name: str, emulator: Emulator, baudrate: int | None, *, can: bool) -> None:
    """Refuse a rate that no bus has, or that the device cannot be set to."""
    if baudrate is None:
        return
    try:
        validated(CanRate if can else Rate, baudrate)
    except Invalid as error:
        raise ConfigError(f"'{name}' at {baudrate} baud: {error.sentence}") from None
    rates = emulator.BAUDRATES
    if rates and not can and baudrate not in rates:
        known = ", ".join(str(rate) for rate in sorted(rates))
        raise ConfigError(f"'{name}' cannot be set to {baudrate} baud; possible: {known}")
