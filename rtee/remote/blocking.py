"""A running hand for scripts and notebooks: like `rtee.remote.client`, without ``async``.

with rtee.connect_blocking("schunk_svh") as hand:
    result = hand.do("pinch_tight", "index", "thumb", intensity=0.6)
"""

from __future__ import annotations

import atexit
import contextlib
import os
import queue
import threading
import weakref
from collections.abc import (
    AsyncGenerator,
    AsyncIterator,
    Callable,
    Coroutine,
    Iterator,
    Mapping,
)
from concurrent.futures import CancelledError, Future
from contextlib import AbstractAsyncContextManager
from functools import partial, wraps
from inspect import signature
from types import TracebackType
from typing import Any, Concatenate, Generic, NoReturn, ParamSpec, Self, TypeVar

import anyio
from anyio.from_thread import BlockingPortal

from rtee import monotonic
from rtee.commands import StreamStatus
from rtee.errors import NoHand
from rtee.messages.requests import Role
from rtee.remote.client import ONE_PROCESS, RemoteHand, connect
from rtee.remote.goal import RunningGoal, check_follower
from rtee.remote.stream import Stream, paced
from rtee.types import Feedback, Result

P = ParamSpec("P")
T = TypeVar("T")

_END_WITHIN = 5.0
"""Time to wait for the end of a call that is given up, and of the event loop [s]: it takes
milliseconds, but must not hang a script."""

_LEFT = "this client has left its hand; connect again"

_PORTALS: weakref.WeakSet[BlockingPortal] = weakref.WeakSet()
"""The event loops of this process."""

_FORKED: weakref.WeakSet[BlockingPortal] = weakref.WeakSet()
"""Event loops copied by a fork, whose threads stayed in the parent process."""

os.register_at_fork(after_in_child=lambda: _FORKED.update(_PORTALS))


def _check_process(portal: BlockingPortal) -> None:
    if portal in _FORKED:
        raise NoHand(
            "this process was forked from one that had connected; start processes by "
            "multiprocessing.get_context('spawn'), and connect in each of them"
        )


def _close(portal: BlockingPortal, opened: contextlib.ExitStack) -> None:
    if portal not in _FORKED:
        opened.close()


class BlockingGoal:
    """A goal that the hand has accepted; iterate over its feedback, then ask for its result."""

    def __init__(self, portal: BlockingPortal, running: RunningGoal) -> None:
        self._portal = portal
        self._running = running
        self.goal = running.goal

    @property
    def done(self) -> bool:
        """Whether the goal has ended."""
        return self._running.done

    def __iter__(self) -> Iterator[Feedback]:
        """Iterate over the feedback until the goal has ended."""
        return _iterate(self._portal, aiter(self._running))

    def result(self) -> Result:
        """Wait until the goal has ended, and return its result."""
        return _wait(self._portal, self._running.result)

    def cancel(self) -> None:
        """Cancel the goal: the hand brakes and holds, and the result says so."""
        _wait(self._portal, self._running.cancel)


class BlockingStream:
    """An open stream of set-points; made by `BlockingHand.stream`."""

    def __init__(self, portal: BlockingPortal, stream: Stream) -> None:
        self._portal = portal
        self._stream = stream
        self.name = stream.name

    @property
    def ended(self) -> str:
        """Reason why the stream has ended, in words; empty while it is open."""
        return self._stream.ended

    def pace(self) -> Iterator[float]:
        """Iterate at the stream's rate; see `Stream.pace`."""
        for time, wait in paced(self._stream.rate, monotonic.asked):
            monotonic.sleep(wait)
            self._stream.check_open()
            yield time

    def send(
        self,
        targets: Mapping[str, float],
        velocity: Mapping[str, float] | None = None,
        stamp: float | None = None,
    ) -> None:
        """Send a sample; see `Stream.send`."""
        # In the caller's thread: the wait for the event loop would add jitter to the stream.
        when = monotonic.now() if stamp is None else stamp
        _wait(self._portal, partial(self._stream.send, targets, velocity or {}, when))

    def status(self) -> StreamStatus:
        """Return the status of the stream: lag, jitter, dropped samples."""
        return _wait(self._portal, self._stream.status)


