from __future__ import annotations

import asyncio
import contextlib
import copy
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import anyio.from_thread
import numpy as np
import pytest
from rtee_process import PYTHON

import rtee
from rtee.actions.build import StepPlan
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference
from rtee.errors import ConfigError, GoalRejected, NoHand, RequestRejected
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.messages.goals import goal_of
from rtee.messages.requests import Role
from rtee.remote.blocking import BlockingHand
from rtee.remote.client import RemoteHand
from rtee.types import Feedback

from .serving import LASTING, Served, serving


@pytest.fixture
def served(hand: Hand, library: ActionLibrary) -> Iterator[Served]:
    """A hand that runs in a thread of its own."""
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, library)) as served,
    ):
        yield served


def test_the_blocking_twin_does_what_the_other_does(served: Served, hand: Hand) -> None:
    heard: list[Feedback] = []
    with rtee.connect_blocking("small") as remote:
        result = remote.do("pinch_tight", "index", "thumb", intensity=0.3, on_feedback=heard.append)
        assert result.reached
        assert heard
        assert remote.open().reached
        assert remote.state().names == hand.actuator_names
        ticks = []
        for state in remote.states(100.0):
            ticks.append(state.tick)
            if len(ticks) == 3:
                break
        assert ticks == sorted(ticks)
        assert remote.status().hand == "small"
        assert remote.info().name == "small"
        assert "<robot" in remote.robot_description()
        assert remote.stop() == {"sim": True}
        remote.recover()
        remote.hold()
        remote.jog({"near": 0.1})
        remote.set_gains({"time_constant": 0.05})
        with remote.lease():
            assert remote.status().holder == remote.client


def test_its_actions(served: Served) -> None:
    with rtee.connect_blocking() as remote:
        remote.add_generic("half", {"near": 0.5}, store=True)
        remote.add_composed("two", [ActionReference("half")])
        remote.add_timed("late", [StepPlan(ActionReference("half"), after=0.1)])
        remote.store_action("two")
        remote.rename_action("two", "three")
        remote.remove_action("late")
        assert {action.name for action in remote.actions("composed")} == {"fist", "three"}
        assert remote.partners("PinchTight", "index") == ("thumb",)
        assert [group.name for group in remote.primitives()] == ["Trig", "PinchTight"]
        with pytest.raises(RequestRejected):
            remote.do("late")


def test_a_goal_can_be_watched_and_cancelled(served: Served) -> None:
    remote = rtee.connect_blocking("small")
    goal = remote.start("fist", **LASTING)
    for feedback in goal:
        if feedback.progress > 0.0:
            goal.cancel()
    assert goal.done
    assert goal.result().cancelled
    remote.disconnect()
    remote.disconnect()


def test_who_has_left_the_hand_is_told_to_connect_again(served: Served) -> None:
    remote = rtee.connect_blocking("small")
    remote.disconnect()
    with pytest.raises(NoHand, match="connect again"):
        remote.status()
    with pytest.raises(NoHand, match="connect again"), remote.lease():
        pass
    with pytest.raises(NoHand, match="connect again"), remote.stream():
        pass


def test_a_stream_and_a_lease_end_with_the_hand_that_is_left(served: Served) -> None:
    remote = rtee.connect_blocking("small")
    with remote.lease(), remote.stream() as stream:
        remote.disconnect()
        with pytest.raises(NoHand, match="connect again"):
            stream.send({"Trig index": 0.1})


def test_a_connection_stays_in_its_process(served: Served) -> None:
    with rtee.connect_blocking("small") as remote:
        for work in (pickle.dumps, copy.deepcopy):
            with pytest.raises(TypeError, match="connect in each process"):
                work(remote)
        assert remote.state().tick > 0


