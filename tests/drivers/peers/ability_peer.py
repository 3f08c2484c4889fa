"""Drive an Ability Hand with the maker's own library: `ability_peer.py PORT`; prints JSON.

The library writes its settings and a log into the working directory.
"""

from __future__ import annotations

import json
import sys
import time

from ah_wrapper import AHSerialClient

GOAL = [20.0, 30.0, 40.0, 50.0, 25.0, -35.0]  # degrees; the thumb's rotator is negative
POSITION_CURRENT_TOUCH, POSITION_VELOCITY_TOUCH, POSITION_CURRENT_VELOCITY = range(3)


def main(port: str) -> None:
    """Move to a posture with each form of reply, and tell what the hand has said."""
    client = AHSerialClient(port=port, baud_rate=460800, write_timeout=1.0, rate_hz=100)
    try:
        client.set_position(GOAL, reply_mode=POSITION_CURRENT_TOUCH)
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            position = client.hand.get_position()
            if position and all(abs(a - b) < 2.0 for a, b in zip(position, GOAL, strict=True)):
                break
            time.sleep(0.02)
        touch = client.hand.get_fsr()
        client.set_position(GOAL, reply_mode=POSITION_CURRENT_VELOCITY)
        while time.monotonic() < end and client.hand.get_velocity() is None:
            time.sleep(0.02)
        found = {
            "position": client.hand.get_position(),
            "current": client.hand.get_current(),
            "velocity": client.hand.get_velocity(),
            "touch": len(touch or ()),
            "read": client.n_reads,
        }
    finally:
        client.close()
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
