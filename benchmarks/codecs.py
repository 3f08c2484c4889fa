"""Run every decoder against random and mutated frames, a million each.

    python benchmarks/codecs.py [--frames 1000000] [--only NAME]

Frames a second are those of processor time, which other programs hardly disturb.

A decoder may raise only its own error, its buffer must stay bounded, and after any garbage it must
find the second good frame at the latest.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Table, command_line

from tests.testing.decoders import DECODERS
from tests.testing.fuzz import fuzz


def main() -> int:
    arguments = command_line(__doc__, frames=1_000_000, only=str).parse_args()
    names = ("decoder", "frames", "decoded", "refused", "kept", "lost", "per s", "failures")
    table = Table(*names, widths=(26, 8, 8, 8, 8, 8, 8))
    bad = 0
    for decoder in DECODERS:
        if arguments.only and arguments.only not in decoder.name:
            continue
        start = time.process_time()
        outcome = fuzz(decoder, arguments.frames)
        rate = outcome.frames / (time.process_time() - start)
        numbers = (
            outcome.frames, outcome.accepted, outcome.rejected, outcome.kept, outcome.lost,
        )  # fmt: skip
        table.row(decoder.name, *numbers, f"{rate:.0f}", "; ".join(map(str, outcome.failures)))
        bad += bool(outcome.failures)
    return bad


if __name__ == "__main__":
    sys.exit(main())
