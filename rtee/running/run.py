"""The composition root: builds running hands from hand.yaml, with recorder, network and signals."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import sys
import threading
from collections.abc import Callable, Collection, Coroutine, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import anyio
from msgspec import structs

from rtee.buses.pool import BusPool
from rtee.errors import ConfigError, LoopError, RteeError, needing_extra, sole_error
from rtee.hand.config_schema import RealtimeSettings, RemoteSettings
from rtee.log import Recorder
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, bring_to_rest, drive
from rtee.loop.memory import give_memory_back
from rtee.loop.realtime import (
    Collector,
    affinity,
    favoured_session,
    set_up,
    share_the_interpreter,
    small_stacks,
)
from rtee.loop.report import EventLog, Tally, start_line, statistics_line
from rtee.loop.service import ServiceReporter
from rtee.loop.settings import profile_words, realtime_settings
from rtee.loop.shutdown_signals import (
    Signals,
    beside_this_run,
    companion,
    receive_signals,
    wait_for_end,
)
from rtee.remote.directory import HandLock, claimed
from rtee.remote.server import Server
from rtee.remote.session import address_of
from rtee.running import free_motion
from rtee.running.event_lines import EventLines, Fields, event_lines
from rtee.running.prepare import PreparedHand, RunOptions, prepare
from rtee.types import Event

__all__ = ["PreparedHand", "RunOptions", "prepare", "run_hands"]

log = logging.getLogger(__name__)

CONNECT_WITHIN = 3.0
"""Longest wait for devices that connect or home, before the hands start to tick [s]: most devices
connect faster."""


Serve = Callable[
    [HandLoop, RemoteSettings, Recorder, str, HandLock], AbstractAsyncContextManager[Server]
]
"""Makes a hand available on the network for as long as the context lasts; see `Server.open`."""


@dataclass
class _RunningHand:
    prepared: PreparedHand
    loop: HandLoop
    recorder: Recorder
    tally: Tally
    server: Server | None = None


async def run_hands(
    names: Sequence[str],
    options: RunOptions | None = None,
    *,
    serve: Serve | None = Server.open,
    say: Callable[[str], None] = print,
    until: anyio.Event | None = None,
    beside: Callable[[BusPool, Sequence[HandLoop]], Coroutine[Any, Any, None]] | None = None,
) -> int:
    """Run hands until a signal, the end of the duration, or ``until``.

    Args:
        names: The hands, by name or folder.
        options: Options of the command line, which override hand.yaml.
        serve: Opens the network server of a hand; ``None``: the hands are not on the network.
        say: Prints a line.
        until: Ends the run when it is set.
        beside: Runs beside the hands; cancelled when they end.

    Returns:
        The exit status: 0.

    Raises:
        UserError: for mistakes in files or options, before anything moves.
        LoopError: if the loop itself failed; the hands were brought to rest as configured.
    """
    options = options or RunOptions()
    until = until or anyio.Event()
    prepared = [_recalled(prepare(name, options)) for name in names]
    given = [one.hand.name for one in prepared]
    if len(set(given)) < len(given):
        raise ConfigError(f"the hand '{max(given, key=given.count)}' is given twice")
    for one in prepared:
        for warning in one.warnings():
            log.warning("%s: %s", one.hand.name, warning)
    _warn_of_profiles(prepared)
    if serve is not None:
        beside_all = (*_in_ros2(names, prepared, options), *_metrics(prepared, options))
        companions = (*options.companions, *beside_all)
        options = replace(options, companions=companions)
    realtime = _realtime(prepared, enabled=options.realtime)
    collector = Collector()
    service = ServiceReporter.of()
    # Closed in the opposite order: first the network, then the devices and the recorders.
    async with AsyncExitStack() as stack:
        if service is not None:
            stack.enter_context(service)
        # Before any thread starts, as the stack size only applies to later ones.
        stack.callback(threading.stack_size, small_stacks())
        # Before devices are opened, so that a signal meanwhile ends the run as configured.
        signals = stack.enter_context(receive_signals())
        # Also before devices are opened: a hand that is already running uses them.
        places = {name: stack.enter_context(claimed(name)) for name in given if serve is not None}
        recorders: list[Recorder] = []
        trace = partial(_trace, recorders) if options.trace else None
        pool = await stack.enter_async_context(BusPool(trace=trace))
        lines = stack.enter_context(event_lines(options.events)) if options.events else None
        hands = [await _open(one, pool, options, stack, recorders, lines) for one in prepared]
        await _connected(hands)
        for hand in hands:
            if serve is not None:
                config = hand.prepared.config
                words = profile_words(config, hand.prepared.settings)
                place = places[hand.loop.name]
                server = serve(hand.loop, config.remote, hand.recorder, words, place)
                hand.server = await stack.enter_async_context(server)
            network = "off" if hand.server is None else hand.server.endpoint
            say(start_line(hand.loop, _log_words(hand.recorder), network))
            if service is not None:
                hand.loop.add_observer(service.watch(hand.loop.name))
        # Read the CPUs before this thread is pinned: companions would inherit the pinned ones.
        cpus = affinity()
        # Only now, since it also gives priority to the hands' threads, which all run by now.
        for warning in set_up(realtime):
            log.warning("%s", warning)
        stack.enter_context(favoured_session(realtime))
        stack.callback(sys.setswitchinterval, share_the_interpreter())
        collector.start()
        stack.callback(collector.stop)
        if not realtime.enabled:  # a real-time tick must not wait for pages returned to the system
            give_memory_back()
        try:
            loops = [hand.loop for hand in hands]
            task = None if beside is None else partial(beside, pool, loops)
            await _run(hands, options, collector, until, signals, cpus, service, task)
        finally:
            for hand in hands:
                known = hand.loop.controller.learned_motion
                free_motion.keep(hand.prepared.hand.name, hand.prepared.devices, known)
            for line in _summary(hands):
                say(line)
    return 0


def _recalled(prepared: PreparedHand) -> PreparedHand:
    """Return a hand with its stored estimates of free motion."""
    known = free_motion.recall(prepared.hand.name, prepared.devices)
    return replace(prepared, settings=structs.replace(prepared.settings, free_motion=known))


def _in_ros2(
    names: Sequence[str], prepared: Sequence[PreparedHand], options: RunOptions
) -> Iterator[tuple[str, ...]]:
    """Yield the command that makes hands ROS 2 nodes, if any hand should be one.

    The command runs as a client in its own process, so that it cannot delay the loop.
    """
    pairs = zip(names, prepared, strict=True)
    shown = [name for name, one in pairs if options.ros2 or one.config.ros2.enabled]
    if shown:
        with needing_extra("ROS 2", "ros2"):
            if importlib.util.find_spec("xxhash") is None:
                raise ModuleNotFoundError
        yield beside_this_run("ros2", "serve", *shown)


def _metrics(prepared: Sequence[PreparedHand], options: RunOptions) -> Iterator[tuple[str, ...]]:
    """Yield the commands that serve metrics, one per address; like ROS 2, they are clients."""
    hands: dict[str, list[str]] = {}
    for one in prepared:
        if listen := options.metrics or one.config.metrics.listen:
            address_of(listen, "metrics")
            hands.setdefault(listen, []).append(one.hand.name)
    for listen, names in hands.items():
        with needing_extra("metrics", "metrics"):
            if importlib.util.find_spec("prometheus_client") is None:
                raise ModuleNotFoundError
        yield beside_this_run("metrics", *names, "--listen", listen)


def _warn_of_profiles(prepared: Sequence[PreparedHand]) -> None:
    """Warn about hands whose motion profile differs from the configured one, once per reason."""
    hands: dict[str, list[str]] = {}
    for one in prepared:
        if one.settings.profile.kind != one.config.profile.kind:
            words = profile_words(one.config, one.settings)
            hands.setdefault(words, []).append(one.hand.name)
    for words, names in hands.items():
        log.warning("%s: profile %s", ", ".join(names), words)


def _realtime(prepared: Sequence[PreparedHand], *, enabled: bool) -> RealtimeSettings:
    """Return the real-time settings of the first hand that has any; warn about others."""
    chosen = RealtimeSettings()
    for one in prepared:
        settings = realtime_settings(one.config, enabled=enabled)
        if not chosen.enabled:
            chosen, first = settings, one.hand.name
        elif settings.enabled and settings != chosen:
            log.warning(
                "%s: `realtime` in its hand.yaml is ignored: that of %s holds for all hands",
                one.hand.name,
                first,
            )
    return chosen


async def _open(
    prepared: PreparedHand,
    pool: BusPool,
    options: RunOptions,
    stack: AsyncExitStack,
    recorders: list[Recorder],
    lines: Callable[[Fields], None] | None,
) -> _RunningHand:
    loop = prepared.loop(pool)
    # The recorder calls `notify` from its writer's thread.
    announce = asyncio.get_running_loop().call_soon_threadsafe

    def notify(event: Event) -> None:
        announce(loop.announce, event)

    recorder = Recorder(
        prepared.hand,
        prepared.recorder_settings(options),
        rate=prepared.settings.rate,
        loop=prepared.settings,
        attachments=prepared.attachments(),
        metadata={
            "drivers": " ".join(device.spec.driver for device in prepared.devices),
            "profile": str(prepared.settings.profile.kind),
        },
        notify=notify,
    )
    tally = Tally()
    recorder.controller = loop.controller
    # Enter the recorder before the loop, so that it still records the closing of the devices.
    await stack.enter_async_context(recorder)
    recorders.append(recorder)
    loop.add_observer(recorder)
    loop.add_observer(tally)
    loop.add_observer(EventLog())
    if lines is not None:
        loop.add_observer(EventLines(loop.name, loop.devices.keys(), lines))
    await stack.enter_async_context(loop)
    return _RunningHand(prepared, loop, recorder, tally)


async def _connected(hands: Sequence[_RunningHand]) -> None:
    """Wait until all devices have tried to connect, for at most `CONNECT_WITHIN`.

    Raises:
        UserError: if a mistake in the configuration prevents a device from ever connecting.
    """
    with anyio.move_on_after(CONNECT_WITHIN):
        for hand in hands:
            await hand.loop.ready()


async def _run(
    hands: Sequence[_RunningHand],
    options: RunOptions,
    collector: Collector,
    until: anyio.Event,
    signals: Signals,
    cpus: Collection[int],
    service: ServiceReporter | None,
    beside: Callable[[], Coroutine[Any, Any, None]] | None,
) -> None:
    # Hands with the same rate share a clock: one wake-up of the thread ticks them all.
    loops_by_rate: dict[float, list[HandLoop]] = {}
    for hand in hands:
        loops_by_rate.setdefault(hand.prepared.settings.rate, []).append(hand.loop)
    rested = False
    try:
        async with anyio.create_task_group() as group:
            for rate, loops in loops_by_rate.items():
                group.start_soon(drive, loops, Clock(rate), collector.idle)
            for command in options.companions:
                group.start_soon(companion, command, cpus)
            if beside is not None:
                group.start_soon(beside)
            reason = await wait_for_end(options.duration, until, signals)
            if service is not None:
                service.stopping()
            # The clocks still tick, as required for opening a hand at the end.
            await _rest(hands, reason, ticking=True)
            rested = True
            group.cancel_scope.cancel()
    except Exception as error:
        if service is not None:
            service.stopping()
        await _rest(hands, "the loop failed", failed=True)
        rested = True
        raise _failure(error, hands) from error
    finally:
        if not rested:  # cancelled from outside, which is not an `Exception`
            await _rest(hands, "the run was cancelled")
        for hand in hands:  # while clients are still connected, so that they receive results
            hand.loop.end()


async def _rest(
    hands: Sequence[_RunningHand], reason: str, *, ticking: bool = False, failed: bool = False
) -> None:
    """Bring all hands to rest at the same time, each as configured."""
    # Shielded, since a cancelled run must bring its hands to rest, too.
    with anyio.CancelScope(shield=True):
        async with anyio.create_task_group() as group:
            for hand in hands:
                safety = hand.prepared.settings.safety
                behaviour = safety.on_error if failed else safety.on_exit
                rest = partial(bring_to_rest, hand.loop, behaviour, reason, ticking=ticking)
                group.start_soon(rest)


def _failure(error: Exception, hands: Sequence[_RunningHand]) -> RteeError:
    """Log an error of the loop, write the flight recording, and return the error to raise."""
    # The task group wraps the clock's error, which by itself is clearer to the user.
    error = sole_error(error)
    log.error("the loop failed", exc_info=error)
    for hand in hands:
        hand.recorder.fault("the loop failed")
    if isinstance(error, RteeError):
        return error
    return LoopError(f"the loop failed: {type(error).__name__}: {error}")


def _trace(
    recorders: Sequence[Recorder], bus: str, direction: str, data: bytes, stamp: float
) -> None:
    """Record bytes on a bus as an event."""
    for recorder in recorders:
        recorder.on_event(Event("trace", bus, f"{direction} {data.hex(' ')}", stamp))


def _log_words(recorder: Recorder) -> str:
    status = recorder.status()
    if not status.recording:
        folder = recorder.flight_folder
        return "off" if folder is None else f"off, but faults go to {folder}"
    return str(status.path) if status.path else f"not written: {status.problem}"


def _summary(hands: Sequence[_RunningHand]) -> list[str]:
    # Hands on one clock share its statistics, and one line.
    by_clock: dict[int, list[HandLoop]] = {}
    for hand in hands:
        by_clock.setdefault(id(hand.loop.clock_statistics), []).append(hand.loop)
    lines = [
        statistics_line(loops[0].statistics(), [loop.name for loop in loops])
        for loops in by_clock.values()
    ]
    lines += [f"{hand.loop.name}: {hand.tally.text()}" for hand in hands]
    for hand in hands:
        status = hand.recorder.status()
        if status.trouble:
            lines.append(f"{hand.loop.name}: recording: {status.trouble}")
        for path in status.flight_files:
            lines.append(f"{hand.loop.name}: the time before the fault is recorded in {path}")
    return lines
