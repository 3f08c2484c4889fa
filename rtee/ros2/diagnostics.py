"""The topic ``/diagnostics`` of a hand's node: the loop, its devices, temperatures."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import anyio

from rtee.remote.monitoring import HandStatus
from rtee.ros2.message import Message
from rtee.ros2.served_hand import Part, ServedHand
from rtee.types import DeviceStatus, Lifecycle, LoopStatistics

_PERIOD = 1.0
"""Time between two messages [s], that of diagnostic_updater."""

_OLD = 1.0
"""Age of the newest measurement above which a device is stale [s]: many ticks of any hand."""


class Level(IntEnum):
    """The levels of ``diagnostic_msgs/msg/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Diagnostics(Part):
    """Publishes ``/diagnostics``, and passes the hand's status to the other parts of the node."""

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._array = served.message("diagnostic_msgs/msg/DiagnosticArray")
        self._status = served.message("diagnostic_msgs/msg/DiagnosticStatus")
        self._pair = served.message("diagnostic_msgs/msg/KeyValue")
        # Absolute in any namespace, since tools subscribe to one topic for the whole robot.
        self._publisher = served.node.publisher(
            "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
        )
        self._before: LoopStatistics | None = None

    async def run(self) -> None:
        """Publish once per second until the hand ends."""
        hand = self._served.hand
        while True:
            status = await hand.status()
            for listener in self._served.on_status:
                listener(status)
            self._publisher.publish(self.message(status, time.time_ns()))
            await anyio.sleep(_PERIOD)

    def message(self, status: HandStatus, wall_ns: int) -> Message:
        """Return the message for a status of the hand at a time since 1970 [ns]."""
        entries = [self._loop(status), *map(self._device, status.devices)]
        temperatures = self._temperatures()
        if temperatures is not None:
            entries.append(temperatures)
        return self._array(header=self._served.header(wall_ns), status=entries)

    def _entry(self, name: str, level: Level, message: str, values: Mapping[str, Any]) -> Message:
        hand = self._served.hand.name
        return self._status(
            level=level,
            name=f"{hand}: {name}",
            message=message,
            hardware_id=hand,
            values=[self._pair(key=key, value=_text(value)) for key, value in values.items()],
        )

    def _loop(self, status: HandStatus) -> Message:
        clock = status.statistics
        # Only since the last message: a tick missed hours ago must not cause warnings for ever.
        before, self._before = self._before or clock, clock
        missed, dropped = clock.missed - before.missed, clock.dropped - before.dropped
        level, summary = Level.OK, status.action or "ready"
        if status.recording_trouble:
            level, summary = Level.WARN, status.recording_trouble
        elif missed or dropped:
            level = Level.WARN
            summary = f"{missed} ticks missed, {dropped} records dropped since the last message"
        values = {
            "rate [Hz]": clock.measured_rate,
            "ticks": clock.ticks,
            "missed": clock.missed,
            "lateness p99 [s]": clock.lateness_p99,
            "busy p99 [s]": clock.busy_p99,
            "client": status.holder,
            "goal": status.action,
            "recording": status.recording,
            "grip effort": status.grip_effort,
            "profile": status.profile,
            "lateness max [s]": clock.lateness_max,
            "records dropped": clock.dropped,
            "clients": status.counts.clients,
            "stops": status.counts.stops,
            "version": status.counts.version,
            **{f"goals {outcome}": n for outcome, n in status.counts.goals.items()},
        }
        return self._entry("loop", level, summary, values)

    def _device(self, device: DeviceStatus) -> Message:
        level, summary = health(device)
        values: dict[str, Any] = {
            "lifecycle": str(device.lifecycle),
            "driver": device.driver,
            "rate [Hz]": device.rate,
            "age [s]": device.age,
            "exchanges": device.exchanges,
            "overruns": device.overruns,
            "errors": device.errors,
            "reconnects": device.reconnects,
            "fault code": device.fault_code,
            "fault": device.fault_name,
            "hint": device.hint,
            **device.identity,
            **device.counters,
        }
        return self._entry(f"device {device.name}", level, summary, values)

    def _temperatures(self) -> Message | None:
        """Return the entry of the temperatures; ``None`` if none is measured."""
        state, limits = self._served.latest, self._served.thermal
        pairs = zip(state.names, state.temperature.tolist(), strict=True)
        known = {name: value for name, value in pairs if not math.isnan(value)}
        if not known:
            return None
        hottest = max(known, key=lambda name: known[name])
        worst = known[hottest]
        level = Level.OK
        if worst >= limits.warn:
            level = Level.ERROR if worst >= limits.disable else Level.WARN
        values = {f"{name} [°C]": value for name, value in known.items()}
        currents = zip(state.names, state.current.tolist(), strict=True)
        values |= {f"{name} [A]": value for name, value in currents if not math.isnan(value)}
        return self._entry("temperatures", level, f"{hottest} is at {worst:.0f} °C", values)


def health(device: DeviceStatus) -> tuple[Level, str]:
    """Return the level of a device's health, and a sentence about the reason."""
    why = "; ".join(filter(None, (device.fault_name or device.message, device.hint)))
    match device.lifecycle:
        case Lifecycle.ACTIVE if device.age > _OLD:
            return Level.STALE, f"its newest measurement is {device.age:.1f} s old"
        case Lifecycle.ACTIVE:
            return Level.OK, "active"
        case Lifecycle.FAULT:
            return Level.ERROR, why or "fault"
        case Lifecycle.INACTIVE:
            return Level.WARN, why or "inactive"
    return Level.STALE, why or str(device.lifecycle)


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
