"""Drives an OnRobot 3FG over Modbus, through the Compute Box or directly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from rtee import monotonic
from rtee.buses.modbus import ModbusBus
from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import Capabilities, GripForce
from rtee.drivers.onrobot_3fg import codec
from rtee.drivers.onrobot_common import OnRobotOptions, metres
from rtee.drivers.onrobot_driver import CONNECTING, OnRobotDriver
from rtee.drivers.options import Length
from rtee.drivers.scale import FingerScale
from rtee.errors import ConfigError
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

_SAME = 10
"""A diameter this near to the measured one asks for no motion [0.1 mm].

It is ten times the resolution, since a held object yields a little.
"""

_REACHED = 3
"""A diameter this near to the measured one counts as reached [0.1 mm]: resolution and rounding."""

_STUCK_BUSY = 0.5
"""Time busy without motion after which the gripper is stopped before the next grip [s]."""

_GRIP_POINTS = 33
"""Number of diameters at which the force is computed: interpolation between them is off by 1 %."""


class OnRobot3FGOptions(OnRobotOptions, frozen=True):
    """Options of a 3FG15 or 3FG25."""

    grip: Literal["external", "internal"] = "external"
    force: Annotated[float, Meta(gt=0, le=2000)] = 240.0
    """Largest force of the model [N]."""
    smallest: Length = 0.0346
    """Raw diameter at the actuator's upper limit [m]."""
    largest: Length | None = None
    """Raw diameter at the actuator's lower limit [m]; by default as the gripper reports it."""
    target: Literal["raw", "tips"] = "raw"
    """Meaning of the target diameter: between the fingertips' centres, or their surfaces."""


