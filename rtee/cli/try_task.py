"""`rtee try --task`: success rates of the tasks egg, cup and tug, with and without reflexes."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rtee.trials.tasks import TaskResult, TaskTrial

_VARIATIONS: Final = 6
"""Default number of variations: enough for a first look, as each takes some seconds."""


@dataclass(frozen=True, slots=True)
class TaskOptions:
    """Options of `rtee try --task`; quantities are texts with a unit, such as ``3N``.

    Attributes:
        reflexes: With reflexes, without, or ``None``: both.
        force: Force to hold with.
        max_force: Force up to which a slip raises the force.
        width: Width of the object.
        mass: Mass of the object [kg].
        variations: Number of variations of each task.
        seed: Seed of the variations.
    """

    tasks: Sequence[str]
    reflexes: bool | None
    force: str | None
    max_force: str | None
    width: str | None
    mass: float | None
    variations: int | None
    seed: int


def try_tasks(
    hand: str,
    action: str,
    elements: Sequence[str],
    objects: Sequence[str],
    options: TaskOptions,
    as_json: bool,
) -> None:
    """Try tasks with an action and a sphere, or other objects; print how often each succeeded.

    Raises `UserError` for every mistake on the command line and in the hand's files.
    """
    from rtee.errors import needing_extra

    with needing_extra("a trial", "sim"):
        from rtee.trials.bench import bench
        from rtee.trials.tasks import RATE, run_task

    trials = _trials(action, tuple(elements), objects, options)
    ready = bench(hand, RATE)
    # An unknown action is refused before the first trial.
    ready.library.find(action, elements)
    # Tasks have no trial without variation, so that --variations 0 still tries one.
    count = _VARIATIONS if options.variations is None else max(options.variations, 1)
    documents = []
    for trial in trials:
        results = [run_task(ready, trial, number) for number in range(count)]
        if as_json:
            documents.append(_document(trial, results))
        else:
            # At once, since a task takes long and the next ones may be interrupted.
            print(_sentence(trial, results), flush=True)
    if as_json:
        print(json.dumps(documents, indent=2))


def _trials(
    action: str, elements: tuple[str, ...], objects: Sequence[str], options: TaskOptions
) -> list[TaskTrial]:
    from rtee.errors import ConfigError, suggestion
    from rtee.trials.tasks import FORCE, MOST, GraspMode, Task, TaskTrial
    from rtee.units import FORCE as NEWTONS
    from rtee.units import LENGTH, quantity

    for name in options.tasks:
        if name not in list(Task):
            raise ConfigError(f"unknown task '{name[:80]}'; {suggestion(name, list(Task))}")
    force = FORCE if options.force is None else quantity(options.force, NEWTONS, "force")
    most = (
        MOST if options.max_force is None else quantity(options.max_force, NEWTONS, "largest force")
    )
    # A --force above the default of --max-force raises that, too.
    most = max(most, force) if options.max_force is None else most
    if most < force:
        raise ConfigError(f"--max-force must be at least --force, {force:g} N, not {most:g} N")
    width = None if options.width is None else quantity(options.width, LENGTH, "width")
    modes = [mode for mode in GraspMode if options.reflexes in (None, mode is GraspMode.REFLEXES)]
    return [
        TaskTrial(
            Task(name),
            action,
            elements,
            shape,
            mode,
            width,
            options.mass,
            force,
            most,
            options.seed,
        )
        for shape in objects or ("sphere:0.03",)
        for name in dict.fromkeys(options.tasks)
        for mode in modes
    ]


def _sentence(trial: TaskTrial, results: Sequence[TaskResult]) -> str:
    from rtee.trials.tasks import End, GraspMode
    from rtee.trials.variation import interval

    held = sum(result.end is End.HELD for result in results)
    low, high = interval(held, len(results))
    ends = Counter(result.end for result in results if result.end is not End.HELD)
    others = "".join(f"; {count} {end}" for end, count in ends.items())
    conditions = {
        GraspMode.EFFORT: "the hand's effort, no reflexes",
        GraspMode.FORCE: f"{trial.force:g} N, no reflexes",
        GraspMode.REFLEXES: f"{trial.force:g} to {trial.most:g} N, reflexes",
    }[trial.mode]
    peak = max(result.peak for result in results)
    grasp = " ".join((trial.action, *trial.elements))
    if ends[End.STALLED] and trial.mode is not GraspMode.EFFORT:
        others += " (the effort for this force hardly moves the hand; try a larger --force)"
    return (
        f"{trial.task}, {grasp} on {trial.object}, {conditions}: {held} of {len(results)} succeed "
        f"(95 % confidence: {low * 100:.0f} to {high * 100:.0f} %){others}; at most {peak:.1f} N"
    )


def _document(trial: TaskTrial, results: Sequence[TaskResult]) -> dict[str, Any]:
    from rtee.trials.tasks import End, GraspMode

    return {
        "task": str(trial.task),
        "action": trial.action,
        "elements": list(trial.elements),
        "object": trial.object,
        "mode": str(trial.mode),
        "reflexes": trial.mode is GraspMode.REFLEXES,
        "force": None if trial.mode is GraspMode.EFFORT else trial.force,
        "max_force": trial.most if trial.mode is GraspMode.REFLEXES else None,
        "succeeded": sum(result.end is End.HELD for result in results),
        "tries": len(results),
        "results": [{"end": str(result.end), "peak": result.peak} for result in results],
    }
