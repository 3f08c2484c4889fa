"""Real-time set-up of the loop's thread; what the system does not permit becomes a warning."""

from __future__ import annotations

import contextlib
import gc
import importlib.util
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from rtee.buses.timing import ask_for_short_slices
from rtee.errors import ConfigError
from rtee.hand.config_schema import RealtimeSettings
from rtee.loop.memory import lock_memory

SWITCH_INTERVAL = 50e-6
"""Longest time another thread runs Python while the loop waits [s]: a twentieth of a period at 1
kHz; much shorter, and the threads spend their time on handing the interpreter over."""

HELPERS_NICE = -15
"""Nice value of the loop's helper threads, where that is permitted: before all ordinary programs,
but not before the system's own at -20."""

# Stack of a thread [byte]: an old kernel locks all of it in memory; the usual 8 MB are not used.
_STACK = 2 * 1024 * 1024
_AUTOGROUP = Path("/proc/self/autogroup")


EVENT_LOOP = "RTEE_EVENT_LOOP"
"""Variable of the environment that names the event loop: ``asyncio`` or ``uvloop``."""


def backend_options() -> dict[str, bool]:
    """Return the ``backend_options`` of `anyio.run` for a run of hands.

    uvloop's event loop takes less processor time for a turn than asyncio's and wakes up sooner.
    It is chosen where it is installed, unless the environment names the other one.

    Raises:
        ConfigError: if the environment names another one, or uvloop without it being installed.
    """
    installed = importlib.util.find_spec("uvloop") is not None
    match os.environ.get(EVENT_LOOP, ""):
        case "":
            return {"use_uvloop": installed}
        case "asyncio":
            return {"use_uvloop": False}
        case "uvloop":
            if not installed:
                raise ConfigError(
                    f"{EVENT_LOOP}=uvloop, but uvloop is not installed; pip install 'rtee[fast]'"
                )
            return {"use_uvloop": True}
        case other:
            raise ConfigError(f"{EVENT_LOOP} must be asyncio or uvloop, not '{other}'")


def set_up(settings: RealtimeSettings) -> list[str]:
    """Request what the settings ask for from the system, for the calling thread alone.

    Threads started later by this one are ordinary again (SCHED_RESET_ON_FORK); those that run
    already go before other programs, but have a real-time priority only if one is given for them.

    Args:
        settings: What to request; unless they are enabled, only what needs no permission.

    Returns:
        A sentence for everything that was not permitted, with what to configure.
    """
    if not settings.enabled:
        ask_for_short_slices()
        return []
    if not sys.platform.startswith("linux"):
        return [f"real-time scheduling is not supported on {sys.platform}; running as it is"]
    warnings: list[str] = []
    if settings.lock_memory:
        warnings += lock_memory()
    if settings.cpus:
        warnings += _pin(settings.cpus)
    # Last: pages are locked and CPUs chosen before the thread may starve others.
    refused = _schedule(settings.priority)
    if not refused:
        refused = _favour_helpers(min(settings.helper_priority, settings.priority - 1))
    return warnings + refused


def _favour_helpers(priority: int) -> list[str]:
    """Let the threads that already run go before other programs; they stay ordinary threads.

    They share the interpreter with the loop: one that is interrupted by another program while it
    holds the interpreter holds up the loop, whatever the loop's own priority.

    Args:
        priority: A real-time priority for them; 0: none.
    """
    own = threading.get_native_id()
    for thread in map(int, os.listdir("/proc/self/task")):
        if thread == own:
            continue
        with contextlib.suppress(ProcessLookupError):  # it may have ended meanwhile
            try:
                if priority > 0:
                    # RESET_ON_FORK, here and for the loop: a program started from it must not
                    # inherit it.
                    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                    os.sched_setscheduler(thread, policy, os.sched_param(priority))
                else:
                    os.setpriority(os.PRIO_PROCESS, thread, HELPERS_NICE)
            except PermissionError:
                return [
                    f"the nice value {HELPERS_NICE} of the loop's helper threads is not permitted;"
                    f" allow it by a line '<user> - nice {HELPERS_NICE}' in"
                    " /etc/security/limits.d/rtee.conf and a new login, or"
                    f" 'LimitNICE={HELPERS_NICE}' in the systemd unit"
                ]
    return []