class OnRobot3FGDriver(OnRobotDriver[codec.Status]):
    """A 3FG15 or 3FG25.

    The gripper accepts no speed, and a force only with the command *grip*, which it ignores while
    it is busy. So the driver follows a changing reference with *move*. Once the reference rests and
    the gripper is free, it grips with the effort limit.
    """

    Options = OnRobot3FGOptions
    options: OnRobot3FGOptions

    MODEL = "an OnRobot 3FG"
    STATUS = codec.Status
    COMMAND = codec.Command
    SOURCE = codec.STATE

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.scale = self._scaled(self.options.largest or 0.150)
        self._fingers = codec.Fingers()
        self._kind = codec.GripType[self.options.grip.upper()]
        self._sent: codec.Command | None = None
        self._tips = 0
        self._wanted: tuple[int, int] = (0, 0)
        self._wanted_since = 0.0
        self._moved_at = 0.0
        self.capabilities = Capabilities(
            measures=frozenset({"position", "effort", "grasped"}),
            accepts=frozenset({"position", "max_effort"}),
            best_rate=self.options.rate,
            recoverable=True,
            grip=self._grip_force(),
            identity={"model": "OnRobot 3FG"},
        )

    def _scaled(self, largest: float) -> FingerScale:
        ends = self.spec.mechanism(self.spec.actuators[0])
        return codec.scale_of(
            ends.lower, ends.upper, largest, self.options.smallest, self.options.force
        )

    def _grip_force(self) -> dict[str, GripForce]:
        """Return the total force of the three fingers by diameter; see `Fingers.leverage`."""
        actuator, scale = self.spec.actuators[0], self.scale
        positions = np.linspace(actuator.lower, actuator.upper, _GRIP_POINTS)
        diameters = [metres(1) * scale.position.to_raw(q) for q in positions.tolist()]
        most = tuple(self.options.force * self._fingers.leverage(d) for d in diameters)
        # The force register counts from 0, so the weakest grip has no force anywhere.
        none = (0.0,) * _GRIP_POINTS
        force = GripForce(scale.effort.si, none, most, tuple(positions.tolist()))
        return {actuator.name: force}

    # --- life --------------------------------------------------------------------------------

    async def _described(self, bus: ModbusBus) -> dict[str, str]:
        unit = self.options.unit
        least, most = await bus.read(unit, codec.LIMITS, 2, deadline=CONNECTING)
        length, _, hole, offset = await bus.read(unit, codec.GEOMETRY, 4, deadline=CONNECTING)
        # Other tools of the vendor have other contents in these registers.
        if hole not in (1, 2, 3) or not least < most:
            raise self.stranger(
                "an OnRobot 3FG",
                f"a tool with finger position {hole} and diameters {least} to {most}",
                hint="is another tool mounted?",
            )
        self._fingers = codec.Fingers(metres(length), hole, abs(codec.offset_metres(offset)))
        if self.options.target == "tips":
            self._tips = round(self._kind.sign * 2.0 * codec.offset_metres(offset) / metres(1))
        # The scale is made again, since the gripper's largest diameter is known only now.
        self.scale = self._scaled(largest := self.options.largest or metres(most))
        if largest <= self.options.smallest:
            raise ConfigError(
                f"device '{self.spec.name}': `smallest` ({self.options.smallest} m) is not below "
                f"the largest diameter ({largest} m)",
                key=f"devices.{self.spec.name}.options.smallest",
            )
        self.refine(grip=self._grip_force())
        return {
            "finger length": f"{metres(length) * 1000:.1f} mm",
            "finger position": str(hole),
            "diameters": f"{metres(least) * 1000:.1f} to {metres(most) * 1000:.1f} mm",
        }

    # --- every cycle -------------------------------------------------------------------------

    def _measured(self, status: codec.Status, stamp: float) -> ActuatorState:
        return ActuatorState.measured(
            [self.scale.position.to_si(status.raw_diameter)],
            stamp,
            effort=[self.scale.effort.to_si(status.force)],
            grasped=(status.grip_detected,),
        )

    async def move(self, reference: Reference) -> None:
        """Follow a changing reference, and grip at a resting one."""
        if not reference.mask[0]:
            return
        command = self._next(
            self.scale.position.to_count(float(reference.position[0])),
            self.scale.effort.to_count(float(reference.max_effort[0])),
            monotonic.now(),
        )
        if command is not None:
            await self.link.exchange(self._registers(command))
            self._sent = command

    def _forget(self) -> None:
        self._sent = None

    def _next(self, diameter: int, force: int, now: float) -> codec.Command | None:
        """Return the command to send for a target [0.1 mm, 0.1 %], or ``None`` to send nothing."""
        if (diameter, force) != self._wanted:
            self._wanted, self._wanted_since = (diameter, force), now
        if self._stays(diameter):
            return None
        if self._may_grip(diameter, now):
            if self._sent == self._command(force, diameter, codec.Control.GRIP):
                return None
            if not self._status.busy:
                return self._command(force, diameter, codec.Control.GRIP)
            # An obstacle keeps the motion from ending, and a busy gripper ignores *grip*.
            if now - self._moved_at > _STUCK_BUSY:
                return self._command(force, diameter, codec.Control.STOP)
        return self._motion(diameter, force)

    def _stays(self, diameter: int) -> bool:
        """Return whether a near target asks for no motion: nothing was sent, or a grip is held."""
        near = abs(diameter - self._status.raw_diameter) <= _SAME
        return near and (self._sent is None or self._status.grip_detected)

    def _may_grip(self, diameter: int, now: float) -> bool:
        """Return whether to grip at a target: it rests, and no *move* has reached it already."""
        rests = now - self._wanted_since >= self.options.settle
        return rests and self._tightens(diameter) and (self._gripping or not self._at(diameter))

    def _motion(self, diameter: int, force: int) -> codec.Command | None:
        """Return the command that moves to a target; a grip under way is stopped first."""
        busy, asked = self._status.busy, self._sent is not None and self._sent.diameter == diameter
        if asked and (self._at(diameter) or busy or self._gripping):
            return None
        stop = self._gripping and busy
        return self._command(force, diameter, codec.Control.STOP if stop else codec.Control.MOVE)

    @property
    def _gripping(self) -> bool:
        return self._sent is not None and self._sent.control is codec.Control.GRIP

    def _at(self, diameter: int) -> bool:
        """Return whether a diameter counts as reached."""
        return abs(diameter - self._status.raw_diameter) <= _REACHED

    def _tightens(self, diameter: int) -> bool:
        """Return whether a target lies in the direction of gripping, or is reached."""
        if self._kind is codec.GripType.EXTERNAL:
            return diameter <= self._status.raw_diameter + _SAME
        return diameter >= self._status.raw_diameter - _SAME

    def _command(self, force: int, diameter: int, control: codec.Control) -> codec.Command:
        return codec.Command(force, diameter, self._kind, control)

    def _registers(self, command: codec.Command) -> Sequence[int]:
        """Return the registers to send for a command with a raw diameter."""
        wanted = max(command.diameter + self._tips, 0)
        return replace(command, diameter=wanted).to_registers()

    def _note(self, status: codec.Status) -> None:
        # A change of one count may be noise at standstill.
        if abs(status.raw_diameter - self._status.raw_diameter) > 1:
            self._moved_at = monotonic.now()
        self._status = status

    # --- stop and faults ---------------------------------------------------------------------

    def _stopping(self) -> Sequence[int]:
        status = self._status
        force = self._sent.force if self._sent else status.force
        return self._registers(self._command(force, status.raw_diameter, codec.Control.STOP))

    def _refuse(self, status: codec.Status) -> None:
        if not status.calibrated:
            # The code is the number of the bit in the status.
            hint = "restart the tool from the Compute Box's web page, then recover"
            raise self.fault(3, "calibration lost", hint)
