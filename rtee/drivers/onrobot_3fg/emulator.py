"""Emulates an OnRobot 3FG on the wire: its registers through the Compute Box or RTU.

Undocumented behaviour is a property here: the speed, the time to build up the force, and whether a
move is accepted while the gripper is busy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from rtee.buses.modbus_slave import ILLEGAL_VALUE, Refused
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing
from rtee.drivers.onrobot_3fg.codec import Control, Fingers, GripType, Status
from rtee.drivers.onrobot_common import PRODUCT
from rtee.drivers.onrobot_emulator import IDENTITY, OnRobotEmulator, OnRobotProperties, identity
from rtee.drivers.options import Duration, Positive

_SETTINGS = 0x0401
"""First register of the fingers' settings; the targets begin at 0."""
_APPROACH_FORCE = 50.0
"""Force before the contact [N]; the connectivity guide says about 50."""
_FLEXIBLE_FORCE = 140.0
"""Greatest force of a flexible grip [N]; connectivity guide, register 3."""


class OnRobot3FGProperties(OnRobotProperties, frozen=True):
    """Properties of the emulated gripper in addition to those of all OnRobot grippers.

    Attributes:
        force: Largest force [N].
        smallest: Smallest raw diameter [m].
        largest: Largest raw diameter [m].
        speed: Speed of the diameter [m/s].
        busy_ignores: While busy it ignores only ``grip``, or ``all`` commands but stop.
        target: Whether a target diameter is ``raw``, between the fingertips' centres, or between
            their surfaces, the ``tips``.
        grip: Direction in which it closes on an object: ``external``, inwards, or ``internal``,
            outwards.
        position: Raw diameter at power-up [m]; by default open for such a grip.
    """

    force: Positive = 240.0
    smallest: Positive = 0.020
    largest: Positive = 0.150
    speed: Positive = 0.080
    force_time: Duration = 0.3
    busy_ignores: Literal["grip", "all"] = "grip"
    target: Literal["raw", "tips"] = "raw"
    grip: Literal["external", "internal"] = "external"
    position: float | None = None


