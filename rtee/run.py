"""The composition root: builds running hands from hand.yaml, with recorder, network and signals."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from dataclasses import dataclass, replace
from functools import partial

import anyio

from rtee.buses.pool import BusPool
from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError, LoopError, RteeError, needing_extra
from rtee.hand.config_schema import RealtimeSettings
from rtee.log import Recorder
from rtee.loop.clock import Clock
from rtee.loop.configure import profile_words, realtime_settings
from rtee.loop.handloop import HandLoop
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
from rtee.loop.service import Service
from rtee.loop.shutdown import bring_to_rest
from rtee.loop.shutdown_signals import (
    Signals,
    beside_this_run,
    companion,
    receive_signals,
    wait_for_end,
)
from rtee.loop.tick_driver import drive
from rtee.prepare import PreparedHand, RunOptions, prepare
from rtee.remote.server import RemoteSettings, Server
from rtee.types import Event

__all__ = ["PreparedHand", "RunOptions", "prepare", "run_hands"]

log = logging.getLogger(__name__)

CONNECT_WITHIN = 3.0
"""Time after which the hands start to tick, even if a device is still connecting or homing [s]:
most devices connect faster."""


Serve = Callable[[HandLoop, RemoteSettings, Recorder, str], AbstractAsyncContextManager[Server]]
"""Makes a hand available on the network for as long as the context lasts: see `Server.open`."""


@dataclass
class _Running:
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
) -> int:
    """Run hands until a signal, the end of the duration, or ``until``.

    Args:
        names: The hands, by name or folder.
        options: Options of the command line, which override hand.yaml.
        serve: Opens the network server of a hand; ``None``: the hands are not on the network.
        say: Prints a line.
        until: Ends the run when it is set.

    Returns:
        The exit status: 0.

    Raises:
        UserError: for mistakes in files or options, before anything moves.
        LoopError: if the loop itself failed; the hands were brought to rest as configured.
    """
    options = options or RunOptions()
    until = until or anyio.Event()
    prepared = [prepare(name, options) for name in names]
    twice = [hand.hand.name for hand in prepared]
    if len(set(twice)) < len(twice):
        raise ConfigError(f"the hand '{max(twice, key=twice.count)}' is given twice")
    for hand in prepared:
        for warning in hand.warnings():
            log.warning("%s: %s", hand.hand.name, warning)
    _warn_of_profiles(prepared)
    if serve is not None:
        companions = (*options.companions, *_in_ros2(names, prepared, options))
        options = replace(options, companions=companions)
    realtime = _realtime(prepared, options)
    collector = Collector()
    service = Service.of()
    async with AsyncExitStack() as stack:
        if service is not None:
            stack.enter_context(service)
        stack.callback(threading.stack_size, small_stacks())
        signals = stack.enter_context(receive_signals())
        trace = _Trace()
        pool = await stack.enter_async_context(BusPool(trace=trace if options.trace else None))
        running = [await _open(hand, pool, options, stack, trace) for hand in prepared]
        await _connected(running)
        for one in running:
            if serve is not None:
                config = one.prepared.config
                words = profile_words(config, one.prepared.settings)
                server = serve(one.loop, config.remote, one.recorder, words)
                one.server = await stack.enter_async_context(server)
            say(start_line(one.loop, _log_words(one.recorder), _network_words(one.server)))
            if service is not None:
                one.loop.add_observer(service.watch(one.loop.name))
        cpus = affinity()
        for warning in set_up(realtime):
            log.warning("%s", warning)
        stack.enter_context(favoured_session(realtime))
        stack.callback(sys.setswitchinterval, share_the_interpreter())
        collector.start()
        stack.callback(collector.stop)
        if not realtime.enabled:  # else no tick may wait for a page that was given back
            give_memory_back()
        try:
            await _run(running, options, collector, until, signals, cpus, service)
        finally:
            for line in _summary(running):
                say(line)
    return 0


def _in_ros2(
    names: Sequence[str], prepared: Sequence[PreparedHand], options: RunOptions
) -> Iterator[tuple[str, ...]]:
    """Yield the command that makes hands nodes of ROS 2, if any hand is to be one.

    It runs as a client in a process of its own, so that it cannot delay the loop.
    """
    pairs = zip(names, prepared, strict=True)
    shown = [name for name, one in pairs if options.ros2 or one.config.ros2.enabled]
    if shown:
        with needing_extra("ROS 2", "ros2"):
            if importlib.util.find_spec("xxhash") is None:
                raise ImportError
        yield beside_this_run("ros2", "serve", *shown)


def _warn_of_profiles(prepared: Sequence[PreparedHand]) -> None:
    """Warn of hands that move by another profile than configured, once for each reason."""
    hands: dict[str, list[str]] = {}
    for one in prepared:
        if one.settings.profile.kind != one.config.profile.kind:
            words = profile_words(one.config, one.settings)
            hands.setdefault(words, []).append(one.hand.name)
    for words, names in hands.items():
        log.warning("%s: profile %s", ", ".join(names), words)


def _realtime(prepared: Sequence[PreparedHand], options: RunOptions) -> RealtimeSettings:
    wanted = [realtime_settings(hand.config, enabled=options.realtime) for hand in prepared]
    return next((settings for settings in wanted if settings.enabled), RealtimeSettings())


async def _open(
    prepared: PreparedHand,
    pool: BusPool,
    options: RunOptions,
    stack: AsyncExitStack,
    trace: _Trace,
) -> _Running:
    devices = [
        (device, find_driver(device.spec.driver, source=device.spec.source)(device.spec, pool))
        for device in prepared.devices
    ]
    loop = HandLoop(prepared.hand, prepared.library, prepared.settings, devices)
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
    await stack.enter_async_context(recorder)
    trace.recorders.append(recorder)
    loop.add_observer(recorder)
    loop.add_observer(tally)
    loop.add_observer(EventLog())
    await stack.enter_async_context(loop)
    return _Running(prepared, loop, recorder, tally)


async def _connected(running: Sequence[_Running]) -> None:
    """Wait until all devices have tried to connect, for `CONNECT_WITHIN` at most.

    Raises:
        UserError: if a mistake in the configuration keeps a device from ever connecting.
    """
    with anyio.move_on_after(CONNECT_WITHIN):
        for one in running:
            await one.loop.ready()


async def _run(
    running: Sequence[_Running],
    options: RunOptions,
    collector: Collector,
    until: anyio.Event,
    signals: Signals,
    cpus: Collection[int],
    service: Service | None,
) -> None:
    clocks: dict[float, list[HandLoop]] = {}
    for one in running:
        clocks.setdefault(one.prepared.settings.rate, []).append(one.loop)
    rested = False
    try:
        async with anyio.create_task_group() as group:
            for rate, loops in clocks.items():
                group.start_soon(drive, loops, Clock(rate), collector.idle)
            for command in options.companions:
                group.start_soon(companion, command, cpus)
            reason = await wait_for_end(options.duration, until, signals)
            if service is not None:
                service.stopping()
            await _rest(running, reason, ticking=True)
            rested = True
            group.cancel_scope.cancel()
    except Exception as error:
        if service is not None:
            service.stopping()
        await _rest(running, "the loop failed", failed=True)
        rested = True
        raise _failure(error, running) from error
    finally:
        if not rested:
            await _rest(running, "the run was cancelled")
        for one in running:  # while clients are still connected, to receive their results
            one.loop.end()


async def _rest(
    running: Sequence[_Running], reason: str, *, ticking: bool = False, failed: bool = False
) -> None:
    """Bring all hands to rest at the same time, each as configured."""
    with anyio.CancelScope(shield=True):
        async with anyio.create_task_group() as group:
            for one in running:
                safety = one.prepared.settings.safety
                behaviour = safety.on_error if failed else safety.on_exit
                rest = partial(bring_to_rest, one.loop, behaviour, reason, ticking=ticking)
                group.start_soon(rest)


def _failure(error: Exception, running: Sequence[_Running]) -> RteeError:
    """Log an error of the loop, write the last minute to a file, and return the error to raise."""
    while isinstance(error, ExceptionGroup) and len(error.exceptions) == 1:
        error = error.exceptions[0]
    log.error("the loop failed", exc_info=error)
    for one in running:
        one.recorder.fault("the loop failed")
    if isinstance(error, RteeError):
        return error
    return LoopError(f"the loop failed: {type(error).__name__}: {error}")


class _Trace:
    """Records the bytes on all buses as events."""

    def __init__(self) -> None:
        self.recorders: list[Recorder] = []

    def __call__(self, bus: str, direction: str, data: bytes, stamp: float) -> None:
        event = Event("trace", bus, f"{direction} {data.hex(' ')}", stamp)
        for recorder in self.recorders:
            recorder.on_event(event)


def _log_words(recorder: Recorder) -> str:
    status = recorder.status()
    if not status.recording:
        folder = recorder.flight_folder
        return "off" if folder is None else f"off, but faults go to {folder}"
    return str(status.path) if status.path else f"not written: {status.problem}"


def _network_words(server: Server | None) -> str:
    return "off" if server is None else server.endpoint


def _summary(running: Sequence[_Running]) -> list[str]:
    lines: list[str] = []
    by_clock: dict[int, list[_Running]] = {}
    for one in running:
        by_clock.setdefault(id(one.loop.clock_statistics), []).append(one)
    for group in by_clock.values():
        names = [one.loop.name for one in group]
        lines.append(statistics_line(group[0].loop.statistics(), names))
    lines += [f"{one.loop.name}: {one.tally.text()}" for one in running]
    for one in running:
        if trouble := one.recorder.status().trouble:
            lines.append(f"{one.loop.name}: recording: {trouble}")
        for path in one.recorder.status().flight_files:
            lines.append(f"{one.loop.name}: the last minute before the fault is in {path}")
    return lines
