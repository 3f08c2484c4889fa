"""Drive an RH56DFTP with inspire_rh56dftp: `dftp_peer.py HOST PORT`; prints JSON."""

from __future__ import annotations

import json
import sys
import time

from inspire_rh56dftp.client import InspireHand


def main(host: str, port: int) -> None:
    """Move the hand, and read its angles, errors and a row of taxels."""
    hand = InspireHand(ip=host, port=port)
    goal = [900, 800, 700, 600, 500, 400]
    sent = hand.send_raw(goal)
    end, angles = time.monotonic() + 20.0, None
    while time.monotonic() < end:
        angles = hand.read_holding(1546, 6)
        if angles and all(abs(a - b) <= 20 for a, b in zip(angles, goal, strict=True)):
            break
        time.sleep(0.05)
    told = {
        "sent": sent,
        "angles": angles,
        "errors": hand.read_holding(1606, 3),
        "taxels": hand.read_holding(3000, 9),
    }
    hand.close()
    print(json.dumps(told))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
