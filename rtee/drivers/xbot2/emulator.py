"""Emulates XBot2 with some joints behind it, at the level of xbot2_zmq.

Only that level is public; the boards' protocol with XBot2 is not. References are slewed, since the
real server interpolates them. The sign of efforts is not known, so it is an option of the driver.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rtee.buses.emulator import Emulator
from rtee.buses.parser import CodecError
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Positive
from rtee.drivers.xbot2 import codec
from rtee.drivers.xbot2.codec import Command, Control, State
from rtee.hand.validation import Section


class ServerProperties(Section, frozen=True):
    """Properties of the emulated server.

    Attributes:
        joints: Names of the joints; by default as in the configuration ``dagana``.
        lower: Lower end of all joints.
        upper: Upper end of all joints.
        start: Their initial position.
        speed: Largest speed of the joints [range units/s].
        effort: Their largest effort.
        rate: Rate of the states [Hz].
    """

    joints: tuple[str, ...] = ("dagana_gripper_claw_joint",)
    lower: float = 0.0
    upper: float = 1.0
    start: float = 0.2
    speed: Positive = 2.0
    effort: Positive = 10.0
    rate: Positive = 100.0

    def __post_init__(self) -> None:
        """Check that the range of the joints is not empty."""
        if not self.lower < self.upper:
            raise ValueError(f"lower, {self.lower:g}, is not below upper, {self.upper:g}")


class XBot2Emulator(Emulator, Grasps):
    """The server.

    Attributes:
        joints: Its joints by name.
        commands: Number of commands received.
    """

    PROPERTIES = ServerProperties
    FAULTS = Emulator.FAULTS | {"silent"}

    def __init__(self, properties: ServerProperties | None = None) -> None:
        super().__init__()
        self.properties = made = properties or ServerProperties()
        self.period = 1.0 / made.rate
        self.joints = {
            name: Axis(
                made.start,
                lower=made.lower,
                upper=made.upper,
                max_velocity=made.speed,
                max_effort=made.effort,
                time_constant=0.01,
                friction=0.02 * made.effort,
                resolution=1e-4,
                enabled=True,
            )
            for name in made.joints
        }
        self.axes = list(self.joints.values())
        self.commands = 0
        self._sequence = 0

    @classmethod
    def fitting(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return properties with the joints that a device's options name, and ``ends`` as stops."""
        given = options.get("joints") or {}
        names = tuple(dict(j).get("joint") or actuator for actuator, j in given.items())
        fitting: dict[str, Any] = {"joints": names} if names else {}
        if options.get("ends"):
            fitting["lower"], fitting["upper"] = options["ends"]
        return fitting

    def power_cycle(self, now: float) -> None:
        """Restart; the joints stay where they are."""
        self._sequence = 0
        for axis in self.axes:
            axis.target = axis.position
            axis.max_effort = self.properties.effort

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the joints."""
        made = self.properties
        return [Closing(axis, made.lower, made.upper, made.effort) for axis in self.axes]

    def step(self, now: float) -> list[bytes]:
        """Let time pass; return the state that is published."""
        for axis in self.axes:
            axis.step(now)
        if "silent" in self.faults:
            return []
        self._sequence += 1
        state = State(
            self._sequence,
            tuple(self.joints),
            tuple(a.measured for a in self.axes),
            tuple(a.velocity for a in self.axes),
            tuple(a.effort for a in self.axes),
            (),
        )
        return [state.to_bytes([a.target for a in self.axes], int(now))]

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive a command."""
        try:
            command = Command.from_bytes(data)
        except CodecError:
            return []
        self.commands += 1
        for i, name in enumerate(command.names):
            axis = self.joints.get(name)
            control = command.control[i] if command.control else Control(0)
            # A command may be for a whole robot, with further joints.
            if axis is None:
                continue
            if control & Control.POSITION and command.position:
                axis.target = command.position[i]
                axis.max_effort = self.properties.effort
                if control & Control.EFFORT and command.effort:  # a limit with a position
                    axis.max_effort = min(abs(command.effort[i]), self.properties.effort)
            elif control & Control.EFFORT and command.effort:
                effort = command.effort[i]
                axis.max_effort = min(abs(effort), self.properties.effort)
                # A target far beyond the stop makes the axis push with its whole effort limit.
                axis.target = axis.position if effort == 0.0 else 1e9 * effort
        return []

    def serve(self, request: bytes, now: float) -> bytes | None:
        """Answer a request."""
        if "silent" in self.faults:
            return None
        try:
            kind = codec.read_yaml(request).get("type")
        except CodecError as error:
            return codec.answer(False, str(error))
        if kind == "joint_names":
            names = ["another_joint"] if "wrong_device" in self.faults else list(self.joints)
            return codec.answer(True, data=names)
        if kind in ("urdf", "srdf"):
            return codec.answer(True, data="")
        if kind in ("set_filter_frequency_hz", "start_plugin"):
            return codec.answer(True)
        return codec.answer(False, f"unknown request '{kind}'")
