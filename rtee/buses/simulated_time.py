"""An event loop on simulated time: it never waits, but sets its clock to the next timer.

Emulators, the model of the wire, drivers and the loop share this time; their waits advance it, not
their computations. Ten seconds of homing take only as long as the computations, and every deadline
is exact on any computer under any load. Everything must happen in this process: data from a real
port or from another process would come too late, since time does not wait for it.
"""

from __future__ import annotations

import asyncio
import math
import queue
import selectors
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

from rtee import monotonic

_START = 1000.0
"""Time at which every simulated clock starts [s]; 0 means "never" in places."""

_TURN = 10e-6
"""Time that one turn of the event loop takes [s]: about that of a real one. Without it, a program
that polls a device until a timeout would never end."""

_Events = list[tuple[selectors.SelectorKey, int]]
_Select = Callable[[float | None], _Events]


@dataclass(eq=False, slots=True)
class _Wait:
    """A worker thread that waits."""

    ready: Callable[[], bool]
    until: float
    over: threading.Event = field(default_factory=threading.Event)


class SimulatedTimeLoop(asyncio.SelectorEventLoop):
    """An event loop whose time stops while anything computes, and then jumps to the next timer.

    While it runs, `rtee.monotonic` returns its time. Time passes only while every worker thread has
    ended or waits, too (`wait`, `rtee.monotonic.sleep`).

    Use it as the loop of a test: ``asyncio.Runner(loop_factory=SimulatedTimeLoop)``.

    Args:
        start: Its time at the beginning [s].

    Attributes:
        suspended: Time for which the simulated computer has been suspended [s].
    """

    def __init__(self, start: float = _START) -> None:
        self._time = start
        self.suspended = 0.0
        self._working = 0
        self._waits: list[_Wait] = []
        self._ended = False
        super().__init__(_JumpingSelector(self._select))

    def time(self) -> float:
        """Return the simulated time [s]."""
        return self._time

    def idle(self) -> bool:
        """Return whether nothing else is ready to run and all worker threads are idle."""
        return not self._ready and not self._working

    def run_forever(self) -> None:
        """Run until stopped, with this loop's time in `rtee.monotonic`."""
        before = monotonic.now, monotonic.now_ns, monotonic.sleep, monotonic.suspended
        monotonic.now, monotonic.now_ns, monotonic.sleep = self.time, self._time_ns, self._sleep
        monotonic.suspended = lambda: self.suspended
        try:
            super().run_forever()
        finally:
            monotonic.now, monotonic.now_ns, monotonic.sleep, monotonic.suspended = before

    def close(self) -> None:
        """Close the loop; threads that still wait in it continue at once."""
        self._ended = True
        for wait in self._waits:
            wait.over.set()
        super().close()

    def run_in_executor(  # type: ignore[override]
        self, executor: Executor | None, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Call a function in a thread; time stands still until it returns or waits."""
        result = super().run_in_executor(executor, func, *args)
        self.work_begins()
        result.add_done_callback(lambda _: self.work_ends())
        return result

    def work_begins(self) -> None:
        """Let time stand still for a worker thread; called in the loop's thread."""
        self._working += 1

    def work_ends(self) -> None:
        """Undo one `work_begins`; called in the loop's thread, after the work's result arrived."""
        self._working -= 1

    def wait(self, ready: Callable[[], bool], within: float) -> bool:
        """Wait in a worker thread until ``ready()``, at most ``within`` [s]; return ``ready()``.

        The loop's thread calls ``ready`` meanwhile, and the worker thread calls it at the end.
        """
        wait = _Wait(ready, self._time + within)
        self._waits.append(wait)
        if self._ended:
            return ready()
        # From now on time may pass; the loop may be waiting for this thread.
        self.call_soon_threadsafe(self.work_ends)
        wait.over.wait()
        return ready()

    def _time_ns(self) -> int:
        return round(self._time * 1e9)

    def _sleep(self, seconds: float) -> None:
        if threading.get_ident() == self._thread_id:
            self._time += seconds
        else:
            self.wait(lambda: False, seconds)

    def _release(self) -> None:
        """Resume the threads whose wait is over."""
        for wait in [w for w in self._waits if w.until <= self._time or w.ready()]:
            self._waits.remove(wait)
            self.work_begins()
            wait.over.set()

    def _select(self, timeout: float | None, select: _Select) -> _Events:
        """Select like a selector, but advance the time instead of waiting."""
        self._time += _TURN
        if self._waits:
            self._release()
        events = select(0)
        if events or (timeout is not None and timeout <= 0.0):
            return events
        if self._working:
            # The next action of a thread wakes the loop up.
            return select(None)
        due = math.inf if timeout is None else self._time + timeout
        for wait in self._waits:
            due = min(due, wait.until)
        if due == math.inf:
            return select(None)  # for a signal, or an unknown thread
        self._time = max(self._time, due)
        self._release()
        return []

    _ready: deque[asyncio.Handle]
    _thread_id: int | None


class _JumpingSelector(selectors.DefaultSelector):
    def __init__(self, passing: Callable[[float | None, _Select], _Events]) -> None:
        super().__init__()
        self._passing = passing

    def select(self, timeout: float | None = None) -> _Events:
        return self._passing(timeout, super().select)


class SimulatedQueue(queue.Queue[Any]):
    """A queue whose ``get`` waits in simulated time; for a blocking library in a worker thread."""

    def __init__(self, loop: SimulatedTimeLoop) -> None:
        super().__init__()
        self._loop = loop

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """Return the oldest item; raises `queue.Empty` after the timeout [s], if there is one."""
        within = math.inf if timeout is None else timeout
        if block and not self._loop.wait(lambda: not self.empty(), within):
            raise queue.Empty
        return super().get(block=False)


def on_simulated_time() -> SimulatedTimeLoop | None:
    """Return the running event loop if it is on simulated time, otherwise ``None``."""
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:  # in a thread without one
        return None
    return loop if isinstance(loop, SimulatedTimeLoop) else None
