"""A batch of trials for programs: checked as a whole before the first one begins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

from rtee.child import processors
from rtee.drivers.mujoco.objects import MESHES
from rtee.errors import ConfigError
from rtee.hand.load import hand_folder
from rtee.hand.model import Hand
from rtee.objects.shape import parse_object
from rtee.trials.bench import bench
from rtee.trials.result import Trial, TrialResult
from rtee.trials.sweep import Local, Sweep


def run_trials(
    hand: Hand | str | Path,
    trials: Sequence[Trial],
    *,
    jobs: int | None = None,
    on_result: Callable[[TrialResult], object] | None = None,
) -> list[TrialResult]:
    """Try actions on objects in simulation: approach, grasp, lift, shake, in several processes.

    Args:
        hand: The hand; or its name, or the path of its folder.
        trials: The trials to run.
        jobs: Number of processes; one for each processor unless given.
        on_result: Called with each result as it comes.

    Returns:
        The results in the order of the trials.

    Raises:
        UserError: if the hand, an action or an object cannot be used, before anything is tried.
        MissingExtra: if the extra ``sim`` is not installed.
        WorkerLost: if something outside killed one of the processes.
    """
    folder = hand_folder(hand)[0]
    if not isinstance(trials, Sequence) or not all(isinstance(each, Trial) for each in trials):
        raise ConfigError(f"trials are a list of Trial(…), not {trials!r:.100}")
    if on_result is not None and not callable(on_result):
        raise ConfigError(f"on_result must be a function, not {on_result!r:.100}")
    if not isinstance(jobs, int | None) or (jobs is not None and jobs < 1):
        raise ConfigError(f"the number of processes must be 1 or more, not {jobs!r:.100}")
    library = bench(str(folder)).library
    for trial in trials:
        library.find(trial.action, trial.elements)
        parse_object(trial.object, MESHES)
    if len(set(trials)) != len(trials):
        raise ConfigError("the batch has the same trial twice; remove one")
    found: dict[Trial, TrialResult] = {}
    processes = min(jobs or processors(), len(trials))
    sweep = Sweep(Local(processes))
    for trial in trials:
        sweep.add(str(folder), trial)
    with closing(sweep.run()) as coming:
        for *_, result in coming:
            if isinstance(result, TrialResult):
                found[result.trial] = result
                if on_result is not None:
                    on_result(result)
    return [found[trial] for trial in trials]
