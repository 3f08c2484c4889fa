"""Drives hands of Feetech servos on one line; each drives a joint, or two drive two joints."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import ClassVar

from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.buses.serial import SerialBus
from rtee.capabilities import Capabilities
from rtee.drivers.connection import Connection
from rtee.drivers.emulators import emulator_of
from rtee.drivers.feetech import table
from rtee.drivers.feetech.cycle import ServoCycle
from rtee.drivers.feetech.joints import Joints
from rtee.drivers.feetech.link import FeetechLink
from rtee.drivers.feetech.options import FeetechOptions
from rtee.drivers.feetech.setup import POWERED
from rtee.drivers.feetech.table import FAMILIES, model_name
from rtee.drivers.options import read_options
from rtee.drivers.servo_lines import Calibrated, CalibratesServos, zeros_of
from rtee.errors import RteeError
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

GAINS = {"p": table.P, "i": table.I, "d": table.D}
"""Registers of the gains that can be tuned."""
_MOST_GAIN = 254
"""Largest gain [counts]."""

_REFUSES: Mapping[str, str] = {
    "": "SCS servos take no torque limit while they run; 'torque' in the options sets one for all",
    "share": "with 'stall_torque' in its options it takes one",
    "current": "with 'torque_per_ampere' in its options it takes one",
}
"""Why an effort limit is not accepted, by how the family limits torques."""


class FeetechDriver(CalibratesServos):
    """SCS, STS, SMS or HLS servos on one line.

    A cycle reads position, speed, load, voltage, temperature and current, by one request for all
    servos or, if the family does not support that, by one for each; and it sets position, speed and
    torque limit of all by one frame without answers. This frame always carries all values, so that
    the next one makes up for a lost one.

    Servos with torque keep it, and their goals, when the line is opened and when it is closed. The
    driver stores nothing in the servos.
    """

    Options: ClassVar[type[FeetechOptions]] = FeetechOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(FeetechOptions, spec)
        self.connection: Connection[ServoCycle] = Connection(spec)
        self._family = FAMILIES[self.options.family]
        self._joints = Joints(spec, self.options)
        measures = {"position", "velocity", "temperature"}
        if self._family.has_current:
            measures.add("current")
        self.capabilities = Capabilities(
            measures=frozenset(measures),
            accepts=frozenset({"position", "max_velocity"}),
            recoverable=True,
            gains=tuple(GAINS),
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and find every servo; writes nothing."""
        options = self.options
        cycle = await self.connection.open(
            self.buses.serial(
                options.port,
                owner=self.connection.owner,
                baudrate=options.baudrate,
                # A reply does not identify its request, so a late one could be taken for the next.
                fresh=True,
                emulator=emulator_of(self.spec, "feetech"),
            ),
            self._talk,
        )
        with cycle.link.unhurried():
            await cycle.find()
        if options.calibration is not None:
            zeros = zeros_of(options.calibration, self.spec.name, cycle.calibrated())
            for scale, zero in zip(cycle.scales, zeros, strict=True):
                scale.zero = zero
            cycle.use_scales()
        self._describe(cycle)

    def _talk(self, bus: SerialBus) -> ServoCycle:
        options = self.options
        link = FeetechLink(bus, self._family, options.deadline, options.retries)
        link.turnaround = options.turnaround
        return ServoCycle(self.spec, options, self._joints, link)

    def _describe(self, cycle: ServoCycle) -> None:
        """Refine the capabilities according to the servos found."""
        link = cycle.link
        models = Counter(model_name(servo.model) for servo in cycle.found.values())
        measures = set(self.capabilities.measures)
        if all(math.isfinite(scale.torque_unit) for scale in cycle.scales):
            measures.add("effort")
        accepts, refuses = {"position", "max_velocity"}, {}
        if cycle.limits_effort:
            accepts.add("max_effort")
        else:
            refuses["max_effort"] = _REFUSES[cycle.family.limits_torque]
        n, size = len(cycle.ids), cycle.family.state
        reading = link.read_time(size, n) if cycle.together else n * link.read_time(size)
        self.capabilities = replace(
            self.capabilities,
            measures=frozenset(measures),
            accepts=frozenset(accepts),
            refuses=refuses,
            best_rate=1.0 / (reading + link.write_time(cycle.written, n)),
            identity={
                "model": ", ".join(f"{count} x {name}" for name, count in models.items()),
                "firmware": ", ".join(sorted({s.firmware for s in cycle.found.values()})),
                "read": "all at once" if cycle.together else "one by one",
            },
        )

    async def activate(self) -> None:
        """Set up the servos without torque and power them at their positions."""
        cycle = self.connection.link
        with cycle.link.unhurried():
            await cycle.power()

    async def examine(self) -> str:
        """Raise the fault that the servos report, or an error of their positions."""
        cycle = self.connection.link
        with cycle.link.unhurried():
            cycle.check(await cycle.states())
        return ""

    async def deactivate(self) -> None:
        """Disable the torque."""
        if self.connection.is_open:
            cycle = self.connection.link
            cycle.active = False
            with cycle.link.unhurried():
                await cycle.link.set_all(table.TORQUE, dict.fromkeys(cycle.ids, 0))

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the servos' measurements."""
        return await self.connection.link.sense()

    async def move(self, reference: Reference) -> None:
        """Set positions, speeds and torque limits of the servos that a reference commands."""
        await self.connection.link.move(reference)

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Write gains of the position controllers of all servos without storing them."""
        cycle = self.connection.link
        for name, value in gains.items():
            register = GAINS[name]
            data = cycle.family.pack(register, min(max(round(value), 0), _MOST_GAIN))
            await cycle.link.write_all(register.address, dict.fromkeys(cycle.ids, data))

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """Hold the measured posture; servos without torque stay without."""
        with contextlib.suppress(RteeError, OSError):
            cycle = self.connection.link
            # The new goals end every grip, so no actuator is left alone any more.
            cycle.attached.begin()
            with cycle.link.unhurried():
                powered = cycle.ids
                if not cycle.active:
                    # A goal would enable the torque of some servos.
                    torque = {n: await cycle.link.value(n, table.TORQUE) for n in cycle.ids}
                    powered = [n for n, value in torque.items() if value == POWERED]
                await patiently(partial(cycle.hold, powered, self.standstill.instead))

    async def disable(self) -> None:
        """Disable the torque; the fingers go limp."""
        with contextlib.suppress(RteeError, OSError):
            await patiently(self.deactivate)

    async def recover(self) -> None:
        """Disable the torque of servos with a fault, which ends an overload.

        The same goes for servos that have restarted, since only servos without torque are set up.
        `activate` powers them again.
        """
        cycle = self.connection.link
        # From here on, missing torque is no fault.
        cycle.active = False
        with cycle.link.unhurried():
            states = await cycle.states()
            hurt = {n for n, state in zip(cycle.ids, states, strict=True) if state.status}
            hurt.update(await cycle.restarted())
            if hurt:
                await cycle.link.set_all(table.TORQUE, dict.fromkeys(hurt, 0))
            cycle.refuse(await cycle.states())

    # --- calibration -------------------------------------------------------------------------

    async def take_zeros(self, rest: FloatArray) -> list[Calibrated]:
        """Set the zeros so that the present positions are a posture [rad]; raises `BusError`."""
        cycle = self.connection.link
        with cycle.link.unhurried():
            cycle.set_zeros(await patiently(cycle.states), rest)
        return cycle.calibrated()
