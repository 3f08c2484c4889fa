"""Probes a CAN bus for nodes; moves nothing."""

from __future__ import annotations

import asyncio

from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame
from rtee.drivers.diagnosis.probes import OWNER, Probe, probe
from rtee.drivers.diagnosis.slaves import Found

_HAND_INFO = 7
"""Length of an Allegro Hand's information [byte]."""

_DEVICE_TYPE = 0x1000, 0
"""Object and subindex of the device type, which every CANopen node has (CiA 301)."""
_DRIVES = 402
"""Device profile number of drives (CiA 402)."""


def can(interface: str, bitrate: int) -> Probe:
    """Return a probe for nodes on a CAN bus: Allegro Hands, LinkerHands and CANopen."""
    return probe(
        "CAN",
        lambda pool, at: pool.can(at, owner=OWNER, interface=interface, bitrate=bitrate),
        lambda bus, channel: _nodes(bus, channel, interface),
    )


async def _nodes(bus: CanBus, channel: str, interface: str) -> list[Found]:
    from rtee.drivers.allegro.codec import Command, request
    from rtee.drivers.cia402 import cia301
    from rtee.drivers.linkerhand import codec as linker

    heard: dict[int, bytes] = {}
    forms: set[tuple[int, bytes, int]] = set()
    device_type = cia301.Sdo.upload(*_DEVICE_TYPE).to_bytes()

    def hear(frame: CanFrame) -> None:
        if not frame.remote:  # some interfaces echo sent frames
            heard.setdefault(frame.id, frame.data)
            # All answers of a LinkerHand have the same id, so only code and length differ.
            forms.add((frame.id, frame.data[:1], len(frame.data)))

    undo = bus.subscribe(hear)
    try:
        for hand in range(4):
            bus.send_now(request(Command.HAND_INFO, hand))
        for unit in (linker.RIGHT, linker.LEFT):
            for code in (1, 4):  # both halves of the positions
                bus.send_now(linker.query(unit, code))
        for node in range(1, cia301.NODES + 1):
            bus.send_now(CanFrame(cia301.SDO_REQUEST + node, device_type))
            # One request per millisecond, so that buffers do not overflow on a slow bus.
            await asyncio.sleep(0.001)
        # Long enough to receive a heartbeat of nodes that send nothing else.
        await asyncio.sleep(0.6)
    finally:
        undo()
    where = {"channel": channel, "interface": interface}
    found = [
        Found("allegro", f"Allegro Hand {hand}", {**where, "hand": hand})
        for hand in range(4)
        if len(heard.get(request(Command.HAND_INFO, hand).id, b"")) >= _HAND_INFO
    ]
    for unit in (linker.RIGHT, linker.LEFT):
        if (unit, b"\x01", 7) in forms:
            # Ten positions take a second frame, which a hand with six does not send.
            model = "l10" if (unit, b"\x04", 5) in forms else "o6"
            options = {**where, "model": model, "unit": unit}
            found.append(Found("linkerhand", f"LinkerHand {model.upper()}, unit {unit}", options))
    for node in range(1, cia301.NODES + 1):
        answer = heard.get(cia301.SDO_ANSWER + node)
        if answer is not None and len(answer) == cia301.FULL:
            # The low half of the device type is the number of the device profile.
            uploaded = answer[0] & 0xE0 == cia301.UPLOAD
            drive = uploaded and int.from_bytes(answer[4:6], "little") == _DRIVES
            name, driver = ("CiA 402 drive", "cia402") if drive else ("CANopen node", "")
            found.append(Found(driver, f"{name} {node}", {**where, "id": node}))
        elif cia301.HEARTBEAT + node in heard:
            found.append(Found("", f"CANopen node {node} (heartbeat only)", where))
    return found
