"""Publishing by the server: states at the rates that clients request, goals, results and events.

Publishing may cost the calling thread up to a millisecond, if it has to wake other processors or is
preempted. The loop's thread therefore only queues messages. One thread publishes states, which are
dropped if a client is congested; another one publishes results and events, which must not be lost
and may have to wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from zlib import crc32

import zenoh

from rtee import monotonic
from rtee.commands import STREAM_ENDED
from rtee.errors import GoalRejected
from rtee.hand.model import Hand
from rtee.loop.grip import Grip, grip_at
from rtee.loop.observer import Observer
from rtee.loop.plan import Plan
from rtee.messages import (
    DEVICE_STATUS,
    EVENT,
    FEEDBACK,
    GOAL,
    LOOP_STATISTICS,
    RESULT,
    JointStateEncoder,
    network_key,
    topics,
)
from rtee.messages.requests import HERE, STATES, topic_for
from rtee.messages.state import StateEncoder
from rtee.messages.topics import JOINT_STATES, REFERENCE, TOUCH
from rtee.messages.touch import TouchEncoder, measured_at
from rtee.remote.call_queue import CallQueue
from rtee.remote.goal_records import GoalRecords
from rtee.remote.lease import Lease
from rtee.remote.session import DELIVER, direct
from rtee.sample import TickRecord
from rtee.touch import TouchState
from rtee.types import DeviceStatus, Event, Feedback, Goal, LoopStatistics, Result


class TopicPublisher:
    """One topic; made by `TopicPublishers.open`. Any thread may call its methods."""

    def __init__(
        self, session: zenoh.Session, hand: str, topic: str, watched: bool, options: dict[str, Any]
    ) -> None:
        self.topic = topic
        self._session, self._hand = session, hand
        self._watched, self._options = watched, options
        self._changing = threading.Lock()
        # Replaced rather than changed, because the loop's thread reads it.
        self._keys: dict[str, _KeyPublisher] = {}

    @property
    def wanted(self) -> bool:
        """Whether the topic has subscribers; true if its subscribers are not watched."""
        return any(key.wanted for key in self._keys.values())

    def put(self, data: bytes) -> None:
        """Publish a message."""
        # Locked while publishing, so that no publisher is undeclared while it is in use.
        with self._changing:
            for key in self._keys.values():
                if key.wanted:
                    key.publisher.put(data)

    def admit(self, paths: Collection[str]) -> None:
        """Publish to the clients on some access paths, and to no others."""
        with self._changing:
            before = self._keys
            self._keys = {path: before.get(path) or self._key(path) for path in paths}
        for path, key in before.items():
            if path not in self._keys:
                key.close()

    def _key(self, path: str) -> _KeyPublisher:
        name = network_key(self._hand, topic_for(path, self.topic))
        return _KeyPublisher(self._session.declare_publisher(name, **self._options), self._watched)

    def close(self) -> None:
        """Stop publishing."""
        self.admit(())


class _KeyPublisher:
    """The publisher of one key; `wanted` if the key has subscribers, or they are not watched."""

    def __init__(self, publisher: zenoh.Publisher, watched: bool) -> None:
        self.publisher, self.wanted = publisher, not watched
        self._listener = publisher.declare_matching_listener(direct(self._on)) if watched else None

    def _on(self, status: zenoh.MatchingStatus) -> None:
        self.wanted = status.matching

    def close(self) -> None:
        if self._listener is not None:
            self._listener.undeclare()  # type: ignore[no-untyped-call]
        self.publisher.undeclare()  # type: ignore[no-untyped-call]


class TopicPublishers:
    """The topics of a hand, for people by the common names of their certificates."""

    def __init__(self, session: zenoh.Session, hand: str, people: Collection[str] = ()) -> None:
        self.hand = hand
        self._session = session
        self._changing = threading.Lock()
        self._paths = (HERE, *people)
        self._open: list[TopicPublisher] = []

    def open(self, topic: str, *, watched: bool = False, **options: Any) -> TopicPublisher:
        """Return a new topic, with options of Zenoh's publishers.

        If watched, it is published only on keys that have subscribers. That saves time for frequent
        messages, but a subscriber may miss those of its first milliseconds.
        """
        publisher = TopicPublisher(self._session, self.hand, topic, watched, options)
        with self._changing:
            publisher.admit(self._paths)
            self._open.append(publisher)
        return publisher

    def close(self, publisher: TopicPublisher) -> None:
        """Stop publishing a topic."""
        with self._changing:
            self._open.remove(publisher)
        publisher.close()

    def admit(self, people: Collection[str]) -> None:
        """Publish only to clients with the given certificates from now on."""
        with self._changing:
            self._paths = (HERE, *people)
            for publisher in self._open:
                publisher.admit(self._paths)


MOST_STREAMS = 16
"""Most different rates streamed at once: more than clients need. Beyond that, only streams of every
1, 2, 4, 8 … ticks are added, which bounds their number."""

_TOPICS = (
    topics.GOALS,
    topics.FEEDBACK,
    topics.RESULTS,
    topics.EVENTS,
    topics.DEVICE_STATUS,
    topics.LOOP_STATISTICS,
)
"""Topics besides the streams of states."""

_MOST_WAITING = 20
"""Ticks whose states may wait to be published: 20 ms at 1 kHz; older states are useless."""


class StateMessages:
    """Encodes the records of ticks, with the opening and force for the last goal with either."""

    def __init__(self, hand: Hand) -> None:
        self.grip: Grip | None = None
        self._transmission = hand.transmission
        self._state = StateEncoder(hand.actuator_names, hand.joint_names)
        self._joint_state = JointStateEncoder(hand.joint_names)
        self._reference = JointStateEncoder(hand.actuator_names)

    def state(self, record: TickRecord) -> bytes:
        """Return a ``rtee_msgs/State``."""
        joints = self._transmission.joints(record.position)
        return self._state.encode(record, joints, grip_at(self.grip, record))

    def joint_state(self, record: TickRecord) -> bytes:
        """Return a ``sensor_msgs/JointState`` of all joints; their efforts are unknown."""
        position = self._transmission.joints(record.position)
        velocity = self._transmission.velocities(record.position, record.velocity)
        return self._joint_state.encode(record.wall_ns, position, velocity, position * float("nan"))

    def reference(self, record: TickRecord) -> bytes:
        """Return a ``sensor_msgs/JointState`` of the references sent to the actuators."""
        return self._reference.encode(
            record.wall_ns,
            record.reference_position,
            record.reference_velocity,
            record.reference_effort,
        )


@dataclass(frozen=True, slots=True)
class PublishedStream:
    """A message, encoded and published every n ticks while it has subscribers."""

    publisher: TopicPublisher
    every: int
    encode: Callable[[TickRecord], bytes]


class Streams:
    """The streams of one hand, with rates of its loop and of topics for all clients [Hz]."""

    def __init__(
        self, publishers: TopicPublishers, hand: Hand, rate: float, state_rate: float
    ) -> None:
        self._publishers, self._rate = publishers, rate
        self.messages = StateMessages(hand)
        every = self._every(state_rate)
        self._fixed = (
            self._stream(JOINT_STATES, every, self.messages.joint_state),
            self._stream(REFERENCE, every, self.messages.reference),
        )
        self._asked: dict[int, PublishedStream] = {}
        self._all: tuple[PublishedStream, ...] = self._fixed
        self._ticks = crc32(hand.name.encode())  # so that hands on one clock publish in turns
        self._worker = CallQueue(f"states {hand.name}", _MOST_WAITING)
        self._touch = self._publisher(TOUCH)
        self._touch_every = every
        self._touch_encoder = TouchEncoder()
        self._felt: Mapping[str, TouchState] = {}

    def _publisher(self, topic: str) -> TopicPublisher:
        drop = zenoh.CongestionControl.DROP
        return self._publishers.open(topic, watched=True, congestion_control=drop, express=True)

    def _stream(
        self, topic: str, every: int, encode: Callable[[TickRecord], bytes]
    ) -> PublishedStream:
        return PublishedStream(self._publisher(topic), every, encode)

    def _every(self, rate: float) -> int:
        return max(1, round(self._rate / rate))

    def ask(self, rate: float) -> str:
        """Return the topic with states at the available rate nearest to a given one [Hz].

        The stream begins when a client subscribes to it. While very many rates are streamed, its
        rate may be up to twice the given one. Raises `GoalRejected` if the rate is out of range.
        """
        if not 0.01 <= rate <= 1e5:
            raise GoalRejected(f"the rate must be from 0.01 Hz to the loop's rate, not {rate:g}")
        every = self._every(rate)
        if every not in self._asked:
            every = every if self._has_room() else 1 << (every.bit_length() - 1)
        if every not in self._asked:
            # Replaced rather than changed, because the loop's thread iterates over it.
            streams = dict(self._asked)
            streams[every] = self._stream(f"{STATES}/{every}", every, self.messages.state)
            self._replace(streams)
        return self._asked[every].publisher.topic

    def _has_room(self) -> bool:
        """Return whether there is room for one more rate; closes an idle stream if needed."""
        if len(self._asked) < MOST_STREAMS:
            return True
        idle = [every for every, stream in self._asked.items() if not stream.publisher.wanted]
        if not idle:
            return False
        stream = self._asked[idle[0]]
        self._replace({every: kept for every, kept in self._asked.items() if kept is not stream})
        self._publishers.close(stream.publisher)
        return True

    def _replace(self, streams: dict[int, PublishedStream]) -> None:
        self._asked, self._all = streams, (*self._fixed, *streams.values())

    def publish(self, record: TickRecord) -> None:
        """Queue the messages that are due at a tick."""
        self._ticks += 1
        due = [
            each for each in self._all if self._ticks % each.every == 0 and each.publisher.wanted
        ]
        if due:
            self._worker.put(partial(self._put, record, due))
        # Sensors measure less often than the loop ticks; the same mapping has no new readings.
        if record.touch is not self._felt and self._ticks % self._touch_every == 0:
            known, self._felt = self._felt, record.touch
            if self._touch.wanted:
                new = [s for name, s in record.touch.items() if known.get(name) is not s]
                self._worker.put(partial(self._put_touch, record, new))

    def _put_touch(self, record: TickRecord, states: Sequence[TouchState]) -> None:
        for state in states:
            self._touch.put(self._touch_encoder.encode(state, measured_at(record, state)))

    def _put(self, record: TickRecord, due: Sequence[PublishedStream]) -> None:
        state = b""
        for stream in due:
            if not stream.publisher.wanted:  # its subscribers have left since
                continue
            # Streams of several rates that are due at one tick share the message.
            if stream.encode == self.messages.state:
                state = state or stream.encode(record)
                stream.publisher.put(state)
            else:
                stream.publisher.put(stream.encode(record))

    def close(self) -> None:
        """Stop publishing; waits until the queued messages are published."""
        streams, self._all = self._all, ()  # nothing more is queued from now on
        self._worker.close()
        for stream in streams:
            self._publishers.close(stream.publisher)
        self._publishers.close(self._touch)


class HandPublisher(Observer):
    """Publishes a loop's records: states in their streams, all other messages in order.

    Its methods are called in the loop's thread. Goals and streams hold the lease until they end.
    """

    def __init__(
        self,
        publishers: TopicPublishers,
        streams: Streams,
        outbox: CallQueue,
        lease: Lease,
        goals: GoalRecords,
    ) -> None:
        self._streams, self._outbox, self._lease, self._goals = streams, outbox, lease, goals
        self._topics = {topic: publishers.open(topic, **DELIVER) for topic in _TOPICS}

    @property
    def dropped(self) -> int:
        """Number of messages that could not be published in time."""
        return self._outbox.dropped

    def _put(self, topic: str, encode: Callable[..., bytes], item: object, **times: float) -> None:
        # Read here, since the message may wait in the queue for a slow client.
        wall = time.time_ns()
        self._outbox.put(lambda: self._topics[topic].put(encode(item, wall=wall, **times)))

    def on_tick(self, record: TickRecord) -> None:
        """Queue the states that are due."""
        self._streams.publish(record)

    def on_goal(self, goal: Goal, stamp: float) -> None:
        """Publish that a goal begins."""
        self._put(topics.GOALS, GOAL.encode, goal, time=stamp)

    def on_plan(self, plan: Plan, stamp: float) -> None:
        """Keep the plan's grip, by which states report opening and force."""
        self._streams.messages.grip = plan.grip

    def on_feedback(self, feedback: Feedback) -> None:
        """Publish a goal's progress."""
        self._put(topics.FEEDBACK, FEEDBACK.encode, feedback)

    def on_result(self, result: Result) -> None:
        """Publish the result of a goal."""
        # Before the result is published: a client that reads it may begin a goal at once.
        self._goals.ended(result)
        self._put(topics.RESULTS, RESULT.encode, result, time=monotonic.now())

    def on_event(self, event: Event) -> None:
        """Publish an event."""
        if event.kind == STREAM_ENDED:
            # Before the event is published, as for results.
            self._lease.ended(event.source)
        self._put(topics.EVENTS, EVENT.encode, event)

    def on_status(self, statuses: Sequence[DeviceStatus], statistics: LoopStatistics) -> None:
        """Publish the status of the devices and the statistics of the clock."""
        for status in statuses:
            self._put(topics.DEVICE_STATUS, DEVICE_STATUS.encode, status)
        self._put(topics.LOOP_STATISTICS, LOOP_STATISTICS.encode, statistics)
