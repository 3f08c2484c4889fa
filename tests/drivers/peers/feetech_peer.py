"""Drive two STS servos with the servo maker's own library: `feetech_peer.py PORT`; prints JSON."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

from scservo_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

IDS, GOALS = (1, 2), (2500, 1500)
TORQUE, GOAL, POSITION = 40, 42, 56  # registers of the STS family
LITTLE_ENDIAN = 0  # the STS family's byte order, for PacketHandler


def patiently(ask: Callable[..., tuple[int, ...]], *words: object) -> tuple[int, ...]:
    """Ask until there is an answer: the library waits for 34 ms, too short on a busy computer."""
    found: tuple[int, ...] = ()
    for _ in range(50):
        found = ask(*words)
        if found[-2] == 0:  # the result; the device's error comes last
            break
    return found


def main(port_name: str) -> None:
    """Ping, move by one frame, and read where they are by one request."""
    port, packets = PortHandler(port_name), PacketHandler(LITTLE_ENDIAN)
    assert port.openPort()
    pinged = {one: patiently(packets.ping, port, one) for one in IDS}
    pinged[9] = packets.ping(port, 9)
    for one in IDS:
        patiently(packets.write1ByteTxRx, port, one, TORQUE, 1)
    write = GroupSyncWrite(port, packets, GOAL, 2)
    for one, goal in zip(IDS, GOALS, strict=True):
        write.addParam(one, [goal & 0xFF, goal >> 8])
    sent = write.txPacket()
    read, positions = GroupSyncRead(port, packets, POSITION, 2), []
    for one in IDS:
        read.addParam(one)
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        if read.txRxPacket() == 0:
            positions = [read.getData(one, POSITION, 2) for one in IDS]
            if all(abs(a - b) < 10 for a, b in zip(positions, GOALS, strict=True)):
                break
        time.sleep(0.02)
    single = [patiently(packets.read2ByteTxRx, port, one, POSITION) for one in IDS]
    port.closePort()
    print(
        json.dumps(
            {
                "models": [pinged[one][0] for one in IDS],
                "results": [pinged[one][1] for one in (*IDS, 9)],
                "sent": sent,
                "positions": positions,
                "single": single,
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1])
