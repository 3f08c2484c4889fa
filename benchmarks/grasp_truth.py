"""Compare what hands say of a grasp with what the contacts of MuJoCo say, in simulated time.

Every hand closes by width and force on objects that it has not been tuned to: boxes and spheres of
five sizes, three forces, at its own speed and at 20 mm/s, with the fingers' forces measured
("sensors") and by effort alone; and on nothing, on soft, slippery and heavy things. Tables: the
blow, the force and the width; whether what is said to be held is; and for each hand what is said of
what is held between the tips or beside them, and of what is not.
Run: python benchmarks/grasp_truth.py
"""

from __future__ import annotations

import argparse
import json
import math
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from common import Table
from grasp_cases import RATE, Case, CaseObject, Truth, Unfit, try_case

from rtee.errors import RteeError, SimulationUnstable
from rtee.loop.planning import make_plan
from rtee.trials.bench import TrialBench, bench
from rtee.types import Around, Fingers, Goal

CONFIG = Path(__file__).resolve().parents[1] / "config"
SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the range of openings
FORCES = (0.1, 0.3, 0.6)  # of the range of forces there
PEAK = 1.3  # a blow may exceed the force asked by this factor
PEAK_LEAST = 1.0  # or by this much [N]
FLAT, ROUND = 0.3, 0.5  # by which an opening may be off, for boxes and for round things [mm]
NEAR = 0.1  # share by which a measured force may be off
THIN = (0.002, 0.004, 0.008)  # widths of plates [m]


def range_of(ready: TrialBench) -> tuple[float, float]:
    """Return the narrowest and the widest opening of a hand [m]."""
    openings = list(ready.library.openings.tables)
    return min(o.narrowest for o in openings), max(o.widest for o in openings)


def forces_at(ready: TrialBench, width: float) -> tuple[float, ...]:
    """Return the forces to ask for at a width [N]."""
    plan = make_plan(Goal(Fingers(), Around(width)), ready.hand, ready.library, ready.settings)
    assert plan.grip is not None
    low, high = plan.grip.forces(ready.hand, plan.grip.intensity_at(width))
    return tuple(float(f"{low + share * (high - low):.2g}") for share in FORCES)


def force_cases(ready: TrialBench, quick: bool) -> Iterator[Case]:
    """Yield the tries of the blow and the force."""
    narrow, wide = range_of(ready)
    for share in (0.3, 0.7) if quick else SHARES:
        width = round(max(narrow + share * (min(wide, 0.1) - narrow), 0.01), 4)
        try:
            forces = forces_at(ready, width)
        except RteeError:
            continue
        for force in forces[1:2] if quick else forces:
            for thing in (CaseObject.BOX, CaseObject.SPHERE):
                for speed in (None,) if quick else (None, 0.02):
                    for numb in (False, True):
                        yield Case(thing, width, force, speed, numb)


def held_cases(ready: TrialBench, quick: bool) -> Iterator[Case]:
    """Yield the tries of what is said to be held."""
    narrow, wide = range_of(ready)
    middle = round(narrow + 0.5 * (min(wide, 0.09) - narrow), 4)
    plates = [w for w in THIN if narrow <= w < wide]
    for numb in (False, True):
        for width in (0.004, middle) if quick else (0.004, 0.03, middle):
            if narrow - 0.005 <= width < wide:
                try:
                    force = forces_at(ready, max(width, narrow))[1]
                except RteeError:
                    continue
                yield Case(CaseObject.NONE, width, force, None, numb)
        for width in plates[:1] if quick else plates:
            yield Case(CaseObject.BOX, width, forces_at(ready, width)[1], None, numb)
        for thing in (CaseObject.CYLINDER, CaseObject.SOFT, CaseObject.HEAVY, CaseObject.SLIPPERY):
            try:
                force = forces_at(ready, middle)[1]
            except RteeError:
                continue
            yield Case(thing, middle, force, None, numb)


