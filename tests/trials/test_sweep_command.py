"""A sweep keeps what it has found, says so when it is interrupted, and leaves nothing running."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("mujoco")

from rtee.actions.fingerprints import Fingerprints
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference
from rtee.cli._common import app_of
from rtee.cli._sweep import tell_of_limits
from rtee.cli.try_ import try_
from rtee.errors import ConfigError
from rtee.hand.load import load_configured
from rtee.hand.own_copy import copy_hand
from rtee.trials.bench import bench
from rtee.trials.result import Trial, TrialResult
from rtee.trials.store import read_results, write_results

GRIPPER = "robotiq_2f_85"


@pytest.fixture
def hand(tmp_path: Path, repository: Path) -> Path:
    """A gripper of one's own that was never tried."""
    copy_hand(repository / "config" / GRIPPER, tmp_path / "config/mine")
    return tmp_path / "config/mine"


def now(hand: Path) -> Fingerprints:
    """Return what the hand's files and actions are now."""
    model, _ = load_configured(hand)
    return Fingerprints.of(hand, ActionLibrary.load(model, hand / "actions"))


def start(hand: Path) -> subprocess.Popen[str]:
    """Start a sweep of two processes in a process group of its own, as a terminal does."""
    return subprocess.Popen(
        [sys.executable, "-m", "rtee", "try", "mine", "--all", "--variations", "0", "--jobs", "2"],
        cwd=hand.parents[1],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def wait_for_a_result(hand: Path, file: str = "trials.yaml") -> None:
    while not read_results(hand / file):
        time.sleep(0.05)


def group(leader: int) -> list[int]:
    """Return the processes of a group that still run."""
    found = []
    for place in Path("/proc").iterdir():
        if place.name.isdigit():
            try:
                words = (place / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(words[2]) == leader and words[0] != "Z":
                found.append(int(place.name))
    return found


def test_effort_limits_that_trials_assume_are_told(
    hand: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tell_of_limits([str(hand)])
    assert capsys.readouterr().err == ""
    urdf = next(hand.glob("*.urdf"))
    urdf.write_text(re.sub(r' effort="[^"]*"', "", urdf.read_text()))
    bench.cache_clear()
    tell_of_limits([str(hand)])
    told = capsys.readouterr().err
    assert told.startswith("note: mine: no effort limit for actuator finger_joint; 10 N·m is")
    assert str(hand / "hand.yaml") in told


@pytest.mark.heavy
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_says_what_is_kept(hand: Path, number: signal.Signals) -> None:
    sweep = start(hand)
    wait_for_a_result(hand)
    # A terminal signals the whole group, a time limit the command alone.
    (os.killpg if number is signal.SIGINT else os.kill)(sweep.pid, number)
    _, said = sweep.communicate()
    kept = read_results(hand / "trials.yaml")
    assert sweep.returncode == 130
    assert said == (
        f"rtee: interrupted; the results of {len(kept)} of 36 trials are kept in "
        "config/mine/trials.yaml; the same command does the others\n"
    )
    while group(sweep.pid):
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
def test_what_is_found_outlives_a_kill_and_the_workers_do_not(hand: Path) -> None:
    sweep = start(hand)
    wait_for_a_result(hand)  # it is in the file while the sweep goes on
    assert sweep.poll() is None
    assert len(group(sweep.pid)) > 2
    sweep.kill()
    sweep.communicate()
    while group(sweep.pid):
        time.sleep(0.05)
    assert 0 < len(read_results(hand / "trials.yaml")) < 36


@pytest.mark.heavy
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
def test_a_worker_that_is_killed_is_told_in_one_sentence(hand: Path) -> None:
    sweep = start(hand)
    wait_for_a_result(hand)
    worker = next(
        one
        for one in group(sweep.pid)
        if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes()
    )
    os.kill(worker, signal.SIGKILL)
    _, said = sweep.communicate()
    kept = read_results(hand / "trials.yaml")
    assert sweep.returncode == 1
    assert said == (
        "rtee: a process with trials was killed, perhaps for lack of memory; "
        f"the results of {len(kept)} of 36 trials are kept in config/mine/trials.yaml; the same "
        "command does the others\n"
    )
    while group(sweep.pid):
        time.sleep(0.05)


@pytest.mark.heavy
def test_outdated_results_stay_until_all_new_ones_are_there(hand: Path) -> None:
    old = [TrialResult(Trial("Grasp", (), "sphere:0.07"), True)]
    write_results(hand / "trials.yaml", Fingerprints("0"), old)
    before = (hand / "trials.yaml").read_text()
    sweep = start(hand)
    wait_for_a_result(hand, "trials.new.yaml")
    os.killpg(sweep.pid, signal.SIGINT)
    _, said = sweep.communicate()
    assert "the 1 results in config/mine/trials.yaml are outdated" in said
    assert "are kept in config/mine/trials.new.yaml; the same command does the others" in said
    assert (hand / "trials.yaml").read_text() == before
    kept = set(read_results(hand / "trials.new.yaml"))
    words = [str(hand), "--all", "--variations", "0", "--object", "sphere:0.03", "--jobs", "1"]
    CliRunner().invoke(app_of(try_), words, catch_exceptions=False)
    found = read_results(hand / "trials.yaml", now(hand))
    assert kept <= set(found)
    assert {result.trial.object for result in found.values()} >= {"sphere:0.03"}
    assert not (hand / "trials.new.yaml").exists()


@pytest.mark.heavy
def test_results_of_other_actions_outlive_a_new_one(hand: Path) -> None:
    known = {
        name: TrialResult(Trial(name, (), "sphere:0.03"), True, position=(0.0, 0.0, place))
        for name, place in (("Grasp", 1.0), ("half", 2.0))
    }
    library = ActionLibrary.load(load_configured(hand)[0], hand / "actions")
    library.add(library.compose("half", [ActionReference("Grasp", (), 0.5)]), store=True)
    write_results(hand / "trials.yaml", now(hand), known.values())
    library.add(library.compose("fist", [ActionReference("Grasp")]), store=True)
    assert read_results(hand / "trials.yaml", now(hand)) == read_results(hand / "trials.yaml")
    library.remove("half")
    library.add(library.compose("half", [ActionReference("Grasp", (), 0.6)]), store=True)
    kept = read_results(hand / "trials.yaml", now(hand))
    assert list(kept.values()) == [known["Grasp"]]
    words = [str(hand), "--all", "--variations", "0", "--object", "sphere:0.03", "--jobs", "1"]
    CliRunner().invoke(app_of(try_), words, catch_exceptions=False)
    found = read_results(hand / "trials.yaml", now(hand))
    assert found == read_results(hand / "trials.yaml")
    assert found[known["Grasp"].trial.key] == known["Grasp"], "not made anew"
    assert found[known["half"].trial.key].position != known["half"].position, "made anew"


def test_outdated_results_stay_while_nothing_is_to_do(hand: Path) -> None:
    library = ActionLibrary.load(load_configured(hand)[0], hand / "actions")
    library.add(library.compose("half", [ActionReference("Grasp", (), 0.5)]), store=True)
    names = [(one.name, one.elements) for one in library]
    known = [TrialResult(Trial(*name, "sphere:0.03"), True) for name in names]
    write_results(hand / "trials.yaml", now(hand), known)
    library.remove("half")
    before = (hand / "trials.yaml").read_text()
    words = [str(hand), "--all", "--variations", "0", "--object", "sphere:0.03", "--jobs", "1"]
    outcome = CliRunner().invoke(app_of(try_), words, catch_exceptions=False)
    assert outcome.exit_code == 0, outcome.output
    assert (hand / "trials.yaml").read_text() == before


def test_a_hand_without_actions_is_told_what_to_type(hand: Path) -> None:
    shutil.rmtree(hand / "actions")
    with pytest.raises(ConfigError, match=r"no actions to try.*: rtee extract .* --save") as caught:
        CliRunner().invoke(app_of(try_), [str(hand), "--all"], catch_exceptions=False)
    assert caught.value.exit_status == 2
    assert not (hand / "trials.yaml").exists()
