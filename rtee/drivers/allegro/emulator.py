"""Emulates an Allegro Hand on a CAN bus: sixteen torque-controlled joints that send positions.

How a real hand behaves when it receives no more torques is not known; here a property sets it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.parser import CodecError
from rtee.drivers.allegro import codec
from rtee.drivers.axis import VirtualObject
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Duration, Positive
from rtee.hand.validation import Section

_STEP = 0.0005
"""Longest integration step [s]: a joint against an object oscillates with a period of 30 ms."""

_MOST_STEPS = 400
"""Largest number of steps at once; a longer pause is integrated in longer steps, so that it does
not delay the bus."""

_STRONG = 0.7
"""Torque at which the vendor's programs clamp the flexing joints, about [N·m]."""
_FAULTS = {
    "over_temperature": codec.Status.OVER_TEMPERATURE,
    "communication": codec.Status.COMMUNICATION,
}
_SERIALS = {
    (4, False): "SAH040AR",
    (4, True): "SAH040AL",
    (5, False): "V5AR0001",
    (5, True): "V5AL0001",
}
"""Serial numbers by version and side (left or not). They contain the side and, in version 5, the
type, where the vendor's program looks for them."""
_RING = 2
"""The finger that sends no positions with the fault ``silent_finger``."""
_CLOSED = 1.6
"""Angle of the flexing joints of a closed finger [rad], for placing objects."""
_HOT = 90.0
"""Temperature at which the hand switches off [°C]; no source gives it."""


class AllegroProperties(Section, frozen=True):
    """Properties of the emulated hand.

    Attributes:
        hand: Its number on the bus, 0 to 3.
        version: 4 or 5.
        left: Whether it is a left hand.
        torque_timeout: Time for which a torque is applied [s]; 0: until the next one.
        inertia: Inertia of a joint [kg·m²].
        damping: Damping of a joint [N·m·s/rad].
        friction: Friction of a joint [N·m].
        start: Angle of all joints at power-up [rad].
    """

    hand: int = 0
    version: Literal[4, 5] = 4
    left: bool = False
    torque_timeout: Duration = 0.0
    inertia: Positive = 5e-4
    damping: float = 0.02
    friction: float = 0.005
    start: float = 0.4


@dataclass(slots=True)
class _Joint:
    """A joint driven by torque: inertia, damping, friction, stops, an object."""

    angle: float
    lower: float
    upper: float
    velocity: float = 0.0
    torque: float = 0.0
    obstacle: VirtualObject | None = None

    @property
    def position(self) -> float:
        return self.angle

    def advance(self, dt: float, made: AllegroProperties) -> None:
        push = self.torque - made.damping * self.velocity
        obstacle = self.obstacle
        if obstacle is not None:
            depth = (self.angle - obstacle.contact) * obstacle.closing
            if depth > 0.0:
                push -= obstacle.closing * (depth * obstacle.stiffness) + 0.05 * self.velocity
        drag = made.friction
        if self.velocity == 0.0 and abs(push) <= drag:
            return
        direction = self.velocity if self.velocity else push
        push -= math.copysign(drag, direction)
        velocity = self.velocity + dt * push / made.inertia
        # Friction stops a joint but never drives it in the opposite direction.
        if self.velocity and velocity * self.velocity < 0.0 and abs(push) <= 2.0 * drag:
            velocity = 0.0
        self.velocity = velocity
        # By the new velocity (semi-implicit Euler), so that a contact's oscillation stays bounded.
        angle = self.angle + dt * velocity
        if not self.lower <= angle <= self.upper:
            angle = min(max(angle, self.lower), self.upper)
            self.velocity = 0.0
        self.angle = angle


