"""Emulates an OnRobot RG2 or RG6 on the wire: its registers through the Compute Box or RTU.

Undocumented behaviour is a property here: the time to build up the force, and whether fingertips
that meet each other count as a grip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing
from rtee.drivers.onrobot_common import PRODUCT, PRODUCTS, TARGETS, TENTH_MM, signed
from rtee.drivers.onrobot_emulator import IDENTITY, OnRobotEmulator, OnRobotProperties, identity
from rtee.drivers.onrobot_rg import codec
from rtee.drivers.options import Duration

_PUSHED_1, _PUSHED_2 = "safety_1", "safety_2"
_SAFETY_ERROR = "safety_error"
_NEAR = 1e-4
"""Error within which the force counts as built up [fraction of the largest force], and a target as
reached [rad]."""


class OnRobotRGProperties(OnRobotProperties, frozen=True):
    """Properties of the emulated gripper in addition to those of all OnRobot grippers.

    Attributes:
        model: ``rg2`` or ``rg6``.
        fingertip: Thickness of the mounted fingertips [m].
        offset: Fingertip offset in its registers at power-up [m].
        position: Width without fingertips at power-up [m]; by default open.
        empty_grip: Whether fingertips that meet each other count as a grip.
    """

    model: Literal["rg2", "rg6"] = "rg2"
    fingertip: Duration = codec.FINGERTIP
    offset: Duration = codec.FINGERTIP
    position: float | None = None
    empty_grip: bool = True


class OnRobotRGEmulator(OnRobotEmulator):
    """An RG2 or RG6.

    A safety switch that is pushed during a motion, or when a motion is commanded, stops the motion
    until the switch is released and the tool is restarted.

    Attributes:
        axis: Its links; position is their angle [rad], effort the force [N].
        begun: The force register when the last motion started.
        stopped: Number of motions ended by a stop.
    """

    PROPERTIES = OnRobotRGProperties
    SHARED = ("unit", "baudrate", "model")
    FAULTS = OnRobotEmulator.FAULTS | {_PUSHED_1, _PUSHED_2, _SAFETY_ERROR}
    READABLE = (
        (TARGETS, TARGETS + 2),
        (0x0100, 0x0117),
        (codec.SET_OFFSET, codec.SET_OFFSET),
        IDENTITY,
    )
    WRITABLE = ((TARGETS, TARGETS + 2), (codec.SET_OFFSET, codec.SET_OFFSET))
    CONTROL = codec.Control
    NEAR = _NEAR

    def __init__(self, properties: OnRobotRGProperties | None = None) -> None:
        made = self.properties = properties or OnRobotRGProperties()
        super().__init__(made)
        model = self.model = codec.MODELS[made.model]
        self._opened = model.angle(model.stroke)
        self._closed = model.angle(2.0 * made.fingertip)
        self.axis = Axis(
            self._opened if made.position is None else model.angle(made.position),
            lower=self._closed,
            upper=self._opened,
            max_velocity=model.speed,
            max_effort=0.0,
            time_constant=0.01,  # short compared with a motion
            resolution=1e-4,
            rating=model.force,
            enabled=True,
            self_locking=True,  # the worm gear keeps the fingers where they are
        )
        self.axes = [self.axis]
        self.begun = 0
        self.stopped = 0
        self._offset = round(made.offset / TENTH_MM)
        self._triggered = [False, False]
        self._error = False
        self.power_cycle(0.0)

    def power_cycle(self, now: float) -> None:
        """Stop, forget targets and safety stops; the encoder is absolute and the gear holds."""
        super().power_cycle(now)
        self._triggered = [False, False]
        self._error = any(self._pushed)

    def _idle_targets(self) -> list[int]:
        return [0, round(self._width * 1e4), 0]

    @property
    def _width(self) -> float:
        """Width without fingertips [m]."""
        return self.model.width(self.axis.measured)

    @property
    def _pushed(self) -> tuple[bool, bool]:
        return _PUSHED_1 in self.faults, _PUSHED_2 in self.faults

    def closings(self) -> Sequence[Closing]:
        """Return the closing motion of the fingers."""
        return [Closing(self.axis, self._opened, self._closed, self.model.force)]

    def closure_at(self, width: float) -> float:
        """Return the fraction of the travel at which the fingers meet an object's width [m]."""
        reach = self.model.stroke - 2.0 * self.properties.fingertip
        if width > reach:
            # Outside 0 to 1, so the caller refuses the object.
            return -1.0
        angle = self.model.angle(width + 2.0 * self.properties.fingertip)
        return (angle - self._opened) / (self._closed - self._opened)

    def on_faults(self) -> None:
        """Push the safety switches and block the motor, according to the faults."""
        super().on_faults()
        for i, pushed in enumerate(self._pushed):
            if not pushed:
                # Clearing the fault means that the switch is released and the tool restarted.
                self._triggered[i] = False
            elif self._busy:
                self._trip(i)
        # An error found at power-up stays while the switch is pushed.
        self._error = _SAFETY_ERROR in self.faults or (self._error and any(self._pushed))

    def _trip(self, switch: int) -> None:
        self._triggered[switch] = True
        self._busy = False
        self.halt()

    # --- registers -------------------------------------------------------------------------------

    def _set(self, address: int, values: Sequence[int]) -> None:
        if address == codec.SET_OFFSET:
            self._offset = signed(values[0])
        else:
            super()._set(address, values)

    def registers(self) -> Mapping[int, int]:
        """Return the values of the registers."""
        status = self.status()
        known = {TARGETS + i: value for i, value in enumerate(self._targets)}
        known |= {codec.OFFSET: self._offset, codec.SET_OFFSET: self._offset}
        known |= {codec.STATE + i: value for i, value in enumerate(status.to_registers())}
        known |= {codec.TIPS_WIDTH: status.width - 2 * self._offset}
        codes = {name: code for code, name in PRODUCTS.items()}
        known |= identity(codes[self.model.name], "RG-EMULATED")
        if "wrong_device" in self.faults:
            known |= {PRODUCT: codes["2FG7"]}
        return known

    def status(self) -> codec.Status:
        """Return the gripper's state."""
        return codec.Status(
            width=round(self._width * 1e4),
            busy=self._busy,
            grip_detected=self._contact,
            pushed=self._pushed,
            triggered=(self._triggered[0], self._triggered[1]),
            safety_error=self._error,
        )

    # --- behaviour -------------------------------------------------------------------------------

    def _command(self, control: codec.Control) -> None:
        if control is codec.Control.STOP:
            self.stopped += self._busy
            self._busy = False
            self.halt()
        elif control is not codec.Control.NONE and not (self._busy or self._locked()):
            tips = 2 * self._offset if control is codec.Control.GRIP_WITH_OFFSET else 0
            self._start((self._targets[1] + tips) * TENTH_MM)

    def _locked(self) -> bool:
        """Return whether a safety switch prevents motion; one that is pushed now trips."""
        for i, pushed in enumerate(self._pushed):
            if pushed:
                self._trip(i)
        return any(self._triggered) or self._error

    def _start(self, width: float) -> None:
        """Begin to grip to a width without fingertips [m]."""
        self._busy = True
        self._contact = False
        self._building = 0.0
        # Almost no force until the contact; the gripper builds it up afterwards.
        self.axis.max_effort = self._effort(0.0)
        angle = self.model.angle(min(max(width, 0.0), self.model.stroke))
        self.axis.target = min(max(angle, 0.0), self._opened)
        self.moves += 1
        self.begun = self._targets[0]

    def _force(self) -> float:
        """Return the target force, limited to the model's [N]."""
        return min(self._targets[0] / 10.0, self.model.force)

    @property
    def _can_grip(self) -> bool:
        meet = math.isclose(self.axis.position, self._closed, abs_tol=_NEAR)
        return not meet or self.properties.empty_grip

    def _effort(self, part: float) -> float:
        return self._force() * max(part, _NEAR)
