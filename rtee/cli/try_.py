"""`rtee try`: try actions on objects in simulation."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rtee.cli._common import FrictionOption, complete_hand, owned, to_json
from rtee.cli._sweep import (
    ClusterOption,
    JobsOption,
    meshes_in,
    resolved,
    tell_of_limits,
    tell_of_meshes,
)
from rtee.cli._table import Column, on_terminal, table_of
from rtee.errors import ConfigError, needing_extra, suggestion
from rtee.hand.files import make_folder
from rtee.units import FORCE as NEWTONS
from rtee.units import LENGTH, quantity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rtee.trials.answers import TrialFile
    from rtee.trials.tasks import TaskResult, TaskTrial
    from rtee.trials.trial import Trial, TrialResult


_OBJECTS: Final = ["sphere:0.03"]
"""The object unless another one is given: a ball of 60 mm."""

_VARIATIONS = 20
"""Variations of each trial with --all: 18 held of 20 means at least 70 %, at 95 % confidence."""


def try_(
    hand: Annotated[str, typer.Argument(autocompletion=complete_hand)],
    action: str | None = None,
    elements: list[str] | None = None,
    *,
    object_: list[str] | None = None,
    intensity: float = 1.0,
    mass: float | None = None,
    friction: FrictionOption = None,
    variations: int | None = None,
    seed: int = 0,
    choose_by: int | None = None,
    all_: bool = False,
    until: float | None = None,
    again: bool = False,
    jobs: JobsOption = 0,
    cluster: ClusterOption = None,
    out: Path | None = None,
    task: list[str] | None = None,
    reflexes: bool | None = None,
    force: str | None = None,
    max_force: str | None = None,
    width: str | None = None,
    pictures: Path | None = None,
    log: Path | None = None,
    json_: bool = False,
) -> None:
    """Try an action on an object: approach, grasp, lift, shake; was it held?

    With --task, the success rates of tasks, with reflexes and without.

    Exit status 1 when a single trial loses its object.

    Arguments and options:
        hand: Name of the hand, or its folder.
        action: Name of the action.
        elements ([ELEMENT]…): Elements of a primitive.
        object_ (SHAPE): box:WxDxH, cylinder:RxH, sphere:R, capsule:RxL [m], drill, a mesh, or a
            folder of meshes; may be repeated.
        intensity (0.0..1.0): Without --task or --all: how far the action goes.
        mass (0.001..100.0): Without --all: mass of the object [kg].
        friction (--friction; 0.0..10.0; MU): Without --task or --all: friction of hand and object
            in simulation; 1 at fingertips and 0.8 elsewhere unless given.
        variations (0..1000; N): Try N times more with size ±10 %, mass up to +50 %, position ±10
            mm, turns of up to 10°, friction 0.5 to 1; 20 with --all unless given.
        seed (0..): Seed of the variations.
        choose_by (10..1000; N): Without --task: choose the object's place by N tries with other
            variations; 20 or more find better places, 40 or more look for the middle of where the
            object is held along each axis, too, and take longer; 10 unless given.
        all_: Without --task: all actions with all standard objects; resumable.
        until (0.01..0.99; RATE): With --all or --variations, without --task: leave variations out
            once the interval lies to one side of this rate, such as 0.7; all are tried unless
            given.
        again: With --all: repeat trials whose results are known.
        jobs (--jobs; -j; 0..): With --all: processes; 0: one per processor.
        cluster (--cluster; ADDRESS): With --all: a sweep on the Dask cluster with this scheduler.
        out (FOLDER|FILE): With --all: where its results are written, if not with the hand: Parquet
            files in a folder, or a small .yaml.
        task (TASK): egg (breaks above 8 N), cup (filled with 500 g while held) or tug (of 5 N),
            instead of lifting and shaking; may be repeated.
        reflexes (--reflexes/--no-reflexes): With --task: with reflexes only, or without only; both
            unless given.
        force (FORCE): With --task: force to hold with; 3N unless given.
        max_force (FORCE): With --task: force up to which a slip raises it; 7N unless given.
        width (LENGTH): With --task: width of the object, if not its smallest extent.
        pictures (DIR): Without --task or --all: write a strip of pictures of each trial.
        log (DIR): Without --task or --all: folder for recordings of the trials.
        json_: Print JSON.
    """
    if object_:
        with needing_extra("a trial", "sim"):
            from rtee.drivers.mujoco.objects import MESHES
        object_ = meshes_in(object_, MESHES)
    if task:
        if action is None:
            raise ConfigError("which action? give its name, such as Grasp")
        tell_of_meshes(object_ or [])
        tell_of_limits([resolved(hand)])
        tasks = _task_trials(
            task,
            object_ or _OBJECTS,
            reflexes,
            force,
            max_force,
            width,
            action=action,
            elements=tuple(elements or ()),
            mass=mass,
            seed=seed,
        )
        _try_tasks(resolved(hand), tasks, variations, json_)
        return

    with needing_extra("a trial", "sim"):
        from rtee.trials.bench import bench
        from rtee.trials.result import CHOOSING, OBJECTS, mass_of
        from rtee.trials.sweep import all_trials
        from rtee.trials.trial import Trial

    name = resolved(hand)
    tell_of_meshes(object_ or [])
    tell_of_limits([name])
    choosing = CHOOSING if choose_by is None else choose_by
    if all_:
        if action is not None:
            raise ConfigError("--all tries all actions; leave out the action")
        varied = _VARIATIONS if variations is None else variations
        trials = all_trials(bench(name).library, object_ or OBJECTS, varied, seed, choosing, until)
        results = _all(name, trials, jobs, again, cluster, out)
        _show(results, json_)
        return
    if action is None:
        raise ConfigError("which action? give its name, or --all")
    known = bench(name).library.find(action, elements or ())
    shapes = object_ or _OBJECTS
    trials = [
        Trial(
            known.name,
            tuple(elements or ()),
            shape,
            intensity,
            mass_of(shape) if mass is None else mass,
            friction=friction,
            variations=variations or 0,
            seed=seed,
            choosing=choosing,
            wanted=until,
        )
        for shape in shapes
    ]
    results = [_one(name, trial, pictures, log) for trial in trials]
    _show(results, json_)
    if not all(result.held for result in results):
        raise typer.Exit(1)


def _one(name: str, trial: Trial, pictures: Path | None, log: Path | None) -> TrialResult:
    from rtee.trials.bench import bench, recorder_for
    from rtee.trials.trial import run_trial

    ready = bench(name)
    stills = None
    if pictures is not None:
        from rtee.trials.pictures import Stills

        make_folder(pictures)
        stills = Stills.of_trial(ready.hand)
    if log is None:
        result = run_trial(ready, trial, watch=stills)
    else:
        with recorder_for(ready, log) as recorder:
            result = run_trial(ready, trial, observers=[recorder], watch=stills)
    # There are no pictures of an object that fits nowhere.
    if pictures is not None and stills is not None and stills.taken:
        from rtee.trials.pictures import write_strip

        words = "_".join((ready.hand.name, trial.action, *trial.elements, trial.object))
        # Objects are written with colons, and meshes with slashes.
        file = "".join(c if c.isalnum() or c in "._-" else "-" for c in words) + ".png"
        write_strip(pictures / file, stills.taken)
    return result


def _all(
    name: str,
    trials: Sequence[Trial],
    jobs: int,
    again: bool,
    cluster: str | None,
    out: Path | None,
) -> list[TrialResult]:
    """Run the trials that have no stored result yet; store each result as it arrives."""
    from rtee.cli._sweep import followed, workers_for
    from rtee.drivers.mujoco.objects import MESHES
    from rtee.objects.shape import parse_object
    from rtee.trials.answers import Answers, TrialFile
    from rtee.trials.bench import bench
    from rtee.trials.result import TrialResult
    from rtee.trials.store import FILE_NAME
    from rtee.trials.sweep import Sweep
    from rtee.trials.work import MadeWith

    # Refuse a mistyped object once, before any process starts.
    for shape in {trial.object: None for trial in trials}:
        parse_object(shape, MESHES)
    if not trials:
        raise ConfigError(
            f"hand '{bench(name).hand.name}' has no actions to try; find its primitives first: "
            f"rtee extract {name} --save"
        )
    known: Answers | TrialFile
    if out is None or out.suffix in (".yaml", ".yml"):
        known = _results_in_file(name, trials, out)
    else:
        known = Answers(out)
    found = [known.find(trial, MadeWith.of(name, trial)) for trial in trials]
    todo = [trial for trial, result in zip(trials, found, strict=True) if again or not result]
    if todo:
        if isinstance(known, TrialFile):
            if out is None:
                # Copy a shipped hand only when there is something to write.
                known.path = owned(bench(name).folder) / FILE_NAME
            known.write()  # fails now rather than after the trials, if it cannot be written
        shapes = [trial.object for trial in todo]
        sweep = Sweep(workers_for([name], shapes, jobs, cluster, len(todo)), known, again=again)
        for trial in todo:
            sweep.add(name, trial)
        same = "the same command without --again" if again else "the same command"

        def kept() -> str:
            count = f"{known.added} of {len(todo)}"
            return (
                f"the results of {count} trials are kept in {known.kept_in}; {same} does the others"
            )

        for _ in followed(sweep, known.write, kept):
            pass
    # Outdated results of other actions stay if all requested results were known.
    if isinstance(known, TrialFile):
        known.finish()
    found = [known.find(trial, MadeWith.of(name, trial)) for trial in trials]
    return [result for result in found if isinstance(result, TrialResult)]


def _results_in_file(name: str, trials: Sequence[Trial], out: Path | None) -> TrialFile:
    """Return the results in a file, by default that of the hand; print if some are outdated."""
    from rtee.actions.fingerprints import Fingerprints
    from rtee.trials.answers import TrialFile
    from rtee.trials.bench import bench
    from rtee.trials.store import FILE_NAME, MOST

    ready = bench(name)
    path = out or ready.folder / FILE_NAME
    known = TrialFile(path, Fingerprints.of(ready.folder, ready.library))
    if len(known.keys | {trial.key for trial in trials}) > MOST:
        raise ConfigError(
            f"{len(trials)} results are too many for {path}, which holds {MOST}; give --out a "
            "folder, for Parquet files"
        )
    if known.outdated:
        print(
            f"rtee: the {known.outdated} results in {path} are outdated, made with other files of "
            "this hand or by an earlier method; they are replaced once the new ones are ready",
            file=sys.stderr,
        )
    return known


def _show(results: Sequence[TrialResult], as_json: bool) -> None:
    from rtee.trials.store import to_document
    from rtee.trials.variation import rate_text

    if as_json:
        documents = [to_document(result) for result in results]
        print(to_json(documents if len(documents) != 1 else documents[0], indent=2))
        return
    if len(results) > 3:
        _table(results)
        return
    for result in results:
        trial = result.trial
        title = f"{trial.what} on {trial.object}"
        if not result.held:
            print(f"{title}: {'lost' if result.fits else 'does not fit'}; {result.reason}")
            continue
        forces = ", ".join(f"{name} {force:.1f} N" for name, force in result.forces if force > 0)
        slip = f"slip {result.slip * 1e3:.1f} mm"
        parts = ("held", slip, forces or "no finger touches", rate_text(result))
        print(f"{title}: {'; '.join(filter(None, parts))}")


def _table(results: Sequence[TrialResult]) -> None:
    shapes = list(dict.fromkeys(result.trial.object for result in results))
    rows: dict[str, dict[str, Any]] = {}
    for result in results:
        name = result.trial.what
        tries = result.tries
        word = f"{result.survived}/{tries}" if tries else f"{result.slip * 1e3:.1f}"
        word = word if result.held else "–" if result.fits else "no fit"
        rows.setdefault(name, {})[result.trial.object] = word
    held, fitting = sum(r.held for r in results), sum(r.fits for r in results)
    varied = any(result.trial.variations for result in results)
    what = "variations survived by" if varied else "slip [mm] of"
    print(f"{what} what was held: {held} of {fitting} that fit")
    # On a terminal there is room for the size only below the kind of an object.
    names = [shape.replace(":", "\n") if on_terminal() else shape for shape in shapes]
    columns: tuple[str | Column, ...] = ("action", *(Column(name, right=True) for name in names))
    lines = ((name, *(row.get(shape, "") for shape in shapes)) for name, row in rows.items())
    table_of(columns, lines).show()


_TASK_VARIATIONS: Final = 6
"""Default number of variations: enough for a first look, as each takes some seconds."""


def _try_tasks(
    hand: str, trials: Sequence[TaskTrial], variations: int | None, as_json: bool
) -> None:
    """Try tasks; print how often each succeeded. Raises `UserError` for a mistake in the files."""
    from rtee.trials.bench import bench
    from rtee.trials.tasks import RATE, run_task

    ready = bench(hand, RATE)
    # An unknown action is refused before the first trial.
    ready.library.find(trials[0].action, trials[0].elements)
    # Tasks have no trial without variation, so that --variations 0 still tries one.
    count = _TASK_VARIATIONS if variations is None else max(variations, 1)
    documents = []
    for trial in trials:
        results = [run_task(ready, trial, number) for number in range(count)]
        if as_json:
            documents.append(_document(trial, results))
        else:
            # At once, since a task takes long and the next ones may be interrupted.
            print(_sentence(trial, results), flush=True)
    if as_json:
        print(to_json(documents, indent=2))


def _task_trials(
    tasks: Sequence[str],
    objects: Sequence[str],
    reflexes: bool | None,
    force: str | None,
    max_force: str | None,
    width: str | None,
    **same: Any,
) -> list[TaskTrial]:
    """Return the trials of tasks with objects, with the attributes that are the ``same`` for all.

    Raises `UserError` for every mistake on the command line.
    """
    with needing_extra("a trial", "sim"):
        from rtee.trials.tasks import FORCE, MOST, GraspMode, Task, TaskTrial

    for name in tasks:
        if name not in list(Task):
            raise ConfigError(f"unknown task '{name[:80]}'; {suggestion(name, list(Task))}")
    least = FORCE if force is None else quantity(force, NEWTONS, "force")
    # A --force above the default of --max-force raises that, too.
    most = max(MOST, least) if max_force is None else quantity(max_force, NEWTONS, "largest force")
    if most < least:
        raise ConfigError(f"--max-force must be at least --force, {least:g} N, not {most:g} N")
    same |= {
        "width": None if width is None else quantity(width, LENGTH, "width"),
        "force": least,
        "most": most,
    }
    modes = [mode for mode in GraspMode if reflexes in (None, mode is GraspMode.REFLEXES)]
    return [
        TaskTrial(Task(name), object=shape, mode=mode, **same)
        for shape in objects
        for name in dict.fromkeys(tasks)
        for mode in modes
    ]


def _sentence(trial: TaskTrial, results: Sequence[TaskResult]) -> str:
    from rtee.trials.tasks import End, GraspMode
    from rtee.trials.variation import interval_text

    held = sum(result.end is End.HELD for result in results)
    likely = interval_text(held, len(results))
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
        f"(95 % confidence: {likely}){others}; at most {peak:.1f} N"
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