def test_a_forked_process_is_told_to_be_spawned(served: Served) -> None:
    code = (
        "import os, sys, rtee\n"
        "hand = rtee.connect_blocking('small')\n"
        "if os.fork() == 0:\n"
        "    try:\n"
        "        hand.state()\n"
        "    except rtee.NoHand as error:\n"
        "        sys.exit(42 if 'spawn' in str(error) else 1)\n"
        "print(os.waitstatus_to_exitcode(os.wait()[1]), hand.state().tick > 0)\n"
    )
    done = subprocess.run([*PYTHON, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "42 True"), done.stderr


def test_a_forgotten_async_with_is_named() -> None:
    unopened: Any = rtee.connect("small")
    with pytest.raises(ConfigError, match="write 'async with"):
        unopened.do("fist")
    with pytest.raises(ConfigError, match="write 'async with"), unopened:
        pass
    assert not hasattr(unopened, "shape")


def test_a_client_of_another_event_loop_is_refused(served: Served) -> None:
    async def main() -> None:
        async with rtee.connect("small") as remote:

            async def elsewhere() -> None:
                with pytest.raises(ConfigError, match="belongs to another event loop"):
                    await remote.do("Trig", "index")

            await asyncio.to_thread(asyncio.run, elsewhere())
            assert (await remote.state()).tick > 0

    asyncio.run(main())


def test_another_event_loop_is_named() -> None:
    """What trio runs has no loop of asyncio; neither has a coroutine that is only sent to."""
    entering = rtee.connect("small").__aenter__()
    with pytest.raises(ConfigError, match="on trio, use rtee"):
        entering.send(None)


def test_what_is_no_name_is_said() -> None:
    with pytest.raises(ConfigError, match="the hand to connect with must be a string, not 3"):
        rtee.connect_blocking(3)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="the client to connect with must be a string, not None"):
        rtee.connect_blocking("small", client=None)  # type: ignore[arg-type]


def test_all_that_the_other_does_it_does_too() -> None:
    missing = {name for name in dir(RemoteHand) if not name.startswith("_")} - set(
        dir(BlockingHand)
    )
    assert missing == {"collected_states", "leave"}  # closing leaves


def test_a_goal_of_ones_own_and_what_others_see_of_it(served: Served) -> None:
    with rtee.connect_blocking("small") as remote:
        assert remote.role is Role.MAINTAINER
        feedback = remote.feedback()
        running = remote.start_goal(goal_of("fist", **LASTING, goal_id="mine"))
        assert next(feedback).goal_id == "mine"
        assert next(iter(running)).goal_id == "mine"
        running.cancel()
        assert running.result().cancelled
        feedback.close()


def test_an_error_of_ones_own_while_a_goal_runs_cancels_it(served: Served) -> None:
    def fail(_: Feedback) -> None:
        raise ZeroDivisionError

    with rtee.connect_blocking("small") as remote:
        with pytest.raises(ZeroDivisionError):
            remote.do("fist", **LASTING, on_feedback=fail)
        assert remote.open().reached
    assert served.watcher.results[0].cancelled


def test_leaving_the_hand_ends_a_wait_in_another_thread(served: Served) -> None:
    remote = rtee.connect_blocking("small")
    begun, states = threading.Event(), remote.states(50.0)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(remote.do, "fist", **LASTING, on_feedback=lambda _: begun.set())
        begun.wait()
        listening = pool.submit(list, remote.states(50.0))
        next(states)
        remote.disconnect()
        for ended in (waiting, listening):
            with pytest.raises(NoHand, match="this client has left"):
                ended.result(10.0)
    for call in (remote.state, remote.open, remote.stop, states.__next__):
        with pytest.raises(NoHand, match="this client has left"):
            call()


@pytest.mark.parametrize(
    ("elements", "options", "said"),
    [
        ((["index", "thumb"],), {}, r"one argument each, not \['index', 'thumb'\]"),
        ((), {"intensity": "most"}, "intensity must be a share, such as 60% or 0.6, not 'most'"),
        ((), {"intensity": None}, "intensity must be a share, such as 60% or 0.6, not None"),
        ((), {"speed": "fast"}, "speed must be a share, such as 60% or 0.6, not 'fast'"),
        ((), {"timeout": "5m"}, "timeout must be a number of seconds, such as 5s, and 'm' is not"),
        ((), {"force": 10**400}, "force must be a force, such as 10N, not 1000000"),
        ((), {"effort": {"near": 10**400}}, "'near' must be a finite number, not 1000000"),
        ((), {"tolerance": "1"}, "tolerance must be a finite number, not '1'"),
        ((), {"effort": "4N"}, "such as 0.4 or 40%, or a number for each actuator, not '4N'"),
        ((), {"effort": {"near": "1"}}, "effort limit 'near' must be a finite number, not '1'"),
        ((), {"intensty": 0.5}, "unknown option 'intensty' of a goal; did you mean 'intensity'"),
    ],
)
def test_what_no_message_can_carry_is_said_in_words(
    served: Served, elements: tuple[Any, ...], options: dict[str, Any], said: str
) -> None:
    with (
        rtee.connect_blocking("small") as remote,
        pytest.raises(GoalRejected, match=said),
    ):
        remote.do("fist", *elements, **options)