@dataclass(frozen=True)
class Row:
    """What one try came to, as it is written to a file; forces [N], lengths [m].

    ``end`` is ``tried``, or why there was no try; the other figures are those of `Truth`.
    """

    hand: str
    part: str
    thing: str
    width: float
    force: float
    speed: float | None
    numb: bool
    seed: int
    end: str
    cpu: float
    action: str = ""
    said: bool = False
    unknown: bool = False
    held: bool = False
    pinched: bool = False
    grasped: bool = False
    reached: bool = False
    peak: float = math.nan
    low: float = math.nan
    high: float = math.nan
    own: float = math.nan
    met: float = math.nan
    gap: float = math.nan
    opening: float | None = None
    opening_error: float | None = None
    force_said: float | None = None
    force_error: float | None = None
    shortfall: str = ""

    @property
    def soft_enough(self) -> bool:
        """Whether the blow is within its goal."""
        return self.peak <= max(PEAK * self.force, self.force + PEAK_LEAST)

    @property
    def offs(self) -> tuple[float, float]:
        """By which share the least and the largest force are off."""
        return self.low / self.force - 1.0, self.high / self.force - 1.0

    @property
    def weak(self) -> bool:
        """Whether the force is always less than the one asked for, by more than `NEAR`."""
        return self.offs[1] < -NEAR

    @property
    def said_right(self) -> bool | None:
        """Whether the force is within what was said of it; ``None``: nothing was."""
        if self.force_said is None or self.force_error is None:
            return None
        least, most = self.force_said - self.force_error, self.force_said + self.force_error
        return least <= self.low and self.high <= most

    @property
    def met_right(self) -> bool | None:
        """Whether the opening is within its error where both sides met it; ``None``: not known."""
        if self.opening is None or self.opening_error is None or math.isnan(self.met):
            return None
        return abs(self.opening - self.met) <= self.opening_error

    @property
    def where(self) -> str:
        """Where the object is: between the tips, beside them, or not in the hand."""
        return "pinched" if self.pinched else "beside" if self.held else "not held"

    @property
    def word(self) -> str:
        """What the hand says of the object."""
        return "grasped" if self.said else "unknown" if self.unknown else "not grasped"

    @property
    def wider(self) -> float | None:
        """By how much the opening that was said exceeds the width [mm]; ``None``: none was."""
        return None if self.opening is None else 1e3 * (self.opening - self.width)


def tried(ready: TrialBench, hand: str, part: str, case: Case) -> Row:
    """Do a try, and return what it came to."""
    began = time.process_time()
    truth: Truth | None = None
    try:
        truth, end = try_case(ready, case), "tried"
    except SimulationUnstable:
        end = "unstable"
    except Unfit:
        end = "fits nowhere"
    except RteeError as error:
        end = f"refused: {error}"
    cpu = round(time.process_time() - began, 2)
    force = case.force or math.nan
    row = Row(
        hand, part, case.thing, case.width, force, case.speed, case.numb, case.seed, end, cpu
    )  # fmt: skip
    if truth is None:
        return row
    result = truth.result
    return replace(
        row,
        action=result.action,
        said=truth.said,
        unknown=truth.unknown,
        held=truth.held,
        pinched=truth.pinched,
        grasped=result.grasped,
        reached=result.reached,
        peak=truth.peak,
        low=truth.low,
        high=truth.high,
        own=truth.own,
        met=truth.met,
        gap=truth.gap,
        opening=result.opening,
        opening_error=result.opening_error,
        force_said=result.force,
        force_error=result.force_error,
        shortfall=result.shortfall,
    )


def rate(values: Sequence[bool]) -> str:
    """Return how many of some are true."""
    return f"{sum(values)} of {len(values)}" if values else "–"


def span(values: Sequence[float], form: str) -> str:
    """Return the least and the largest of some values."""
    return f"{min(values):{form}} to {max(values):{form}}" if values else "–"


