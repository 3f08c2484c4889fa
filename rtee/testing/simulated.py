"""A hand with emulated devices on simulated time, in the process of a test.

Drivers, wires, emulators and the loop share a time that passes only while the test waits for the
hand, as fast as the processor computes: ten seconds take about one second of processor time, and
every deadline is exact. Nothing listens: pass the hand to the code under test, which cannot connect
to it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar, Unpack

import anyio

from rtee.actions.types import ActionReference
from rtee.buses.pool import BusPool
from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.errors import NoHand, NotReady, sole_error
from rtee.hand.load import hand_folder
from rtee.hand.model import Hand
from rtee.loop.clock import Clock
from rtee.loop.handloop import drive
from rtee.loop.observer import Observer
from rtee.loop.plan import Plan
from rtee.messages.goals import GOAL
from rtee.messages.state import State, decode_state
from rtee.remote.goal_values import (
    GoalOptions,
    GraspOptions,
    TouchOptions,
    action_goal,
    complete,
    grasp_goal,
    opening_goal,
    share_of,
    shares,
    spelled_out,
    touch_goal,
)
from rtee.remote.publishing import StateMessages
from rtee.running.prepare import RunOptions, prepare
from rtee.testing.bench import EmulatedDevices, act
from rtee.types import DeviceStatus, Event, Goal, Lifecycle, Result
from rtee.units import TIME, quantity

T = TypeVar("T")

_READY_WITHIN: Final = 120.0
"""Longest time for connecting and homing [s], simulated: an SVH homes for 30 s."""

_LOOK_EVERY: Final = 0.02
"""Simulated interval of the checks whether all devices are active [s]."""


class SimulatedHand(EmulatedDevices, Observer):
    """A hand on simulated time; `rtee.simulated` makes it.

    It has some methods of `rtee.connect_blocking`, and those of `EmulatedDevices`. Time passes
    while they work, and in `wait`.

    Attributes:
        name: The hand's name.
        events: What happened, in order.
    """

    def __init__(
        self,
        hand: Hand | str | Path,
        object: str | None = None,  # noqa: A002 - as on the command line
    ) -> None:
        """Read a hand; the object is between its fingers. Raises `UserError` for every mistake."""
        options = RunOptions(
            driver="devices", emulated=True, ideal=True, home=True, object_in_hand=object
        )
        name = str(hand_folder(hand)[0]) if isinstance(hand, Hand) else str(hand)
        prepared = prepare(name, options)
        self.name = prepared.hand.name
        self.events: list[Event] = []
        self._prepared = prepared
        self._runner = asyncio.Runner(loop_factory=SimulatedTimeLoop)
        self._pool = BusPool()
        self._loop = prepared.loop(self._pool)
        self._loop.add_observer(self)
        self._messages = StateMessages(prepared.hand)
        self._ended = False
        self._end = asyncio.Event()
        self._life: asyncio.Task[None] | None = None

    def on_event(self, event: Event) -> None:
        """Store the event."""
        self.events.append(event)

    def on_plan(self, plan: Plan, stamp: float) -> None:
        """Keep the plan's grip, by which states report opening and force."""
        self._messages.grip = plan.grip

    # --- its life

    def begin(self) -> None:
        """Connect and home the devices; raises `NotReady` if they do not become active."""
        self._run(self._begin())

    def close(self) -> None:
        """End the hand, its devices and its time; may be called more than once."""
        if self._ended:
            return
        try:
            self._run(self._finish())
        finally:
            self._ended = True
            _beside_event_loop(self._runner.close)

    async def _begin(self) -> None:
        lives = asyncio.Event()
        self._life = asyncio.create_task(self._live_alone(lives))
        while not lives.is_set():
            if self._life.done():
                await self._life
            await asyncio.sleep(_LOOK_EVERY)

    async def _finish(self) -> None:
        self._end.set()
        if self._life is not None:
            await self._life

    async def _live_alone(self, lives: asyncio.Event) -> None:
        try:
            await self._live(lives)
        except ExceptionGroup as group:
            # Task groups wrap even a single error, which callers want to catch by its type.
            raise sole_error(group) from None

    async def _live(self, lives: asyncio.Event) -> None:
        async with self._pool, self._loop, anyio.create_task_group() as group:
            await self._loop.ready()
            group.start_soon(drive, [self._loop], Clock(self._prepared.settings.rate))
            with anyio.move_on_after(_READY_WITHIN):
                while not self._active():  # noqa: ASYNC110 - devices have no event
                    await asyncio.sleep(_LOOK_EVERY)
            if not self._active():
                lacks = [s.name for s in self._loop.statuses() if s.lifecycle != Lifecycle.ACTIVE]
                group.cancel_scope.cancel()
                raise NotReady(f"the hand '{self.name}' is not ready: {', '.join(lacks)}")
            lives.set()
            await self._end.wait()
            group.cancel_scope.cancel()

    def _active(self) -> bool:
        return all(each.lifecycle is Lifecycle.ACTIVE for each in self._loop.statuses())

    def _run(self, work: Coroutine[Any, Any, T]) -> T:
        if self._ended:
            work.close()  # otherwise Python warns that nobody awaited it
            raise NoHand(f"the simulated hand '{self.name}' has ended; begin another one")
        return _beside_event_loop(lambda: self._runner.run(work))

    # --- goals

    @spelled_out
    def do(
        self, action: ActionReference | str, *elements: str, **options: Unpack[GoalOptions]
    ) -> Result:
        """Do an action and return its result; see `RemoteHand.do`.

        Raises `GoalRejected` if it cannot be done.
        """
        share = share_of(options.get("effort"))
        if share is not None:
            limits = {a.name: a.effort for a in self._prepared.hand.actuators}
            options["effort"] = shares(limits, share)
        return self.execute(action_goal(action, *elements, **options))

    def open(
        self, *, speed: float | str = 1.0, effort: Mapping[str, float] | float | str | None = None
    ) -> Result:
        """Go to the rest posture; see `RemoteHand.open`."""
        return self.do("open", speed=speed, effort=effort)

    def move_opening(
        self,
        opening: float | str,
        *,
        fingers: Sequence[str] | None = None,
        tip_speed: float | str | None = None,
    ) -> Result:
        """Open or close the fingertips to an opening [m]; see `RemoteHand.move_opening`."""
        return self.execute(opening_goal(opening, fingers, tip_speed))

    @spelled_out
    def grasp(self, width: float | str, **options: Unpack[GraspOptions]) -> Result:
        """Open wider than an object, close on it and keep a force; see `RemoteHand.grasp`."""
        return self.execute(grasp_goal(width, **options))

    @spelled_out
    def touch(self, **options: Unpack[TouchOptions]) -> Result:
        """Close slowly until a first contact; see `RemoteHand.touch`."""
        return self.execute(touch_goal(**options))

    def execute(self, goal: Goal) -> Result:
        """Execute a complete goal to its end; raises the errors of `do`, and `MessageError`."""
        # Checked as on its way to a running hand.
        return self._run(self._loop.execute(GOAL.decode(GOAL.encode(complete(goal)))))

    def stop(self) -> dict[str, bool]:
        """Stop all devices; return whether each confirmed it."""
        return dict(self._run(self._loop.stop()))

    def recover(self, device: str | None = None) -> None:
        """Bring a device, or all, out of fault or inactivity; raises the error of one that fails.

        Returns once the next ticks have seen the result.
        """
        self._run(self._loop.recover(device))
        self.wait(_LOOK_EVERY)

    # --- time and state

    def wait(self, seconds: float) -> None:
        """Let simulated time pass [s]; raises `GoalRejected` for anything but a time."""
        self._run(asyncio.sleep(quantity(seconds, TIME, "time to wait")))

    def state(self) -> State:
        """Return the state of the last tick, as `RemoteHand.state` does."""
        return decode_state(self._messages.state(self._loop.snapshot()))

    def status(self) -> list[DeviceStatus]:
        """Return the status of all devices."""
        return self._loop.statuses()

    def _act(self, what: str, detail: str, device: str | None) -> None:
        async def done() -> None:
            act(self._pool, [self._loop], what, detail, device)

        self._run(done())


