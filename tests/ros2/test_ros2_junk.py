"""What others may send: junk of every kind, and far too much of it."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import anyio
import anyio.lowlevel
import pytest
import zenoh

from rtee.hand.config_schema import Ros2Settings
from rtee.ros2 import Context, attachments, endpoints, inbox, participant
from rtee.ros2.endpoints import LONGEST
from rtee.ros2.inbox import Inbox, Limit, SharedLimit, WarningLog
from rtee.ros2.message import Message

from .test_ros2_nodes import STRING, TRIGGER, until

pytestmark = pytest.mark.anyio

Peer = Callable[[], zenoh.Session]

GID = bytes(16)


def numbered(number: int) -> bytes:
    return attachments.encode(number, time.time_ns(), GID)


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.name.startswith("rtee.ros2")]


async def test_messages_that_make_no_sense_are_dropped_and_told_once(
    settings: Ros2Settings, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    async with Context.open(settings, {}) as context:
        got: list[Any] = []
        kind = context.interfaces.topic(STRING)
        context.node("hand").subscription("/a", kind, lambda message: got.append(message.data))
        publisher = peer().declare_publisher(
            f"0/a/std_msgs::msg::dds_::String_/{kind.hash}",
            # Else a busy computer drops the last one behind the long ones.
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        good = kind.message(data="good").encode()
        await until(lambda: publisher.matching_status.matching)
        for payload, attachment in (
            (good, None),
            (good, b""),
            (good, numbered(1)[:-1]),
            (good, numbered(1) + b"0"),
            (good, bytes(1_000_000)),
            (good[:-3], numbered(1)),
            (b"", numbered(1)),
            (good + bytes(20), numbered(1)),
            (b"\x00\x00" + good[2:], numbered(1)),
            (bytes(LONGEST + 1), numbered(1)),
        ):
            for _ in range(5):
                publisher.put(payload, attachment=attachment)
        publisher.delete()
        publisher.put(good, attachment=numbered(2))
        await until(lambda: bool(got))
        assert got == ["good"]
        assert context.warning_log.count["a message on /a is dropped"] >= 10
    assert len([text for text in warnings(caplog) if "/a is dropped" in text]) == 1


async def test_requests_that_make_no_sense_are_dropped(
    settings: Ros2Settings, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    async with Context.open(settings, {}) as context:
        trigger = context.interfaces.service(TRIGGER)
        calls: list[Any] = []
        held = anyio.Event()

        async def stop(request: Any) -> Any:
            calls.append(request)
            await held.wait()
            return trigger.response(success=True)

        context.node("hand").service("/stop", trigger, stop)
        key = f"0/stop/std_srvs::srv::dds_::Trigger_/{trigger.hash}"
        other, replies = peer(), []
        good = trigger.request().encode()

        def ask(payload: bytes | None, attachment: bytes | None) -> None:
            other.get(
                key,
                lambda reply: replies.append(reply.ok is not None),
                payload=payload,
                attachment=attachment,
                timeout=30,
                target=zenoh.QueryTarget.ALL_COMPLETE,
            )

        with other.declare_querier(key) as querier:
            await until(lambda: querier.matching_status.matching)
        for payload, attachment in (
            (good, None),
            (good, bytes(1_000_000)),
            (None, numbered(1)),
            (b"", numbered(1)),
            (b"\xff" * 9, numbered(1)),  # only this one tells whom to answer: that it is not done
            (bytes(LONGEST + 1), numbered(1)),
        ):
            ask(payload, attachment)
        ask(good, numbered(7))
        ask(good, numbered(7))  # the same number again, while it is not answered
        ask(good, numbered(8))
        await until(lambda: len(calls) == 2)
        held.set()
        await until(lambda: replies.count(True) == 3)
        assert len(calls) == 2
        assert context.warning_log.count["a request of /stop is dropped"] == 7
    assert len([text for text in warnings(caplog) if "/stop is dropped" in text]) == 1


def ask(session: zenoh.Session, key: str, number: int, request: Message, ended: list[int]) -> None:
    """Send a numbered request, which is added to those that ended once its answers have."""
    session.get(
        key,
        zenoh.handlers.Callback(lambda reply: None, lambda: ended.append(number), indirect=False),
        payload=request.encode(),
        attachment=numbered(number),
        timeout=30,
    )


async def test_too_many_requests_are_dropped_and_told_once(
    settings: Ros2Settings, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    async with Context.open(settings, {}) as context:
        trigger = context.interfaces.service(TRIGGER)
        running: list[int] = []
        most: list[int] = []

        async def slow(request: Any) -> Any:
            running.append(1)
            most.append(len(running))
            await anyio.sleep(0.001)
            running.pop()
            return trigger.response(success=True)

        context.node("hand").service("/slow", trigger, slow, at_once=3)
        key = f"0/slow/std_srvs::srv::dds_::Trigger_/{trigger.hash}"
        other, ended = peer(), list[int]()
        with other.declare_querier(key) as querier:
            await until(lambda: querier.matching_status.matching)
        asked = 1000
        for number in range(asked):
            ask(other, key, number, trigger.request(), ended)
        await until(lambda: len(ended) == asked)  # dropped ones end at once: nothing is kept
        assert max(most) <= 3
        assert context.warning_log.count["requests of /slow are dropped"] >= asked - len(most) - 1
        assert len(most) >= endpoints._MOST_WAITING
    assert len([text for text in warnings(caplog) if "too many at once" in text]) == 1


async def test_a_client_of_many_requests_delays_no_other(
    settings: Ros2Settings, peer: Peer
) -> None:
    async with Context.open(settings, {}) as context, Context.open(settings, {}) as other:
        set_bool = context.interfaces.service("std_srvs/srv/SetBool")
        held, under_way = anyio.Event(), list[bool]()

        async def answer(request: Any) -> Any:
            under_way.append(request.data)
            if request.data:
                await held.wait()
            return set_bool.response(success=True)

        service = context.node("hand").service("/wait", set_bool, answer, at_once=4)
        client = other.node("other").client("/wait", "std_srvs/srv/SetBool")
        await client.wait(20)
        key, greedy = f"0/wait/std_srvs::srv::dds_::SetBool_/{set_bool.hash}", peer()
        with greedy.declare_querier(key) as querier:
            await until(lambda: querier.matching_status.matching)
        ended: list[int] = []

        for number in range(endpoints._MOST_WAITING + 2):
            ask(greedy, key, number, set_bool.request(data=True), ended)
            # Step by step, since the queue of Zenoh's threads is as short as that of the service.
            await until(lambda: len(service._under_way) + len(service._waiting) == number + 1)  # noqa: B023
        # Two of four places, and all of the queue; the other client finds a place all the same,
        assert (await client.call(client.type.request(data=False), 20)).success
        assert under_way == [True, True, False]
        async with anyio.create_task_group() as group:
            for _ in range(4):  # and when its requests have to wait, a place in the queue.
                group.start_soon(client.call, client.type.request(data=True), 20)
            await until(lambda: len(ended) == 3)
            assert ended == [101, 100, 99]
            held.set()


async def test_a_flood_of_one_client_leaves_requests_to_others(
    settings: Ros2Settings, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One second for all requests, however long they take here.
    monkeypatch.setattr(inbox, "monotonic", SimpleNamespace(now=lambda: 1.0))
    async with Context.open(settings, {}) as context, Context.open(settings, {}) as other:
        trigger = context.interfaces.service(TRIGGER)
        calls: list[int] = []

        async def answer(request: Any) -> Any:
            calls.append(1)
            return trigger.response(success=True)

        context.node("hand").service("/flooded", trigger, answer)
        client = other.node("other").client("/flooded", TRIGGER)
        await client.wait(20)
        key, greedy = f"0/flooded/std_srvs::srv::dds_::Trigger_/{trigger.hash}", peer()
        with greedy.declare_querier(key) as querier:
            await until(lambda: querier.matching_status.matching)
        ended: list[int] = []
        asked = 3 * endpoints._MOST_A_SECOND
        for number in range(asked):
            ask(greedy, key, number, trigger.request(), ended)
        await until(lambda: len(ended) == asked)
        assert len(calls) <= endpoints._MOST_A_SECOND / 2
        assert (await client.call(client.type.request(), 20)).success


def test_a_limit_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=lambda: 1.0)
    monkeypatch.setattr(inbox, "monotonic", clock)
    limit = SharedLimit(60)
    assert [limit.passes(b"a") for _ in range(100)].count(True) == 30
    assert [limit.passes(b"b") for _ in range(100)].count(True) == 15
    clock.now = lambda: 2.0
    both = [(limit.passes(b"a"), limit.passes(b"b")) for _ in range(100)]
    assert both.count((True, True)) == both.index((False, False)) == 20
    clock.now = lambda: 3.0
    assert sum(limit.passes(str(n).encode()) for n in range(100)) == 60


async def test_nodes_that_come_and_go_leave_nothing(
    settings: Ros2Settings,
    peer: Peer,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with Context.open(settings, {}) as context:
        assert context.graph.entities() == []
        liveliness = peer().liveliness()
        for burst in range(5):
            tokens = [
                liveliness.declare_token(f"@ros2_lv/0/a/{node}/{node}/NN/%/%/node_{burst}_{node}")
                for node in range(100)
            ]
            tokens += [liveliness.declare_token(f"@ros2_lv/0/junk/{n}/x") for n in range(50)]
            await context.graph.wait_until(lambda: len(context.graph.entities()) == 100)
            while tokens:
                tokens.pop().undeclare()
            await context.graph.wait_until(lambda: not context.graph._tokens)
        monkeypatch.setattr(participant, "MOST", 10)
        tokens = [liveliness.declare_token(f"@ros2_lv/0/b/{n}/{n}/NN/%/%/n") for n in range(50)]
        await until(lambda: "entities of the ROS graph are left out" in context.warning_log.count)
        assert len(context.graph._tokens) == 10
    assert len([text for text in warnings(caplog) if "not understood" in text]) == 1


async def test_a_callback_that_fails_or_is_slow_harms_nobody(
    settings: Ros2Settings, caplog: pytest.LogCaptureFixture
) -> None:
    async with Context.open(settings, {}) as context:
        node = context.node("hand")
        got: list[str] = []
        woken: list[str] = []
        asleep: list[int] = []

        def fail(message: Any) -> None:
            raise ValueError(message.data)

        async def sleepy(message: Any) -> None:
            asleep.append(1)
            assert len(asleep) == 1  # one message after the other
            await anyio.sleep(0.01)
            asleep.pop()
            woken.append(message.data)
            raise ValueError(message.data)

        for callback in (fail, sleepy, lambda message: got.append(message.data)):
            node.subscription("/a", STRING, callback)
        publisher = node.publisher("/a", STRING)
        for number in range(50):  # more than the QoS keeps: the newest are taken
            publisher.publish(publisher.type.message(data=str(number)))
        await until(lambda: got[-1:] == ["49"] and woken[-1:] == ["49"])
        assert len(woken) <= 11
    assert "could not be handled" in caplog.text


async def test_boxes_keep_the_newest_or_the_oldest() -> None:
    newest: list[int] = []
    oldest: list[int] = []
    dropped: list[int] = []
    keeps = Inbox(newest.append, 3)
    refuses = Inbox(oldest.append, 3, keep_newest=False, dropped=lambda: dropped.append(1))
    for number in range(10):
        keeps.put(number)
        refuses.put(number)
    await until(lambda: bool(newest) and bool(oldest))
    assert (newest, oldest, len(dropped)) == ([7, 8, 9], [0, 1, 2], 7)
    keeps.close()
    keeps.put(1)
    await anyio.lowlevel.checkpoint()
    assert newest == [7, 8, 9]
    limit = Limit(5)
    assert 5 <= sum(limit.passes() for _ in range(10)) < 10


def test_complaints_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    warning_log = WarningLog(logging.getLogger("rtee.ros2.test"))
    for number in range(1000):
        warning_log.tell(f"thing {number}")
    assert len(warning_log.count) == WarningLog.MOST == len(warnings(caplog))


async def test_an_answer_may_take_for_ever_and_be_given_up(settings: Ros2Settings) -> None:
    async with Context.open(settings, {}) as hand, Context.open(settings, {}) as user:
        trigger = hand.interfaces.service(TRIGGER)
        asked: list[Any] = []
        ended = anyio.Event()

        async def hold(request: Any) -> Any:
            asked.append(request)
            await ended.wait()
            return trigger.response(message="at last")

        hand.node("hand").service("/hold", trigger, hold)
        client = user.node("user").client("/hold", trigger)
        await client.wait(300)
        with pytest.raises(TimeoutError):
            await client.call(trigger.request(), 0.05)
        with anyio.move_on_after(0.05) as scope:
            await client.call(trigger.request(), math.inf)
        assert scope.cancelled_caught
        answers: list[Any] = []

        async def wait() -> None:
            answers.append(await client.call(trigger.request(), math.inf))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            await until(lambda: len(asked) == 3)
            ended.set()
        assert [one.message for one in answers] == ["at last"]
