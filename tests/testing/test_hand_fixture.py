"""The pytest fixture `rtee_hand`, as the tests of a user's application use it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from patient import patient_gripper

from rtee.errors import ConfigError
from rtee.remote.directory import VARIABLE, hands_running
from rtee.testing.running import running_hand

pytest_plugins = ["pytester"]

APPLICATION = '''
import rtee

def pick(effort):
    """What the application does with a gripper, wherever that is."""
    with rtee.connect_blocking(client="picker") as hand:
        return hand.do("grasp", effort=effort).outcome, hand.name

async def pick_async():
    async with rtee.connect("robotiq_2f_85") as hand:
        return (await hand.do("grasp")).grasped
'''

TESTS = """
import os
import application
import time
import pytest
import rtee
from rtee.errors import ConfigError, NoHand

@pytest.fixture
def anyio_backend():
    return "asyncio"

@pytest.mark.anyio
async def test_something_is_picked_by_async_code(rtee_hand, tmp_path):
    rtee_hand("robotiq_2f_85", object="50mm")
    assert await application.pick_async()
    assert list((tmp_path / "rtee/logs").glob("*.mcap"))

def until(true):
    while not true():
        time.sleep(0.01)

def test_a_part_is_pulled_out_and_the_cable_too(rtee_hand):
    hand = rtee_hand("robotiq_2f_85")
    assert application.pick(1.0) == ("reached", "robotiq_2f_85")  # nothing is there to pick
    assert hand.open().reached
    hand.place("50mm")
    assert application.pick(0.5) == ("held", "robotiq_2f_85")
    closed = hand.state().position[0]
    hand.take_away()
    until(lambda: hand.state().position[0] > closed + 0.05)
    hand.unplug()
    until(lambda: hand.status().devices[0].lifecycle != "active")
    hand.plug("gripper")
    until(lambda: hand.status().devices[0].reconnects)
    hand.recover()
    assert hand.open().reached
    second = rtee_hand("schunk_svh", driver="kinematic")
    assert (hand.name, second.name) == ("robotiq_2f_85", "schunk_svh")
    assert second.do("trig", "index", intensity=0.2).reached
    for mistake, call in (
        ("unknown fault 'rust'", lambda: hand.fault("rust")),
        ("no device 'grip'; did you mean 'gripper'", lambda: hand.unplug("grip")),
        ("does not fit the fingers", lambda: hand.place("500mm")),
    ):
        with pytest.raises(ConfigError, match=mistake):
            call()

def test_mistakes_are_told_at_once(rtee_hand):
    with pytest.raises(ValueError, match="unknown hand 'robotiq_2f_8'"):
        rtee_hand("robotiq_2f_8")
    with pytest.raises(ValueError, match="50kg"):
        rtee_hand("robotiq_2f_85", object="50kg")

def test_none_is_left(rtee_hand):
    with pytest.raises(NoHand):
        rtee.connect_blocking()
"""


def test_a_project_tests_its_application(pytester: pytest.Pytester, repository: Path) -> None:
    pytester.makepyfile(application=APPLICATION, test_application=TESTS)
    config = pytester.path / "config"
    config.mkdir()
    patient_gripper(config, repository)
    (config / "schunk_svh").symlink_to(repository / "config/schunk_svh")
    done = pytester.runpytest_subprocess("-q", "-W", "error", "-p", "no:cacheprovider", timeout=280)
    done.assert_outcomes(passed=4)


@pytest.mark.samples("False")
@pytest.mark.timeout(120)
@pytest.mark.parametrize("connect", [False, True])
def test_a_test_does_not_move_a_hand_that_runs_already(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, repository: Path, connect: bool
) -> None:
    """It connected to whatever hand of that name ran, and moved it; the error came afterwards."""
    monkeypatch.chdir(repository)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "real"))
    with running_hand("robotiq_2f_85", folder=tmp_path, driver="kinematic") as real:
        before = real.state().position
        other = tmp_path / "other"
        other.mkdir()
        if not connect:
            with (
                pytest.raises(
                    ConfigError, match=r"is already running, in process .* must not move it"
                ),
                running_hand("robotiq_2f_85", folder=other, driver="kinematic") as hand,
            ):
                hand.do("grasp")
        else:  # an address in the environment leads to the real hand
            monkeypatch.setenv("RTEE_CONNECT", hands_running()["robotiq_2f_85"].endpoints[0])
            monkeypatch.setenv(VARIABLE, str(other / "run"))
            with running_hand("robotiq_2f_85", folder=other, driver="kinematic") as hand:
                assert hand.do("grasp").reached
        assert real.state().position.tolist() == before.tolist()


FALLS = """
import os, signal
from pathlib import Path

def test_the_hand_falls(rtee_hand, tmp_path):
    hand = rtee_hand("robotiq_2f_85", driver="kinematic")
    (entry,) = (tmp_path / "rtee/run").glob("*.json")
    import json
    os.kill(json.loads(entry.read_text())["pid"], signal.SIGKILL)
"""


@pytest.mark.heavy
def test_a_hand_that_fails_fails_the_test(pytester: pytest.Pytester, repository: Path) -> None:
    pytester.makepyfile(FALLS)
    (pytester.path / "config").symlink_to(repository / "config")
    done = pytester.runpytest_subprocess("-q", "-p", "no:cacheprovider", timeout=280)
    done.assert_outcomes(passed=1, errors=1)
    done.stdout.fnmatch_lines(["*the hand 'robotiq_2f_85' failed*"])


KILLED = """
import os, signal

def test_it_is_killed(rtee_hand, tmp_path):
    hand = rtee_hand("robotiq_2f_85", driver="kinematic")
    print("RUN", tmp_path / "rtee/run", flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_hand_ends_with_tests_that_are_killed(
    pytester: pytest.Pytester, repository: Path
) -> None:
    file = pytester.makepyfile(KILLED)
    (pytester.path / "config").symlink_to(repository / "config")
    words = [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", str(file)]
    done = subprocess.run(words, capture_output=True, text=True, env=dict(os.environ))
    (folder,) = (line[4:] for line in done.stdout.splitlines() if line.startswith("RUN "))
    while list(Path(folder).glob("*.json")):  # the hand takes itself off the list when it ends
        time.sleep(0.05)
