"""All experiments, or those that are named: ``python -m experiments [NAME ...]``.

Prints one table of all conditions with what was measured, and writes it into docs/experiments.md,
where it replaces the rows of the experiments that were run. Exit status 1 when a condition is not
met, 2 when something that an experiment needs is missing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from experiments import dagana_gui, drill, heri_objects, same_object, svh, variants, wide_grasp
from experiments.common import HEADER, Outcome, cells, table
from rtee.errors import UserError
from rtee.hand.files import write_atomically

EXPERIMENTS: Mapping[str, Callable[[Path], Outcome]] = {
    "svh": svh.run,
    "variants": variants.run,
    "drill": drill.run,
    "wide_grasp": wide_grasp.run,
    "dagana_gui": dagana_gui.run,
    "same_object": same_object.run,
    "heri_objects": heri_objects.run,
}
"""In the order of the paper's figures."""

FULL = ("experiment", *HEADER)

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
PAGE = Path(__file__).parents[1] / "docs" / "experiments.md"


def rows_of(name: str, outcome: Outcome) -> list[tuple[str, ...]]:
    """Return the rows of an experiment, the first cell its name."""
    return [(name, *cells(condition)) for condition in outcome.conditions]


def written(text: str, new: Mapping[str, Sequence[Sequence[str]]]) -> str:
    """Return the page with the rows of some experiments replaced and all others as they were.

    Args:
        text: The page, with its two markers.
        new: Rows by experiment.
    """
    before, rest = text.split(BEGIN)
    old, after = rest.split(END)
    kept: dict[str, list[Sequence[str]]] = {}
    for line in old.strip().splitlines()[2:]:
        row = [cell.strip() for cell in line.strip().strip("|").split(" | ")]
        kept.setdefault(row[0], []).append(row)
    rows = [row for name in EXPERIMENTS for row in new.get(name, kept.get(name, ()))]
    return f"{before}{BEGIN}\n{table(FULL, rows, pad=False)}\n{END}{after}"


def main() -> None:
    """Run the experiments from the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="; ".join(EXPERIMENTS))
    parser.add_argument("--out", type=Path, default=Path("logs") / "experiments")
    asked = parser.parse_args()
    if unknown := set(asked.names) - set(EXPERIMENTS):
        parser.error(f"there is no experiment {', '.join(sorted(unknown))}")
    found: dict[str, list[tuple[str, ...]]] = {}
    passed, missing = True, False
    for name in asked.names or EXPERIMENTS:
        try:
            outcome = EXPERIMENTS[name](asked.out / name)
        except UserError as error:
            print(f"{name}: {error}", file=sys.stderr)
            missing = True
            continue
        print(f"{name}: {'passed' if outcome.passed else 'failed'}", flush=True)
        found[name] = rows_of(name, outcome)
        passed = passed and outcome.passed
    print(table(FULL, [row for rows in found.values() for row in rows]))
    write_atomically(PAGE, written(PAGE.read_text(), found))
    sys.exit(2 if missing else 0 if passed else 1)


if __name__ == "__main__":
    main()
