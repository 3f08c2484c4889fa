"""Run every decoder against random and mutated frames, a million each.

    python benchmarks/codecs.py [--frames 1000000] [--only NAME]

Nothing but a decoder's own error may be raised, its buffer stays bounded, and after any garbage it
finds the next good frame but one at the latest.
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
        start = time.perf_counter()
        found = fuzz(decoder, arguments.frames)
        rate = found.frames / (time.perf_counter() - start)
        numbers = (found.frames, found.accepted, found.rejected, found.kept, found.lost)
        table.row(decoder.name, *numbers, f"{rate:.0f}", "; ".join(map(str, found.failures)))
        bad += bool(found.failures)
    return bad


if __name__ == "__main__":
    sys.exit(main())
