"""A running hand for scripts and notebooks: the same as `rtee.remote.client`, without ``async``.

with rtee.connect_blocking("schunk_svh") as hand:
    result = hand.do("pinch_tight", "index", "thumb", intensity=0.6)
"""

from __future__ import annotations

import atexit
import contextlib
import threading
from collections.abc import (
    AsyncGenerator,
    AsyncIterator,
    Callable,
    Collection,
    Coroutine,
    Iterator,
    Mapping,
    Sequence,
)
from concurrent.futures import Future
from functools import partial
from typing import Any, Self, TypeVar, Unpack

import anyio
from anyio.from_thread import BlockingPortal

from rtee.actions.build import StepPlan
from rtee.actions.types import Action, ActionReference, CustomAction, PrimitiveGroup
from rtee.messages.state import State
from rtee.planning.result import Ranking
from rtee.remote.action_client import GraspOptions
from rtee.remote.client import GoalOptions, RemoteHand, connect
from rtee.remote.goal import RunningGoal
from rtee.remote.monitoring import READY_WITHIN, HandStatus
from rtee.remote.planner import HandInfo
from rtee.types import Event, Feedback, Result

T = TypeVar("T")

_ATTEMPTS = 100
"""Attempts to close a generator whose step is still ending: together 1 s."""

_PAUSE = 0.01
"""Time between two of these attempts [s]."""


class BlockingGoal:
    """A goal that was taken; iterate over its feedback, then ask for its result."""

    def __init__(self, portal: BlockingPortal, running: RunningGoal) -> None:
        self._portal = portal
        self._running = running
        self.goal = running.goal

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._running.done

    def __iter__(self) -> Iterator[Feedback]:
        """Iterate over its feedback until it has ended."""
        return _iterate(self._portal, aiter(self._running))

    def result(self) -> Result:
        """Wait until it has ended."""
        return _wait(self._portal, self._running.result)

    def cancel(self) -> None:
        """Cancel it: the hand brakes and holds; the result says so."""
        _wait(self._portal, self._running.cancel)


class BlockingHand:
    """A running hand. Made by `connect_blocking`; see `RemoteHand` for its methods.

    It may be used as a context, or closed by `close`; the end of the program closes it, too.
    """

    def __init__(self, portal: BlockingPortal, hand: RemoteHand, exit_: Callable[[], None]) -> None:
        self._portal = portal
        self._hand = hand
        self._exit = exit_
        self.name = hand.name
        self.client = hand.client

    def __enter__(self) -> Self:
        """Return the hand itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the hand."""
        self.close()

    def close(self) -> None:
        """Leave the hand; may be called any number of times."""
        self._exit()
        atexit.unregister(self._exit)

    def _call(
        self, function: Callable[..., Coroutine[Any, Any, T]], *arguments: Any, **options: Any
    ) -> T:
        return _wait(self._portal, partial(function, *arguments, **options))

    # --- moving it

    def start(self, action: str, *elements: str, **options: Unpack[GoalOptions]) -> BlockingGoal:
        """Begin an action and return at once."""
        running = self._call(self._hand.start, action, *elements, **options)
        return BlockingGoal(self._portal, running)

    def do(
        self,
        action: str,
        *elements: str,
        on_feedback: Callable[[Feedback], object] | None = None,
        **options: Unpack[GoalOptions],
    ) -> Result:
        """Execute an action and wait for its result; being interrupted cancels it.

        Args:
            action: Its name; case and underscores do not matter.
            elements: Fingers or actuator of a primitive, in any order.
            on_feedback: Called with feedback meanwhile.
            options: See `GoalOptions`.
        """
        goal = self.start(action, *elements, **options)
        try:
            if on_feedback is not None:
                for feedback in goal:
                    on_feedback(feedback)
            return goal.result()
        except KeyboardInterrupt:
            goal.cancel()
            raise

    def open(self, on_feedback: Callable[[Feedback], object] | None = None) -> Result:
        """Go to the rest posture and wait for the result."""
        return self.do("open", on_feedback=on_feedback)

    def effort_limits(
        self, share: float, only: Collection[str] | None = None, *, besides: Collection[str] = ()
    ) -> dict[str, float]:
        """Return a share of the effort limits of actuators; see `RemoteHand.effort_limits`."""
        return self._call(self._hand.effort_limits, share, only, besides=besides)

    def cancel(self, goal_id: str = "") -> None:
        """Cancel a goal, or whichever runs."""
        self._call(self._hand.cancel, goal_id)

    def hold(self) -> None:
        """Hold the measured posture."""
        self._call(self._hand.hold)

    def jog(self, positions: Mapping[str, float], max_velocity: float | None = None) -> None:
        """Move some actuators; returns at once."""
        self._call(self._hand.jog, positions, max_velocity)

    def stop(self) -> dict[str, bool]:
        """Stop all devices now; return which confirmed it."""
        return self._call(self._hand.stop)

    def recover(self, device: str | None = None) -> None:
        """Bring a device, or all, out of a fault."""
        self._call(self._hand.recover, device)

    def set_gains(self, gains: Mapping[str, float], device: str | None = None) -> None:
        """Change gains of a device, or of every device that has them."""
        self._call(self._hand.set_gains, gains, device)

    def record(self, what: str, text: str = "") -> None:
        """Start, stop or mark the recording; see `RemoteHand.record`."""
        self._call(self._hand.record, what, text)

    def acquire(self) -> None:
        """Acquire the lease, until `release`: nobody else may move the hand."""
        self._call(self._hand.acquire)

    def release(self) -> None:
        """Give the hand back."""
        self._call(self._hand.release)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold the hand for as long as the context lasts."""
        with self._portal.wrap_async_context_manager(self._hand.held()):
            yield

    # --- watching it

    def state(self) -> State:
        """Return the newest state."""
        return self._call(self._hand.state)

    def states(self, rate: float = 100.0) -> Iterator[State]:
        """Iterate over states until the hand goes."""
        return _iterate(self._portal, self._hand.states(rate))

    def events(self) -> Iterator[Event]:
        """Iterate over what happens from now on."""
        return _iterate(self._portal, self._hand.events())

    def status(self) -> HandStatus:
        """Return how the loop and the devices are doing."""
        return self._call(self._hand.status)

    def ready(
        self,
        timeout: float | None = READY_WITHIN,
        on_wait: Callable[[str], object] | None = None,
    ) -> None:
        """Wait until the hand ticks and all its devices are active; see `RemoteHand.ready`."""
        self._call(self._hand.ready, timeout, on_wait)

    def info(self, posture: Mapping[str, float] | None = None) -> HandInfo:
        """Return the hand as a grasp planner needs it."""
        return self._call(self._hand.info, posture)

    def robot_description(self) -> str:
        """Return the URDF."""
        return self._call(self._hand.robot_description)

    # --- its actions

    def actions(self, kind: str = "", name: str = "", elements: Sequence[str] = ()) -> list[Action]:
        """Return the actions that pass a filter."""
        return self._call(self._hand.actions, kind, name, elements)

    def primitives(self) -> list[PrimitiveGroup]:
        """Return the primitives, one group per name."""
        return self._call(self._hand.primitives)

    def partners(self, name: str, element: str) -> tuple[str, ...]:
        """Return the elements that a primitive can be done with together with a given one."""
        return self._call(self._hand.partners, name, element)

    def trials(self) -> str:
        """Return the text of the file with what trials of the actions found; empty for none."""
        return self._call(self._hand.trials)

    def grasp_plan(self, thing: str, **options: Unpack[GraspOptions]) -> Ranking:
        """Return which actions suit an object, the best first; see `Library.grasp_plan`."""
        return self._call(self._hand.grasp_plan, thing, **options)

    def add_generic(self, name: str, set_points: Mapping[str, float], **options: Any) -> None:
        """Add a generic action; options as for `Library.add_generic`."""
        self._call(self._hand.add_generic, name, set_points, **options)

    def add_composed(self, name: str, parts: Sequence[ActionReference], **options: Any) -> None:
        """Add a composed action; options as for `Library.add_composed`."""
        self._call(self._hand.add_composed, name, parts, **options)

    def add_timed(self, name: str, steps: Sequence[StepPlan], **options: Any) -> None:
        """Add a timed action; options as for `Library.add_timed`."""
        self._call(self._hand.add_timed, name, steps, **options)

    def add_action(self, action: CustomAction, **options: Any) -> None:
        """Add a composed, timed or generic action; options as for `Library.add_action`."""
        self._call(self._hand.add_action, action, **options)

    def store_action(self, name: str) -> None:
        """Write an action that is only in memory to the hand's folder."""
        self._call(self._hand.store_action, name)

    def remove_action(self, name: str) -> None:
        """Remove an action, and its file."""
        self._call(self._hand.remove_action, name)

    def rename_action(self, name: str, new_name: str) -> None:
        """Give an action another name, everywhere it is used."""
        self._call(self._hand.rename_action, name, new_name)


