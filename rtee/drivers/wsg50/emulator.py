"""Emulates a WSG 50 on the wire.

Behaviour that no document states is a property here: how far beyond a part's width a grasp searches
for the part, the time to build up the force, and whether a connection that ends unannounced is an
error.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence

from rtee.buses.emulator import Emulator
from rtee.buses.parser import CodecError
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Duration, Positive
from rtee.drivers.wsg50.codec import (
    MOTIONS,
    Command,
    Frame,
    FrameParser,
    Grasping,
    Info,
    Limits,
    State,
    Status,
    answer,
    numbers,
)
from rtee.hand.validation import Section

_HOMING_SPEED = 50.0
"""Speed of homing [mm/s]; no document states it."""
_NUMBER = 4
"""Bytes of a number; every command with numbers has at least one."""
_NEAR = 0.02
"""Distance below which a target counts as reached [mm]."""
_AUTO = frozenset(
    {
        Command.STATE,
        Command.GRASPING,
        Command.WIDTH,
        Command.SPEED,
        Command.FORCE,
        Command.TEMPERATURE,
    }
)
_ERRORS: Mapping[str, State] = {
    "fast_stop": State.FAST_STOP,
    "temperature": State.TEMPERATURE_ERROR,
    "power": State.POWER_ERROR,
    "current": State.CURRENT_ERROR,
    "finger": State.FINGER_ERROR,
}


class Wsg50Properties(Section, frozen=True):
    """Properties of the emulated gripper.

    Attributes:
        referenced: Whether it is homed at power-up, as after an earlier connection.
        position: Width at power-up [mm].
        clamping: How far beyond a part's width a grasp searches for the part [mm].
        force_time: Time to build up the force after the contact [s].
        error_on_disconnect: Whether a connection that ends unannounced causes a fast stop.
        haste: Factor by which it moves faster than the real one.
    """

    referenced: bool = False
    position: float = 80.0
    clamping: Duration = 5.0
    force_time: Duration = 0.1
    error_on_disconnect: bool = False
    haste: Positive = 1.0


class Wsg50Emulator(Emulator, Grasps):
    """A WSG 50.

    Attributes:
        axis: Its fingers; position is the width [mm], effort the force [N].
        moves: Number of motions started.
        begun: The force limit when the last motion started [N].
        homings: Number of completed homings.
        requests: Frames received that ask for no measurement, newest last, for tests.
    """

    PROPERTIES = Wsg50Properties
    FAULTS = Emulator.FAULTS | frozenset(_ERRORS)
    SCHEME = "socket"
    parser: FrameParser
    period = 0.005

    def __init__(self, properties: Wsg50Properties | None = None) -> None:
        super().__init__()
        made = self.properties = properties or Wsg50Properties()
        self.limits = Limits()
        self.axis = Axis(
            made.position,
            lower=0.0,
            upper=self.limits.stroke,
            max_effort=self.limits.force[1],
            time_constant=0.01,
            resolution=_NEAR / 2,
            enabled=True,
            self_locking=True,
        )
        self.axes = [self.axis]
        self.moves = 0
        self.homings = 0
        self.begun = 0.0
        self.requests: list[Frame] = []
        self.parser = FrameParser()
        self._announced = True
        self._latched = False
        self._auto: dict[int, list[float]] = {}
        self._aborted: list[Frame] = []
        self._running: int | None = None
        self._start(made.referenced)

    def _start(self, referenced: bool) -> None:
        self._referenced = referenced
        self._running = None
        self._grasping = Grasping.IDLE
        self._blocked = State(0)
        self._reached = False
        self._stop_on_block = False
        self._building = 0.0
        self._latched = False
        self._settings = {
            Command.SET_ACCELERATION: (1000.0,),
            Command.SET_FORCE: (self.limits.force[1],),
            Command.SET_SOFT_LIMITS: (0.0, self.limits.stroke),
        }
        self._auto.clear()
        self.halt()

    def power_cycle(self, now: float) -> None:
        """Lose the reference and the settings; the spindle keeps the fingers where they are."""
        self.line_reset()
        self._start(False)

    def line_reset(self) -> None:
        """Forget an incomplete request; a connection that ends unannounced may be an error.

        Periodic answers end with the connection.
        """
        super().line_reset()
        self._auto.clear()
        if self.properties.error_on_disconnect and not self._announced:
            self._fast_stop()
        self._announced = True

    def on_faults(self) -> None:
        """Apply the faults: a stuck motor is blocked, and an error stops the gripper."""
        super().on_faults()
        if any(fault in self.faults for fault in _ERRORS):
            self._fast_stop(latch="fast_stop" in self.faults)

    def _fast_stop(self, *, latch: bool = True) -> None:
        self._latched = self._latched or latch
        self._abort()
        self._grasping = Grasping.ERROR if self._grasping else Grasping.IDLE
        self.halt()

    # --- objects -----------------------------------------------------------------------------

    def closings(self) -> Sequence[Closing]:
        """Return the closing motion of the fingers."""
        return [Closing(self.axis, self.limits.stroke, 0.0, self.limits.force[1])]

    def closure_at(self, width: float) -> float:
        """Return the fraction of the travel at which the fingers meet a width [m]."""
        return 1.0 - 1e3 * width / self.limits.stroke

    # --- the wire ----------------------------------------------------------------------------

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive bytes and return the answers."""
        answers = self._pass(now)
        for frame in self.parser.feed(data):
            if frame.command not in _AUTO:
                # The newest 64: a run of hours must not fill the memory.
                self.requests = [*self.requests[-63:], frame]
            self._announced = False
            # A stop is answered before the result of the motion that it has ended.
            answers += [self._answer(frame, now), *self._aborted]
            self._aborted.clear()
        return [one.to_bytes() for one in answers]

    def step(self, now: float) -> list[bytes]:
        """Let time pass; return results of motions and periodic answers."""
        return [one.to_bytes() for one in self._pass(now)]

    def _answer(self, frame: Frame, now: float) -> Frame:
        if "wrong_device" in self.faults:
            return answer(frame.command, Status.UNKNOWN_COMMAND)
        try:
            command = Command(frame.command)
        except ValueError:
            return answer(frame.command, Status.UNKNOWN_COMMAND)
        try:
            if command in _AUTO:
                return self._measured(command, frame.payload, now)
            return self._done(command, frame)
        except CodecError:
            # Shorter than any number: too few parameters; any other wrong length is a wrong format.
            few = len(frame.payload) < _NUMBER
            status = Status.TOO_FEW_PARAMETERS if few else Status.FORMAT
            return answer(command, status)

    def _measured(self, command: Command, payload: bytes, now: float) -> Frame:
        if len(payload) != 3:
            raise CodecError("a request for a measurement needs three bytes")
        period = int.from_bytes(payload[1:], "little") / 1000.0
        if payload[0] & 1:
            self._auto[command] = [period, now + period]
        else:
            self._auto.pop(command, None)
        return self._value(command)

    def _value(self, command: int) -> Frame:
        values: Mapping[int, Callable[[], bytes]] = {
            Command.STATE: lambda: int(self.state()).to_bytes(4, "little"),
            Command.GRASPING: lambda: bytes([self._grasping]),
            Command.WIDTH: lambda: _floats(self.axis.measured),
            Command.SPEED: lambda: _floats(self.axis.velocity),
            Command.FORCE: lambda: _floats(abs(self.axis.effort)),
            Command.TEMPERATURE: lambda: round(10 * self.axis.temperature).to_bytes(2, "little"),
            Command.INFO: lambda: Info(2, 1, 0x4000, 1234).to_bytes(),
            Command.LIMITS: self.limits.to_bytes,
            Command.ACCELERATION: lambda: _floats(*self._settings[Command.SET_ACCELERATION]),
            Command.FORCE_LIMIT: lambda: _floats(*self._settings[Command.SET_FORCE]),
            Command.SOFT_LIMITS: lambda: _floats(*self._settings[Command.SET_SOFT_LIMITS]),
        }
        return answer(command, Status.OK, values[command]())

    def _done(self, command: Command, frame: Frame) -> Frame:
        if command in MOTIONS:
            return self._motion(command, frame)
        if command in self._settings:
            return self._set(command, frame)
        if command is Command.LOOP:
            return answer(command, Status.OK, frame.payload)
        if command is Command.ACKNOWLEDGE:
            return self._acknowledge(frame)
        if frame.payload:
            return answer(command, Status.NO_PARAMETER_EXPECTED)
        if command is Command.DISCONNECT:
            self._announced = True
        elif command is Command.STOP:
            self._stop()
        elif command is Command.FAST_STOP:
            self._fast_stop()
        elif command is Command.CLEAR_SOFT_LIMITS:
            self._settings[Command.SET_SOFT_LIMITS] = (0.0, self.limits.stroke)
        elif command is Command.TARE:
            return answer(command, Status.NOT_AVAILABLE)
        else:
            return self._value(command)
        return answer(command, Status.OK)

    def _acknowledge(self, frame: Frame) -> Frame:
        if frame.payload != b"ack":
            return answer(frame.command, Status.PARAMETER)
        # A fast stop comes back at once as long as its cause is present.
        self._latched = "fast_stop" in self.faults
        return answer(frame.command, Status.OK)

    def _set(self, command: Command, frame: Frame) -> Frame:
        wanted = numbers(Frame(command, b"\0\0" + frame.payload), len(self._settings[command]))
        ranges = {
            Command.SET_ACCELERATION: self.limits.acceleration,
            Command.SET_FORCE: (self.limits.force[0], self.limits.force[2]),
            Command.SET_SOFT_LIMITS: (0.0, self.limits.stroke),
        }
        low, high = ranges[command]
        if not all(low <= value <= high for value in wanted):
            return answer(command, Status.RANGE)
        self._settings[command] = wanted
        if command is Command.SET_FORCE and self._grasping is Grasping.HOLDING:
            self.axis.max_effort = wanted[0]
        return answer(command, Status.OK)

    # --- behaviour ---------------------------------------------------------------------------

    def state(self) -> State:
        """Return the system's state."""
        found = self._blocked
        found |= State.REFERENCED if self._referenced else State(0)
        found |= State.STOPPED if self._running is None else State.MOVING
        found |= State.REACHED if self._reached else State(0)
        found |= State.FAST_STOP if self._latched else State(0)
        found |= State.FORCE_CONTROL if self._grasping is Grasping.HOLDING else State(0)
        for fault, bit in _ERRORS.items():
            found |= bit if fault in self.faults else State(0)
        return found

    def _motion(self, command: Command, frame: Frame) -> Frame:
        if self._latched or any(fault in self.faults for fault in _ERRORS):
            return answer(command, Status.ACCESS_DENIED)
        if self._running is not None:
            return answer(command, Status.ALREADY_RUNNING)
        if command is Command.HOME:
            if len(frame.payload) != 1:
                raise CodecError("homing needs a direction")
            self._begin(command, (self.limits.stroke, _HOMING_SPEED))
            return answer(command, Status.PENDING)
        if not self._referenced:
            return answer(command, Status.NOT_REFERENCED)
        flags, payload = 0, frame.payload
        if command is Command.MOVE:
            flags, payload = int.from_bytes(payload[:1], "little"), payload[1:]
        # Read like the numbers of an answer, which follow a status of two bytes.
        width, speed = numbers(Frame(command, b"\0\0" + payload), 2)
        width += self.axis.position if flags & 1 else 0.0
        # Beyond its stroke a real gripper goes to the end instead of refusing.
        width = min(max(width, 0.0), self.limits.stroke)
        low, high = self.limits.speed
        inner, outer = self._settings[Command.SET_SOFT_LIMITS]
        if not (inner <= width <= outer and low <= speed <= high):
            return answer(command, Status.RANGE)
        self._stop_on_block = bool(flags & 2)
        self._begin(command, (width, speed))
        return answer(command, Status.PENDING)

    def _begin(self, command: Command, target: tuple[float, float]) -> None:
        width, speed = target
        self._running = command
        self._blocked, self._reached, self._building = State(0), False, 0.0
        self._grasping = {Command.GRASP: Grasping.CLOSING, Command.RELEASE: Grasping.RELEASING}.get(
            command, Grasping.IDLE
        )
        # A grasp looks for the part a little beyond its width.
        beyond = self.properties.clamping if command is Command.GRASP else 0.0
        self.axis.target = max(width - beyond, 0.0)
        self.axis.max_velocity = speed
        self.axis.max_effort = self._settings[Command.SET_FORCE][0]
        self.begun = self.axis.max_effort
        if command is Command.HOME:
            self._referenced = False
        else:
            self.moves += 1

    def _stop(self) -> None:
        if self._grasping is not Grasping.HOLDING:
            self._grasping = Grasping.IDLE
            self.halt()
        self._abort()

    def _abort(self) -> None:
        if self._running is not None:
            self._aborted.append(answer(self._running, Status.ABORTED))
        self._running = None

    def _pass(self, now: float) -> list[Frame]:
        """Let time pass; return the frames that it sends by itself."""
        dt = self._elapsed(now)
        running = self._running
        status = self._advance(dt * self.properties.haste) if dt > 0.0 else None
        sent = [] if status is None or running is None else [answer(running, status)]
        sent += self._aborted
        self._aborted.clear()
        for command, clock in self._auto.items():
            if now >= clock[1]:
                # Answers missed during a pause are not sent later.
                clock[1] = max(clock[1] + clock[0], now)
                sent.append(self._value(command))
        return sent

    def _advance(self, dt: float) -> Status | None:
        """Let time pass; return the result of a motion that has ended."""
        self.axis.advance(dt)
        if (
            self._grasping is Grasping.HOLDING
            and abs(self.axis.position - self.axis.target) < _NEAR
        ):
            # The fingers have closed over where the part was.
            self._grasping = Grasping.PART_LOST
            self.halt()
        if self._running is None or self.axis.moving:
            return None
        there = abs(self.axis.position - self.axis.target) < _NEAR
        if self._running == Command.GRASP:
            return self._grasped(there, dt)
        if not there:
            inwards = self.axis.target < self.axis.position
            self._blocked = State.BLOCKED_MINUS if inwards else State.BLOCKED_PLUS
        elif self._running == Command.HOME:
            self._referenced = True
            self.homings += 1
        if not there and self._stop_on_block:
            self.halt()
        self._running, self._reached = None, there
        self._grasping = Grasping.IDLE
        return Status.OK if there else Status.AXIS_BLOCKED

    def _grasped(self, there: bool, dt: float) -> Status | None:
        # No contact over the whole travel means that there is no part.
        if there or self.axis.stuck:
            self._running = None
            self._grasping = Grasping.NO_PART
            self.halt()
            return Status.FAILED
        self._building += dt
        if self._building < self.properties.force_time:
            return None
        self._running = None
        self._grasping = Grasping.HOLDING
        return Status.OK


def _floats(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)
