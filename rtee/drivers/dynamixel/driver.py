"""Drives hands of Dynamixel X servos: any number on one line, one read and one write per cycle."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import ClassVar

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.capabilities import Capabilities
from rtee.drivers.connection import Connection
from rtee.drivers.dynamixel import setup, table
from rtee.drivers.dynamixel.cycle import ServoCycle
from rtee.drivers.dynamixel.options import DynamixelOptions
from rtee.drivers.dynamixel.table import model_of
from rtee.drivers.emulators import emulator_of
from rtee.drivers.options import read_options
from rtee.drivers.servo_lines import Calibrated, CalibratesServos, zeros_of
from rtee.drivers.wiring import check_names
from rtee.errors import RteeError
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

_SLOW = 5.0
"""Longest time to read or write all servos one by one [s]."""

_ONE_SERVO = 1.0
"""Longest time for one request to one servo, retries included [s]."""

_REBOOT_POLL = 0.1
"""Pause between two pings of rebooted servos [s]; a reboot takes about 0.4 s."""

_MOST_GAIN = 16383
"""Largest gain of the position controllers (addresses 80 to 84)."""

GAINS = {"p": table.POSITION_P, "i": table.POSITION_I, "d": table.POSITION_D}
"""Registers of the gains that can be tuned."""


class DynamixelDriver(CalibratesServos):
    """Dynamixel X servos on one line.

    A cycle is one group read of current, velocity and position, and one group write of goal
    positions. Current limits (from the effort limit) and profile velocities are written before the
    positions when they change. Hardware errors set the alert bit of every answer.

    Servos lose their turn count with their supply: for a joint whose range crosses the wrap, the
    turn is assumed in which it is within its limits. Servos with torque keep it, and their goals,
    when the line is opened and when it is closed.
    """

    Options: ClassVar[type[DynamixelOptions]] = DynamixelOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(DynamixelOptions, spec)
        check_names(spec, "servos", self.options.servos)
        self.connection: Connection[ServoCycle] = Connection(spec)
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "current", "temperature"}),
            accepts=frozenset({"position", "max_velocity"}),
            best_rate=self._best_rate(fast=self.options.fast != "never"),
            watchdog=self.options.watchdog > 0.0,
            recoverable=True,
            gains=tuple(GAINS),
        )

    def _best_rate(self, *, fast: bool) -> float:
        """Return the fastest rate of cycles that the line allows [Hz]."""
        n, size = len(self.spec.actuators), table.STATE_SIZE
        # Bytes of the read request, the answers (one packet, or one per servo), the write request.
        answer = 8 + n * (size + 4) if fast else n * (size + 11)
        count = 14 + n + answer + 14 + n * 5
        # A byte takes ten bits on the line: eight of data between a start and a stop bit.
        return 1.0 / (count * 10.0 / self.options.baudrate + self.options.turnaround)

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and find every servo; writes nothing."""
        options = self.options
        cycle = await self.connection.open(
            self.buses.dynamixel(
                options.port,
                owner=self.connection.owner,
                baudrate=options.baudrate,
                emulator=emulator_of(self.spec, "dynamixel"),
            ),
            lambda bus: ServoCycle(self.spec, options, bus),
        )
        link = cycle.link
        await link.run(cycle.find, _SLOW)
        # After finding the servos, since a calibration of other servos is refused.
        if options.calibration is not None:
            zeros = zeros_of(options.calibration, self.spec.name, _as_calibrated(cycle))
            for scale, zero in zip(cycle.scales, zeros, strict=True):
                scale.zero = zero
        await link.run(partial(link.choose_read, options.fast), _ONE_SERVO)
        self._describe(cycle)
        await link.run(cycle.unwrap, _SLOW)

    def _describe(self, cycle: ServoCycle) -> None:
        """Refine the capabilities according to the servos found."""
        servos = cycle.found.values()
        models = Counter(model_of(servo.model).name for servo in servos)
        measures = {"position", "velocity", "temperature"}
        if all(math.isfinite(s.current_unit) for s in cycle.scales):
            measures.add("current")
        if all(math.isfinite(s.to_effort(1.0)) for s in cycle.scales):
            measures.add("effort")
        accepts, refuses = {"position", "max_velocity"}, {}
        if cycle.limits_effort:
            accepts.add("max_effort")
        else:
            refuses["max_effort"] = "'mode: current_based_position' in its options takes one"
        fast = cycle.link.fast
        self.capabilities = replace(
            self.capabilities,
            measures=frozenset(measures),
            accepts=frozenset(accepts),
            refuses=refuses,
            best_rate=self._best_rate(fast=fast),
            identity={
                "model": ", ".join(f"{n} x {name}" for name, n in models.items()),
                "firmware": ", ".join(sorted({str(s.firmware) for s in servos})),
                "read": "fast sync read" if fast else "sync read",
            },
        )

    async def activate(self) -> None:
        """Set up the servos without torque and power them at their positions."""
        cycle = self.connection.link
        cycle.link.patient = True
        # Again, since a power cycle after `configure` has reset the turn counts.
        await cycle.link.run(cycle.unwrap, _SLOW)
        await cycle.link.run(cycle.power, _SLOW)
        # From now on the exchanges have to fit into a cycle.
        cycle.link.patient = False
        cycle.active = True

    async def examine(self) -> str:
        """Raise the fault that the servos report."""
        cycle = self.connection.link
        await cycle.link.run(cycle.check, _SLOW)
        return ""

    async def deactivate(self) -> None:
        """Disable the torque."""
        if self.connection.is_open:
            cycle = self.connection.link
            # From here on, missing torque is no fault.
            cycle.active = False
            await cycle.link.run(cycle.release, _ONE_SERVO)

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Read current, velocity and position of all servos in one exchange."""
        cycle = self.connection.link
        return await cycle.link.run(cycle.sense)

    async def move(self, reference: Reference) -> None:
        """Write changed limits, then the goal positions."""
        cycle = self.connection.link
        await cycle.link.run(partial(cycle.move, reference))

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Write gains of the position controllers of all servos."""
        link = self.connection.link.link

        def write() -> None:
            for name, value in gains.items():
                count = min(max(round(value), 0), _MOST_GAIN)
                link.write_confirmed(GAINS[name], dict.fromkeys(link.ids, count))

        await link.run(write, _ONE_SERVO)

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """Hold the measured posture."""
        # It must not raise, not even before the line is open.
        with contextlib.suppress(RteeError, OSError):
            cycle = self.connection.link
            await patiently(partial(cycle.link.run, partial(cycle.hold, self.standstill)))

    async def disable(self) -> None:
        """Disable the torque; the fingers go limp."""
        with contextlib.suppress(RteeError, OSError):
            await patiently(self.deactivate)

    async def recover(self) -> None:
        """Reboot the servos with a hardware error; they are powered again by `activate`."""
        cycle = self.connection.link
        link, cycle.active = cycle.link, False
        link.patient = True
        broken = await link.run(partial(setup.hurt, link), _SLOW)
        for number in broken:
            await link.run(partial(link.reboot, number), _ONE_SERVO)
        # A servo is silent until its reboot is done.
        end = monotonic.now() + self.options.reboot_time
        while broken:
            await asyncio.sleep(_REBOOT_POLL)
            models = [await link.run(partial(link.ping, n), _ONE_SERVO) for n in broken]
            broken = [n for n, model in zip(broken, models, strict=True) if model is None]
            if broken and monotonic.now() > end:
                raise cycle.fault(setup.TORQUE_LOST, "silent after its reboot", broken)
        await link.run(cycle.find, _SLOW)
        await link.run(cycle.check, _SLOW)

    # --- calibration -------------------------------------------------------------------------

    async def take_zeros(self, rest: FloatArray) -> list[Calibrated]:
        """Set the zeros so that the present positions are a posture [rad]; raises `BusError`."""
        cycle = self.connection.link
        await cycle.link.run(partial(cycle.set_zeros, rest), _SLOW)
        return _as_calibrated(cycle)


def _as_calibrated(cycle: ServoCycle) -> list[Calibrated]:
    """Return the servos with the zeros that they have now."""
    return [
        Calibrated(cycle.names[f.id], f.id, f.model, f.drive_mode, f.homing_offset, scale.zero)
        for f, scale in zip((cycle.found[n] for n in cycle.link.ids), cycle.scales, strict=True)
    ]
