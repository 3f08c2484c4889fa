from __future__ import annotations

import itertools
import math
import re
import threading
from dataclasses import replace
from typing import Any

import anyio
import numpy as np
import pytest
import zenoh

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import (
    ConfigError,
    GoalRejected,
    LeaseHeld,
    MessageError,
    NoHand,
    RequestRejected,
    RteeError,
)
from rtee.hand.model import Hand
from rtee.messages import EVENT
from rtee.remote import goal as remote_goal
from rtee.remote.server import Server
from rtee.remote.session import direct
from rtee.sample import TickRecord
from rtee.types import Event, Feedback, Goal, Intensity, Lifecycle, Named, Stage

from .serving import (
    LASTING,
    RATE,
    Config,
    Remote,
    Told,
    free_endpoint,
    make_hand,
    make_library,
    serving,
    until,
)

pytestmark = pytest.mark.anyio


async def test_an_action_is_executed(hand: Hand, library: ActionLibrary) -> None:
    heard: list[Feedback] = []
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        result = await remote.do(
            "pinch_tight", "thumb", "index", intensity=0.5, on_feedback=heard.append
        )
        assert result.reached
        assert result.succeeded
        assert result.position["near"] == pytest.approx(0.5, abs=0.02)
        assert [goal.client for goal in served.watcher.goals] == [remote.client]
    assert heard
    assert all(a.progress <= b.progress for a, b in itertools.pairwise(heard))


async def test_feedback_of_a_timed_action_names_its_inner_actions(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library), rtee.connect() as remote:
        running = await remote.start("wave")
        inner = [feedback.inner async for feedback in running]
        assert (await running.result()).reached
    assert list(dict.fromkeys(name for name in inner if name)) == ["up", "side"]


