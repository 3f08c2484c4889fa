"""Drives a SCHUNK SVH: nine channels, one exchange per cycle."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from operator import sub

import numpy as np

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.schunk_svh import codec, homing
from rtee.drivers.schunk_svh.channels import (
    CHANNELS,
    HOMING_ORDER,
    Channel,
    SchunkSvhOptions,
    channels_for,
    channels_of,
)
from rtee.drivers.schunk_svh.codec import FeedbackAll
from rtee.drivers.schunk_svh.limits import ControllerLimits
from rtee.drivers.schunk_svh.link import SvhLink
from rtee.errors import DeviceFault
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

_LEEWAY = 1000
"""Change of a position that is plausible at any speed [ticks]: 1 to 3 % of a range."""


class ChannelScales:
    """The units of the channels in use, computed once for a homed hand.

    Args:
        channels: The channels in use, in the order of the actuators.
        stops: Stops found by homing [ticks], by channel; a channel without one has no position.
        rates: Largest speed of each channel [ticks/s].

    Attributes:
        homed: Whether each channel has a position.
    """

    def __init__(
        self, channels: Sequence[Channel], stops: Mapping[int, int], rates: Sequence[float]
    ) -> None:
        self._index = [c.index for c in channels]
        # Twice the commanded rate, since a finger may be pushed and packets may be late.
        self._rate = [2.0 * rate for rate in rates]
        self.homed = [c.index in stops for c in channels]
        # Numbers instead of arrays: for so few, numpy takes longer, and this runs in every cycle.
        self._measuring = [
            (
                c.index,
                float(c.zero(stops[c.index])) if c.index in stops else math.nan,
                c.rad_per_tick,
                c.force_slope * c.lever,
                c.force_offset * c.lever if c.force_slope * c.lever else math.nan,
                -float(c.direction),  # also the sign of a zero current
            )
            for c in channels
        ]
        self._moving = [
            (c.rad_per_tick, c.zero(stops[c.index]), *c.soft_limits(stops[c.index]))
            if c.index in stops
            else (c.rad_per_tick, 0, *c.soft_limits(0))
            for c in channels
        ]

    def measured(self, feedback: FeedbackAll) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions [rad], efforts [N·m] and currents [A]; ``NaN`` where not known."""
        positions, currents = feedback.positions, feedback.currents_ma
        where, efforts = [], []
        for index, zero, slope, force, least, sign in self._measuring:
            where.append((positions[index] - zero) * slope)
            current = currents[index]
            effort = force * abs(current) + least
            efforts.append(math.copysign(0.0 if effort < 0.0 else effort, current * sign))
        return (
            np.array(where),
            np.array(efforts),
            np.array([currents[index] * 1e-3 for index in self._index]),
        )

    def targets(self, position: FloatArray) -> list[int]:
        """Return the targets [ticks] for positions [rad], within the soft limits."""
        return [
            min(max(round(q / slope) + zero, low), high)
            for q, (slope, zero, low, high) in zip(position.tolist(), self._moving, strict=True)
        ]

    def jumped(self, before: FeedbackAll, after: FeedbackAll, dt: float) -> bool:
        """Return whether a position changed more than a finger can move in ``dt`` [s]."""
        moved = list(map(sub, after.positions, before.positions))
        if min(moved) >= -_LEEWAY and max(moved) <= _LEEWAY:
            return False  # the usual case, decided quickly in every cycle
        return any(
            abs(moved[index]) > _LEEWAY + dt * rate
            for index, rate in zip(self._index, self._rate, strict=True)
        )


