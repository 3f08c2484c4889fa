"""Count how often a planned grasp holds in dynamics, beside the best stored and a random action.

Objects without an action made for them (``experiments/objects``) are grasped, lifted, held and
shaken:

- *planned*: the first choice of `rtee grasp-plan`, from geometry alone, where it puts the object;
- *checked*: the first choice of `rtee grasp-plan --check`, which tries the best three, and further
  ones until one holds;
- *stored*: the action that held most of the standard objects in the hand's ``trials.yaml``, at the
  first place that `rtee try` finds for it;
- *random*: an action drawn from all of the hand's, the same way.

Run: ``python benchmarks/grasp_plan.py [--hands H …] [--only THING] [--places N] [--no-trials]``;
prints Markdown. ``--table`` tries the first choices for what stands on a table, there and with
variations (``--varied`` of them, of another ``--seed``), and prints how many of each score held;
``--others`` does so with other shapes, ``--unseen`` with shapes to which no constant of the planner
was fitted. ``--no-trials`` plans only, and prints
the processor time of each plan.
"""

from __future__ import annotations

import random
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

from common import Table, command_line

from rtee.actions.types import Action
from rtee.errors import RteeError
from rtee.objects.shape import Table as Plane
from rtee.planning.objects import GraspObject, read_object
from rtee.planning.plan import plan_grasps
from rtee.trials.bench import TrialBench, bench
from rtee.trials.planned import check_plan, checked
from rtee.trials.store import FILE_NAME, read_results
from rtee.trials.trial import Trial, run_trial
from rtee.trials.variation import Variation, draw

FOLDER = Path(__file__).parents[1] / "experiments" / "objects"
# The experiments are not installed; their objects and masses are shared with them.
sys.path.insert(0, str(FOLDER.parents[1]))

from experiments.objects.make import MASSES  # noqa: E402

HANDS = ("robotiq_2f_85", "robotiq_3f", "schunk_svh")
CHECKED = 3  # as `rtee grasp-plan --check`
TABLE_SEED = 7
VARIED = 4  # variations of a grasp from a table
LYING = {
    "banana": (0.0, 1.0, 0.0),
    # On its end it falls over by itself while a hand of several fingers closes.
    "egg": (1.0, 0.0, 0.0),
    "marker": (1.0, 0.0, 0.0),
    "screwdriver": (1.0, 0.0, 0.0),
}
SHAPES = ("box:0.05x0.04x0.03", "cylinder:0.025x0.12", "box:0.12x0.03x0.02", "sphere:0.03")
OTHERS = (
    "box:0.03x0.03x0.06",
    "box:0.06x0.035x0.05",
    "cylinder:0.018x0.08",
    "cylinder:0.03x0.05",
    "sphere:0.022",
    "capsule:0.02x0.1",
)
UNSEEN = (
    "box:0.045x0.045x0.07",
    "box:0.1x0.05x0.04",
    "cylinder:0.022x0.06",
    "cylinder:0.035x0.09",
    "sphere:0.035",
    "sphere:0.026",
    "capsule:0.025x0.06",
    "box:0.025x0.05x0.08",
)
BINS = (0.2, 0.4, 0.6, 0.8)  # of scores
SEED = 13  # of the random actions, so that runs can be compared


def best_stored(ready: TrialBench) -> Action:
    """Return the action that held most of the standard objects; the first one of several."""
    results = read_results(ready.folder / FILE_NAME).values()
    held = Counter((r.trial.action, r.trial.elements) for r in results if r.held)
    there = {(action.name, action.elements): action for action in ready.library}
    known = [name for name, _ in held.most_common() if name in there]
    return there[known[0]] if known else next(iter(ready.library))


def tried(ready: TrialBench, action: Action, obj: GraspObject, places: int) -> bool:
    """Return whether an action holds an object at one of the places that `rtee try` finds."""
    trial = Trial(action.name, action.elements, obj.name, mass=obj.mass, places=places)
    try:
        return run_trial(ready, trial).held
    except RteeError:
        return False


def planned(ready: TrialBench, obj: GraspObject) -> tuple[str, bool, bool, float, float]:
    """Return the first choice, whether it holds, whether any of those that ``--check`` tries does.

    And how long planning took: wall and processor time [s].
    """
    began, used = time.perf_counter(), time.process_time()
    try:
        ranking = plan_grasps(ready.hand, ready.library, obj)
    except RteeError:
        return "", False, False, time.perf_counter() - began, time.process_time() - used
    took = time.perf_counter() - began, time.process_time() - used
    if not ranking.plans:
        return "", False, False, *took
    label = ranking.plans[0].label
    tried = checked(ready, obj, ranking, CHECKED).plans
    held = [plan.label for plan in tried if plan.check is not None and plan.check.held]
    return label, label in held, bool(held), *took


