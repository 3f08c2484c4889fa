"""Watch a running hand: states, events, status, description."""

from __future__ import annotations

import asyncio
import contextlib
import math
import operator
import weakref
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import anyio

from rtee.commands import StreamStatus
from rtee.errors import GoalRejected, MessageError, NotReady
from rtee.messages import EVENT, FEEDBACK, RESULT, topics
from rtee.messages.convert import DEVICE_STATUS, LOOP_STATISTICS, OBJECT
from rtee.messages.state import State, decode_state
from rtee.messages.touch import TOUCH, reply_of, touch_of
from rtee.objects.description import ObjectDescription
from rtee.remote.counts import Counts, counts_of
from rtee.remote.goal_values import finite, numbers
from rtee.remote.hand_info import HandInfo, info_of
from rtee.remote.link import Link
from rtee.touch import TouchState
from rtee.types import DeviceStatus, Event, Feedback, Lifecycle, LoopStatistics, Result
from rtee.units import longest_wait
from rtee.values import Value

T = TypeVar("T")

READY_WITHIN = 60.0
"""Default time to wait until a hand is ready [s]: twice what homing a hand takes."""

_POLL_PERIOD = 0.05
"""Interval of requests for the status while waiting [s]: short compared with any homing."""

_MOST_WAITING = 1000
"""Events and results queued for a slow reader: 1 s at 1 kHz. Older ones are dropped."""


@dataclass(frozen=True, slots=True)
class HandStatus(Value):
    """Status of a hand's loop and devices.

    Attributes:
        hand: Name of the hand.
        holder: The client that holds the lease, or an empty string.
        goal_id: The running goal, or an empty string.
        action: Its action.
        recording: Path of the recording being written, or an empty string.
        recording_trouble: Losses of the recording and their reason, or an empty string.
        grip_effort: Effort kept on a grasped object, as a fraction of the effort limit.
        statistics: Statistics of the loop's clock.
        devices: Status of each device.
        profile: Profile of the references, with the reason if it is not the one in hand.yaml.
        stream: Status of the stream of set-points.
        agents_out: Why agents may not move the hand, in words; empty if there are none.
        counts: Counts of events since the hand started.
    """

    hand: str
    holder: str
    goal_id: str
    action: str
    recording: str
    recording_trouble: str
    grip_effort: float
    statistics: LoopStatistics
    devices: tuple[DeviceStatus, ...]
    profile: str = ""
    stream: StreamStatus = field(default_factory=StreamStatus)
    agents_out: str = ""
    counts: Counts = field(default_factory=Counts)

    @property
    def inactive(self) -> list[DeviceStatus]:
        """The devices that do not follow references."""
        return [each for each in self.devices if each.lifecycle is not Lifecycle.ACTIVE]


class CollectedStates:
    """States that have arrived since the last `drain`."""

    def __init__(self, found: deque[bytes]) -> None:
        self._messages = found

    def drain(self, step: int = 1) -> list[State]:
        """Return the states since the last call, oldest first, and remove them.

        Args:
            step: Return only every ``step``-th of them; always the newest.
        """
        states: list[State] = []
        # The length is read once, since Zenoh's thread keeps appending.
        for number in range(len(self._messages) - 1, -1, -1):
            data = self._messages.popleft()
            if number % step == 0:
                with contextlib.suppress(MessageError):  # any peer may publish on the key
                    states.append(decode_state(data))
        return states


