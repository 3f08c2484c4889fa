"""What all experiments share: where results go, recordings, plots, picture strips."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from rtee.actions.types import Action
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.drivers.mujoco.surroundings import Surroundings
from rtee.errors import UserError
from rtee.hand.files import make_folder
from rtee.hand.model import Hand
from rtee.log import Recorder, read
from rtee.log.figure import PlotSubject, figure
from rtee.log.playback import fingers
from rtee.log.plots import write_png
from rtee.loop.observer import Observer
from rtee.planning.objects import read_object
from rtee.sample import FloatArray
from rtee.trials.bench import TrialBench, bench, recorder_for
from rtee.trials.grasp_placement import fingers_of
from rtee.trials.headless import HeadlessHand
from rtee.trials.pictures import Stills, write_strip
from rtee.trials.planned import PRESSED
from rtee.trials.robust_places import robust_places
from rtee.trials.trial import Trial, TrialResult, run_trial
from rtee.types import Feedback

SLIP = 0.06
"""How far an object may move in the hand before it counts as fallen [m], as in `rtee try`."""

_ROW = 5
"""Pictures beside one another that can still be made out on a page."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Something that had to be seen, and what was.

    Attributes:
        what: What was looked at, such as ``the trigger is pressed``.
        measured: What was seen, with its unit.
        limit: What it had to be, such as ``> 5 mm``; empty when ``what`` says it.
        passed: It was so.
    """

    what: str
    measured: str
    limit: str
    passed: bool


@dataclass
class Outcome:
    """How an experiment ended.

    Attributes:
        condition: What had to be seen, in words.
        conditions: The same one by one, with what was measured.
        files: What was written.
    """

    condition: str
    conditions: list[Condition] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Everything was seen."""
        return all(condition.passed for condition in self.conditions)

    def check(self, passed: bool, what: str, measured: str = "", limit: str = "") -> None:
        """Note a condition; see `Condition`."""
        self.conditions.append(Condition(what, measured, limit, bool(passed)))

    def below(self, what: str, value: float, limit: float, unit: str, form: str = ".1f") -> None:
        """Note a value that has to be smaller than a limit, both in the unit that is printed."""
        self.check(value < limit, what, f"{value:{form}} {unit}", f"< {limit:g} {unit}")

    def touches(
        self, what: str, pressed: float, held_by: Sequence[str], fingers: Sequence[str]
    ) -> None:
        """Note what every grasp has to be: the action's fingers alone hold, and nothing is hit.

        Args:
            what: Which grasp it is.
            pressed: The largest force of another contact [N]; see `Touching`.
            held_by: The fingers that touch the lifted object.
            fingers: Those of the action.
        """
        self.below(f"{what}: presses elsewhere", pressed, PRESSED, "N")
        self.check(
            set(held_by) <= set(fingers),
            f"{what}: held by its fingers alone",
            ", ".join(held_by),
        )

    def above(self, what: str, value: float, limit: float, unit: str, form: str = ".1f") -> None:
        """Note a value that has to be larger than a limit, both in the unit that is printed."""
        self.check(value > limit, what, f"{value:{form}} {unit}", f"> {limit:g} {unit}")


HEADER = ("condition", "measured", "limit", "passed")


def cells(condition: Condition) -> tuple[str, str, str, str]:
    """Return a condition as a row under `HEADER`."""
    return (
        condition.what,
        condition.measured,
        condition.limit,
        "yes" if condition.passed else "NO",
    )


