"""A sweep finds what single trials find, wherever it is done, and tells who is of no use to it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from rtee.errors import WorkerLost
from rtee.hand.load import hand_folder
from rtee.hand.own_copy import copy_hand
from rtee.trials.answers import Answers
from rtee.trials.cluster import Cluster
from rtee.trials.store import from_document, to_document
from rtee.trials.sweep import Local, Sweep
from rtee.trials.trial import Trial
from rtee.trials.variation import decided
from rtee.trials.work import Answer, Planned, Planning, Task, attempt, perform, to_text

GRIPPER = "robotiq_2f_85"
BALL = Trial("Grasp", object="sphere:0.03")
TOO_WIDE = Trial("Grasp", object="sphere:0.06")


def answers(sweep: Sweep) -> dict[Task, Answer]:
    return {task: answer for _, task, answer in sweep.run()}


@pytest.mark.heavy
def test_a_sweep_of_two_processes_equals_single_trials() -> None:
    sweep = Sweep(Local(2))
    for trial in (BALL, TOO_WIDE):
        sweep.add(GRIPPER, trial)
    assert answers(sweep) == {trial: attempt(GRIPPER, trial) for trial in (BALL, TOO_WIDE)}


class Two:
    """Two workers: the first has other files, and one that is asked for a sphere of 1 m fails."""

    capacity = 1

    def __init__(self) -> None:
        self.out: dict[str, str] = {}
        self.failures = 0

    def submit(self, hand: str, task: Task) -> Future[str]:
        done: Future[str] = Future()
        if isinstance(task, Trial) and task.object == "sphere:1":
            done.set_exception(RuntimeError("ended"))
            return done
        said = json.loads(perform(hand, to_text(task)))
        said["worker"] = "bob" if "alice" in self.out else "alice"
        if said["worker"] == "alice":
            said["made_with"]["model"] = "another"
        done.set_result(json.dumps(said))
        return done

    def check(self) -> None:
        """Both are there."""

    def failed(self, error: BaseException) -> None:
        self.failures += 1

    def refuse(self, worker: str, why: str) -> None:
        self.out[worker] = why

    def close(self) -> None:
        """Nothing is left to end."""


def test_an_answer_made_with_other_files_is_refused_and_the_task_tried_elsewhere() -> None:
    workers = Two()
    sweep = Sweep(workers)
    sweep.add(GRIPPER, TOO_WIDE)
    assert answers(sweep) == {TOO_WIDE: attempt(GRIPPER, TOO_WIDE)}
    assert list(workers.out) == ["alice"]
    assert "other model: another instead of" in workers.out["alice"]
    sweep = Sweep(workers)
    sweep.add(GRIPPER, Trial("Grasp", object="sphere:1"))
    with pytest.raises(RuntimeError, match="ended"):
        answers(sweep)
    assert workers.failures == 2


def test_answers_are_known_until_something_they_were_made_with_changes(tmp_path: Path) -> None:
    copy_hand(hand_folder(GRIPPER)[0], tmp_path / "mine")
    asked: list[Task] = [TOO_WIDE, Planning("sphere:0.06")]
    for round_ in ("first", "again", "changed"):
        known = Answers(tmp_path / "answers")
        hand = tmp_path / "mine"
        if round_ == "changed":
            hand = tmp_path / "other"
            copy_hand(tmp_path / "mine", hand)
            text = (hand / "hand.yaml").read_text()
            (hand / "hand.yaml").write_text(text.replace("payload:", "payload: 0.05  # "))
        sweep = Sweep(Local(1), known)
        for task in asked:
            sweep.add(str(hand), task)
        found = answers(sweep)
        known.write()
        assert known.added == {"first": 2, "again": 0, "changed": 2}[round_]
        if round_ == "first":
            first = found
        assert (found == first) == (round_ != "changed")
    assert isinstance(first[asked[1]], Planned)
    # As pandas and DuckDB read it: one table, whatever the number of its files.
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(tmp_path / "answers").to_pylist()
    assert [row["fits"] for row in table if row["kind"] == "trial"] == [False, False]


def test_variations_end_once_the_interval_has_decided() -> None:
    assert not decided(8, 8, 0.7)
    assert decided(9, 9, 0.7)
    assert decided(0, 2, 0.7)
    assert not decided(9, 9, None)
    found = attempt(GRIPPER, Trial("Grasp", object="sphere:0.03", variations=2, wanted=0.2))
    assert (found.survived, found.tries, found.left) == (1, 1, 1)
    assert from_document(to_document(found)) == found


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[tuple[str, dict[str, subprocess.Popen[bytes]]]]:
    """A scheduler's address, and its workers by name."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    root = Path(__file__).parents[2]

    def start(what: str, *words: str, without: str = "", place: Path = tmp_path) -> object:
        lines = f"import sys; sys.modules['{without}'] = None; " if without else "import sys; "
        code = f"{lines}from distributed.cli.dask_{what} import main; main()"
        return subprocess.Popen(
            [sys.executable, "-c", code, "--scheduler-file", str(file), "--no-dashboard", *words],
            cwd=place,
            env={**os.environ, "PYTHONPATH": str(root)},
            stderr=subprocess.DEVNULL,
        )

    started = {"scheduler": start("scheduler", "--host", "127.0.0.1", "--port", "0")}
    other = tmp_path / "other/config/mine"
    copy_hand(hand_folder(GRIPPER)[0], other)
    text = (other / "hand.yaml").read_text()
    (other / "hand.yaml").write_text(text.replace("payload:", "payload: 0.05  # "))
    for name in ("other", "killed", "lacking", "bare"):
        (tmp_path / name).mkdir(exist_ok=True)
        words = ("--name", name, "--nthreads", "1", "--no-nanny")
        without = "rtee" if name == "bare" else ""
        started[name] = start("worker", *words, without=without, place=tmp_path / name)
    while not file.exists() or not file.read_text().endswith("}"):
        time.sleep(0.05)
    yield json.loads(file.read_text())["address"], started
    for process in started.values():
        process.kill()
        process.wait()


@pytest.mark.heavy
def test_a_cluster_of_unlike_workers_ends_with_the_same_results(
    tmp_path: Path, scheduler: tuple[str, dict[str, subprocess.Popen[bytes]]]
) -> None:
    address, workers = scheduler
    mine = tmp_path / "own/mine"
    copy_hand(hand_folder(GRIPPER)[0], mine)
    mesh = tmp_path / "part.stl"
    pytest.importorskip("trimesh").creation.icosphere(radius=0.03).export(mesh)
    trials = [Trial("Grasp", object=f"sphere:{0.02 + n / 1000}", variations=1) for n in range(8)]
    trials.append(Trial("Grasp", object=str(mesh)))
    told: list[str] = []
    cluster = Cluster(address, {str(mine): mine}, [t.object for t in trials], told.append)
    while len(cluster._client.scheduler_info()["workers"]) < 4:
        time.sleep(0.05)
    cluster.look()
    assert [text.split()[1] for text in told] == ["bare"]
    sweep, found = Sweep(cluster), dict[Task, Answer]()
    for trial in trials:
        sweep.add(str(mine), trial)
    for _, task, answer in sweep.run():
        found[task] = answer
        workers["killed"].kill()
    assert found == {trial: attempt(str(mine), trial) for trial in trials}
    assert len(told) == 1
    lost = Sweep(Cluster(address, {str(mine): mine}, [], told.append))
    lost.add(str(mine), BALL)
    workers["scheduler"].kill()
    with pytest.raises(WorkerLost, match="is gone"):
        answers(lost)
