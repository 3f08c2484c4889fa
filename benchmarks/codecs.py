"""Every decoder against random and mutated frames, a million each.

    python benchmarks/codecs.py [--frames 1000000] [--only NAME]

Nothing but a decoder's own error may be raised, its buffer stays bounded, and after any garbage it
finds the next good frame but one at the latest.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rtee.testing.fuzz import fuzz
from tests.testing.decoders import DECODERS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--only")
    arguments = parser.parse_args()
    names = ("frames", "decoded", "refused", "kept", "lost", "per s")
    print("decoder".ljust(26) + "".join(f"{name:>10}" for name in names))
    bad = 0
    for decoder in DECODERS:
        if arguments.only and arguments.only not in decoder.name:
            continue
        start = time.perf_counter()
        found = fuzz(decoder, arguments.frames)
        rate = found.frames / (time.perf_counter() - start)
        print(
            f"{decoder.name:26}{found.frames:10}{found.accepted:10}{found.rejected:10}"
            f"{found.kept:10}{found.lost:10}{rate:10.0f}",
            flush=True,
        )
        for failure in found.failures:
            print(f"    {failure}")
        bad += bool(found.failures)
    return bad


if __name__ == "__main__":
    sys.exit(main())