def table(header: Sequence[str], rows: Sequence[Sequence[str]], *, pad: bool = True) -> str:
    """Return a table in Markdown; padded, its columns are aligned in a terminal, too."""
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(len, column)) if pad else 0 for column in columns]
    lines = [header, ["-" * max(width, 3) for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |"
        for line in lines
    )


class Steps(Observer):
    """Tells when a step of a timed action begins, by its name."""

    def __init__(self, call: Callable[[str], None]) -> None:
        """Start before the first step.

        Args:
            call: Told the name of each step as it begins.
        """
        self._call = call
        self._now = ""

    def on_feedback(self, feedback: Feedback) -> None:
        """Notice another step."""
        if feedback.inner != self._now:
            self._now = feedback.inner
            self._call(self._now)


class Touching:
    """Notes what a hand touches from the start of a trial: a watch of it.

    Attributes:
        pressed: The largest force of the hand on what is not the object, or on the object with
            other links than those of the action's fingers [N].
        held_by: The fingers that touch the lifted object.
    """

    def __init__(self, hand: Hand, action: Action) -> None:
        """Nothing is touched yet."""
        self.fingers = fingers_of(hand, action)
        self.pressed = 0.0
        self.held_by: tuple[str, ...] = ()
        self._hand = hand
        self._links = frozenset(link for name in self.fingers for link in hand.finger(name).body)

    def __call__(self, moment: str, headless: HeadlessHand[Simulation]) -> None:
        """Begin to look at the start; look which fingers hold what is lifted."""
        around = headless.simulation.surroundings
        if moment == "start":
            headless.before_tick(lambda _: self.look(around))
        if moment == "lift":
            touching = set(around.touching())
            self.held_by = tuple(f.name for f in self._hand.fingers if touching & set(f.body))

    def look(self, around: Surroundings) -> None:
        """Look at the contacts of now."""
        self.pressed = max(self.pressed, around.pressing(self._links))


class TrialStills:
    """Takes the pictures of a trial, those of the ends of a timed action's steps among them.

    Attributes:
        stills: The pictures.
        steps: Observer of the trial.
    """

    def __init__(self, stills: Stills) -> None:
        """Start without pictures.

        Args:
            stills: What takes them.
        """
        self.stills = stills
        self.steps = Steps(self._step)
        self._headless: HeadlessHand[Simulation] | None = None
        self._before = ""

    def __call__(self, moment: str, headless: HeadlessHand[Simulation]) -> None:
        """Take a picture at a moment of the trial."""
        self._headless, self._before = headless, ""
        self.stills(moment, headless)

    def _step(self, name: str) -> None:
        if self._before and self._headless is not None:
            self.stills(self._before, self._headless)
        self._before = name


@contextmanager
def recording(ready: TrialBench, folder: Path, outcome: Outcome) -> Iterator[Recorder]:
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
    write_png(figure(found, by=PlotSubject.ACTUATOR, fingers=fingers(found)), plot)
    return plot


def steadiest(ready: TrialBench, trial: Trial) -> int:
    """Return at which of a trial's places the object slides least, counted from 0."""
    hand, library, settings = ready.hand, ready.library, ready.settings
    options = SimOptions(object=trial.object, object_mass=trial.mass, carrier="arm")
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    action = library.find(trial.action, trial.elements)
    obj = read_object(trial.object, trial.mass)
    count = len(robust_places(simulation, library, action, obj, trial.places))
    tried = [
        run_trial(ready, replace(trial, places=number + 1), skip=number) for number in range(count)
    ]
    held = [result for result in tried if result.held]
    return min(held, key=lambda result: result.slip).places - 1 if held else 0


def hold(
    name: str,
    trial: Trial,
    folder: Path,
    outcome: Outcome,
    *,
    slip: float = SLIP,
    pictures: bool = True,
    view: FloatArray | None = None,
) -> TrialResult:
    """Try a grasp at its best place, with recording, plot and pictures; note whether it held.

    Args:
        name: The hand.
        trial: What is tried.
        folder: Where recording, plot and pictures go.
        outcome: What notes the conditions.
        slip: How far the object may move in the hand from the grasp to the end [m].
        pictures: Take pictures.
        view: Vector ``(3,)`` in the world towards the camera; chosen for the hand unless given.
    """
    ready = bench(name)
    touching = Touching(ready.hand, ready.library.find(trial.action, trial.elements))
    stills = TrialStills(Stills.of_trial(ready.hand, view)) if pictures else None
    # Once at each place, and again at the best one, to record nothing else.
    skip = steadiest(ready, trial)

    def watch(moment: str, headless: HeadlessHand[Simulation]) -> None:
        for each in (touching, stills):
            if each is not None:
                each(moment, headless)

    with recording(ready, folder, outcome) as recorder:
        result = run_trial(
            ready,
            replace(trial, places=skip + 1),
            observers=[recorder] if stills is None else [recorder, stills.steps],
            watch=watch,
            skip=skip,
        )
    what = f"{name}: {' '.join((trial.action, *trial.elements))} on {trial.object}"
    outcome.check(result.held, f"{what} is lifted, held and shaken", result.reason or "held")
    if result.held:
        outcome.below(f"{what} slips in the hand", 1e3 * result.slip, 1e3 * slip, "mm")
        outcome.touches(what, touching.pressed, touching.held_by, touching.fingers)
    if stills is not None and stills.stills.taken:
        taken = stills.stills.taken
        columns = -(-len(taken) // 2) if len(taken) > _ROW else None
        strip(folder / f"{name}_{trial.action}.png", taken, outcome, columns)
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
    print(table(HEADER, [cells(condition) for condition in outcome.conditions]))
    for file in outcome.files:
        print(f"  {file}")
    print("passed" if outcome.passed else "failed")
    sys.exit(0 if outcome.passed else 1)