def _beside_event_loop(call: Callable[[], T]) -> T:
    """Call a function that runs an event loop, in another thread if one runs already."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return call()
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(call).result()


class StartSimulatedHand(Protocol):
    """The type of the fixture ``rtee_simulated_hand``."""

    def __call__(
        self,
        hand: str | Path,
        *,
        object: str | None = None,  # noqa: A002 - as on the command line
    ) -> SimulatedHand:
        """Start a hand; see `simulated`."""


@contextlib.contextmanager
def simulated(
    hand: Hand | str | Path,
    *,
    object: str | None = None,  # noqa: A002 - as on the command line
) -> Iterator[SimulatedHand]:
    """Run a hand with emulated devices on simulated time for as long as the context lasts.

    Nothing real is connected to, and nothing listens. Drivers, wires, emulators and the loop work
    in this process, whose other clocks are those of the simulation while the hand works.

    Args:
        hand: The hand, as `rtee.load_hand` returns it; or its name, or its folder.
        object: Object between the fingers, as for ``rtee run --object``.

    Yields:
        The hand, ready to move.

    Raises:
        UserError: for every mistake in the hand's files or the options.
        NotReady: if a device does not become active.
    """
    made = SimulatedHand(hand, object)
    try:
        made.begin()
        yield made
    finally:
        made.close()