def _waiting(
    method: Callable[Concatenate[RemoteHand, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[BlockingHand, P], T]:
    """Return a method of `BlockingHand` that waits for the given method of `RemoteHand`."""

    @wraps(method)
    def call(self: BlockingHand, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return _wait(self._portal, partial(method, self._hand, *args, **kwargs))

    return call


def _following(
    method: Callable[Concatenate[RemoteHand, P], Coroutine[Any, Any, Result]],
) -> Callable[Concatenate[BlockingHand, P], Result]:
    """Return a method of `BlockingHand` that executes a goal by the given method of `RemoteHand`.

    However the wait ends, by an interrupt, an exception of a signal's handler or an error of
    ``on_feedback``, the goal is cancelled. ``on_feedback`` is called in the caller's thread.
    """

    @wraps(method)
    def call(self: BlockingHand, /, *args: P.args, **kwargs: P.kwargs) -> Result:
        on_feedback: Any = kwargs.get("on_feedback")
        check_follower(on_feedback)
        if on_feedback is None:
            return _wait(self._portal, partial(method, self._hand, *args, **kwargs))
        said: queue.SimpleQueue[Feedback | None] = queue.SimpleQueue()

        async def execute() -> Result:
            try:
                kwargs["on_feedback"] = said.put
                return await method(self._hand, *args, **kwargs)
            finally:
                said.put(None)

        def follow() -> None:
            while (feedback := said.get()) is not None:
                on_feedback(feedback)

        return _wait(self._portal, execute, follow)

    return call


def _starting(
    method: Callable[Concatenate[RemoteHand, P], Coroutine[Any, Any, RunningGoal]],
) -> Callable[Concatenate[BlockingHand, P], BlockingGoal]:
    """Return a method of `BlockingHand` that begins a goal by the given method of `RemoteHand`."""

    @wraps(method)
    def call(self: BlockingHand, /, *args: P.args, **kwargs: P.kwargs) -> BlockingGoal:
        start = partial(method, self._hand, *args, **kwargs)
        return BlockingGoal(self._portal, _wait(self._portal, start))

    shown: Any = call
    shown.__signature__ = signature(method).replace(return_annotation="BlockingGoal")
    return call


def _iterating(
    method: Callable[Concatenate[RemoteHand, P], AsyncIterator[T]],
) -> Callable[Concatenate[BlockingHand, P], Iterator[T]]:
    """Return a method of `BlockingHand` that iterates like the given method of `RemoteHand`."""

    @wraps(method)
    def call(self: BlockingHand, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        return _iterate(self._portal, method(self._hand, *args, **kwargs))

    return call


class BlockingHand:
    """A running hand, made by `connect_blocking`.

    Any thread may call its methods, several at a time; processes connect themselves.
    It has the methods of `RemoteHand`, which wait for their results, except for `collected_states`.
    Use it as a context manager, or leave the hand with `disconnect`; the end of the program does
    so, too.

    Attributes:
        name: The hand's name.
        client: This client's name on the network.
    """

    def __init__(
        self, portal: BlockingPortal, hand: RemoteHand, opened: contextlib.ExitStack
    ) -> None:
        self._portal = portal
        self._hand = hand
        self._opened = opened
        # Zenoh's threads must not outlive the interpreter.
        self._exit = atexit.register(_close, portal, opened)
        self.name = hand.name
        self.client = hand.client

    def __enter__(self) -> Self:
        """Return the hand itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the hand; leaving with an error counts as losing the client, as with `connect`."""
        # Otherwise, the connection's objects would be kept until the program ends.
        atexit.unregister(self._exit)
        if self._portal not in _FORKED:
            self._opened.__exit__(kind, error, trace)

    def disconnect(self) -> None:
        """Leave the hand; may be called more than once."""
        self.__exit__(None, None, None)

    def __reduce__(self) -> NoReturn:
        """Refuse to be copied or pickled."""
        raise TypeError(ONE_PROCESS)

    @property
    def role(self) -> Role:
        """This client's role; see `RemoteHand.role`."""
        return self._hand.role

    @contextlib.contextmanager
    def stream(
        self,
        rate: float = 50.0,
        *,
        deadline: float | str | None = None,
        effort: Mapping[str, float] | float | str | None = None,
    ) -> Iterator[BlockingStream]:
        """Stream set-points for as long as the context lasts; see `RemoteHand.stream`."""
        opened = self._hand.stream(rate, deadline=deadline, effort=effort)
        with _entered(self._portal, opened) as stream:
            yield BlockingStream(self._portal, stream)

    @contextlib.contextmanager
    def lease(self) -> Iterator[None]:
        """Hold the lease for as long as the context lasts."""
        with _entered(self._portal, self._hand.lease()):
            yield

    start = _starting(RemoteHand.start)
    start_goal = _starting(RemoteHand.start_goal)
    do = _following(RemoteHand.do)
    open = _following(RemoteHand.open)
    move_opening = _following(RemoteHand.move_opening)
    grasp = _following(RemoteHand.grasp)
    touch = _following(RemoteHand.touch)
    cancel = _waiting(RemoteHand.cancel)
    effort_limits = _waiting(RemoteHand.effort_limits)
    hold = _waiting(RemoteHand.hold)
    jog = _waiting(RemoteHand.jog)
    stop = _waiting(RemoteHand.stop)
    recover = _waiting(RemoteHand.recover)
    admit_agents = _waiting(RemoteHand.admit_agents)
    set_gains = _waiting(RemoteHand.set_gains)
    record = _waiting(RemoteHand.record)
    acquire_lease = _waiting(RemoteHand.acquire_lease)
    release_lease = _waiting(RemoteHand.release_lease)

    state = _waiting(RemoteHand.state)
    states = _iterating(RemoteHand.states)
    touch_state = _waiting(RemoteHand.touch_state)
    touch_states = _iterating(RemoteHand.touch_states)
    events = _iterating(RemoteHand.events)
    feedback = _iterating(RemoteHand.feedback)
    results = _iterating(RemoteHand.results)
    ask = _waiting(RemoteHand.ask)
    status = _waiting(RemoteHand.status)
    ready = _waiting(RemoteHand.ready)
    info = _waiting(RemoteHand.info)
    object_description = _waiting(RemoteHand.object_description)
    robot_description = _waiting(RemoteHand.robot_description)

    actions = _waiting(RemoteHand.actions)
    primitives = _waiting(RemoteHand.primitives)
    partners = _waiting(RemoteHand.partners)
    openings = _waiting(RemoteHand.openings)
    limits = _waiting(RemoteHand.limits)
    trials = _waiting(RemoteHand.trials)
    grasp_plan = _waiting(RemoteHand.grasp_plan)
    reach = _waiting(RemoteHand.reach)
    grasp_at = _waiting(RemoteHand.grasp_at)
    add_generic = _waiting(RemoteHand.add_generic)
    add_composed = _waiting(RemoteHand.add_composed)
    add_timed = _waiting(RemoteHand.add_timed)
    add_action = _waiting(RemoteHand.add_action)
    store_action = _waiting(RemoteHand.store_action)
    remove_action = _waiting(RemoteHand.remove_action)
    rename_action = _waiting(RemoteHand.rename_action)


class _Call(Generic[T]):
    """An async function that the event loop's thread runs, and that its caller can give up."""

    def __init__(self, function: Callable[[], Coroutine[Any, Any, T]]) -> None:
        self._function = function
        self._scope: anyio.CancelScope | None = None
        self._given_up = False
        self._ended = threading.Event()

    async def run(self) -> T:
        try:
            with anyio.CancelScope() as self._scope:
                if self._given_up:
                    self._scope.cancel()
                return await self._function()
            raise CancelledError  # no caller waits for a result any more
        finally:
            self._ended.set()

    def give_up(self, portal: BlockingPortal) -> None:
        """Cancel the function and wait until it has ended, as when its goal is cancelled."""
        self._given_up = True
        if not self._ended.is_set():
            with contextlib.suppress(RuntimeError):  # the portal has ended, and the function too
                portal.start_task_soon(self._cancel)
                self._ended.wait(_END_WITHIN)

    def _cancel(self) -> None:
        if self._scope is None:  # not started, since tasks start in order
            self._ended.set()
        else:
            self._scope.cancel()


def _wait(
    portal: BlockingPortal,
    function: Callable[[], Coroutine[Any, Any, T]],
    meanwhile: Callable[[], object] = lambda: None,
) -> T:
    """Call an async function and wait for it; any exception of the wait cancels the function.

    Such exceptions are an interrupt (Ctrl-C), those of the handlers of signals, and errors of
    ``meanwhile``, which is called first. Raises `NoHand` if the hand was left.
    """
    _check_process(portal)
    call = _Call(function)
    try:
        try:
            future: Future[T] = portal.start_task_soon(call.run)
        except RuntimeError as error:
            raise _left(error) from None
        meanwhile()
        try:
            return future.result()
        except CancelledError:  # by the end of the portal
            raise NoHand(_LEFT) from None
    except BaseException:
        # Otherwise, the call would go on in the other thread.
        call.give_up(portal)
        raise


@contextlib.contextmanager
def _entered(portal: BlockingPortal, opened: AbstractAsyncContextManager[T]) -> Iterator[T]:
    """Enter an async context for as long as this one lasts; raises `NoHand` like `_wait`."""
    _check_process(portal)
    manager = portal.wrap_async_context_manager(opened)
    with contextlib.ExitStack() as stack:
        try:
            value = stack.enter_context(manager)
        except RuntimeError as error:
            raise _left(error) from None
        except BaseException as error:
            # The other thread may have entered it all the same, as after an interrupt.
            with contextlib.suppress(Exception):
                manager.__exit__(type(error), error, error.__traceback__)
            raise
        try:
            yield value
        finally:
            # Where the hand was left before, the context has ended with it.
            if portal in _FORKED or _stopped(portal):
                stack.pop_all()


def _stopped(portal: BlockingPortal) -> bool:
    try:
        portal.call(lambda: None)
    except RuntimeError as error:
        return "not running" in str(error)
    return False


def _left(error: RuntimeError) -> RuntimeError | NoHand:
    """Return the error for a call of a client that has left, or the error itself."""
    if "not running" not in str(error):  # as when called from the event loop
        return error
    return NoHand(_LEFT)


def _iterate(portal: BlockingPortal, source: AsyncIterator[T]) -> Iterator[T]:
    # In a tuple, an item that is ``None`` differs from the end.
    async def following() -> tuple[T] | None:
        try:
            return (await anext(source),)
        except StopAsyncIteration:
            return None

    async def close() -> None:
        if isinstance(source, AsyncGenerator):
            await source.aclose()

    try:
        while (item := _wait(portal, following)) is not None:
            yield item[0]
    finally:
        # When the hand was left before, as at the end of a script, the portal is closed already.
        with contextlib.suppress(RuntimeError):
            if portal not in _FORKED:
                portal.call(close)


def connect_blocking(
    hand: str | None = None,
    *,
    endpoint: str | None = None,
    client: str = "python",
    wait: float | str = 0.0,
    on_wait: Callable[[str], object] | None = None,
) -> BlockingHand:
    """Connect to a running hand through an event loop in another thread.

    Takes the same arguments as `rtee.connect`, and raises the same errors.
    """
    return BlockingHand(*opened(hand, endpoint=endpoint, client=client, wait=wait, on_wait=on_wait))


def opened(
    hand: str | None,
    *,
    endpoint: str | None = None,
    client: str = "python",
    wait: float | str = 0.0,
    on_wait: Callable[[str], object] | None = None,
) -> tuple[BlockingPortal, RemoteHand, contextlib.ExitStack]:
    """Return the parts of a `BlockingHand`; arguments and errors are those of `connect`."""
    with contextlib.ExitStack() as stack:
        portal = stack.enter_context(_portal())
        connection = connect(hand, endpoint=endpoint, client=client, wait=wait, on_wait=on_wait)
        remote = stack.enter_context(_entered(portal, connection))
        # An error before this line leaves the context, which closes everything; from here on, the
        # hand does.
        return portal, remote, stack.pop_all()


@contextlib.contextmanager
def _portal() -> Iterator[BlockingPortal]:
    """Run an event loop in a daemon thread, so that it doesn't keep the process from ending."""
    started: Future[BlockingPortal] = Future()

    async def run() -> None:
        async with BlockingPortal() as portal:
            started.set_result(portal)
            await portal.sleep_until_stopped()

    thread = threading.Thread(target=anyio.run, args=(run,), name="rtee client", daemon=True)
    thread.start()
    portal = started.result()
    _PORTALS.add(portal)
    try:
        yield portal
    finally:
        if portal not in _FORKED:
            # With what is still open, such as a stream, for which it would wait.
            portal.call(portal.stop, True)
        # At its end, the loop closes open iterators by calls into Zenoh. A thread that
        # returns from one while the interpreter ends aborts the process.
        thread.join(_END_WITHIN)
