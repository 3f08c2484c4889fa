"""Drives a Robotiq two-finger gripper over Modbus."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, structs

from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import GripForce
from rtee.drivers.deadlines import time_limit
from rtee.drivers.json_files import read_calibration_file, write_json
from rtee.drivers.register_blocks import PATIENT
from rtee.drivers.robotiq_2f.codec import FAULTS, MODELS, Command, Grasp, Status
from rtee.drivers.robotiq_common import INPUT, OUTPUT, SAME, RobotiqOptions, SteadyContact
from rtee.drivers.robotiq_driver import RobotiqDriver
from rtee.drivers.scale import FingerScale
from rtee.drivers.wiring import only_actuator
from rtee.errors import BusError, CalibrationError, ConfigError
from rtee.hand.validation import Misfit, Section
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

_MORE = 6
"""Number of registers that published programs read from a two-finger gripper."""

_WIDEST = 1.5
"""Farthest closed position, in ranges of the URDF: models round their limits, and some leave a gap;
a value in degrees or millimetres is far beyond."""

_LEAST_RANGE = 100
"""Smallest plausible travel [counts]; a gripper that moves freely has about 227."""


class Robotiq2FOptions(RobotiqOptions, frozen=True):
    """Options of a Robotiq two-finger gripper."""

    unit: Annotated[int, Meta(ge=1, le=247)] = 9
    """Modbus number of the gripper."""
    model: Literal["2f_85", "2f_140", "hand_e", "hand_e_c10"] = "2f_85"
    open_count: Annotated[int, Meta(ge=0, le=254)] = 3
    """Measured position when fully open."""
    closed_count: Annotated[int, Meta(ge=1, le=255)] = 230
    """Measured position when fully closed."""
    calibration: Path | None = None
    """File of a calibration (``rtee calibrate``); its counts replace these."""
    closed_position: float | None = None
    """Actuator's position when fully closed; by default its upper limit."""
    register_base: int | None = None
    """First register of both blocks, 0 for the old universal controller."""
    function: Literal[3, 4] | None = None
    """Modbus function to read with; by default 3, or 4 with ``register_base``."""

    def __post_init__(self) -> None:
        """Check that counts rise while the gripper closes, as its manual says."""
        if self.closed_count <= self.open_count:
            raise Misfit(
                f"{self.closed_count} should be above 'open_count', {self.open_count}: counts rise "
                "while it closes",
                "closed_count",
            )


class EndStops(Section, frozen=True):
    """The measured end stops of a gripper, which model and unit identify: it has no serial number.

    Attributes:
        model: The model it was made with.
        unit: The gripper's Modbus number.
        open_count: gPO when fully open.
        closed_count: gPO when fully closed.
    """

    model: str
    unit: int
    open_count: int
    closed_count: int

    def __str__(self) -> str:
        return f"open at {self.open_count}, closed at {self.closed_count} counts"


