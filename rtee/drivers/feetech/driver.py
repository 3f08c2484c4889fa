"""Drives hands of Feetech servos on one line: a servo drives a joint, or two drive two joints."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import IntFlag
from typing import Any, ClassVar

import numpy as np

from rtee.buses.pool import BusPool
from rtee.drivers.feetech import table
from rtee.drivers.feetech.codec import Status
from rtee.drivers.feetech.identity import recognise
from rtee.drivers.feetech.link import FeetechLink
from rtee.drivers.feetech.options import FeetechOptions, Joints
from rtee.drivers.feetech.table import CURRENT_UNIT, FAMILIES, FULL, MODELS, model_name
from rtee.drivers.servo_lines import DELAY_UNIT, ServoOptions, ServoScale
from rtee.drivers.servos import POWERED, FoundServo, Goals, Readings, ServoCoupling, ServoDriver
from rtee.errors import BusTimeout, ConfigError, FrameError
from rtee.types import DeviceSpec

RESTARTED = 0x200
"""Code of the driver's own fault, above the bits of the status."""
_MARK = 0x80
"""Unused bit of the register that selects the errors for the LED. The driver writes it without
storing it, so a servo that has lost it has had a power cycle."""
_FASTER = 1.5
"""Speed limit of references without one [velocity limit of the actuators]: a servo that lags behind
its set-points has to be faster than they are."""
_QUICK = 30.0
"""Largest plausible speed of a servo [rad/s]: several times its no-load speed."""
_JUMP = 0.1
"""Change of a servo's angle that is plausible at any speed [rad], from backlash or a push."""
_REFUSES: Mapping[str, str] = {
    "": "SCS servos take no torque limit while they run; 'torque' in the options sets one for all",
    "share": "with 'stall_torque' in its options it takes one",
    "current": "with 'torque_per_ampere' in its options it takes one",
}
"""Why an effort limit is not accepted, by how the family limits torques."""


