"""`rtee try --task`: how often eggs, cups and tugs succeed, with reflexes and without."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rtee.trials.tasks import TaskResult, TaskTrial

_VARIATIONS: Final = 6
"""How often each is tried unless said otherwise: a first look, at some seconds each."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What the command line says of tasks.

    Attributes:
        tasks: Their names.
        reflexes: With reflexes, without, or ``None``: both.
        force: Force to hold with, as people write it.
        max_force: Force up to which a slip raises it.
        width: Width of the object.
        mass: Mass of the object [kg].
        variations: How often each is tried.
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
    asked: Asked,
    as_json: bool,
) -> None:
    """Try tasks with an action, and print how often each succeeded.

    Args:
        hand: The hand, by name or folder.
        action: Name of the action.
        elements: Its elements.
        objects: The objects; empty: a sphere.
        asked: What else the command line says.
        as_json: Print JSON.

    Raises:
        UserError: for every mistake on the command line and in the hand's files.
    """
    from rtee.errors import needing_extra

    with needing_extra("a trial", "sim"):
        from rtee.trials.sweep import bench
        from rtee.trials.tasks import RATE, run_task

    trials = _trials(action, tuple(elements), objects, asked)
    ready = bench(hand, RATE)
    # An unknown action is refused before the first trial.
    ready.library.find(action, elements)
    # Tasks have no trial without variation, so that there is at least one with it.
    count = _VARIATIONS if asked.variations is None else max(asked.variations, 1)
    documents = []
    for trial in trials:
        results = [run_task(ready, trial, number) for number in range(count)]
        if as_json:
            documents.append(_document(trial, results))
        else:
            print(_sentence(trial, results), flush=True)
    if as_json:
        print(json.dumps(documents, indent=2))


def _trials(
    action: str, elements: tuple[str, ...], objects: Sequence[str], asked: Asked
) -> list[TaskTrial]:
    from rtee.errors import ConfigError, suggestion
    from rtee.trials.tasks import FORCE, MOST, Task, TaskTrial, Way
    from rtee.units import FORCE as NEWTONS
    from rtee.units import LENGTH, quantity

    for name in asked.tasks:
        if name not in list(Task):
            raise ConfigError(f"unknown task '{name[:80]}'; {suggestion(name, list(Task))}")
    force = FORCE if asked.force is None else quantity(asked.force, NEWTONS, "force")
    most = MOST if asked.max_force is None else quantity(asked.max_force, NEWTONS, "largest force")
    # A force above the usual largest one alone is no mistake.
    most = max(most, force) if asked.max_force is None else most
    if most < force:
        raise ConfigError(f"--max-force must be at least --force, {force:g} N, not {most:g} N")
    width = None if asked.width is None else quantity(asked.width, LENGTH, "width")
    ways = [way for way in Way if asked.reflexes in (None, way is Way.REFLEXES)]
    return [
        TaskTrial(
            Task(name), action, elements, shape, way, width, asked.mass, force, most, asked.seed
        )
        for shape in objects or ("sphere:0.03",)
        for name in dict.fromkeys(asked.tasks)
        for way in ways
    ]


def _sentence(trial: TaskTrial, results: Sequence[TaskResult]) -> str:
    from rtee.trials.tasks import End, Way
    from rtee.trials.variation import interval

    held = sum(result.end is End.HELD for result in results)
    low, high = interval(held, len(results))
    ends = Counter(result.end for result in results if result.end is not End.HELD)
    others = "".join(f"; {count} {end}" for end, count in ends.items())
    how = {
        Way.EFFORT: "the hand's effort, no reflexes",
        Way.FORCE: f"{trial.force:g} N, no reflexes",
        Way.REFLEXES: f"{trial.force:g} to {trial.most:g} N, reflexes",
    }[trial.way]
    peak = max(result.peak for result in results)
    what = f"{trial.task}, {' '.join((trial.action, *trial.elements))} on {trial.object}, {how}"
    if ends[End.STALLED] and trial.way is not Way.EFFORT:
        others += " (the effort for this force hardly moves the hand; try a larger --force)"
    return (
        f"{what}: {held} of {len(results)} succeed (95 % confidence: {low * 100:.0f} to "
        f"{high * 100:.0f} %){others}; at most {peak:.1f} N"
    )


def _document(trial: TaskTrial, results: Sequence[TaskResult]) -> dict[str, Any]:
    from rtee.trials.tasks import End, Way

    return {
        "task": str(trial.task),
        "action": trial.action,
        "elements": list(trial.elements),
        "object": trial.object,
        "way": str(trial.way),
        "reflexes": trial.way is Way.REFLEXES,
        "force": None if trial.way is Way.EFFORT else trial.force,
        "max_force": trial.most if trial.way is Way.REFLEXES else None,
        "succeeded": sum(result.end is End.HELD for result in results),
        "tries": len(results),
        "results": [{"end": str(result.end), "peak": result.peak} for result in results],
    }