def from_table(hands: list[str], things: list[str], seed: int, times: int) -> None:
    """Print how often first choices for what stands on a table hold there, and with variations."""
    table = Table("hand", "object", "first choice", "score", "held", "varied", "pressed [N]")
    by_score: list[tuple[float, int]] = []
    for name in hands:
        ready = bench(name)
        held, varied = 0, 0
        for obj in things:
            mass = MASSES.get(obj, 0.1)
            target = read_object(str(FOLDER / f"{obj}.stl") if obj in MASSES else obj, mass)
            # A capsule lies; shapes have their axis along z.
            up = (1.0, 0.0, 0.0) if "capsule" in obj else LYING.get(obj, (0.0, 0.0, 1.0))
            try:
                ranking = plan_grasps(ready.hand, ready.library, target, table=Plane(up))
            except RteeError as error:
                table.row(name, obj, str(error), "", "", "", "")
                continue
            if not ranking.plans:
                table.row(name, obj, "none", "", "", "", "")
                continue
            plan, draws = ranking.plans[0], [None, *(small(seed, n) for n in range(times))]
            first, *others = [
                check_plan(ready, target, ranking, plan, variation) for variation in draws
            ]
            count = sum(check.held for check in others)
            held, varied = held + first.held, varied + count
            by_score.append((plan.score, first.held + count))
            pressed = max(check.pressed for check in (first, *others))
            words = "held" if first.held else first.reason
            table.row(name, obj, plan.label, plan.score, words, count, f"{pressed:.0f}")
        table.row(name, f"{len(things)} things", "", "", held, varied, "")
    print()
    calibration = Table("score", "choices", "mean score", "held")
    for low, high in zip((0.0, *BINS), (*BINS, 1.01), strict=True):
        found = [(score, count) for score, count in by_score if low <= score < high]
        if found:
            mean = sum(score for score, _ in found) / len(found)
            tries = len(found) * (times + 1)
            share = f"{sum(count for _, count in found)} of {tries}"
            calibration.row(f"{low} to {min(high, 1.0)}", len(found), f"{mean:.2f}", share)


def small(seed: int, number: int) -> Variation:
    """Return a variation by up to 5 mm, 5 degrees and a friction, half of a trial's."""
    drawn = draw(seed, number)
    x, y, z, rx, ry, rz = (0.5 * value for value in (*drawn.position, *drawn.turn))
    return replace(drawn, size=1.0, mass=1.0, position=(x, y, z), turn=(rx, ry, rz))


def planning_times(hands: list[str], things: list[str]) -> None:
    """Print the processor time that planning takes for each hand and object [s]."""
    table = Table("hand", *things)
    for name in hands:
        ready = bench(name)
        times = []
        for obj in things:
            target = replace(read_object(str(FOLDER / f"{obj}.stl")), mass=MASSES[obj])
            began = time.process_time()
            plan_grasps(ready.hand, ready.library, target)
            times.append(time.process_time() - began)
        table.row(name, *(f"{took:.2f}" for took in times))


def main() -> None:
    """Print the figures as Markdown."""
    parser = command_line(__doc__, only="", places=3, seed=TABLE_SEED, varied=VARIED)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="names of hands")
    parser.add_argument("--table", action="store_true", help="things stand on a table")
    parser.add_argument("--others", action="store_true", help="other shapes stand there")
    parser.add_argument("--unseen", action="store_true", help="shapes of no fit stand there")
    parser.add_argument("--no-trials", action="store_true", help="time planning only")
    arguments = parser.parse_args()
    if arguments.no_trials:
        things = [obj for obj in sorted(MASSES) if arguments.only in obj]
        planning_times(arguments.hands, things)
        return
    if arguments.table:
        things = [*UNSEEN] if arguments.unseen else [*sorted(MASSES), *SHAPES]
        things = [*OTHERS] if arguments.others else things
        things = [obj for obj in things if arguments.only in obj]
        from_table(arguments.hands, things, arguments.seed, arguments.varied)
        return
    table = Table(
        "hand",
        "object",
        "first choice",
        "planned",
        "checked",
        "stored",
        "random",
        "seconds",
        "processor",
    )
    totals = []
    for name in arguments.hands:
        ready = bench(name)
        stored, draw = best_stored(ready), random.Random(SEED)
        held, times = Counter[str](), []
        things = [obj for obj in sorted(MASSES) if arguments.only in obj]
        for obj in things:
            target = replace(read_object(str(FOLDER / f"{obj}.stl")), mass=MASSES[obj])
            label, one, best, wall, used = planned(ready, target)
            two = tried(ready, stored, target, arguments.places)
            three = tried(ready, draw.choice(list(ready.library)), target, arguments.places)
            # Counters add booleans as 0 and 1.
            held.update(planned=one, checked=best, stored=two, random=three)
            times.append(wall)
            words = ["held" if found else "lost" for found in (one, best, two, three)]
            table.row(name, obj, label or "none", *words, f"{wall:.1f}", f"{used:.1f}")
        totals.append((name, len(things), held, sorted(times)[len(times) // 2]))
    print()
    table = Table("hand", "planned", "checked", "stored", "random", "median of planning [s]")
    for name, count, held, median in totals:
        shares = (f"{held[key]} of {count}" for key in ("planned", "checked", "stored", "random"))
        table.row(name, *shares, f"{median:.1f}")


if __name__ == "__main__":
    main()
