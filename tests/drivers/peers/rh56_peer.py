"""Drive an RH56 with pyrh56: `rh56_peer.py PORT`; prints JSON, waits for a line, prints JSON.

In between the other side puts a fault into the hand.
"""

from __future__ import annotations

import json
import sys

from rh56_sdk import RH56Driver


def main(port: str) -> None:
    """Identify the hand, move it, read it; then report and clear a fault."""
    with RH56Driver(port, timeout=1.0) as hand:
        before = hand.read_status()
        hand.check_motion_ready()
        hand.set_speed([1000] * 6)
        hand.set_force_threshold([500] * 6)
        hand.move_finger(3, 400, base="hold")
        hand.wait_until_reached([None, None, None, 400, None, None], timeout=20.0)
        hand.move_to([900, 800, 700, 600, 500, 500])
        angles = hand.wait_until_reached([900, 800, 700, 600, 500, 500], timeout=20.0)
        told = {
            "before": before,
            "angles": angles,
            "status": hand.read_status(),
            "voltage": hand.read_voltage(),
            "temperature": hand.read_temperature(),
        }
        print(json.dumps(told), flush=True)
        sys.stdin.readline()
        error = hand.read_error()
        sys.stdout.write(json.dumps({"error": error}) + "\n")
        sys.stdout.flush()
        sys.stdin.readline()
        hand.clear_error()
        hand.save_parameters()
        print(json.dumps({"cleared": hand.read_error()}))


if __name__ == "__main__":
    main(sys.argv[1])