class AllegroEmulator(Emulator, Grasps):
    """The hand.

    Attributes:
        joints: Its joints, in the order of the wire.
        periods: Periods at which it sends data unasked.
        servo: Whether its motors are on.
        temperature: Temperature [°C].
        frames: Number of frames received, by command.
    """

    PROPERTIES = AllegroProperties
    SHARED = ("hand", "version")
    FAULTS = Emulator.FAULTS | frozenset(_FAULTS) | {"silent", "silent_finger"}
    period = 0.0005

    def __init__(self, properties: AllegroProperties | None = None) -> None:
        super().__init__()
        self.properties = made = properties or AllegroProperties()
        self.scale = codec.SCALES[made.version]
        self.joints = [_Joint(made.start, -0.8, 2.2) for _ in range(codec.JOINTS)]
        self.frames: dict[int, int] = {}
        self.temperature = 30.0
        self.power_cycle(0.0)

    def power_cycle(self, now: float) -> None:
        """Restart with the motors off, silent until a request."""
        self.periods = codec.Periods()
        self._fault = codec.Status(0)
        self._next = now
        self._torque_at = now
        self._off()

    def inject(self, fault: str) -> None:
        """Inject a fault; over-temperature and communication faults switch the motors off."""
        super().inject(fault)
        if fault in _FAULTS:
            self._fail(_FAULTS[fault])

    def _fail(self, fault: codec.Status) -> None:
        self._fault |= fault
        self._off()

    def _off(self) -> None:
        self.servo = False
        for joint in self.joints:
            joint.torque = 0.0

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions: all joints but the first of each finger, which spreads it."""
        return [
            Closing(joint, 0.0, _CLOSED, _STRONG)
            for number, joint in enumerate(self.joints)
            if number % (codec.JOINTS // codec.FINGERS)
        ]

    # --- time --------------------------------------------------------------------------------

    def step(self, now: float) -> list[CanFrame]:
        """Let time pass; return the positions when they are due."""
        self._advance(now)
        if not self.periods.joints or now < self._next or "silent" in self.faults:
            return []
        period = self.periods.joints / 1000.0
        # Counted from the last due time, to keep the rate; a pause causes no burst of old frames.
        self._next = max(self._next + period, now)
        silent = _RING if "silent_finger" in self.faults else None
        return [self._pose(finger) for finger in range(codec.FINGERS) if finger != silent]

    def _advance(self, now: float) -> None:
        dt = self._elapsed(now)
        timeout = self.properties.torque_timeout
        if timeout and now - self._torque_at > timeout:
            for joint in self.joints:
                joint.torque = 0.0
        steps = min(max(1, math.ceil(dt / _STEP)), _MOST_STEPS) if dt else 0
        if "stuck" not in self.faults:
            for _ in range(steps):
                for joint in self.joints:
                    joint.advance(dt / steps, self.properties)
        load = max(abs(j.torque) for j in self.joints)
        self.temperature += dt * (8.0 * load - 0.02 * (self.temperature - 30.0))
        if self.temperature > _HOT:
            self._fail(codec.Status.OVER_TEMPERATURE)

    def _pose(self, finger: int) -> CanFrame:
        first = finger * codec.PER_FINGER
        counts = [
            self.scale.to_count(j.angle) for j in self.joints[first : first + codec.PER_FINGER]
        ]
        return self._frame(codec.Command.FINGER_POSE + finger, codec.pack_counts(counts))

    def _frame(self, command: int, data: bytes) -> CanFrame:
        return CanFrame(codec.identifier(command, self.properties.hand), data)

    # --- frames ------------------------------------------------------------------------------

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        """Receive a frame from the bus and return the answer, if any."""
        self._advance(now)
        command, hand = codec.split(frame.id)
        if frame.extended or hand != self.properties.hand or "silent" in self.faults:
            return []
        self.frames[command] = self.frames.get(command, 0) + 1
        if frame.remote:
            return self._report(command)
        try:
            self._obey(command, frame.data, now)
        except CodecError:
            return []
        return []

    def _report(self, command: int) -> list[CanFrame]:
        made = self.properties
        if command == codec.Command.HAND_INFO:
            status = self._fault | (codec.Status.SERVO_ON if self.servo else codec.Status(0))
            version = 9 if "wrong_device" in self.faults else made.version
            info = codec.HandInfo(
                version << 8, 0x0201, int(made.left), min(round(self.temperature), 255), status
            )
            return [self._frame(command, info.to_bytes())]
        if command == codec.Command.SERIAL:
            serial = _SERIALS[made.version, made.left]
            return [self._frame(command, serial.encode("ascii", "replace").ljust(8)[:8])]
        finger = command - codec.Command.FINGER_POSE
        return [self._pose(finger)] if 0 <= finger < codec.FINGERS else []

    def _obey(self, command: int, data: bytes, now: float) -> None:
        finger = command - codec.Command.SET_TORQUE
        if command == codec.Command.SYSTEM_ON:
            # A fault comes back at once as long as its cause is present.
            self._fault = codec.Status(
                sum(bit for fault, bit in _FAULTS.items() if fault in self.faults)
            )
            self.servo = not self._fault
        elif command == codec.Command.SYSTEM_OFF:
            self._off()
        elif command == codec.Command.SET_PERIOD:
            self.periods = codec.Periods.from_bytes(data)
            self._next = now
        elif 0 <= finger < codec.FINGERS and self.servo:
            self._torque_at = now
            first = finger * codec.PER_FINGER
            for offset, count in enumerate(codec.read_counts(data)):
                limit = codec.LIMITS_PWM[first + offset]
                pwm = min(max(count, -limit), limit)
                self.joints[first + offset].torque = pwm / self.scale.pwm_per_torque
