"""Drives an RH56: six motors with force sensors, on a serial line or over Modbus."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, structs

from rtee import monotonic
from rtee.buses.modbus import ModbusRefusal
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.deadlines import cycle_deadline
from rtee.drivers.inspire_rh56 import codec
from rtee.drivers.inspire_rh56.codec import COUNT, FINGERS, KEEP, Register, Report, State, table
from rtee.drivers.inspire_rh56.link import FrameLink, ModbusLink, Rh56Link, WriteRefused
from rtee.drivers.inspire_rh56.options import InspireRh56Options, motors_of, scales_of
from rtee.drivers.inspire_rh56.tactile import TactileReader, sensors
from rtee.drivers.json_files import read_calibration_file, write_json
from rtee.errors import BusError, CalibrationError, CommandRejected, FrameError
from rtee.hand.validation import Section
from rtee.sample import ActuatorState, FloatArray
from rtee.touch import TouchReading
from rtee.types import DeviceSpec, Reference

_SPEED = 250
"""Speed at which the hand opens before calibrating [0.1 %]: a quarter of the largest."""
_OPENING = 5.0  # longest time to open [s]
_LASTS = 8.0
"""Time that published clients wait for the calibration [s]; it takes about 6 s."""
_SAMPLES = 20
"""Number of readings averaged for a zero."""
_IDLE = 100
"""Largest plausible reading of an idle finger [g]: published force curves begin there."""


class ForceZeros(Section, frozen=True):
    """Readings of the force sensors of an idle hand.

    Attributes:
        unit: Number of the hand.
        grams: The readings, in the order of `FINGERS` [g].
    """

    unit: int
    grams: Annotated[tuple[int, ...], Meta(min_length=COUNT, max_length=COUNT)]

    def __str__(self) -> str:
        pairs = zip(FINGERS, self.grams, strict=True)
        return "idle, " + ", ".join(f"{finger} reads {grams} g" for finger, grams in pairs)


async def calibrate(
    link: Rh56Link,
    measured: Callable[[], Awaitable[Report]],
    device: str,
    unit: int,
    angles: Sequence[int],
    path: Path,
) -> ForceZeros:
    """Open the hand, let it calibrate its force sensors, and store their readings afterwards.

    Args:
        link: The hand.
        measured: Reads the hand's measurements.
        device: The device's name.
        unit: The hand's number.
        angles: Set-points of the open hand, in the order of `FINGERS`; `KEEP`: unchanged.
        path: File to write.

    Raises:
        BusError: if the line fails.
        CalibrationError: if a finger does not open, or reads a force while it is idle.
        ConfigError: if the file cannot be written.
    """
    # Restored below, since the hand keeps set-points until its supply is cut.
    before = await patiently(lambda: link.read(Register.SPEED_SET, 2 * COUNT))
    await patiently(lambda: link.write(Register.SPEED_SET, table([_SPEED] * COUNT)))
    try:
        await patiently(lambda: link.write(Register.ANGLE_SET, table(angles)))
        await _opened(measured, device, angles)
    finally:
        # Even if a finger does not open: otherwise, the hand would keep the slow speed.
        await patiently(lambda: link.write(Register.SPEED_SET, before))
    await patiently(lambda: link.write(Register.FORCE_CALIBRATION, b"\x01"))
    await asyncio.sleep(_LASTS)
    sums = [0] * COUNT
    for _ in range(_SAMPLES):
        report = await patiently(measured)
        sums = [total + grams for total, grams in zip(sums, report.forces, strict=True)]
    zeros = ForceZeros(unit, tuple(round(total / _SAMPLES) for total in sums))
    for finger, grams, angle in zip(FINGERS, zeros.grams, angles, strict=True):
        # A finger that was not opened may touch something, so its force proves nothing.
        if angle != KEEP and abs(grams) > _IDLE:
            raise CalibrationError(
                device,
                f"{finger} measures {grams} g although the hand is idle; does it touch something?",
            )
    write_json(path, structs.asdict(zeros))
    return zeros


async def _opened(
    measured: Callable[[], Awaitable[Report]], device: str, angles: Sequence[int]
) -> None:
    """Wait until the motors that got a set-point have reached it; raises `CalibrationError`."""
    end = monotonic.now() + _OPENING
    while True:
        report = await patiently(measured)
        away = [
            FINGERS[m]
            for m, angle in enumerate(angles)
            if angle != KEEP and report.states[m] is not State.AT_TARGET
        ]
        if not away:
            return
        if monotonic.now() > end:
            raise CalibrationError(device, f"the hand does not open: {', '.join(away)}")
        await asyncio.sleep(0.05)


_CLEARING = 0.2
"""Longest time from clearing the errors until they are gone [s]; no source gives it."""

_BEHIND = 1
"""Number of transactions by which the hand's Modbus TCP answers may lag, as published clients
report."""

_PAUSE = 0.3
"""Pause between two network connections [s], as in published clients."""

_HOLDS = {
    codec.State.AT_FORCE: True,
    codec.State.OPENING: False,
    codec.State.CLOSING: False,
    codec.State.AT_TARGET: False,
}
"""Whether a motor holds something, by its state; not known in error states and before its first
command."""


class InspireRh56Driver(Driver):
    """An RH56DFX, DFQ, BFX or DFTP.

    A cycle reads angles, forces, currents, errors, states and temperatures in one exchange, or in
    two if the hand does not return them together, and writes set-points that have changed: force
    limits and speeds first, then the angles. A motor without a reference keeps its set-point.

    The motors cannot be switched off. The hand loses force limits and speeds when its supply is
    cut, so the driver reads the set-points back from time to time.
    """

    Options = InspireRh56Options
    options: InspireRh56Options
    link: Rh56Link

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._motors = motors_of(spec, self.options)
        self._scales = scales_of(spec, self.options, self._motors)
        self._zeros = (0,) * codec.COUNT
        self._here: FloatArray = np.full(len(self._motors), math.nan)
        self._block = self.options.reading == "block"
        self._count = 0
        self._closed = -math.inf
        self._angles = [codec.KEEP] * codec.COUNT
        self._forces: list[int] | None = None
        self._speeds: list[int] | None = None
        areas = self.options.areas
        self._tactile = TactileReader(areas) if areas else None
        self._touch: TouchReading | None = None
        pairs = zip(spec.actuators, self._scales, strict=True)
        self.capabilities = Capabilities(
            measures=frozenset({"position", "effort", "current", "temperature", "grasped"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            recoverable=True,
            grip={actuator.name: scale.grip for actuator, scale in pairs},
            touch=sensors(areas),
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line, check that an RH56 answers, and choose how to read it; moves nothing."""
        options = self.options
        if options.calibration is not None:
            # Sensors differ from hand to hand, so the zeros of another hand are wrong here.
            self._zeros = read_calibration_file(
                options.calibration, self.spec.name, ForceZeros, unit=options.unit
            ).grams
        link = await self._open()
        # The supply may have been cut, which restores the hand's initial limits.
        self._forces = self._speeds = None
        self._angles = [codec.KEEP] * codec.COUNT
        with (
            link.relaxed_deadline(),
            self.identifying(
                "an RH56",
                f"no RH56 answers as unit {options.unit} at {options.port}",
                "check supply, wires, `unit`, `baudrate`, and `protocol`: some hands speak Modbus "
                "only",
                ModbusRefusal,
                CodecError,
            ),
        ):
            await self._identify(link)
        best = self._best_rate(link)
        link.deadline = cycle_deadline(self.spec, best)
        self.refine(
            best_rate=best,
            identity={
                "model": f"Inspire RH56{options.model.upper()}",
                "address": f"unit {options.unit}",
                "protocol": "Modbus" if options.modbus else "frames",
                "reading": "one exchange" if self._block else "two exchanges",
            },
        )

    async def _open(self) -> Rh56Link:
        options = self.options
        # The deadline is set when the best rate is known; until then, a relaxed one applies.
        arguments = options.unit, 0.0, options.retries
        if options.modbus:
            await self._pause()
            return await self.open(
                self.buses.modbus,
                options.port,
                lambda bus: ModbusLink(bus, *arguments),
                behind=_BEHIND,
                baudrate=options.baudrate,
            )
        return await self.open(
            self.buses.serial,
            options.port,
            lambda bus: FrameLink(bus, *arguments),
            baudrate=options.baudrate,
            # A reply names its registers, but not its request: a late one would be an old state.
            fresh=True,
        )

    async def _pause(self) -> None:
        """Wait as long as a hand on the network needs between two connections."""
        if self.options.port.startswith("tcp://") and not self.spec.emulated:
            await self.detach()
            await asyncio.sleep(max(0.0, self._closed + _PAUSE - monotonic.now()))

    async def _identify(self, link: Rh56Link) -> None:
        """Read the hand, and find out whether one exchange is enough for all measurements."""
        # Two exchanges first: if these fail, the cause is the hand and not the reading as a block.
        self._block = False
        await self._read(link)
        if self.options.reading == "separate":
            return
        self._block = True
        try:
            await self._read(link)
        except (BusError, CodecError):
            if self.options.reading == "block":
                raise
            # The bytes between the two tables have no meaning, and a hand may refuse to read them.
            self._block = False

    def _best_rate(self, link: Rh56Link) -> float:
        sizes = (codec.BLOCK,) if self._block else (codec.WORDS, codec.REPORT)
        turnaround = self.options.turnaround
        reading = sum(link.read_time(size, turnaround) for size in sizes)
        once = reading + link.write_time(codec.WORDS, turnaround)
        if self._tactile is not None:
            once += link.read_time(self._tactile.largest, turnaround)
        # On a network nothing else bounds the rate; a hand takes more than a millisecond.
        return 1.0 / max(once, 1e-3)

    async def activate(self) -> None:
        """Attach to the hand as it is: its motors are always on and keep their set-points."""
        link = self.link
        with link.relaxed_deadline():
            self._check(await self._read(link))
            await self._read_back(link)
        # Its set-points may hold a grip, which a reference at the measured posture would end.
        self.attached.begin(range(len(self._motors)))

    async def examine(self) -> str:
        """Raise `DeviceFault` if the hand reports a fault."""
        link = self.link
        with link.relaxed_deadline():
            self._check(await self._read(link))
        return ""

    # --- every cycle -------------------------------------------------------------------------

    async def _read(self, link: Rh56Link) -> codec.Report:
        """Read the hand's measurements; raises `BusError` and `CodecError`."""
        if self._block:
            return codec.Report.from_bytes(await link.read(codec.Register.ANGLE, codec.BLOCK))
        angles = await link.read(codec.Register.ANGLE, codec.WORDS)
        return codec.Report.from_bytes(
            angles + codec.GAP + await link.read(codec.Register.FORCE, codec.REPORT)
        )

    async def _measured(self) -> codec.Report:
        """Read the hand's measurements; raises `BusError`."""
        try:
            return await self._read(self.link)
        except CodecError as error:
            raise FrameError(self.options.port, str(error)) from error

    async def sense(self) -> ActuatorState:
        """Return the hand's measurements."""
        self._count += 1
        if self._count % self.options.check_every == 0:
            await self._read_back(self.link)
        report = await self._measured()
        stamp = monotonic.now()
        self._check(report)
        if self._tactile is not None:
            # ``None`` until every area has been read once.
            self._touch = await self._tactile.read(self.link) or self._touch
        both = tuple(zip(self._motors, self._scales, strict=True))
        position = [scale.position.within(report.angles[motor]) for motor, scale in both]
        # For `move`, which compares references with this position while a grip is kept.
        self._here = np.array(position)
        return ActuatorState.measured(
            position,
            stamp,
            effort=[scale.effort(report.forces[m] - self._zeros[m]) for m, scale in both],
            current=[report.currents_ma[motor] * 1e-3 for motor in self._motors],
            temperature=[float(report.temperatures[motor]) for motor in self._motors],
            grasped=tuple(_HOLDS.get(report.states[motor]) for motor in self._motors),
            touch=self._touch,
        )

    def _check(self, report: codec.Report) -> None:
        """Raise the fault in a report, if any."""
        faulty = {codec.FINGERS[m]: report.errors[m] for m in self._motors if report.errors[m]}
        if not faulty:
            return
        names = [
            f"{finger}: {name}"
            for finger, bits in faulty.items()
            for bit, name in codec.ERRORS.items()
            if bits & bit
        ]
        together = codec.Error(0)
        for bits in faulty.values():
            together |= bits
        hint = "free the finger, then `rtee recover`"
        if together & codec.Error.TOO_HOT:
            hint = "let it cool down, then `rtee recover`; nothing else clears it"
        elif together == codec.Error.COMMUNICATION:
            hint = "`rtee recover`; if that does not help, cut the hand's supply for a moment"
        raise self.fault(int(together), "; ".join(names), hint=hint)

    async def _read_back(self, link: Rh56Link) -> None:
        """Read the set-points back; those that differ are sent again with the next reference."""
        try:
            data = await link.read(codec.Register.ANGLE_SET, codec.SetPoints.SIZE)
        except ModbusRefusal:
            return  # this hand does not return them, so they are assumed to be unchanged
        found = codec.SetPoints.from_bytes(data)
        self._forces, self._speeds = list(found.forces), list(found.speeds)
        pairs = zip(self._angles, found.angles, strict=True)
        # KEEP means unknown here, so that the next reference writes the set-point again. A hand
        # that was restarted also reports KEEP for each motor that has no set-point yet.
        self._angles = [sent if here == sent else codec.KEEP for sent, here in pairs]

    async def move(self, reference: Reference) -> None:
        """Write force limits and speeds that have changed, then the angles."""
        left = self.attached.holding(reference, self._here) if self.attached else ()
        most = self.options.most
        # A table sets all six motors, so motors without a reference get their present values.
        forces = list(self._forces or (most,) * codec.COUNT)
        speeds = list(self._speeds or (codec.MOST,) * codec.COUNT)
        angles = [codec.KEEP] * codec.COUNT
        mask = reference.mask.tolist()
        for i, (motor, scale) in enumerate(zip(self._motors, self._scales, strict=True)):
            if not mask[i] or i in left:
                continue
            forces[motor] = scale.limit(float(reference.max_effort[i]))
            speeds[motor] = scale.speed(float(reference.max_velocity[i]))
            angles[motor] = scale.position.to_count(float(reference.position[i]))
        if all(angle == codec.KEEP for angle in angles):
            return
        try:
            await self._set(forces, speeds, angles)
        except (WriteRefused, ModbusRefusal) as error:
            raise CommandRejected(self.spec.name, error.message) from error

    async def _set(
        self, forces: Sequence[int], speeds: Sequence[int], angles: Sequence[int]
    ) -> None:
        """Write the tables that differ from those in the hand."""
        link = self.link
        # A set-point counts as unknown until the hand has confirmed it.
        if forces != self._forces:
            self._forces = None
            await link.write(codec.Register.FORCE_SET, codec.table(forces))
            self._forces = list(forces)
        if speeds != self._speeds:
            self._speeds = None
            await link.write(codec.Register.SPEED_SET, codec.table(speeds))
            self._speeds = list(speeds)
        # Angles last, so that no motion begins with the limits of the previous one.
        changed = [
            codec.KEEP if new == sent else new
            for new, sent in zip(angles, self._angles, strict=True)
        ]
        if any(angle != codec.KEEP for angle in changed):
            wanted = [
                sent if new == codec.KEEP else new
                for new, sent in zip(angles, self._angles, strict=True)
            ]
            self._angles = [codec.KEEP] * codec.COUNT
            await link.write(codec.Register.ANGLE_SET, codec.table(changed))
            self._angles = wanted

    async def hold(self) -> None:
        """Command the measured pose."""
        # Within the cycle's deadline: a lost answer must not use up the time of a stop.
        report = await patiently(self._measured)
        both = tuple(zip(self._motors, self._scales, strict=True))
        here = [scale.position.within(report.angles[motor]) for motor, scale in both]
        angles = list(report.angles)
        for i, position in self.standstill.instead(here).items():
            motor, scale = both[i]
            angles[motor] = scale.position.to_count(position)
        await patiently(lambda: self._hold(angles, self._motors))

    async def _hold(self, angles: Sequence[int], motors: Sequence[int]) -> None:
        """Make the angles of some motors, as measured, their set-points."""
        # The hand may refuse a count outside the range, and -1 would keep the old set-point.
        here = [min(max(a, 0), 1000) if m in motors else codec.KEEP for m, a in enumerate(angles)]
        self._angles = [codec.KEEP] * codec.COUNT
        await self.link.write(codec.Register.ANGLE_SET, codec.table(here))

    async def recover(self) -> None:
        """Clear the errors; motors that had one hold their measured position."""
        link = self.link
        with link.relaxed_deadline():
            report = await self._measured()
            faulty = [m for m in self._motors if report.errors[m]]
            if faulty:
                # No source says whether a cleared motor continues to its old set-point.
                with contextlib.suppress(WriteRefused):
                    await self._hold(report.angles, faulty)
                await link.write(codec.Register.CLEAR_ERROR, b"\x01")
                report = await self._cleared()
                self._check(report)
                # Again, since a motor with an error may have refused it.
                await self._hold(report.angles, faulty)
        self.attached.begin(range(len(self._motors)))

    async def _cleared(self) -> codec.Report:
        """Return the report in which the errors are gone, or the last one after `_CLEARING`."""
        end = monotonic.now() + _CLEARING
        while True:
            report = await self._measured()
            if not any(report.errors[m] for m in self._motors) or monotonic.now() > end:
                return report
            await asyncio.sleep(0.01)

    async def close(self) -> None:
        """Detach from the bus; the hand keeps its set-points."""
        if self.connected:
            self._closed = monotonic.now()
        await super().close()

    # --- calibration -------------------------------------------------------------------------

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> ForceZeros:
        """Let the open hand calibrate its force sensors; store their readings afterwards.

        Arguments and errors are those of `Calibrates.calibrate`; the hand first moves to the rest
        posture.

        Raises:
            DeviceFault: if the hand reports a fault.
        """
        self._check(await patiently(self._measured))
        await ready("Take everything out of the hand's reach and do not touch it: it will open.")
        angles = [codec.KEEP] * codec.COUNT
        for motor, scale, position in zip(self._motors, self._scales, rest.tolist(), strict=True):
            angles[motor] = scale.position.to_count(position)
        with self.link.relaxed_deadline():
            return await calibrate(
                self.link,
                self._measured,
                self.spec.name,
                self.options.unit,
                angles,
                path,
            )
