"""What all experiments share: where results go, recordings, plots, picture strips."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rtee.errors import UserError
from rtee.hand.files import make_folder
from rtee.log import Recorder, read
from rtee.log.figure import By, figure
from rtee.log.playback import fingers
from rtee.log.plot_png import write_png
from rtee.trials.pictures import Stills, write_strip
from rtee.trials.recorded import recorder_for
from rtee.trials.sweep import Bench, bench
from rtee.trials.trial import Trial, TrialResult, run_trial


@dataclass
class Outcome:
    """How an experiment ended.

    Attributes:
        condition: What had to be seen, in words.
        passed: It was seen.
        facts: What was measured, a line each.
        files: What was written.
    """

    condition: str
    passed: bool = True
    facts: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)

    def check(self, seen: bool, fact: str) -> None:
        """Note a fact, and whether it is as the condition wants it."""
        self.facts.append(("ok    " if seen else "FAILED ") + fact)
        self.passed = self.passed and seen


@contextmanager
def recording(ready: Bench, folder: Path, outcome: Outcome) -> Iterator[Recorder]:
    """Record into a folder; afterwards plot what was recorded beside it."""
    make_folder(folder)
    before = set(folder.glob("*.mcap"))
    with recorder_for(ready, folder) as recorder:
        yield recorder
    for path in sorted(set(folder.glob("*.mcap")) - before):
        if not len(read(path).actuator_states):
            outcome.files.append(path)
            continue
        outcome.files += [path, plot_of(path)]


def plot_of(path: Path) -> Path:
    """Plot a recording, with the spans of the actions, beside it; returns the picture's path."""
    found, plot = read(path), path.with_suffix(".png")
    write_png(figure(found, by=By.ACTUATOR, fingers=fingers(found)), plot)
    return plot


def hold(
    name: str, trial: Trial, folder: Path, outcome: Outcome, *, pictures: bool = True
) -> TrialResult:
    """Try a grasp, with recording, plot and pictures, and note whether the object was held."""
    ready = bench(name)
    stills = Stills.of_trial(ready.hand) if pictures else None
    # Once to find the place that holds, and again from there, to record nothing else.
    first = run_trial(ready.hand, ready.library, ready.settings, trial)
    with recording(ready, folder, outcome) as recorder:
        result = run_trial(
            ready.hand,
            ready.library,
            ready.settings,
            trial,
            observers=[recorder],
            watch=stills,
            skip=max(0, first.places - 1),
        )
    what = f"{name}: {' '.join((trial.action, *trial.elements))} on {trial.object}"
    outcome.check(result.held, f"{what}: {result.reason or f'slip {result.slip * 1e3:.1f} mm'}")
    if stills is not None and stills.taken:
        strip(folder / f"{name}_{trial.action}.png", stills.taken, outcome)
    return result


def strip(
    path: Path, stills: list[tuple[str, bytes]], outcome: Outcome, columns: int | None = None
) -> None:
    """Write pictures side by side, or in rows of so many columns."""
    make_folder(path.parent)
    write_strip(path, stills, columns)
    outcome.files.append(path)


def main(run: Callable[[Path], Outcome], name: str) -> None:
    """Run an experiment from the command line.

    Exit status 1 when it does not pass, 2 when something that it needs is missing.
    """
    parser = argparse.ArgumentParser(description=sys.modules[run.__module__].__doc__)
    parser.add_argument("--out", type=Path, default=Path("logs") / "experiments" / name)
    try:
        outcome = run(parser.parse_args().out)
    except UserError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(2)
    print(outcome.condition)
    for fact in outcome.facts:
        print(f"  {fact}")
    for file in outcome.files:
        print(f"  {file}")
    print("passed" if outcome.passed else "failed")
    sys.exit(0 if outcome.passed else 1)
