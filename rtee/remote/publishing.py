"""What the server publishes: states at the rates that clients want, and what happens.

To put something costs the loop's thread up to a millisecond where processors are woken for it or
taken away meanwhile, so that it only hands on what is due. States are put by one thread, dropped if
a client is congested; results and events must not be lost, so that another puts them and may wait.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from functools import partial
from typing import Any
from zlib import crc32

import zenoh

from rtee.errors import GoalRejected
from rtee.hand.model import Hand
from rtee.loop.observer import TickRecord
from rtee.messages import JointStateEncoder, network_key
from rtee.messages.requests import ANSWERS, STATES
from rtee.messages.state import State, StateEncoder
from rtee.messages.topics import JOINT_STATES, REFERENCE
from rtee.remote.session import direct
from rtee.remote.worker import Worker

MOST_STREAMS = 16
"""Different rates that may be streamed at once."""

_MOST_WAITING = 20
"""Ticks that may wait until their states are published; those of further ones are dropped."""


class StateMessages:
    """Encodes the records of ticks."""

    def __init__(self, hand: Hand) -> None:
        self._transmission = hand.transmission
        self._names, self._joint_names = hand.actuator_names, hand.joint_names
        self._state = StateEncoder(self._names, self._joint_names)
        self._joint_state = JointStateEncoder(self._joint_names)
        self._reference = JointStateEncoder(self._names)
        self._no_effort = hand.rest[:0]

    def state(self, record: TickRecord) -> bytes:
        """Return a ``rtee_msgs/State``."""
        return self._state.encode(self.as_state(record))

    def as_state(self, record: TickRecord) -> State:
        """Return the state that a record holds."""
        return State(
            tick=record.tick,
            stamp=record.stamp,
            wall_ns=record.wall_ns,
            names=self._names,
            position=record.position,
            velocity=record.velocity,
            effort=record.effort,
            current=record.current,
            temperature=record.temperature,
            grasped=record.grasped,
            fresh=record.fresh,
            reference_position=record.reference_position,
            reference_velocity=record.reference_velocity,
            reference_effort=record.reference_effort,
            joint_names=self._joint_names,
            joint_position=self._transmission.joints(record.position),
            channels=record.extras,
        )

    def joint_state(self, record: TickRecord) -> bytes:
        """Return a ``sensor_msgs/JointState`` of all joints; efforts of joints are not known."""
        position = self._transmission.joints(record.position)
        velocity = self._transmission.velocities(record.position, record.velocity)
        return self._joint_state.encode(record.wall_ns, position, velocity, position * float("nan"))

    def reference(self, record: TickRecord) -> bytes:
        """Return a ``sensor_msgs/JointState`` of what was sent to the actuators."""
        return self._reference.encode(
            record.wall_ns,
            record.reference_position,
            record.reference_velocity,
            record.reference_effort,
        )


class Stream:
    """One message in every n ticks, for as long as somebody wants it.

    Attributes:
        key: Its key on the network.
        every: It is published every n ticks.
        wanted: Somebody subscribes to it.
    """

    def __init__(
        self, session: zenoh.Session, key: str, every: int, encode: Callable[[TickRecord], bytes]
    ) -> None:
        self.key = key
        self.every = every
        self.wanted = False
        self.encode = encode
        self._publisher = session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, express=True
        )
        self._listener = self._publisher.declare_matching_listener(direct(self._matched))

    def _matched(self, status: Any) -> None:
        self.wanted = status.matching

    def put(self, data: bytes) -> None:
        """Publish a message."""
        self._publisher.put(data)

    def close(self) -> None:
        """Publish no more."""
        self.wanted = False
        self._listener.undeclare()  # type: ignore[no-untyped-call]
        self._publisher.undeclare()  # type: ignore[no-untyped-call]


class Streams:
    """The streams of one hand.

    Args:
        session: The network.
        hand: The hand.
        rate: Rate of the loop [Hz].
        state_rate: Rate of the topics that everybody gets [Hz].
    """

    def __init__(self, session: zenoh.Session, hand: Hand, rate: float, state_rate: float) -> None:
        self._session, self._hand, self._rate = session, hand.name, rate
        self.messages = StateMessages(hand)
        every = self._every(state_rate)
        self._fixed = (
            Stream(session, network_key(hand.name, JOINT_STATES), every, self.messages.joint_state),
            Stream(session, network_key(hand.name, REFERENCE), every, self.messages.reference),
        )
        self._asked: dict[int, Stream] = {}
        self._all: tuple[Stream, ...] = self._fixed
        self._ticks = crc32(hand.name.encode())  # hands on one clock take turns
        self._worker: Worker[tuple[TickRecord, list[Stream]]] = Worker(
            f"states {hand.name}", self._put, _MOST_WAITING
        )

    def _every(self, rate: float) -> int:
        return max(1, round(self._rate / rate))

    def ask(self, rate: float) -> str:
        """Return the key of a stream of states at about a rate [Hz]; it begins when subscribed to.

        Raises:
            GoalRejected: if the rate cannot be had.
        """
        if not 0.01 <= rate <= 1e5:
            raise GoalRejected(f"the rate must be 0.01 Hz to that of the loop, not {rate:g}")
        every = self._every(rate)
        if every not in self._asked:
            self._make_room()
            key = f"{network_key(self._hand, STATES)}/{every}"
            asked = dict(self._asked)
            asked[every] = Stream(self._session, key, every, self.messages.state)
            self._take(asked)
        return self._asked[every].key

    def _make_room(self) -> None:
        if len(self._asked) < MOST_STREAMS:
            return
        idle = [every for every, stream in self._asked.items() if not stream.wanted]
        if not idle:
            raise GoalRejected(f"states are streamed at {MOST_STREAMS} rates already")
        stream = self._asked[idle[0]]
        self._take({every: kept for every, kept in self._asked.items() if kept is not stream})
        stream.close()

    def _take(self, asked: dict[int, Stream]) -> None:
        self._asked, self._all = asked, (*self._fixed, *asked.values())

    def publish(self, record: TickRecord) -> None:
        """Have published what is due at a tick; takes next to no time."""
        self._ticks += 1
        due = [each for each in self._all if each.wanted and self._ticks % each.every == 0]
        if due:
            self._worker.put((record, due))

    def _put(self, what: tuple[TickRecord, list[Stream]]) -> None:
        record, due = what
        state = b""
        for stream in due:
            if not stream.wanted:  # any more
                continue
            if stream.encode == self.messages.state:
                state = state or stream.encode(record)
                stream.put(state)
            else:
                stream.put(stream.encode(record))

    def close(self) -> None:
        """Publish no more; waits for what is under way."""
        streams, self._all = self._all, ()
        self._worker.close()
        for stream in streams:
            stream.close()


class Outbox:
    """Publishes and answers what must arrive, in order, from a thread of its own.

    Answers to stop have another one: they wait for no client that is slow to take something else.

    Attributes:
        dropped: Messages that were dropped because too much was waiting.
    """

    def __init__(self, session: zenoh.Session, hand: str) -> None:
        self._session, self._hand = session, hand
        self._publishers: dict[str, zenoh.Publisher] = {}
        self.dropped = 0
        self._worker: Worker[Callable[[], object]] = Worker(f"publish {hand}", _call)
        self._first: Worker[Callable[[], object]] = Worker(f"stop {hand}", _call)

    def put(self, topic: str, encode: Callable[[int], bytes]) -> None:
        """Publish a message on a topic; ``encode`` is given the time since 1970 [ns]."""
        self._later(self._worker, partial(self._publish, topic, encode, time.time_ns()))

    def answer(self, query: zenoh.Query, data: bytes, ok: bool) -> None:
        """Answer a query with a message, or with a refusal."""
        self._later(self._worker, partial(answer, self._hand, query, data, ok))

    def answer_first(self, query: zenoh.Query, data: bytes, ok: bool) -> None:
        """Answer a query before all others."""
        self._later(self._first, partial(answer, self._hand, query, data, ok))

    def answer_put(self, client: str, number: str, data: bytes, ok: bool) -> None:
        """Answer what a client has put under a number with a message, or with a refusal."""
        self._later(self._worker, partial(self._answer_put, client, number, data, ok))

    def _later(self, worker: Worker[Callable[[], object]], call: Callable[[], object]) -> None:
        if not worker.put(call):
            self.dropped += 1

    def close(self) -> None:
        """Publish and answer what is waiting, then end; waits for that, but not for long."""
        self._first.close()
        self._worker.close()

    def _publish(self, topic: str, encode: Callable[[int], bytes], wall: int) -> None:
        self._publisher(topic).put(encode(wall))

    def _answer_put(self, client: str, number: str, data: bytes, ok: bool) -> None:
        self._session.put(
            network_key(self._hand, f"{ANSWERS}/{client}"),
            data,
            attachment=f"{'+' if ok else '-'}{number}",
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
        )

    def _publisher(self, topic: str) -> zenoh.Publisher:
        if topic not in self._publishers:
            self._publishers[topic] = self._session.declare_publisher(
                network_key(self._hand, topic),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
            )
        return self._publishers[topic]


def _call(function: Callable[[], object]) -> None:
    function()


def answer(hand: str, query: zenoh.Query, data: bytes, ok: bool) -> None:
    """Answer a query with a message, or with a refusal; may wait for the network."""
    # Whoever asked may be gone by now.
    with contextlib.suppress(zenoh.ZError), query:
        if ok:
            # All hands may have been asked at once: this one answers under its own name.
            asked = str(query.key_expr).split("/", 2)[2]
            query.reply(network_key(hand, asked), data, express=True)
        else:
            query.reply_err(data)