@pytest.mark.parametrize(
    ("fingers", "said"),
    [
        (5, "must be a list of names, such as \\['index'\\], not 5"),
        (np.array([1.0, 2.0]), "must be a list of names"),
        (iter(["nobody"]), "nobody"),
    ],
)
def test_fingers_are_names_that_can_be_read_once(served: Served, fingers: Any, said: str) -> None:
    with rtee.connect_blocking("small") as remote, pytest.raises(GoalRejected, match=said):
        remote.touch(fingers=fingers)


def test_a_share_of_the_efforts_is_given_as_in_a_goal(served: Served) -> None:
    with rtee.connect_blocking("small") as remote:
        assert remote.effort_limits("40%") == remote.effort_limits(0.4)
        for wrong in ("4N", None, 10**400):
            with pytest.raises(GoalRejected, match="effort must be a share"):
                remote.effort_limits(wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("effort", ["40%", 0.4, np.float32(0.4)])
def test_a_stream_takes_efforts_as_a_goal_does(served: Served, effort: Any) -> None:
    with rtee.connect_blocking("small") as remote:
        with remote.stream(effort=effort) as stream:
            assert not stream.ended
        with (
            pytest.raises(GoalRejected, match=r"share of all limits, such as 0\.4 or 40%, .*'4N'"),
            remote.stream(effort="4N"),
        ):
            pass


def test_feedback_needs_a_function_before_anything_moves(served: Served) -> None:
    with (
        rtee.connect_blocking("small") as remote,
        pytest.raises(GoalRejected, match="on_feedback must be a function"),
    ):
        remote.do("fist", on_feedback=3)  # type: ignore[arg-type]
    assert served.watcher.goals == []


def test_events(served: Served) -> None:
    with rtee.connect_blocking("small") as remote, rtee.connect_blocking("small") as other:
        portal = remote._portal
        events = remote.events()
        first = portal.start_task_soon(lambda: anext(remote._hand.events()))
        while not remote._hand._monitoring._event_queues:
            pass
        other.stop()
        assert first.result().kind == "stop"
        events.close()


def test_a_script_that_fails_after_a_jog_counts_as_lost(served: Served) -> None:
    with rtee.connect_blocking("small", client="other") as other:
        events = other.events()
        with contextlib.suppress(ZeroDivisionError), rtee.connect_blocking("small") as remote:
            remote.jog({"near": 0.1})
            raise ZeroDivisionError
        lost = next(event for event in events if event.kind == "client_lost")
        assert lost.source == remote.client
        events.close()


def test_no_hand() -> None:
    with pytest.raises(NoHand):
        rtee.connect_blocking("small")


@pytest.mark.heavy  # so do the scripts of the next two tests
def test_a_script_that_forgets_to_close_ends_all_the_same(served: Served) -> None:
    code = "import rtee; hand = rtee.connect_blocking('small'); print(hand.state().tick > 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "True"), done.stderr


def test_a_stream_that_a_script_forgets_to_close_says_nothing(served: Served) -> None:
    code = (
        "import rtee\n"
        "stream = rtee.connect_blocking('small').stream()\n"
        "print(stream.__enter__() is not None)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "True", "")


def test_what_is_still_iterated_over_at_the_end_of_a_script_says_nothing(served: Served) -> None:
    code = (
        "import rtee\n"
        "hand = rtee.connect_blocking('small')\n"
        "states = hand.states(50.0)\n"
        "print(next(states).tick > 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "True", "")


def test_a_script_that_is_interrupted_cancels_its_goal(served: Served, tmp_path: Path) -> None:
    code = (
        "import _thread, rtee\n"
        "hand = rtee.connect_blocking('small')\n"
        "hand.do('fist', speed=0.05, on_feedback=lambda _: _thread.interrupt_main())\n"
    )
    done = subprocess.run([*PYTHON, "-c", code], capture_output=True, text=True)
    assert done.returncode != 0
    assert "KeyboardInterrupt" in done.stderr
    assert served.watcher.results[0].cancelled


ENDINGS: dict[str, Callable[[BlockingHand, Any], object]] = {
    "do": lambda remote, heard: remote.do("Grasp", speed=0.01, on_feedback=heard),
    "grasp": lambda remote, heard: remote.grasp(0.02, tip_speed=0.0005, on_feedback=heard),
    "touch": lambda remote, heard: remote.touch(tip_speed=0.0005, on_feedback=heard),
    "move_opening": lambda remote, heard: remote.move_opening(
        0.01, tip_speed=0.0005, on_feedback=heard
    ),
}
"""The calls that wait for a goal, each so slow that it is left while the goal runs."""


class OutOfTime(BaseException):
    """What the handler of a signal raises, as the timeout of a test does."""


@pytest.fixture
def gripper(repository: Path) -> Iterator[Served]:
    """A gripper whose openings are known."""
    folder = repository / "config/robotiq_2f_85"
    gripper = load_hand(folder)
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(
            serving(gripper, ActionLibrary.load(gripper, folder / "actions"))
        ) as served,
    ):
        yield served


@pytest.mark.parametrize("watched", [False, True])
@pytest.mark.parametrize("error", [OutOfTime, SystemExit, KeyboardInterrupt])
def test_however_a_call_is_left_its_goal_ends(
    gripper: Served, error: type[BaseException], watched: bool
) -> None:
    def handler(*_: object) -> None:
        raise error

    main = threading.main_thread().ident
    assert main is not None

    def interrupt() -> None:
        while gripper.loop.controller.running is None:
            time.sleep(0.002)
        signal.pthread_kill(main, signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, handler)
    try:
        with rtee.connect_blocking() as remote, ThreadPoolExecutor() as pool:
            for name, call in ENDINGS.items():
                results = len(gripper.watcher.results)
                interrupted = pool.submit(interrupt)
                with pytest.raises(error):
                    call(remote, (lambda _: None) if watched else None)
                interrupted.result()
                # The call has returned once the hand has accepted the cancellation.
                while len(gripper.watcher.results) == results:
                    time.sleep(0.002)
                assert gripper.watcher.results[-1].cancelled, name
            assert remote.do("Grasp", intensity=0.05).reached
    finally:
        signal.signal(signal.SIGUSR1, before)


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        (lambda hand: hand.jog({"near": "0.1"}), "value 'near' must be a finite number"),
        (lambda hand: hand.jog({"nea": 0.1}), "did you mean 'near'"),
        (lambda hand: hand.do("Trig", "index", intensity=2.0), "intensity must be 0 to 1, not 2"),
        (lambda hand: hand.do("no_such_action"), "unknown action 'no_such_action'"),
        (lambda hand: hand.grasp("30mm", fingers="index"), r"a list of names, such as \['index'\]"),
        (lambda hand: hand.touch(fingers="index"), r"a list of names, such as \['index'\]"),
        (lambda hand: hand.grasp("30mm", width_tolerance="99"), "two lengths, narrower and wider"),
        (lambda hand: hand.grasp(None), "width must be a length, such as 30mm"),
        (lambda hand: hand.move_opening(40), "the opening would be 40 m; write 40mm"),
        (lambda hand: hand.jog({"near": 45}), "position 45 of 'near' is outside its limits"),
        (lambda hand: hand.do("trig:index", "thumb"), "elements of 'trig:index' are given twice"),
    ],
)
def test_this_computer_and_the_hand_refuse_by_the_same_error(
    served: Served, mistake: Callable[[BlockingHand], object], told: str
) -> None:
    with rtee.connect_blocking("small", wait="3s") as remote:
        with pytest.raises(GoalRejected, match=told) as caught:
            mistake(remote)
        assert isinstance(caught.value, RequestRejected)
        assert isinstance(caught.value, ValueError)
        if "did you mean" in told:
            found = caught.value.code, caught.value.option, caught.value.nearest
            assert found == ("unknown", "positions", "near")
            assert "near" in caught.value.valid