def _wait(portal: BlockingPortal, function: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Call an async function and wait for it; an interrupt cancels it."""
    future: Future[T] = portal.start_task_soon(function)
    try:
        return future.result()
    except KeyboardInterrupt:
        future.cancel()
        raise


def _iterate(portal: BlockingPortal, source: AsyncIterator[T]) -> Iterator[T]:
    async def following() -> tuple[T] | None:
        try:
            return (await anext(source),)
        except StopAsyncIteration:
            return None

    async def close() -> None:
        # After an interrupt the step that was cancelled may still be ending.
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(RuntimeError):
                if isinstance(source, AsyncGenerator):
                    await source.aclose()
                return
            await anyio.sleep(_PAUSE)

    try:
        while (item := _wait(portal, following)) is not None:
            yield item[0]
    finally:
        portal.call(close)


def connect_blocking(
    hand: str | None = None,
    *,
    endpoint: str | None = None,
    client: str = "python",
    wait: float = 0.0,
    on_wait: Callable[[str], object] | None = None,
) -> BlockingHand:
    """Connect to a running hand; an event loop in a thread of its own does the work.

    Args:
        hand: Its name; not needed where only one runs.
        endpoint: Where it is, such as ``tcp/robot:7447``; else as ``RTEE_CONNECT`` says, else on
            this computer.
        client: A name for this client, for people.
        wait: Time to wait for a hand that does not run yet [s]; `BlockingHand.ready` waits until
            its devices are active, too.
        on_wait: Called with why it waits, in words, whenever that changes.

    Raises:
        NoHand: if no such hand runs.
        ConfigError: if several run and none is named.
    """
    with contextlib.ExitStack() as stack:
        portal = _start_portal()
        stack.callback(lambda: portal.call(portal.stop))
        opened = connect(hand, endpoint=endpoint, client=client, wait=wait, on_wait=on_wait)
        remote = stack.enter_context(portal.wrap_async_context_manager(opened))
        leave = stack.pop_all().close
    # Zenoh's threads must not outlive the interpreter.
    atexit.register(leave)
    return BlockingHand(portal, remote, leave)


def _start_portal() -> BlockingPortal:
    """Start an event loop in a thread that doesn't keep the process from ending."""
    started: Future[BlockingPortal] = Future()

    async def run() -> None:
        async with BlockingPortal() as portal:
            started.set_result(portal)
            await portal.sleep_until_stopped()

    threading.Thread(target=anyio.run, args=(run,), name="rtee client", daemon=True).start()
    return started.result()
