"""Real-time set-up of the loop's thread; requests that the system refuses become warnings."""

from __future__ import annotations

import contextlib
import gc
import importlib.util
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from rtee import monotonic
from rtee.buses.timing import ask_for_short_slices
from rtee.errors import ConfigError, install_line
from rtee.hand.config_schema import RealtimeSettings
from rtee.loop.memory import lock_memory

SWITCH_INTERVAL = 50e-6
"""Longest time for which another thread may run Python while the loop waits [s]: a twentieth of a
period at 1 kHz. Were it much shorter, the threads would spend their time passing the interpreter
to each other."""

HELPERS_NICE = -15
"""Nice value of the loop's helper threads, where permitted: ahead of all ordinary programs, but not
of the system's own at -20."""

# Stack of a thread [byte]: an old kernel locks all of it in memory, and none uses the usual 8 MB.
_STACK = 2 * 1024 * 1024
_AUTOGROUP = Path("/proc/self/autogroup")


EVENT_LOOP = "RTEE_EVENT_LOOP"
"""Environment variable that selects the event loop: ``asyncio`` or ``uvloop``."""


def backend_options() -> dict[str, bool]:
    """Return the ``backend_options`` of `anyio.run` for a run of hands.

    uvloop's event loop takes less processor time per turn than asyncio's and wakes up sooner. It is
    chosen where it is installed, unless the environment names asyncio.

    Raises:
        ConfigError: if the environment names an unknown event loop, or uvloop is not installed.
    """
    try:
        installed = importlib.util.find_spec("uvloop") is not None
    except ImportError:  # refused by an import hook
        installed = False
    match os.environ.get(EVENT_LOOP, ""):
        case "":
            return {"use_uvloop": installed}
        case "asyncio":
            return {"use_uvloop": False}
        case "uvloop":
            if not installed:
                raise ConfigError(
                    f"{EVENT_LOOP}=uvloop, but uvloop is not installed: {install_line('fast')}"
                )
            return {"use_uvloop": True}
        case other:
            raise ConfigError(f"{EVENT_LOOP} must be asyncio or uvloop, not '{other}'")


def set_up(settings: RealtimeSettings) -> list[str]:
    """Request real-time scheduling for the calling thread.

    Threads that it starts later are ordinary again (SCHED_RESET_ON_FORK). Threads that run already
    take precedence over other programs, but have a real-time priority only if the settings give
    one.

    Args:
        settings: The settings; unless enabled, only requests that need no permission are made.

    Returns:
        For each refused request, one sentence that says what to configure.
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
    # Last, so that pages are locked and CPUs chosen before the thread can starve others.
    refused = _schedule(settings.priority)
    if not refused:
        refused = _favour_helpers(min(settings.helper_priority, settings.priority - 1))
    return warnings + refused


def _favour_helpers(priority: int) -> list[str]:
    """Give the threads that are running already precedence over other programs.

    They share the interpreter with the loop: a thread that is preempted by another program while it
    holds the interpreter delays the loop, whatever the loop's own priority. Without a real-time
    priority (0), they get a nice value.
    """
    own = threading.get_native_id()
    for thread in map(int, os.listdir("/proc/self/task")):
        if thread == own:
            continue
        with contextlib.suppress(ProcessLookupError):  # it may have ended in the meantime
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
    """Give this session's programs precedence over those of other sessions, within the context.

    Where Linux groups programs by session (autogroup, see sched(7)), nice values only count within
    a session; without this, the helper threads would wait for the programs of other sessions. Does
    nothing unless real time is enabled and the system has, and permits, autogroups.
    """
    before = ""
    if settings.enabled:
        with contextlib.suppress(OSError):
            before = _AUTOGROUP.read_text().rpartition(" ")[2].strip()
    if before:  # empty for a program without an autogroup
        with contextlib.suppress(OSError):
            _AUTOGROUP.write_text(str(HELPERS_NICE))
    try:
        yield
    finally:
        if before:
            with contextlib.suppress(OSError):
                _AUTOGROUP.write_text(before)


def small_stacks() -> int:
    """Give threads that are started from now on stacks of 2 MiB instead of Linux' 8 MiB.

    Locked memory is resident as a whole, also where a stack is never used.

    Returns:
        The previous setting, for `threading.stack_size`.
    """
    return threading.stack_size(_STACK)


def share_the_interpreter() -> float:
    """Make other threads yield the interpreter to the loop within `SWITCH_INTERVAL`, not 5 ms.

    A thread that has waited for the interpreter this long makes its holder release it.

    Returns:
        The previous setting [s].
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
    """Return the CPUs that the calling thread may run on; empty if they are unknown."""
    if not hasattr(os, "sched_getaffinity"):
        return frozenset()
    return frozenset(os.sched_getaffinity(0))


def _pin(cpus: tuple[int, ...]) -> list[str]:
    try:
        os.sched_setaffinity(0, cpus)
    except OSError as error:
        present = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
        wanted = ", ".join(map(str, cpus))
        return [f"CPU {wanted} cannot be used ({error.strerror}); this computer has {present}"]
    return []


class Collector:
    """Collects garbage between ticks, never during a tick.

    Objects that exist when it starts are exempted (`gc.freeze`). Later it collects young objects
    often and all objects rarely, when there is time left before the next tick.

    Args:
        every: Collection interval of each of the three generations [ns]; the defaults keep the
            young ones small, and run the long collection rarely.
    """

    def __init__(
        self, every: tuple[int, int, int] = (100_000_000, 2_000_000_000, 20_000_000_000)
    ) -> None:
        self._every = every
        self._due = [0, 0, 0]
        self._cost = [0, 0, 0]
        self._was_enabled = False

    def start(self) -> None:
        """Replace the automatic collection."""
        self._was_enabled = gc.isenabled()
        # Objects left after this live as long as the program: frozen, they are not traversed again.
        gc.collect()
        gc.freeze()
        gc.disable()
        now = monotonic.now_ns()
        self._due = [now + every for every in self._every]

    def stop(self) -> None:
        """Restore the automatic collection."""
        gc.unfreeze()
        if self._was_enabled:
            gc.enable()

    def idle(self, until_ns: int) -> None:
        """Run a due collection if there is time until the next tick [ns, CLOCK_MONOTONIC]."""
        now = monotonic.now_ns()
        if now < self._due[0]:
            return
        for generation in (2, 1, 0):
            if now < self._due[generation]:
                continue
            # Overdue by a whole interval: without this, memory would grow without bound in a loop
            # that is never idle for long enough.
            late = now - self._due[generation] > self._every[generation]
            if now + 2 * self._cost[generation] > until_ns and not late:
                return
            gc.collect(generation)
            done = monotonic.now_ns()
            # Let the recorded cost of a slow collection decay: it may only have been preempted.
            self._cost[generation] = max(done - now, self._cost[generation] * 7 // 8)
            # Collecting a generation collects the younger ones, too.
            for younger in range(generation + 1):
                self._due[younger] = done + self._every[younger]
            return