async def test_everything_about_a_goal_arrives(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        await remote.do(
            "PinchTight",
            "index",
            "thumb",
            intensity=0.5,
            effort={"near": 1.5},
            tolerance=0.02,
            speed=0.75,
            timeout=5.0,
            stage="pre_grasp",
            kind="primitive",
        )
        goal = served.watcher.goals[0]
    assert goal.effort == {"near": 1.5}
    assert (goal.to, goal.speed, goal.timeout) == (Intensity(0.5, Stage.PRE_GRASP, 0.02), 0.75, 5.0)


@pytest.mark.parametrize(
    ("action", "elements", "options", "reason"),
    [
        ("dance", (), {}, "unknown action 'dance'"),
        ("Trig", ("ring",), {}, "does not exist with 'ring'"),
        ("fist", (), {"intensity": 1.2}, "intensity must be 0 to 1"),
        ("fist", (), {"intensity": math.nan}, "intensity must be 0 to 1"),
        ("fist", (), {"speed": 0.0}, "speed must be above 0"),
        ("fist", (), {"timeout": -1.0}, "timeout must be above 0"),
        ("fist", (), {"tolerance": math.inf}, "tolerance must be"),
        ("fist", (), {"effort": {"pollex": 1.0}}, "unknown actuator 'pollex'"),
        ("fist", (), {"effort": {"near": 99.0}}, "effort limit of 'near'"),
        ("fist", (), {"kind": "timed"}, "unknown action 'fist'"),
    ],
)
async def test_bad_goals_are_refused_with_a_reason(
    hand: Hand,
    library: ActionLibrary,
    action: str,
    elements: tuple[str],
    options: dict,
    reason: str,
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match=reason):
            await remote.do(action, *elements, **options)
        assert served.watcher.goals == []


async def test_a_wrong_argument_is_a_sentence(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        for goal in ("fist", None, Named("fist")):
            with pytest.raises(GoalRejected, match=r"a complete goal is a Goal\(…\), not"):
                await remote.start_goal(goal)
        with pytest.raises(
            MessageError, match=r"'what' must be Named\(…\) or Fingers\(…\), not 'fist'"
        ):
            await remote.start_goal(Goal("fist"))
        for action, what in (
            (7, "action: a string expected, not 7"),
            ("fist", r"effort: .*'much'"),
        ):
            with pytest.raises(MessageError, match=rf"rtee_msgs/msg/Goal\.{what}"):
                await remote.start_goal(Goal(Named(action), effort={"near": "much"}))
        for name in ("statte", None, []):
            with pytest.raises(RequestRejected, match="no request '"):
                await remote.ask(name)
        with pytest.raises(
            MessageError, match=r"the fields of a .*GoalReference by name expected, not 'all'"
        ):
            await remote.ask("cancel", "all")
        with pytest.raises(MessageError, match=r"missing or unknown fields \['client'\]"):
            await remote.ask("cancel", {"goal_id": "a"})
        for within in ("soon", -1.0, math.nan, None):
            with pytest.raises(GoalRejected, match="the time to wait must"):
                await remote.ask("status", within=within)
        assert served.watcher.goals == []


async def test_cancel_holds_the_hand(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        running = await remote.start("fist", **LASTING)
        await running.cancel()
        result = await running.result()
        assert result.cancelled
        assert not result.succeeded
        await running.cancel()


async def test_cancelling_the_caller_cancels_the_goal(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        with anyio.CancelScope() as scope:
            await remote.do("fist", **LASTING, on_feedback=lambda _: scope.cancel())
        await until(lambda: bool(served.watcher.results))
        assert served.watcher.results[0].cancelled


async def test_an_error_in_feedback_cancels_the_goal(hand: Hand, library: ActionLibrary) -> None:
    def fail(_: Feedback) -> None:
        raise ZeroDivisionError

    async with serving(hand, library) as served, rtee.connect("small") as remote:
        with pytest.raises(ZeroDivisionError):
            await remote.do("fist", **LASTING, on_feedback=fail)
        await until(lambda: bool(served.watcher.results))
        assert served.watcher.results[0].cancelled


async def test_a_new_goal_preempts_the_own_one(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        first = await remote.start("fist", **LASTING)
        second = await remote.start("Trig", "index")
        assert (await first.result()).preempted
        assert (await second.result()).reached


async def test_one_client_moves_the_hand_at_a_time(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as one, rtee.connect("small") as two:
        running = await one.start("fist", **LASTING)
        with pytest.raises(LeaseHeld) as caught:
            await two.do("fist")
        assert caught.value.holder == one.client
        with pytest.raises(LeaseHeld):
            await two.jog({"near": 0.1})
        with pytest.raises(LeaseHeld):
            await two.cancel()
        assert (await two.status()).holder == one.client
        await running.cancel()
        await running.result()
        assert (await two.do("Trig", "index", intensity=0.1)).reached


async def test_a_taken_hand_stays_taken_until_given_back(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library), rtee.connect("small") as one, rtee.connect("small") as two:
        async with one.lease():
            with pytest.raises(LeaseHeld):
                await two.acquire_lease()
            assert (await one.do("Trig", "index", intensity=0.1)).reached
        await two.acquire_lease()
        await two.release_lease()


async def test_a_hand_is_held_until_the_outermost_context_ends(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library), rtee.connect("small") as one, rtee.connect("small") as two:
        async with one.lease():
            async with one.lease():
                pass
            with pytest.raises(LeaseHeld):
                await two.acquire_lease()
        await two.acquire_lease()
        with pytest.raises(LeaseHeld):
            async with one.lease():
                pass
        async with two.lease():
            pass
        assert (await one.status()).holder == two.client, "it has acquired the hand besides"
        await two.release_lease()


async def test_who_gives_up_before_it_holds_the_hand_does_not_keep_it(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library), rtee.connect("small") as one, rtee.connect("small") as two:
        with anyio.CancelScope() as scope:
            scope.cancel()  # while the answer is waited for
            async with one.lease():
                pass
        await two.acquire_lease()
        await two.release_lease()


async def test_stop_needs_no_lease(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as one, rtee.connect("small") as two:
        running = await one.start("fist", **LASTING)
        assert await two.stop() == {"sim": True}
        result = await running.result()
        assert result.cancelled
        assert two.client in result.reason


async def test_the_answer_to_a_stop_does_not_wait_behind_others(
    hand: Hand, library: ActionLibrary
) -> None:
    taken = threading.Event()  # by a client that is slow to take what it is told
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        served.server.outbox.put(taken.wait)
        try:
            with anyio.fail_after(300):
                assert await remote.stop() == {"sim": True}
        finally:
            taken.set()


async def test_open_goes_to_the_rest_posture(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        await remote.do("fist", intensity=0.3)
        result = await remote.open()
        assert result.reached
        assert result.position["near"] == pytest.approx(0.0, abs=0.02)


async def test_jog(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        await remote.jog({"near": 0.2}, max_velocity=2.0)
        async for state in remote.states(RATE):
            if abs(state.positions["near"] - 0.2) < 0.01:
                break
        for positions, limit, reason in (
            ({"pollex": 1.0}, None, "unknown actuator"),
            ({"near": math.nan}, None, "must be a finite number"),
            ({"near": 0.1}, -1.0, "velocity must be above 0"),
        ):
            with pytest.raises(RequestRejected, match=reason):
                await remote.jog(positions, limit)


async def test_gains_and_recovery(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        await remote.set_gains({"time_constant": 0.2}, "sim")
        with pytest.raises(RequestRejected, match="unknown gain 'p'"):
            await remote.set_gains({"p": 1.0})
        served.driver.fail("too hot")
        await until(lambda: not any(served.loop.controller.active))
        assert (await remote.status()).devices[0].lifecycle is Lifecycle.FAULT
        with pytest.raises(RequestRejected, match=r"device 'sim' is in fault: .*too hot"):
            await remote.do("fist")
        await remote.recover()
        assert (await remote.status()).devices[0].lifecycle is Lifecycle.ACTIVE
        with pytest.raises(RequestRejected, match="unknown device"):
            await remote.recover("other")


async def test_states_come_at_the_rate_asked_for(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        for rate in (RATE, RATE / 4):
            ticks = []
            async for state in remote.states(rate):
                ticks.append(state.tick)
                if len(ticks) == 5:
                    break
            steps = {b - a for a, b in itertools.pairwise(ticks)}
            assert min(steps) >= RATE / rate
        assert state.names == hand.actuator_names
        assert state.joint_names == hand.joint_names
        u = np.array([state.positions[name] for name in hand.actuator_names])
        assert state.joint_position == pytest.approx(hand.transmission.joints(u))
        with pytest.raises(RequestRejected, match="rate"):
            await anext(remote.states(math.nan))
        slow, all_ = remote.states(RATE), remote.states(RATE, keep=100)
        first = (await anext(slow)).tick, (await anext(all_)).tick
        while (await remote.state()).tick < first[1] + 20:  # noqa: ASYNC110
            await anyio.sleep(0.01)
        assert (await anext(slow)).tick > first[0] + 10
        assert (await anext(all_)).tick < first[1] + 10


async def test_states_are_collected_until_somebody_looks(
    hand: Hand, library: ActionLibrary
) -> None:
    async with (
        serving(hand, library),
        rtee.connect("small") as remote,
        remote.collected_states(RATE, most=8) as states,
    ):
        found = []
        while len(found) < 3:
            found += states.drain()
            await anyio.sleep(0.01)
        first = (await remote.state()).tick
        while (await remote.state()).tick < first + 20:  # noqa: ASYNC110
            await anyio.sleep(0.01)
        kept = [state.tick for state in states.drain()]
        assert kept == sorted(kept)
        assert len(kept) <= 8
        while (await remote.state()).tick < kept[-1] + 20:  # noqa: ASYNC110
            await anyio.sleep(0.01)
        few = [state.tick for state in states.drain(4)]
        assert few[0] > kept[-1]
        assert len(few) == 2
        assert few[1] - few[0] >= 4


async def test_what_nobody_takes_does_not_pile_up(hand: Hand, library: ActionLibrary) -> None:
    taken: list[bytes] = []
    received = threading.Event()

    def at_last(sample: zenoh.Sample) -> None:
        if sample.payload.to_bytes() == b"299":
            received.set()

    async with serving(hand, library) as served, rtee.connect("small") as remote:
        session, key = remote._link._session, "rtee/small/states/test"
        with remote._link.subscribed("states/test", taken.append, 10):
            watched = session.declare_subscriber(key, direct(at_last))
            while not received.is_set():  # until the subscriptions have got around
                for number in range(300):
                    served.server._session.put(key, str(number))
                received.wait(0.2)  # the event loop is held up
            await until(lambda: taken[-1:] == [b"299"])
            watched.undeclare()
    assert len(taken) <= 20


async def test_a_hand_is_found_before_its_first_tick(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        found, refused = served.loop.snapshot, iter([RteeError("the loop has not ticked yet")] * 3)

        def snapshot() -> TickRecord:
            for error in refused:
                raise error
            return found()

        monkeypatch.setattr(served.loop, "snapshot", snapshot)
        assert len((await remote.state()).position) == len(hand.actuators)


async def test_a_single_state(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        first, second = await remote.state(), await remote.state()
        assert second.tick >= first.tick
        assert np.isfinite(second.reference_position).all()


@pytest.mark.parametrize("delay", [0.0, 0.0005, 0.001, 0.003])
async def test_a_call_that_is_given_up_before_its_answer_moves_nothing(
    hand: Hand, library: ActionLibrary, delay: float
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        before = (await remote.state()).position
        with anyio.move_on_after(delay) as given_up:
            await remote.do("fist", **LASTING)
        assert given_up.cancelled_caught
        while (await remote.status()).goal_id:  # noqa: ASYNC110 - it brakes first
            await anyio.sleep(0.01)
        # The result of a goal that had begun may come after the status.
        await until(lambda: not remote._goals._running._running)
        assert all(result.cancelled for result in served.watcher.results)
        assert (await remote.state()).position == pytest.approx(before, abs=0.01)


async def test_a_hand_whose_run_is_cancelled_leaves_the_network(
    hand: Hand, library: ActionLibrary
) -> None:
    with anyio.CancelScope() as scope:
        async with serving(hand, library) as served:
            assert served.server.endpoint
            scope.cancel()
            await anyio.sleep(1.0)
    assert not [one.name for one in threading.enumerate() if one.name.endswith(" small")]


async def test_a_goal_that_runs_is_not_started_again(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        running = await remote.start("fist", **LASTING)
        with pytest.raises(GoalRejected, match="is running already"):
            await remote._goals.start_goal(running.goal)
        await running.cancel()
        assert (await running.result()).cancelled, "it is still followed"


async def test_a_goal_that_is_asked_for_again_is_prepared_once(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[Any, ...]] = []
    make = remote_goal.goal_by

    def noted(*asked: Any) -> Goal:
        made.append(asked)
        return make(*asked)

    monkeypatch.setattr(remote_goal, "goal_by", noted)
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        for intensity in (0.5, 0.5, "50%", "50%", 0.25):
            assert (await remote.do("fist", intensity=intensity)).reached
        assert [asked[2] for asked in made] == [{"intensity": i} for i in (0.5, "50%", 0.25)]
        for _ in range(2):
            with pytest.raises(GoalRejected, match="the intensity must be 0 to 1, not 2"):
                await remote.do("fist", intensity=2.0)
        for share in (0.5, 0.25):
            effort = {"near": share}
            for _ in range(2):  # a mapping may have changed since
                await remote.do("fist", effort=effort)
                effort["near"] /= 2.0
        goals = served.watcher.goals
        assert [each.to.share for each in goals[:5]] == [0.5, 0.5, 0.5, 0.5, 0.25]
        assert goals[1] == replace(goals[0], goal_id=goals[1].goal_id)
        assert [each.effort["near"] for each in goals[5:]] == [0.5, 0.25, 0.25, 0.125]
        assert len({each.goal_id for each in goals}) == len(goals) == 9


async def test_status(hand: Hand, library: ActionLibrary) -> None:
    told = Told()
    told.start()
    told.lost = 3
    serves = serving(hand, library, recorder=told)
    async with serves as served, rtee.connect("small") as remote:
        running = await remote.start("fist", **LASTING)
        await until(lambda: bool(served.watcher.goals))
        status = await remote.status()
        assert (status.hand, status.action) == ("small", "fist")
        assert status.goal_id == running.goal.goal_id
        assert status.recording == "/logs/small.mcap"
        assert status.recording_trouble.startswith("3 ticks lost")
        assert status.statistics.rate == RATE
        assert [device.driver for device in status.devices] == ["kinematic"]


async def test_events_reach_every_client(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as one, rtee.connect("small") as two:
        events = two.events()
        async with anyio.create_task_group() as group:
            group.start_soon(one.stop)
            assert (await anext(events)).kind == "stop"
        await events.aclose()


async def test_a_hand_that_goes_ends_everything(hand: Hand, library: ActionLibrary) -> None:
    async def run() -> None:
        async with serving(hand, library):
            await end.wait()

    end = anyio.Event()
    async with anyio.create_task_group() as group:
        group.start_soon(run)
        async with rtee.connect("small", wait=300.0) as remote:
            states = remote.states(50.0)
            await anext(states)
            running = await remote.start("fist", **LASTING)
            end.set()
            with pytest.raises(NoHand, match="has ended or no longer answers"):
                async for _ in states:
                    pass
            with pytest.raises(NoHand, match="has ended or no longer answers"):
                await running.result()
            with pytest.raises(NoHand):
                await remote.status()


async def test_what_came_before_a_hand_goes_is_told(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        events = remote.events()
        for text in ("first", "last"):
            remote._monitoring._on_event(EVENT.encode(Event("note", "sim", text, 0.0), wall=0))
        remote._link._on_gone()  # before anybody had a chance to look
        assert [(await anext(events)).text for _ in range(2)] == ["first", "last"]
        with pytest.raises(NoHand, match="has ended or no longer answers"):
            await anext(events)
        with pytest.raises(NoHand, match="has ended or no longer answers"):
            await anext(remote.events())


async def test_no_hand_and_several_hands(
    hand: Hand, library: ActionLibrary, tmp_path_factory: pytest.TempPathFactory
) -> None:
    with pytest.raises(NoHand, match="no hand is running"):
        async with rtee.connect():
            pass
    other = make_hand(tmp_path_factory.mktemp("other"), "other")
    async with serving(hand, library), serving(other, make_library(other)):
        with pytest.raises(ConfigError, match=r"several hands are running .*: other, small"):
            async with rtee.connect():
                pass
        with pytest.raises(NoHand, match=r"'smal' is not running .* did you mean 'small'"):
            async with rtee.connect("smal"):
                pass
        async with rtee.connect("small") as one, rtee.connect("other") as two:
            assert (await one.do("Trig", "index", intensity=0.1)).reached
            assert (await two.state()).positions["near"] == pytest.approx(0.0, abs=1e-6)


async def test_the_same_hand_runs_once(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        with pytest.raises(ConfigError, match="'small' is already running"):
            async with Server.open(served.loop, Config().remote):
                pass
        async with rtee.connect("small") as remote:
            assert (await remote.status()).hand == "small"


async def test_waiting_for_a_hand(hand: Hand, library: ActionLibrary) -> None:
    async def look() -> None:
        async with rtee.connect("small", wait=300.0) as remote:
            names.append(remote.name)
            there.set()

    names: list[str] = []
    there = anyio.Event()
    async with anyio.create_task_group() as group:
        group.start_soon(look)
        await anyio.sleep(0.05)
        async with serving(hand, library):
            await there.wait()
    assert names == ["small"]


async def test_a_hand_elsewhere_is_reached_by_its_endpoint(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch, runtime: object
) -> None:
    endpoint = free_endpoint()
    config = Config(Remote(listen=[endpoint]))
    async with serving(hand, library, config=config):
        monkeypatch.setenv("RTEE_RUNTIME_DIR", "/nonexistent")
        with pytest.raises(NoHand):
            async with rtee.connect("small"):
                pass
        async with rtee.connect("small", endpoint=endpoint) as remote:
            assert (await remote.status()).hand == "small"
        monkeypatch.setenv("RTEE_CONNECT", endpoint)
        async with rtee.connect() as remote:
            assert remote.name == "small"
        with pytest.raises(NoHand, match="'large' is not running at"):
            async with rtee.connect("large"):
                pass


async def test_an_endpoint_that_cannot_be_used_is_a_mistake(
    hand: Hand, library: ActionLibrary
) -> None:
    config = Config(Remote(listen=["tcp/256.1.1.1:70000"]))
    with pytest.raises(ConfigError, match=r"256\.1\.1\.1"):
        async with serving(hand, library, config=config):
            pass
    with pytest.raises(NoHand, match="nothing answers"):
        async with rtee.connect("small", endpoint="tcp/127.0.0.1:1"):
            pass
    brackets = ("tcp/[::1:7447", "tcp/127.0.0.1]:7447", "tcp/[robot:7447", "tcp/[robot]:7447")
    for wrong in ("robot", "tcp/robot", "robot:7447", "http/robot:7447", *brackets):
        with pytest.raises(ConfigError, match=re.escape(f"'{wrong}' is not an endpoint")):
            async with rtee.connect("small", endpoint=wrong):
                pass
