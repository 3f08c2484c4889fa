"""Drive an Ability Hand with the maker's client: `ability_peer.py PORT GOAL REPLY`; prints JSON.

GOAL is a JSON list of six angles [degrees], REPLY the form of the hand's replies: 0, 1 or 2.
"""

from __future__ import annotations

import json
import sys
import time

from ah_wrapper.ah_serial_client import AHSerialClient


def main(port: str, goal: list[float], reply: int) -> None:
    """Move to the goal, and print positions, touch, currents and velocities."""
    client = AHSerialClient(port=port, baud_rate=460800, reply_mode=reply, rate_hz=100)
    end = time.monotonic() + 30.0
    while time.monotonic() < end:
        client.set_position(goal)
        here = client.hand.get_position()
        # The first finger may be blocked.
        if here and all(abs(a - b) < 1.0 for a, b in zip(here[1:], goal[1:], strict=True)):
            break
        time.sleep(0.01)
    time.sleep(0.3)  # until the velocities are 0
    hand = client.hand
    told = [hand.get_position(), hand.get_fsr(), hand.get_current(), hand.get_velocity()]
    client.close()  # which prints, too
    print(json.dumps(told))


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3]))
