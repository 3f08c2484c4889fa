"""Waiting for a hand says what it waits for; efforts may be shares of the limits."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import anyio
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal
from rtee_process import RTEE
from typer.testing import CliRunner

import rtee
from rtee.actions.cli_syntax import read_efforts
from rtee.actions.library import ActionLibrary
from rtee.cli._common import app_of
from rtee.cli.do import do
from rtee.cli.do import open_ as open
from rtee.errors import ActionError, GoalRejected, NoHand, NotReady, RequestRejected
from rtee.hand.model import Hand

from .serving import Served, serving

pytestmark = pytest.mark.anyio


@pytest.fixture
def portal() -> Iterator[BlockingPortal]:
    with start_blocking_portal() as portal:
        yield portal


@pytest.fixture
def served(hand: Hand, library: ActionLibrary, portal: BlockingPortal) -> Iterator[Served]:
    with portal.wrap_async_context_manager(serving(hand, library)) as served:
        yield served


def run(command: Callable[..., None], *words: str, status: int = 0) -> str:
    result = CliRunner().invoke(app_of(command), words, catch_exceptions=False)
    assert result.exit_code == status, result.output
    return result.output


# --- ready


async def test_a_hand_that_is_ready_can_be_moved_at_once(
    hand: Hand, library: ActionLibrary
) -> None:
    told: list[str] = []
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        await remote.ready(20.0, told.append)
        assert told == []
        await served.loop.disable()
        with pytest.raises(
            NotReady, match=r"'small' is not ready after 0.2 s: device 'sim' is"
        ) as e:
            await remote.ready(0.2, told.append)
        assert isinstance(e.value, TimeoutError)
        assert len(told) == 1
        assert told[0].startswith("device 'sim' is inactive")
        async with anyio.create_task_group() as group:
            group.start_soon(remote.recover)
            await remote.ready(None)
        assert (await remote.do("fist", intensity=0.1)).reached


def test_the_blocking_twin_is_ready_too(served: Served, portal: BlockingPortal) -> None:
    with rtee.connect_blocking("small") as remote:
        remote.ready(timeout=20.0)
        assert remote.do("fist", intensity=0.1).reached
        portal.call(served.loop.disable)
        with pytest.raises(NotReady, match="inactive"):
            remote.ready(timeout=0.2)


def test_a_hand_that_goes_is_no_silent_wait(
    hand: Hand, library: ActionLibrary, portal: BlockingPortal
) -> None:
    with portal.wrap_async_context_manager(serving(hand, library)):
        remote = rtee.connect_blocking("small")
    with remote, pytest.raises(NoHand):
        remote.ready(timeout=None)


def test_do_waits_until_the_devices_are_active(served: Served, portal: BlockingPortal) -> None:
    with rtee.connect_blocking("small") as remote:
        portal.call(served.loop.disable)
        with pytest.raises(NotReady, match=r"after 0\.\d+ s: device 'sim' is inactive"):
            run(do, "fist", "--wait", "0.3")
        remote.recover()
    assert "fist: reached" in run(do, "--wait", "fist", "--intensity", "0.1")
    assert "open: reached" in run(open, "--wait")


def test_do_waits_for_a_hand_that_does_not_run_yet(
    hand: Hand, library: ActionLibrary, portal: BlockingPortal
) -> None:
    words = [*RTEE, "do", "fist", "--wait", "50", "--intensity", "0.1"]
    with subprocess.Popen(words, stdout=-1, stderr=-1, text=True) as waiting:
        assert waiting.stderr is not None
        said = waiting.stderr.readline()
        with portal.wrap_async_context_manager(serving(hand, library)):
            answer, _ = waiting.communicate()
    assert said == (
        "rtee: waiting: no hand is running on this computer; start one with 'rtee run HAND'\n"
    )
    assert "fist: reached" in answer


def test_who_waits_is_told_why_and_for_how_long(runtime: object) -> None:
    with pytest.raises(NoHand, match="no hand is running"):
        run(do, "fist", "--wait", "0.1")


# --- efforts


def test_a_share_of_all_effort_limits(served: Served, hand: Hand) -> None:
    limits = dict(zip(hand.actuator_names, (a.effort for a in hand.actuators), strict=True))
    done = json.loads(run(do, "fist", "--effort", "40%", "--json"))
    assert done["succeeded"]
    goal = served.watcher.goals[-1]
    assert goal.effort == pytest.approx({name: 0.4 * most for name, most in limits.items()})
    run(do, "open", "--effort", "40%", "--effort", "near=1.5", "--effort", "push=10%")
    expected = {"near": 1.5, "push": 4.0, "thumb": 1.2}
    assert served.watcher.goals[-1].effort == pytest.approx(expected)


def test_a_share_in_python(served: Served) -> None:
    with rtee.connect_blocking() as remote:
        assert remote.do("fist", effort=0.5).succeeded
        assert served.watcher.goals[-1].effort == {"near": 1.0, "thumb": 1.5, "push": 20.0}
        assert remote.effort_limits(0.5, ["near"]) == {"near": 1.0}
        for share in (0.0, 40, -1.0, float("nan")):
            with pytest.raises(GoalRejected, match=r"share of (all|their) limits"):
                remote.do("fist", effort=share)
        with pytest.raises(GoalRejected, match="unknown actuator 'far'"):
            remote.effort_limits(0.5, ["far"])
        with pytest.raises(RequestRejected, match="unknown actuator 'far'"):
            remote.do("fist", effort={"far": 1.0})


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("near", "'near' is not an effort limit; write PERCENT% for all actuators, ACTUATOR="),
        ("40", "'40' is not an effort limit"),
        ("=3", "'=3' is not an effort limit"),
        ("near=much", "the effort limit in 'near=much' must be a number, not 'much'"),
        ("140%", "must be above 0 % and at most 100 %"),
        ("near=0%", "must be above 0 % and at most 100 %"),
        ("nan%", "must be above 0 % and at most 100 %"),
        ("40% 50%", "the effort of all actuators is given twice"),
        ("near=1 near=40%", "the actuator 'near' is given twice"),
    ],
)
def test_words_that_are_no_effort(words: str, said: str) -> None:
    with pytest.raises(ActionError) as caught:
        read_efforts(words.split())
    assert said in str(caught.value)
    assert "set-point" not in str(caught.value)
    assert caught.value.exit_status == 2


@pytest.mark.parametrize("wrong", [float("nan"), "soon", [], 1j])
def test_a_wait_is_a_time(served: Served, wrong: Any) -> None:
    with pytest.raises(GoalRejected, match="the wait must be a number of seconds, such as 5s"):
        rtee.connect_blocking("nobody", wait=wrong)
    with rtee.connect_blocking("small") as hand:
        hand.ready("10s")
        with pytest.raises(GoalRejected, match="the timeout must be a number of seconds"):
            hand.ready(wrong)


@pytest.mark.parametrize("wrong", [0, -1, 0.5, None, "all"])
def test_at_least_one_state_is_kept(served: Served, wrong: Any) -> None:
    said = "states to keep must be a whole number from 1"
    with rtee.connect_blocking("small") as hand, pytest.raises(GoalRejected, match=said):
        next(hand.states(50.0, keep=wrong))