class OnRobot3FGEmulator(OnRobotEmulator):
    """A 3FG15.

    Attributes:
        axis: Its fingers; position is the raw diameter [m], effort the force [N].
        begun: The force register when the last motion started.
    """

    PROPERTIES = OnRobot3FGProperties
    SHARED = ("unit", "baudrate", "grip")
    FAULTS = OnRobotEmulator.FAULTS | {"calibration_lost"}
    READABLE = (
        (0x0000, 0x0003),
        (0x0100, 0x0113),
        (0x0201, 0x0202),
        (0x0401, 0x0404),
        IDENTITY,
    )
    WRITABLE = ((0x0000, 0x0003), (0x0401, 0x0404))
    CONTROL = Control
    NEAR = 2e-4  # two counts of the diameter register [m], its resolution

    def __init__(self, properties: OnRobot3FGProperties | None = None) -> None:
        made = self.properties = properties or OnRobot3FGProperties()
        super().__init__(made)
        self.fingers = Fingers()
        self.axis = Axis(
            self._ends[0] if made.position is None else made.position,
            lower=made.smallest,
            upper=made.largest,
            max_velocity=made.speed,
            max_effort=_APPROACH_FORCE,
            time_constant=0.01,
            resolution=2e-5,
            rating=made.force,
            enabled=True,
        )
        self.axes = [self.axis]
        self.begun = 0
        # The factory's fingers in the registers' units: 49 mm, second hole, 6.3 mm offset.
        self._settings = [490, 0, 2, 630]
        self.power_cycle(0.0)

    def power_cycle(self, now: float) -> None:
        """Stop, and forget targets and contact; encoders are absolute and the gears hold."""
        super().power_cycle(now)
        self._control = Control.NONE
        self.axis.max_effort = _APPROACH_FORCE

    def _idle_targets(self) -> list[int]:
        return [0, round(self.axis.position * 1e4), 0, 0]

    @property
    def _ends(self) -> tuple[float, float]:
        """Raw diameters of the open and of the closed gripper [m]."""
        made = self.properties
        inwards = made.grip == "external"
        return (made.largest, made.smallest) if inwards else (made.smallest, made.largest)

    def closings(self) -> Sequence[Closing]:
        """Return the closing motion of the fingers."""
        return [Closing(self.axis, *self._ends, self.properties.force)]

    def closure_at(self, width: float) -> float:
        """Return the fraction of the travel at which the fingers meet an object's diameter [m]."""
        opened, closed = self._ends
        tips = 2.0 * self.fingers.offset * (1.0 if self.properties.grip == "external" else -1.0)
        return (width + tips - opened) / (closed - opened)

    # --- registers -------------------------------------------------------------------------------

    def _set(self, address: int, values: Sequence[int]) -> None:
        if address < _SETTINGS:
            super()._set(address, values)
            return
        start = address - _SETTINGS
        settings = [*self._settings]
        settings[start : start + len(values)] = values
        if settings[2] not in (1, 2, 3):
            raise Refused(ILLEGAL_VALUE)
        self._settings = settings
        self.fingers = Fingers(settings[0] * 1e-4, settings[2], settings[3] * 1e-5)

    def registers(self) -> Mapping[int, int]:
        """Return the values of the registers."""
        status = self.status()
        raw = status.raw_diameter * 1e-4
        known = dict(enumerate(self._targets))
        known |= {0x0100 + i: value for i, value in enumerate(status.to_registers())}
        length, _, position, offset = self._settings
        known |= {0x0105: round(self.fingers.angle(raw) * 1000), 0x010E: length}
        known |= {0x0110: position, 0x0111: offset, 0x0113: status.diameter}
        known |= {0x0201: round(self.properties.smallest * 1e4)}
        known |= {0x0202: round(self.properties.largest * 1e4)}
        known |= {0x0401 + i: value for i, value in enumerate(self._settings)}
        # Sources disagree about its product code.
        known |= identity(0x70, "3FG15-EMULATED")
        if "wrong_device" in self.faults:
            known |= {0x0110: 0, 0x0201: 0, 0x0202: 0, PRODUCT: 0x20}
        return known

    def status(self) -> Status:
        """Return the gripper's state."""
        raw = self.axis.measured
        kind = GripType(self._targets[2] & 1)
        force = abs(self.axis.effort) if self._contact else 0.0
        return Status(
            busy=self._busy,
            grip_detected=self._contact,
            force_grip=self._contact and self._built_up == 1.0,
            calibrated="calibration_lost" not in self.faults,
            raw_diameter=round(raw * 1e4),
            diameter=round(self.fingers.diameter(raw, kind) * 1e4),
            force=min(round(force / self.properties.force * 1000), 1000),
        )

    # --- behaviour -------------------------------------------------------------------------------

    def _command(self, control: Control) -> None:
        if control is Control.STOP:
            self.halt()
            self._busy = False
            self._control = control
        elif control is not Control.NONE and "calibration_lost" not in self.faults:
            grips = control in (Control.GRIP, Control.FLEXIBLE_GRIP)
            if not (self._busy and (grips or self.properties.busy_ignores == "all")):
                self._start(control)

    def _start(self, control: Control) -> None:
        self._control = control
        self._busy = True
        self._contact = False
        self._building = 0.0
        self.axis.max_effort = self._effort(0.0) if self._can_grip else _APPROACH_FORCE
        wanted = self._targets[1] * 1e-4
        if self.properties.target == "tips":
            wanted -= GripType(self._targets[2] & 1).sign * 2.0 * self.fingers.offset
        self.axis.target = min(max(wanted, self.properties.smallest), self.properties.largest)
        self.moves += 1
        self.begun = self._targets[0]

    @property
    def _can_grip(self) -> bool:
        return self._control in (Control.GRIP, Control.FLEXIBLE_GRIP)

    def _force(self) -> float:
        most = _FLEXIBLE_FORCE if self._control is Control.FLEXIBLE_GRIP else self.properties.force
        return min(self._targets[0], 1000) / 1000 * most

    def _effort(self, part: float) -> float:
        low = min(_APPROACH_FORCE, self._force())
        return low + (self._force() - low) * part