def tables(rows: Sequence[Row]) -> None:
    """Print the tables of the goals."""
    done = [row for row in rows if row.end == "tried"]
    groups = list(dict.fromkeys((row.hand, row.numb) for row in done))
    print("\nThe blow, the force and the width.\n")
    table = Table(
        "hand", "sensors", "held", "peak within", "worst peak / asked", "force within 10 %", "off",
        "less: said so", "said to be less: is", "within its ±", "opening within its ±",
        "width within", "width off mm",
    )  # fmt: skip
    for hand, numb in groups:
        some = [r for r in done if (r.hand, r.numb, r.part) == (hand, numb, "force")]
        if not some:
            continue
        got = [r for r in some if r.said and r.held]
        wide = [(r.thing, w) for r in got if (w := r.wider) is not None]
        table.row(
            hand,
            "no" if numb else "yes",
            rate([r.said and r.held for r in some]),
            rate([r.soft_enough for r in some]),
            f"{max(r.peak / r.force for r in some):.2f}",
            rate([max(map(abs, r.offs)) <= NEAR for r in got]),
            span([off for r in got for off in r.offs], "+.0%"),
            rate([bool(r.shortfall) for r in got if r.weak]),
            rate([r.high < r.force for r in got if r.shortfall]),
            rate([right for r in got if (right := r.said_right) is not None]),
            rate([right for r in got if (right := r.met_right) is not None]),
            rate([abs(w) <= (ROUND if thing == CaseObject.SPHERE else FLAT) for thing, w in wide]),
            span([w for _, w in wide], "+.1f"),
        )
    print("\nWhat is said to be held.\n")
    table = Table(
        "hand", "sensors", "grasped with nothing", "grasped and lost unsaid", "missed", "unknown"
    )
    for hand, numb in groups:
        some = [r for r in done if (r.hand, r.numb) == (hand, numb)]
        things = [r for r in some if r.thing != CaseObject.NONE]
        table.row(
            hand,
            "no" if numb else "yes",
            rate([r.said for r in some if r.thing == CaseObject.NONE]),
            rate([r.said and not r.held for r in things]),
            rate([not (r.said or r.unknown) for r in things if CaseObject(r.thing).holds]),
            rate([r.unknown for r in some]),
        )
    print("\nWhat is said of what is held between the tips or beside them, and of what is not.\n")
    words = ("grasped", "unknown", "not grasped")
    places = ("pinched", "beside", "not held")
    table = Table("hand", "sensors", *(f"{true}: {word}" for true in places for word in words))
    for hand, numb in groups:
        some = [r for r in done if (r.hand, r.numb) == (hand, numb)]
        counts = [
            str(sum(r.where == true and r.word == word for r in some))
            for true in places
            for word in words
        ]
        table.row(hand, "no" if numb else "yes", *counts)


def main() -> None:
    """Run the sweep, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", nargs="+", help="these hands only")
    parser.add_argument("--quick", action="store_true", help="a small part of the sweep")
    parser.add_argument("--every", type=int, default=1, help="about one of so many tries")
    parser.add_argument("--seed", type=int, default=0, help="of places and frictions")
    parser.add_argument("--out", type=Path, help="add every try to this file, a line each")
    parser.add_argument("--read", type=Path, nargs="+", help="print the tables of such files")
    arguments = parser.parse_args()
    if arguments.read:
        lines = [line for path in arguments.read for line in path.read_text().splitlines()]
        tables([Row(**json.loads(line)) for line in lines])
        return
    rows = []
    for hand in arguments.hand or sorted(p.parent.name for p in CONFIG.glob("*/openings.yaml")):
        ready = bench(str(CONFIG / hand), RATE)
        for part, made in (("force", force_cases), ("held", held_cases)):
            for number, case in enumerate(made(ready, arguments.quick)):
                seed = zlib.crc32(f"{arguments.seed}/{hand}/{part}/{number}".encode())
                if seed % arguments.every:
                    continue
                rows.append(tried(ready, hand, part, replace(case, seed=seed)))
                if arguments.out:
                    with arguments.out.open("a") as file:
                        file.write(json.dumps(asdict(rows[-1])) + "\n")
    tables(rows)


if __name__ == "__main__":
    main()
