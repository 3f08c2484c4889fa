"""What a client sees of a hand: states, events, status, information."""

from __future__ import annotations

import asyncio
import contextlib
import math
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import anyio

from rtee.errors import MessageError, NoHand, NotReady
from rtee.messages import decode_event, topics
from rtee.messages.convert import DEVICE_STATUS, LOOP_STATISTICS
from rtee.messages.state import State, decode_state
from rtee.remote.link import Link
from rtee.remote.planner import HandInfo, info_of
from rtee.types import DeviceStatus, Event, Lifecycle, LoopStatistics

T = TypeVar("T")

READY_WITHIN = 60.0
"""How long one waits for a hand to be ready unless told [s]; homing a hand takes half of it."""

_LOOK_EVERY = 0.05
"""Time between two looks whether a hand is ready [s]."""

_MOST_WAITING = 1000
"""States or events that wait for who is slow to take them: 1 s at 1 kHz; older ones are dropped."""


@dataclass(frozen=True, slots=True)
class HandStatus:
    """How a hand's loop and devices are doing.

    Attributes:
        hand: The hand.
        holder: The client that holds it, or an empty string.
        goal_id: The goal that runs, or an empty string.
        action: Its action.
        recording: Path of the recording under way, or an empty string.
        recording_trouble: What it has lost and why, in words, or an empty string.
        grip_effort: Effort kept on what is held, as a fraction of the effort limit.
        statistics: The loop's clock.
        devices: The devices.
        profile: How references move, and why if not as in hand.yaml.
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


class CollectedStates:
    """States that have come and nobody has looked at yet."""

    def __init__(self, found: deque[bytes]) -> None:
        self._found = found

    def drain(self, step: int = 1) -> list[State]:
        """Return the states since the last call, oldest first, and forget them.

        Args:
            step: Only every so many of them, and the newest.
        """
        states: list[State] = []
        for number in range(len(self._found) - 1, -1, -1):
            data = self._found.popleft()
            if number % step == 0:
                with contextlib.suppress(MessageError):  # anybody may publish on a key
                    states.append(decode_state(data))
        return states


class View:
    """A running hand as it can be watched.

    Attributes:
        name: The hand's name.
        client: This client's name on the network.
    """

    def __init__(self, link: Link) -> None:
        self.name = link.hand
        self.client = link.client
        self._link = link
        self._watchers: weakref.WeakSet[asyncio.Queue[Event | None]] = weakref.WeakSet()
        self._streams: set[asyncio.Queue[State | None]] = set()
        self._gone = False
        link.subscribe(topics.EVENTS, self._on_event)
        link.watch(self._on_gone)

    def _on_event(self, data: bytes) -> None:
        event = decode_event(data)
        for watcher in tuple(self._watchers):
            _put(watcher, event)

    def _on_gone(self) -> None:
        self._gone = True
        self._link.putting.lost()
        for watcher in tuple(self._watchers):
            _put(watcher, None)
        for stream in self._streams:
            _put(stream, None)

    async def state(self) -> State:
        """Return the newest state."""
        return decode_state(await self._link.ask_bytes("state"))

    async def states(self, rate: float = 100.0) -> AsyncIterator[State]:
        """Iterate over states until the hand goes; a slow reader misses some.

        Args:
            rate: How many it wants [Hz]; the nearest that divides the loop's rate.

        Raises:
            NoHand: if the hand goes.
        """
        reply = await self._link.ask("stream", {"client": self.client, "rate": rate})
        queue: asyncio.Queue[State | None] = asyncio.Queue(_MOST_WAITING)

        def receive(data: bytes) -> None:
            _put(queue, decode_state(data))

        self._streams.add(queue)
        try:
            with self._link.subscribed(reply["text"], receive, _MOST_WAITING):
                while not self._gone and (state := await queue.get()) is not None:
                    yield state
        finally:
            self._streams.discard(queue)
        raise NoHand(f"the hand '{self.name}' has gone")

    @contextlib.asynccontextmanager
    async def collected_states(
        self, rate: float = 100.0, most: int = _MOST_WAITING
    ) -> AsyncIterator[CollectedStates]:
        """Collect states while the context lasts, for those who look at them now and then.

        Other than with `states`, this process is not woken for each of them.

        Args:
            rate: How many it wants [Hz]; the nearest that divides the loop's rate.
            most: How many are kept; the newest stay.
        """
        reply = await self._link.ask("stream", {"client": self.client, "rate": rate})
        with self._link.collected(reply["text"], most) as found:
            yield CollectedStates(found)

    def events(self) -> AsyncIterator[Event]:
        """Iterate over what happens from this call on.

        Raises:
            NoHand: if the hand goes.
        """
        queue: asyncio.Queue[Event | None] = asyncio.Queue(_MOST_WAITING)
        self._watchers.add(queue)
        return self._drained(queue)

    async def _drained(self, queue: asyncio.Queue[Event | None]) -> AsyncIterator[Event]:
        while not self._gone and (event := await queue.get()) is not None:
            yield event
        raise NoHand(f"the hand '{self.name}' has gone")

    async def status(self) -> HandStatus:
        """Return how the loop and the devices are doing."""
        reply = await self._link.ask("status")
        return HandStatus(
            hand=reply["hand"],
            holder=reply["holder"],
            goal_id=reply["goal_id"],
            action=reply["action"],
            recording=reply["recording_path"],
            recording_trouble=reply["recording_trouble"],
            grip_effort=reply["grip_effort"],
            statistics=LOOP_STATISTICS.of(reply["statistics"]),
            devices=tuple(DEVICE_STATUS.of(device) for device in reply["devices"]),
            profile=reply["profile"],
        )

    async def ready(
        self,
        timeout: float | None = READY_WITHIN,
        on_wait: Callable[[str], object] | None = None,
    ) -> None:
        """Wait until the hand ticks and all its devices are active, homing and activation done.

        Args:
            timeout: How long at most [s]; ``None``: for ever.
            on_wait: Called with what it waits for, in words, whenever that changes.

        Raises:
            NotReady: if it is not in time; with what it lacks.
            NoHand: if the hand goes.
        """
        lacks, told, active_at = "it has not answered", "", math.inf
        with anyio.move_on_after(timeout):
            while True:
                if self._gone:
                    raise NoHand(f"the hand '{self.name}' has gone")
                status = await self.status()
                ticks = status.statistics.ticks
                troubles = [_trouble(d) for d in status.devices if d.lifecycle != Lifecycle.ACTIVE]
                if not troubles and ticks > active_at:
                    return
                # The loop takes note of a device that is active now at its next tick.
                active_at = math.inf if troubles else min(active_at, ticks)
                lacks = "; ".join(troubles) or "the loop does not tick"
                if on_wait is not None and troubles and lacks != told:
                    told = lacks
                    on_wait(lacks)
                await anyio.sleep(_LOOK_EVERY)
        within = 0.0 if timeout is None else timeout
        raise NotReady(f"the hand '{self.name}' is not ready after {within:g} s: {lacks}")

    async def info(self, posture: Mapping[str, float] | None = None) -> HandInfo:
        """Return the hand as a grasp planner needs it.

        Args:
            posture: Actuator positions for poses and Jacobians [rad | m]; the others are at rest.
        """
        values = posture or {}
        fields = {"name": list(values), "position": list(values.values())}
        return info_of(await self._link.ask("info", fields))

    async def robot_description(self) -> str:
        """Return the URDF."""
        return str((await self._link.ask("robot_description"))["data"])


def _trouble(device: DeviceStatus) -> str:
    """Return in words why a device is not active."""
    what = f"fault {device.fault_code} ({device.fault_name})" if device.fault_name else ""
    why = "; ".join(text for text in (what or device.message, device.hint) if text)
    return f"device '{device.name}' is {device.lifecycle}" + (f": {why}" if why else "")


def _put(queue: asyncio.Queue[T], item: T) -> None:
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(item)
