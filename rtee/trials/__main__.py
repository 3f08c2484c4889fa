"""Run one job of trials or of planning in this process: see `rtee.trials.job`."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
from typing import Any, TextIO

from rtee.errors import RteeError, needing_extra
from rtee.trials.job import TrialJob


def main() -> None:
    """Run the job on standard input."""
    # A loop with real-time priority may have started this, by the GUI.
    with contextlib.suppress(OSError, AttributeError):
        if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print must not come between the lines
    job = TrialJob.from_json(sys.stdin.readline())
    # After the job was read: the thread reads the same input.
    threading.Thread(target=_watch, daemon=True).start()
    try:
        job.check()
        if job.actions is None:
            _plan(job, out)
        else:
            _try(job, job.actions, out)
        _write(out, {"done": True})
    except RteeError as error:
        _write(out, {"error": str(error)})


def _watch() -> None:
    """End this process when the requesting process ends."""
    while sys.stdin.read(1):
        pass
    # From a thread, and in the middle of a trial, nothing else ends the process at once.
    os._exit(1)


def _write(out: TextIO, said: dict[str, Any]) -> None:
    out.write(json.dumps(said) + "\n")
    out.flush()


def _try(job: TrialJob, actions: tuple[tuple[str, tuple[str, ...]], ...], out: TextIO) -> None:
    """Try actions on the object, one after the other."""
    with needing_extra("trying an action", "sim"):
        from rtee.trials.bench import bench
        from rtee.trials.trial import run_trial
    from rtee.trials.result import Trial, TrialResult
    from rtee.trials.store import to_document

    ready = bench(job.folder)
    count = len(actions)
    for number, (name, elements) in enumerate(actions):
        what = " ".join((name, *elements))
        _write(out, {"progress": number / count, "text": f"{what}: without variation"})

        def tell(done: int, of: int, number: int = number, what: str = what) -> None:
            text = f"{what}: variation {done} of {of}"
            # One more than the variations: the trial without any comes first.
            _write(out, {"progress": (number + done / (of + 1)) / count, "text": text})

        trial = Trial(name, elements, job.object, 1.0, job.mass, 3, job.friction, job.variations)
        try:
            found = run_trial(ready, trial, progress=tell)
        except RteeError as error:
            # The only trial's error is the job's; among several, it is the result of that one.
            if count == 1:
                raise
            found = TrialResult(trial, False, str(error))
        _write(out, {"result": to_document(found)})


def _plan(job: TrialJob, out: TextIO) -> None:
    """Rank the actions for the object; then again after the best ones were tried in dynamics."""
    with needing_extra("planning a grasp", "extract"):
        from rtee.planning.objects import read_object
        from rtee.planning.plan import plan_grasps
        from rtee.planning.planner import FRICTION
    from rtee.planning.result import to_document
    from rtee.trials.bench import bench

    _write(out, {"progress": 0.05, "text": "looking for grasps"})
    ready = bench(job.folder)
    obj = read_object(job.object, job.mass)
    friction = FRICTION if job.friction is None else job.friction
    ranking = plan_grasps(ready.hand, ready.library, obj, friction=friction, table=job.table)
    _write(out, {"ranking": to_document(ranking)})
    if not job.checked or not ranking.plans:
        return
    with needing_extra("trying grasps in simulation", "sim"):
        from rtee.trials.planned import checked
    most = min(job.checked, len(ranking.plans))
    _write(out, {"progress": 0.4, "text": f"trying the best {most} in simulation"})
    ranking = checked(ready, obj, ranking, most)
    _write(out, {"ranking": to_document(ranking)})


if __name__ == "__main__":
    main()