@contextlib.contextmanager
def favoured_session(settings: RealtimeSettings) -> Iterator[None]:
    """Let the programs of this session go before those of others, for as long as this lasts.

    Where Linux groups programs by session (autogroup, see sched(7)), nice values only count among
    those of one; without this, the helper threads would have to wait for other sessions' programs.
    Does nothing unless real time is enabled, the system groups so, and permits it.
    """
    before = ""
    if settings.enabled:
        with contextlib.suppress(OSError):
            before = _AUTOGROUP.read_text().rpartition(" ")[2].strip()
    if before:  # the file is empty for a program that is in no such group
        with contextlib.suppress(OSError):
            _AUTOGROUP.write_text(str(HELPERS_NICE))
    try:
        yield
    finally:
        if before:
            with contextlib.suppress(OSError):
                _AUTOGROUP.write_text(before)


def small_stacks() -> int:
    """Give threads that are started from now on stacks of 2 MiB instead of Linux' 8.

    Memory that is locked is taken up whole.

    Returns:
        What was set before, for `threading.stack_size`.
    """
    return threading.stack_size(_STACK)


def share_the_interpreter() -> float:
    """Make other threads give the interpreter back to the loop at once, not after 5 ms.

    A thread that waits for the interpreter requests it from its holder after this time.

    Returns:
        The time that was set before [s].
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, SWITCH_INTERVAL))
    return before


def _schedule(priority: int) -> list[str]:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return [
            f"SCHED_FIFO priority {priority} is not permitted; allow it by a line"
            f" '<user> - rtprio {priority}' in /etc/security/limits.d/rtee.conf and a new login,"
            f" or 'LimitRTPRIO={priority}' in the systemd unit"
        ]
    except OSError as error:
        return [f"SCHED_FIFO priority {priority} was refused: {error.strerror}"]
    return []


def affinity() -> frozenset[int]:
    """Return the CPUs that the calling thread may run on; none where the system does not say."""
    if not hasattr(os, "sched_getaffinity"):
        return frozenset()
    return frozenset(os.sched_getaffinity(0))


def _pin(cpus: tuple[int, ...]) -> list[str]:
    try:
        os.sched_setaffinity(0, cpus)
    except OSError as error:
        present = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
        wanted = ", ".join(map(str, cpus))
        return [f"CPU {wanted} cannot be used ({error.strerror}); there are: {present}"]
    return []


class Collector:
    """Collects garbage between ticks, never during one.

    What exists when it starts is exempted (`gc.freeze`); then it collects young objects often and
    all of them seldom, when there is time left before the next tick.

    Args:
        every: How often each of the three generations is collected [ns]; the defaults keep the
        young ones small, and repeat the long collection seldom.
    """

    def __init__(
        self, every: tuple[int, int, int] = (100_000_000, 2_000_000_000, 20_000_000_000)
    ) -> None:
        self._every = every
        self._due = [0, 0, 0]
        self._cost = [0, 0, 0]
        self._was_enabled = False

    def start(self) -> None:
        """Take over from the automatic collection."""
        self._was_enabled = gc.isenabled()
        # What is left after this lives as long as the program: freezing spares looking at it again.
        gc.collect()
        gc.freeze()
        gc.disable()
        now = time.monotonic_ns()
        self._due = [now + every for every in self._every]

    def stop(self) -> None:
        """Give the automatic collection back."""
        gc.unfreeze()
        if self._was_enabled:
            gc.enable()

    def idle(self, until_ns: int) -> None:
        """Collect what is due if it can be done in time; else later.

        Args:
            until_ns: When the next tick is due, CLOCK_MONOTONIC [ns].
        """
        now = time.monotonic_ns()
        if now < self._due[0]:
            return
        for generation in (2, 1, 0):
            if now < self._due[generation]:
                continue
            # A period overdue: memory must not grow for ever because the loop is never idle enough.
            late = now - self._due[generation] > self._every[generation]
            if now + 2 * self._cost[generation] > until_ns and not late:
                return
            gc.collect(generation)
            done = time.monotonic_ns()
            # A slow collection counts, but is forgotten in time: it may have been preempted.
            self._cost[generation] = max(done - now, self._cost[generation] * 7 // 8)
            # A collection takes the younger generations with it.
            for younger in range(generation + 1):
                self._due[younger] = done + self._every[younger]
            return