class SchunkSvhDriver(Driver):
    """A SCHUNK SVH on its serial line.

    The reply to a command for all channels has their positions and currents, so a cycle of `sense`
    and `move` takes one exchange: `sense` returns the reply to the last `move`, and reads the hand
    only if there was none. Limits of effort and speed are controller settings of each channel; a
    changed limit is sent before the position of its channel, at most two in a cycle.

    Encoders are relative: without homing the positions are not known. A hand that lost its supply
    has to be homed again; one that has stayed enabled keeps its zero.

    Attributes:
        stops: The stops found by homing [ticks], by channel.
    """

    Options = SchunkSvhOptions
    options: SchunkSvhOptions
    link: SvhLink

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._index = channels_of(spec)
        self._table: tuple[Channel, ...] = CHANNELS
        self.stops: dict[int, int] = {}
        self._scales: ChannelScales | None = None
        self._limits = ControllerLimits()
        self._targets = [0] * codec.CHANNELS
        self._health = homing.Health(spec.name)
        self._here: FloatArray = np.full(len(spec.actuators), math.nan)
        self._answer: tuple[codec.FeedbackAll, float] | None = None
        self._last: tuple[codec.FeedbackAll, float] | None = None
        self._count = 0
        exchange = 2 * codec.PACKET * 10.0 / codec.BAUDRATE + self.options.turnaround
        self.capabilities = Capabilities(
            measures=frozenset({"position", "effort", "current"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=1.0 / exchange,
            homing=True,
            recoverable=True,
        )

    async def configure(self) -> None:
        """Open the line, identify the hand and read whether it is enabled; moves nothing."""
        options = self.options
        link = await self.open(
            self.buses.serial,
            options.port,
            lambda bus: SvhLink(bus, options.deadline, options.retries),
            baudrate=codec.BAUDRATE,
            # Where replies carry no index, a late one could be taken for the next.
            fresh=True,
        )
        with self.identifying(
            "an SVH",
            f"no SVH answers at {options.port}",
            "is the 24 V supply on, and is it the right port?",
        ):
            firmware = await link.firmware()
        if firmware.name != codec.NAME:
            raise self.stranger("an SVH", f"'{firmware.name}'", hint="check the port")
        self._adopt(firmware)
        own = options.settings == "device" or (options.settings == "auto" and firmware.major >= 2)
        await self._limits.read(link, self.spec.name, self._used(), options.channels, device=own)
        state = await link.state()
        enabled = {c for c in range(codec.CHANNELS) if state.enabled >> c & 1}
        self._health.found(state)
        # Stops that this driver has found are newer than those in the file.
        if not self.stops:
            self._adopt_stops(homing.read_stops(options.stops_file))
        # A stored zero may be from before a power cycle; a finger beyond its range proves that.
        if self.stops and not homing.plausible(self.stops, self._table, await link.feedback_all()):
            self._adopt_stops({})
        if not set(self._index) <= enabled:
            # It has been disabled: perhaps by a cut supply, which also resets the encoders.
            self._adopt_stops({})
        self._scales = None

    def _adopt_stops(self, stops: dict[int, int]) -> None:
        self.stops = stops
        self._scales = None

    @property
    def _units(self) -> ChannelScales:
        if self._scales is None:
            rates = [self._limits.position[index].max_rate for index in self._index]
            self._scales = ChannelScales(self._used(), self.stops, rates)
        return self._scales

    def _adopt(self, firmware: codec.FirmwareInfo) -> None:
        self._table = self.options.applied_to(channels_for(firmware.version))
        used = zip(self.spec.actuators, self._used(), strict=True)
        self.refine(
            unlimited=frozenset(a.name for a, channel in used if channel.force_slope == 0.0),
            identity={
                "model": "SCHUNK SVH",
                "firmware": f"{firmware.major}.{firmware.minor}",
                "text": firmware.text,
            },
        )

    def _used(self) -> list[Channel]:
        return [self._table[index] for index in self._index]

    async def activate(self) -> None:
        """Enable the channels at their positions; home them first if needed and allowed."""
        self.link.patient = True
        wanted = sum(1 << channel for channel in self._index)
        homed = set(self._index) <= set(self.stops)
        if homed and self._health.enabled & wanted == wanted:
            await self._seed()
            # The hand may hold an object, which a reference at the measured position would release.
            self.attached.begin(range(len(self._index)))
            self.link.patient = False
            return
        if not homed:
            if self.options.home == "on_demand" and not self._home_asked:
                raise self.fault(homing.NOT_HOMED, "not homed", hint=homing.HOMING)
            await self.home()
        self._home_asked = False
        await self._enable()
        self.link.patient = False

    async def examine(self) -> str:
        """Return ``not homed`` if it is not; raises the fault that the hand reports."""
        self._check(await self.link.state())
        return "" if set(self._index) <= set(self.stops) else "not homed"

    async def home(self) -> None:
        """Find the stops of all channels, one after the other; this moves the fingers.

        Raises `DeviceFault` if a channel does not find its stop, and `BusError`.
        """
        self._answer = None
        self._health.off()
        # Discarded first, so that a failed homing does not leave the old zeros behind.
        self._adopt_stops({})
        await homing.disable(self.link)
        # Homing needs the current limits: at the stop, only they protect the gears.
        await self._limits.write(self.link, self._index)
        stops: dict[int, int] = {}
        order = [channel for channel in HOMING_ORDER if channel in self._index]
        for number, channel in enumerate(order, start=1):
            with self.busy(f"homing {self._table[channel].name}, {number} of {len(order)}"):
                stops[channel] = await homing.home(
                    self.link,
                    self.spec.name,
                    self._table[channel],
                    self._limits.position[channel],
                    self._limits.current[channel],
                    timeout=self.options.home_timeout,
                )
        self._adopt_stops(stops)
        homing.write_stops(self.options.stops_file, stops)

    async def _enable(self) -> None:
        # Settings and targets before the power, so that none of an earlier run takes effect.
        await self._limits.write(self.link, self._index)
        await self._seed()
        await self.link.set_targets(self._targets)
        state = await homing.enable(self.link, self._index)
        self._health.begin(state, self._index)
        self._check(state)

    async def _seed(self) -> codec.FeedbackAll:
        """Make the measured positions the targets, so that enabling moves nothing; return them."""
        self._answer = self._last = None
        self.attached.begin()
        feedback = await self.link.feedback_all()
        self._targets = list(feedback.positions)
        return feedback

    async def sense(self) -> ActuatorState:
        """Return the reply to the last `move`, if there was one, or read the hand."""
        self._count += 1
        if self._count % self.options.status_every == 0:
            self._check(await self.link.state())
        answer, self._answer = self._answer, None
        if answer is None:
            feedback = await self.link.feedback_all()
            answer = feedback, monotonic.now()
        feedback, stamp = answer
        units = self._units
        before, self._last = self._last, (feedback, stamp)
        if before is not None and units.jumped(before[0], feedback, stamp - before[1]):
            # No finger is that fast: the encoders were reset, as by a power cycle.
            self._check(await self.link.state())
            units = self._units
        position, effort, current = units.measured(feedback)
        self._here = position
        return ActuatorState.measured(
            position, stamp, effort=effort, current=current, warnings=self._health.warnings
        )

    def _check(self, state: codec.ControllerState) -> None:
        try:
            self._health.check(state, self._table)
        except DeviceFault as fault:
            if fault.code == homing.LOST_POWER:
                # Without its supply the hand loses the positions.
                self._adopt_stops({})
            raise

    async def move(self, reference: Reference) -> None:
        """Send changed limits, then the targets of all channels; keep the reply for `sense`."""
        # One packet sets the targets of all channels, and the present ones cannot be read. The
        # limits are not changed either: a smaller current would loosen the grip.
        if self.attached.all_holding(reference, self._here):
            return
        waiting: Collection[int] = ()
        if not self._limits.settled(reference):
            waiting = await self._limits.update(self.link, self._used(), reference)
        units = self._units
        targets, homed = units.targets(reference.position), units.homed
        for index, target, known, commanded in zip(
            self._index, targets, homed, reference.mask.tolist(), strict=True
        ):
            if commanded and known and index not in waiting:
                self._targets[index] = target
        # One packet sets all channels; those without a reference get their last targets again.
        feedback = await self.link.set_targets(self._targets)
        self._answer = feedback, monotonic.now()

    async def hold(self) -> None:
        """Command the measured posture."""
        feedback = await patiently(self._seed)
        units = self._units
        here = units.measured(feedback)[0]
        instead = self.standstill.instead(here.tolist())
        held = np.array([instead.get(i, 0.0) for i in range(len(here))])
        targets = units.targets(held)
        for i in instead:
            if units.homed[i]:
                self._targets[self._index[i]] = targets[i]
        await patiently(lambda: self.link.set_targets(self._targets))

    async def recover(self) -> None:
        """Clear latched faults; enable the channels at their positions, if these are known.

        Otherwise the next `activate` homes the hand, which moves it.
        """
        self.link.patient = True
        await homing.disable(self.link)
        # Disabled on purpose, so channels without power are not a fault now.
        self._health.off()
        state = await self.link.state()
        self._health.cleared(state)
        self._check(state)
        # By asking for recovery the user agrees to the motion of homing.
        self._home_asked = not set(self._index) <= set(self.stops)
        if not self._home_asked:
            await self._enable()

    async def disable(self) -> None:
        """Disable every channel; the fingers go limp."""
        self._answer = None
        self._health.off()
        await homing.disable(self.link)

    async def close(self) -> None:
        """Detach from the line; enabled channels stay enabled."""
        # After a reconnection, an old reply must not pass for a measurement.
        self._answer = None
        await super().close()