class FeetechDriver(ServoDriver[FeetechLink]):
    """SCS, STS, SMS or HLS servos on one line.

    A cycle reads position, speed, load, voltage, temperature and current, with one request for all
    servos or, if the family does not support that, with one for each. It then sets position, speed
    and torque limit of all servos with one frame, which they do not answer. This frame always
    carries all values, so that the next one makes up for a lost one. The driver stores nothing in
    the servos.

    Attributes:
        family: The servos' family.
    """

    Options = FeetechOptions
    options: FeetechOptions
    TORQUE = table.TORQUE
    GOAL = table.GOAL_POSITION
    GAINS: ClassVar[Mapping[str, Any]] = {"p": table.P, "i": table.I, "d": table.D}
    MOST_GAIN = table.MOST_GAIN
    STORED = table.RAM
    HINT = "`rtee recover` powers it again"
    LOST = "the supply was cut, or the servo has switched off; `rtee recover` powers it again"

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._by_current = [False] * len(self.ids)
        self._silent = False
        self._seen: tuple[float, list[int]] | None = None
        self._doubted: list[int] = []
        self._fastest = [_FASTER * a.velocity for a in spec.actuators]

    def _wired(
        self,
    ) -> tuple[Mapping[str, ServoOptions], tuple[float, float], ServoCoupling | None]:
        family = self.family = FAMILIES[self.options.family]
        joints = self._joints = Joints(self.spec, self.options)
        servos = {name: self.options.servos[name] for name in joints.names}
        turn = family.rad_per_count, float(family.center)
        return servos, turn, joints if joints.pairs else None

    async def _connect(self) -> FeetechLink:
        options = self.options
        together = self.family.sync_read if options.read == "auto" else options.read == "sync"
        return await self.open(
            self.buses.serial,
            options.port,
            lambda bus: FeetechLink(
                bus, self.family, options.deadline, options.retries, options.turnaround, together
            ),
            baudrate=options.baudrate,
            # A reply does not identify its request, so a late one could be taken for the next.
            fresh=True,
        )

    # --- set-up ------------------------------------------------------------------------------

    def _model(self, number: int | None) -> str:
        return model_name(number)

    def _check_model(self, name: str, servo: ServoOptions, model: int) -> None:
        known, family = MODELS.get(model), self.family
        if servo.model is None and (known is None or known.family != family.name):
            data = family.pack(table.MODEL, model)
            other = recognise(data)
            raise self.stranger(
                f"an {family.name.upper()} servo as {servo.id} ({name})",
                f"model {data.hex(' ').upper()}"
                if other is None
                else f"{other.name}, of family {other.family}",
                hint="is `family` right? If it has the same registers, configure 'model'",
            )

    def _as_found(self, number: int, stored: bytes, powered: bool) -> FoundServo:
        family = self.family

        def get(register: table.Register) -> int:
            return family.unpack(register, stored)

        by_current, scs = family.limits_torque == "current", family.offset is None
        return FoundServo(
            number,
            get(table.MODEL),
            f"{stored[0]}.{stored[1]}",
            0 if scs else get(table.PHASE),
            0 if family.offset is None else get(family.offset),
            0 if scs else get(table.MODE),
            # In HLS servos, this register is a second id, which cannot be read.
            0 if by_current else get(table.RETURN_DELAY),
            (get(table.MIN_ANGLE), get(table.MAX_ANGLE)),
            get(table.PROTECTION_CURRENT if by_current else table.MAX_TORQUE),
            powered,
            (get(table.P), get(table.I), get(table.D)),
            bool(get(table.ALARM) & _MARK),
        )

    def _check_found(self, name: str, found: FoundServo) -> None:
        if found.limits == (0, 0) and self.family.offset is None:
            raise self.stranger(
                f"servo {found.id} ({name}) with position limits",
                "limits of 0 and 0, with which it turns endlessly",
                hint="restore its limits; the factory limits are 20 and 1003",
            )

    def _adopt(self, servo: ServoOptions, found: FoundServo, scale: ServoScale) -> None:
        options, family = self.options, self.family
        # The delay of the slowest servo, since the deadline is the same for all.
        self.link.delay = DELAY_UNIT * max(s.return_delay for s in self.found.values())
        model = MODELS.get(found.model)
        known = math.nan if model is None else model.stall_torque
        stall = options.servos[self.names[servo.id]].stall_torque or options.stall_torque or known
        per_ampere = servo.torque_per_ampere or options.torque_per_ampere or math.nan
        by_load, by_current = stall / FULL, per_ampere * CURRENT_UNIT
        # From the current if it is measured and its torque is known, otherwise from the load; both
        # are good approximations only at standstill.
        measured = family.has_current and math.isfinite(per_ampere)
        self._by_current[self.ids.index(servo.id)] = measured
        scale.effort_unit = scale.gear * (by_current if measured else by_load)
        limited = {"share": by_load, "current": by_current}.get(family.limits_torque, math.nan)
        scale.limit_unit = scale.gear * limited
        scale.current_unit = CURRENT_UNIT if family.has_current else math.nan
        scale.speed_unit = family.speed_unit(found.drive_mode)

    def _described(self) -> tuple[float, str]:
        link, n, size = self.link, len(self.ids), self.family.state
        together = link.together and n > 1
        reading = link.read_time(size, n) if together else n * link.read_time(size)
        # Position, speed and, if the family has such a register, the share of the torque.
        written = 8 if self.family.limits_torque == "share" else 6
        rate = 1.0 / (reading + link.write_time(written, n))
        return rate, "all at once" if together else "one by one"

    def _refuses_effort(self) -> str:
        limited = all(math.isfinite(scale.limit_unit) for scale in self.scales)
        return "" if limited else _REFUSES[self.family.limits_torque]

    def _ends(self) -> list[tuple[float, float]]:
        return self._joints.ends(self.spec.actuators)

    def _check_range(self, number: int, ends: Sequence[float]) -> None:
        low, high = self.found[number].limits
        # A servo with the opposite sign swaps the ends.
        first, last = sorted(ends)
        # A servo that counts turns has limits of 0 and takes any position.
        if low < high and not low <= first <= last <= high:
            raise ConfigError(
                f"device '{self.spec.name}': servo {number} ({self.names[number]}) would have to "
                f"move from {first} to {last}, but accepts {low} to {high}; set its 'zero', or "
                "tighten "
                "the limits of its actuator"
            )

    async def _prepare(self, off: Sequence[int]) -> None:
        options, family, link = self.options, self.family, self.link
        # Locked servos accept settings without storing them, so that their memory does not wear
        # out.
        await self._set(family.lock, dict.fromkeys(off, 1))
        await self._set_gains(off)
        found = [self.found[number] for number in off]
        if family.offset is not None:
            # SCS servos have no such register: their limits select position or wheel mode.
            await self._set(table.MODE, {s.id: self.mode for s in found if s.mode != self.mode})
        if options.torque is not None and not family.limits_torque:
            most = round(options.torque * FULL)
            await self._set(table.MAX_TORQUE, {s.id: most for s in found if s.most != most})
        if options.acceleration is not None and family.offset is not None:
            await self._set(table.ACCELERATION, dict.fromkeys(off, options.acceleration))
        delay = options.return_delay
        # In HLS servos, the register of the return delay has another meaning.
        if delay is not None and family.name != "hls":
            slow = [s.id for s in found if s.return_delay != delay]
            # Not an error if a servo keeps its delay: it is only slower.
            await link.set_all(table.RETURN_DELAY, dict.fromkeys(slow, delay))
        # A servo that does not accept the mark still works, but its power cycles go unnoticed.
        new = [s.id for s in found if not s.marked]
        alarms = await link.values(table.ALARM, new)
        await link.set_all(table.ALARM, {n: alarm | _MARK for n, alarm in alarms.items()})

    # --- every cycle -------------------------------------------------------------------------

    async def _readings(self) -> Readings:
        first, size = table.PRESENT_POSITION.address, self.family.state
        try:
            answers = await self.link.read_all(first, size, self.ids)
        except (BusTimeout, FrameError):
            # Stored for the next cycle, which checks for a power cycle. Noise on the line of servos
            # without supply makes a silence a `FrameError`.
            self._silent = True
            raise
        measured = [self.family.measured(answers[n].params) for n in self.ids]
        columns = np.array(measured, dtype=np.float64).T
        columns[2] = np.where(self._by_current, columns[3], columns[2])
        return Readings(columns, {n: answers[n].code & Status.KNOWN for n in self.ids})

    async def _errors(self, errors: Mapping[int, int]) -> Mapping[int, IntFlag]:
        # Read again, since the checksum misses one damaged answer in fifty.
        again = (await self._readings()).errors
        return {number: Status(error) for number, error in again.items() if error}

    async def _watch(self) -> None:
        """Check one servo in turn, or all after a silence, which may have been a power cycle."""
        turn, rest = divmod(self._count + 1, self.options.check_every)
        # One servo at a time, since checking all would take as long as a whole cycle.
        due = [self.ids[turn % len(self.ids)]] if rest == 0 else []
        for number in (self.ids if self._silent else due) if self.active else ():
            await self._check_servo(number)
        if self.active:
            self._silent = False

    async def _condition(self, number: int) -> tuple[int, bool]:
        """Return a servo's torque register, and whether it has lost its mark."""
        first = table.ALARM.address
        size = table.TORQUE.address + 1 - first
        data = await self.link.data(number, first, size)
        alarm = self.family.unpack(table.ALARM, data, first)
        # A servo that had no mark when it was found cannot lose it.
        lost = self.found[number].marked and not alarm & _MARK
        return self.family.unpack(table.TORQUE, data, first), lost

    async def _check_servo(self, number: int) -> None:
        """Check that a servo has kept torque and settings; raises `DeviceFault` and `BusError`."""
        # Twice, so that a damaged answer is not taken for a servo without torque.
        torque, lost = POWERED, False
        for _ in range(2):
            torque, lost = await self._condition(number)
            if torque == POWERED and not lost:
                return
        if not torque:
            await self._refuse(await self._readings())
            raise self._lost([number])
        if lost:
            hint = (
                "its supply was cut, or a damaged frame has changed its settings; `rtee recover` "
                "sets it up again where it stands"
            )
            raise self._lost([number], "restarted", RESTARTED, hint=hint)
        # Any other value comes from a frame that was damaged on its way.
        await self.link.set_all(table.TORQUE, {number: POWERED})

    def _believe(self, readings: Readings, stamp: float) -> None:
        """Raise `FrameError` for a position out of reach, unless the servo reports it twice.

        The answer must have been damaged in spite of its checksum.
        """
        reported, doubted = [int(p) for p in readings.columns[0]], self._doubted
        self._doubted = []
        if self._seen is not None:
            when, last = self._seen
            reach = (_JUMP + _QUICK * (stamp - when)) / self.family.rad_per_count
            pairs = zip(self.ids, reported, last, strict=True)
            jumped = [n for n, p, q in pairs if abs(p - q) > reach]
            again = bool(doubted) and all(
                abs(p - q) <= reach for p, q in zip(reported, doubted, strict=True)
            )
            if jumped and not again:
                self._doubted = reported
                numbers = ", ".join(str(n) for n in jumped)
                raise FrameError(
                    self.options.port,
                    f"servo {numbers} cannot have reached the position it reports",
                )
        # A jump that was reported twice is real.
        self._seen = stamp, reported

    def _most(self, i: int) -> int:
        share, most = self.options.torque or 1.0, self.found[self.ids[i]].most
        if self.family.limits_torque == "current":
            return round(share * most)
        return min(most, round(share * FULL))

    async def _write(self, goals: Goals) -> None:
        family, data, limited = self.family, {}, not self._refuses_effort()
        for i in goals.chosen:
            scale, torque = self.scales[i], self._most(i)
            rate, effort = goals.rates[i], goals.efforts[i]
            if limited and math.isfinite(effort):
                torque = min(scale.to_limit(effort), torque)
            values = family.pack(table.GOAL_POSITION, goals.positions[i])
            # In HLS servos, this register is the goal torque; in others it is a running time, which
            # has an effect only without a speed.
            values += family.pack(table.GOAL_TIME, torque if family.name == "hls" else 0)
            rate = rate if math.isfinite(rate) else self._fastest[i]
            values += family.pack(table.GOAL_SPEED, scale.to_speed(rate))
            if family.limits_torque == "share":
                values += family.pack(table.TORQUE_LIMIT, torque)
            data[self.ids[i]] = values
        await self.link.write_all(table.GOAL_POSITION.address, data)

    # --- faults ------------------------------------------------------------------------------

    async def recover(self) -> None:
        """Disable the torque of servos with a fault, which ends an overload.

        Servos that have restarted, or are powered in a mode that does not stop at a goal, lose
        their torque, too, since only servos without torque are set up. `activate` powers all of
        them again.
        """
        # From here on, missing torque is not a fault.
        self.active = False
        link = self.link
        with link.relaxed_deadline():
            hurt = {n for n, error in (await self._readings()).errors.items() if error}
            for number in self.ids:
                torque, restarted = await self._condition(number)
                if restarted or (torque == POWERED and self._misled([number])):
                    hurt.add(number)
            await link.set_all(table.TORQUE, dict.fromkeys(hurt, 0))
            await self._refuse(await self._readings())