class Robotiq2FDriver(RobotiqDriver[Status, Command]):
    """A 2F-85, 2F-140 or Hand-E.

    A gripper that holds an object keeps its grip as long as the reference is the measured position.
    """

    Options = Robotiq2FOptions
    options: Robotiq2FOptions
    MODEL = "Robotiq 2-finger gripper"
    STATUS = Status
    COMMAND = Command
    FAULTS = FAULTS
    HINT = (
        "`rtee recover`, or `rtee run --home`, activates it: the fingers close and open once, so "
        "nothing may be between them"
    )

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        only_actuator(spec, "a two-finger gripper")
        self._check_closed(self.options.closed_position)
        self._grip = SteadyContact()
        # No echo has this value, so the first one counts as that of a new request.
        self._requested = -1
        self.scale = self._scaled(self.options.open_count, self.options.closed_count)

    def _check_closed(self, position: float | None) -> None:
        """Check where the option says that the gripper is closed [rad | m], which scales all."""
        actuator = self.spec.actuators[0]
        ends = self.spec.mechanism(actuator)
        most = ends.lower + _WIDEST * (ends.upper - ends.lower)
        if position is not None and not ends.lower < position <= most:
            raise ConfigError(
                f"device '{self.spec.name}': 'closed_position' is {position:g}, but "
                f"'{actuator.name}' is open at {ends.lower:g} and closes to {ends.upper:g} "
                "in the URDF [rad | m]",
                key=f"devices.{self.spec.name}.options.closed_position",
            )

    def _scaled(self, open_count: int, closed_count: int) -> FingerScale:
        ends, closed = self.spec.mechanism(self.spec.actuators[0]), self.options.closed_position
        return MODELS[self.options.model].scale(
            ends.lower,
            ends.upper if closed is None else closed,
            open_count,
            closed_count,
        )

    async def configure(self) -> None:
        """Read the calibration, open the line and check that a two-finger gripper answers."""
        options = self.options
        if options.calibration is not None:
            stops = read_calibration_file(
                options.calibration,
                self.spec.name,
                EndStops,
                model=options.model,
                unit=options.unit,
            )
            self._checked(stops)
            self.scale = self._scaled(stops.open_count, stops.closed_count)
        await super().configure()
        weak, strong = MODELS[self.options.model].force
        grip = GripForce(self.scale.effort.si, (weak,), (strong,))
        self.refine(grip={self.spec.actuators[0].name: grip})

    async def _identify(self) -> None:
        await super()._identify()
        if self.options.register_base is not None or not self.options.check_fingers:
            return
        # Inactive grippers of two and three fingers differ only in the registers that follow, where
        # the 3-Finger reports the positions of its second and third finger.
        bus, options = self.link.bus, self.options
        try:
            block = await bus.read(
                options.unit, INPUT, _MORE, deadline=PATIENT, function=self._places()[2]
            )
        except BusError:
            return  # it has no further registers
        second, third = block[3] & 0xFF, block[5] >> 8
        if second and third:
            raise self.stranger(
                f"a {self.MODEL}",
                "one with more motors",
                hint="for a 3-Finger gripper set 'driver: robotiq_3f'; if it has two fingers, "
                "'check_fingers: false'",
            )

    def _places(self) -> tuple[int, int, int]:
        base = self.options.register_base
        places = (OUTPUT, INPUT) if base is None else (base, base)
        # With one common base, function 3 reads written values and function 4 measured ones.
        return *places, self.options.function or (3 if base is None else 4)

    def _gap(self) -> float | None:
        return MODELS[self.options.model].gap

    def _identity(self) -> Mapping[str, str]:
        model = MODELS[self.options.model].name
        return {"model": model, "address": f"unit {self.options.unit}"}

    # --- every cycle -------------------------------------------------------------------------

    def _measured(self, status: Status, stamp: float) -> ActuatorState:
        warnings = self._warnings(status)
        if status.controller_fault:
            text = f"the optional controller reports fault {status.controller_fault}"
            warnings = (*warnings, text)
        return ActuatorState.measured(
            [self.scale.position.to_si(status.position)],
            stamp,
            current=[status.current],
            grasped=(self._grasped(status),),
            warnings=warnings,
        )

    def _grasped(self, status: Status) -> bool:
        """Return whether something is held, judged by gOBJ and by the position.

        Contact is not reported for thin objects: then the fingers stop short of a request that they
        could have reached. Right after a new request, gOBJ may still be that of the previous one.
        """
        before, self._requested = self._requested, status.requested
        opened, closed = self.scale.position.raw
        contact = False
        if status.going:
            if status.grasp is Grasp.CONTACT_CLOSING:
                # One count short of the end stop: against the stop itself contact is reported too.
                contact = status.position < closed - 1
            elif status.grasp is Grasp.CONTACT_OPENING:
                contact = status.position > opened + 1
        moving = status.going and status.grasp is Grasp.MOVING
        if self._grip.steady(contact, moving, status.position, status.requested):
            return True
        reachable = min(max(status.requested, opened), closed)
        short = reachable - status.position > 2 * SAME and before == status.requested
        return status.going and status.grasp is Grasp.AT_REQUEST and short

    def _registers_for(self, reference: Reference) -> Sequence[int] | None:
        if not reference.mask[0]:
            return None
        status = self._status
        command = Command(
            activate=True,
            go=True,
            position=self.scale.position.to_count(float(reference.position[0])),
            speed=self.scale.velocity.to_count(float(reference.max_velocity[0])),
            force=self.scale.effort.to_count(float(reference.max_effort[0])),
        )
        if abs(command.position - status.position) <= SAME:
            if self._sent is None:
                return None
            # The request beyond the object presses on it; the measured position would release it.
            if _holds(status):
                command = replace(command, position=self._sent.position)
        self._sent = command
        return command.to_registers()

    def _stopping(self) -> Sequence[int]:
        status, sent = self._status, self._sent
        return Command(
            activate=status.activated,
            position=status.requested,
            speed=sent.speed if sent else 255,
            force=sent.force if sent else 255,
        ).to_registers()

    # --- calibration -------------------------------------------------------------------------

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> EndStops:
        """Close and open the gripper fully, gently, and store the counts at its end stops.

        Arguments and errors as for `Calibrates.calibrate`; the rest posture is not needed.
        """
        await ready("Take everything out of the gripper's reach: it will close and open fully.")
        # The motions below are not part of a cycle.
        self.link.deadline = PATIENT
        self._home_asked = True
        await self.activate()
        # Closed first, so that the gripper ends open.
        closed = await self._end_stop(255)
        opened = await self._end_stop(0)
        stops = self._checked(EndStops(self.options.model, self.options.unit, opened, closed))
        write_json(path, structs.asdict(stops))
        return stops

    async def _end_stop(self, request: int) -> int:
        """Move to an end slowly and with little force; return the count where it stops."""
        # A quarter of the speed range and the least force: gentle on whatever is in the way.
        command = Command(activate=True, go=True, position=request, speed=64, force=0)

        def arrived(status: Status) -> bool:
            # Right after the write, the status may still be that of the previous request.
            there = status.requested == request and status.going
            return there and status.grasp is not Grasp.MOVING

        def blocked() -> CalibrationError:
            return CalibrationError(self.spec.name, "the fingers did not reach an end stop")

        async with time_limit(self.options.activation_timeout, blocked):
            await self._write(command.to_registers())
            await self._until(arrived)
        return self._status.position

    def _checked(self, stops: EndStops) -> EndStops:
        """Return a calibration; raises `CalibrationError` if its travel is implausibly short."""
        travel = stops.closed_count - stops.open_count
        if travel < _LEAST_RANGE:
            raise CalibrationError(
                self.spec.name,
                f"the gripper moved {travel} counts between open and closed instead of at least "
                f"{_LEAST_RANGE}; is something between the fingers?",
            )
        return stops


def _holds(status: Status) -> bool:
    return status.going and status.grasp in (Grasp.CONTACT_CLOSING, Grasp.CONTACT_OPENING)