class Monitoring:
    """Reads the states, events, status and description of a running hand.

    Args:
        link: The connection to the hand.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        # Weak, because an iterator that was never started is never closed.
        self._queues: weakref.WeakSet[asyncio.Queue[Any]] = weakref.WeakSet()
        self._event_queues: weakref.WeakSet[asyncio.Queue[Event | None]] = weakref.WeakSet()
        link.subscribe(topics.EVENTS, self._on_event)
        link.on_gone(self._on_gone)

    def _on_event(self, data: bytes) -> None:
        event = EVENT.decode(data)
        for queue in tuple(self._event_queues):
            _put(queue, event)

    def _on_gone(self) -> None:
        # ``None`` ends iterations that would otherwise wait forever.
        for queue in tuple(self._queues):
            _put(queue, None)

    def _queue(self, most: int = _MOST_WAITING) -> asyncio.Queue[Any]:
        """Return a new queue of messages, which ends with ``None`` when the hand goes."""
        queue: asyncio.Queue[Any] = asyncio.Queue(most)
        self._queues.add(queue)
        return queue

    async def _next(self, queue: asyncio.Queue[T | None]) -> T | None:
        """Return a queue's next item; ``None`` once the hand has gone and the queue is empty."""
        if self._link.gone and queue.empty():
            return None
        return await queue.get()

    async def state(self) -> State:
        """Return the newest state.

        A hand answers 100 such requests of a client a second, after a burst of 50; faster ones wait
        for their turn. Loops that need each state, or more of them, iterate over `states`.
        """
        return decode_state(await self._link.paced("state"))

    async def states(self, rate: float = 100.0, *, keep: int = 1) -> AsyncIterator[State]:
        """Iterate over states until the hand goes; each is the newest there is.

        Args:
            rate: Desired rate [Hz]; the nearest one that divides the loop's rate is used.
            keep: Most states that wait for a slow reader, who gets the oldest of them first; older
                ones are dropped.

        Raises:
            GoalRejected: if the rate or the number of states cannot be used.
            NoHand: if the hand goes.
        """
        keep = _count(keep, "number of states to keep")
        # Closed with this iterator, or the hand would go on publishing for a while.
        async with contextlib.aclosing(
            self._messages(await self._stream(rate), decode_state, keep)
        ) as states:
            async for state in states:
                yield state

    @contextlib.asynccontextmanager
    async def collected_states(
        self, rate: float = 100.0, most: int = _MOST_WAITING
    ) -> AsyncIterator[CollectedStates]:
        """Collect states while the context lasts, for a reader that drains them now and then.

        Unlike with `states`, the event loop is not woken for each state.

        Args:
            rate: Desired rate [Hz]; the nearest one that divides the loop's rate is used.
            most: Number of states to keep; older ones are dropped.

        Raises:
            GoalRejected: if the rate or the number of states cannot be used.
        """
        most = _count(most, "number of states to keep")
        with self._link.collected(await self._stream(rate), most) as messages:
            yield CollectedStates(messages)

    async def _stream(self, rate: float) -> str:
        """Request states at a rate [Hz]; return the topic on which they are published."""
        fields = {"client": self._link.client, "rate": finite(rate, "rate of states")}
        return str((await self._link.ask("stream", fields))["text"])

    async def touch_state(self) -> dict[str, TouchState]:
        """Return the newest states of the touch sensors, by device; empty if there are none.

        Raises:
            MessageError: if the answer is malformed.
        """
        return reply_of(await self._link.ask("touch"))

    async def touch_states(self) -> AsyncIterator[TouchState]:
        """Iterate over states of the touch sensors until the hand goes; a slow reader misses some.

        Readings are published as devices return them, at most at the hand's ``state_rate``.

        Raises:
            NoHand: if the hand goes.
        """
        known = {name: state.sensors for name, state in (await self.touch_state()).items()}
        async for fields in self._messages(topics.TOUCH, TOUCH.decode):
            with contextlib.suppress(MessageError):  # any peer may publish on the key
                state = touch_of(fields, known)
                if state.sensors is not known.get(state.device):
                    # New sensors: request their places, but not again for each reading.
                    known |= {n: s.sensors for n, s in (await self.touch_state()).items()}
                    state = touch_of(fields, known)
                    known[state.device] = state.sensors
                yield state

    def events(self) -> AsyncIterator[Event]:
        """Iterate over the events from this call on.

        Raises:
            NoHand: if the hand goes.
        """
        # Registered here rather than at the first step of the iteration, to miss no event.
        queue = self._queue()
        self._event_queues.add(queue)
        return self._drained(queue)

    async def _drained(self, queue: asyncio.Queue[T | None]) -> AsyncIterator[T]:
        while (item := await self._next(queue)) is not None:
            yield item
        raise self._link.lost()

    def feedback(self) -> AsyncIterator[Feedback]:
        """Iterate over the feedback of all clients' goals until the hand goes.

        Raises:
            NoHand: if the hand goes.
        """
        return self._messages(topics.FEEDBACK, FEEDBACK.decode)

    def results(self) -> AsyncIterator[Result]:
        """Iterate over the results of all clients' goals until the hand goes.

        Raises:
            NoHand: if the hand goes.
        """
        return self._messages(topics.RESULTS, RESULT.decode)

    async def _messages(
        self, topic: str, decode: Callable[[bytes], T], most: int = _MOST_WAITING
    ) -> AsyncGenerator[T]:
        queue = self._queue(most)
        with self._link.subscribed(topic, lambda data: _put(queue, decode(data)), most):
            while (message := await self._next(queue)) is not None:
                yield message
        raise self._link.lost()

    async def status(self) -> HandStatus:
        """Return the status of the loop and the devices."""
        reply = await self._link.ask("status")
        held = {
            "recording": reply.pop("recording_path"),
            "statistics": LOOP_STATISTICS.of(reply["statistics"]),
            "devices": tuple(DEVICE_STATUS.of(device) for device in reply["devices"]),
            "stream": StreamStatus(**reply["stream"]),
            "counts": counts_of(reply["counts"]),
        }
        return HandStatus(**(reply | held))

    async def ready(
        self,
        timeout: float | str | None = READY_WITHIN,
        on_wait: Callable[[str], object] | None = None,
    ) -> None:
        """Wait until the hand ticks and all its devices are active, after homing and activation.

        Args:
            timeout: Longest time to wait [s], or a text such as ``10s``; ``None``: without limit.
            on_wait: Called with the reason for waiting, in words, whenever it changes.

        Raises:
            GoalRejected: if the timeout is no time.
            NotReady: if it takes longer; the error says why.
            NoHand: if the hand goes.
        """
        within = math.inf if timeout is None else longest_wait(timeout, "timeout")
        lacks, reported, active_at = "it has not answered", "", math.inf
        with anyio.move_on_after(within):
            while True:
                if self._link.gone:
                    raise self._link.lost()
                status = await self.status()
                ticks = status.statistics.ticks
                troubles = [device.trouble for device in status.inactive]
                if not troubles and ticks > active_at:
                    return
                # The loop detects an active device at its next tick.
                active_at = math.inf if troubles else min(active_at, ticks)
                lacks = "; ".join(troubles) or "the loop does not tick"
                if on_wait is not None and troubles and lacks != reported:
                    reported = lacks
                    on_wait(lacks)
                await anyio.sleep(_POLL_PERIOD)
        raise NotReady(f"the hand '{self._link.hand}' is not ready after {within:g} s: {lacks}")

    async def info(self, posture: Mapping[str, float] | None = None) -> HandInfo:
        """Return the description of the hand for grasp planners.

        Args:
            posture: Actuator positions for poses and Jacobians [rad | m]; other actuators are at
                rest.

        Raises:
            GoalRejected: if a position is not a finite number.
        """
        values = numbers({} if posture is None else posture, "position")
        fields = {"name": list(values), "position": list(values.values())}
        return info_of(await self._link.ask("info", fields))

    async def object_description(self) -> ObjectDescription | None:
        """Return the shape of the object in a simulated device of the hand; ``None``: no object.

        Its pose and the contact forces are channels of the states; see `rtee.objects.description`.

        Raises:
            MessageError: if the answer is malformed.
        """
        description = OBJECT.of(await self._link.ask("object_description"))
        return description if description.parts else None

    async def robot_description(self) -> str:
        """Return the URDF."""
        return str((await self._link.ask("robot_description"))["data"])


def _count(value: int, what: str) -> int:
    """Return a number of at least one; raises `GoalRejected` for anything else."""
    # No queue takes another: one of length 0 would keep either nothing or everything.
    with contextlib.suppress(TypeError):
        if (count := operator.index(value)) > 0:
            return count
    raise GoalRejected(f"the {what} must be a whole number from 1, not {value!r:.100}")


def _put(queue: asyncio.Queue[T], item: T) -> None:
    """Append an item; drop the oldest one if the queue is full."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(item)
