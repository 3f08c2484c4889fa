"""Emulates a SCHUNK EGU or EGK on Modbus RTU: parameters, cyclic images, the toggle-bit handshake.

Behaviour that the sources leave open is a property here: the timeout of the communication, the
speed of a grip, and the time to build up its force.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import or_

from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusEmulator, Refused
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Byte, Duration, Positive, Rate
from rtee.drivers.schunk_egu import codec
from rtee.hand.validation import Section

_COMMANDS = reduce(or_, codec.COMMANDS.values())
_MOVE_FORCE = 0.3
"""Force of a motion that is not a grip, as a share of the largest; no document states it."""
_NEAR = 0.04
"""Distance below which a target counts as reached [mm]."""
_ERRORS: Mapping[str, int] = {
    "motor_hot": 0x6D,
    "motor_supply_low": 0x74,
    "overcurrent": 0xDE,
    "brake_test": 0x28,
    "restart": 0x7C,
}
_WRITTEN: Mapping[codec.Parameter, int] = {
    codec.Parameter.COMMAND: 1,
    codec.Parameter.SET_POSITION: 2,
    codec.Parameter.SET_SPEED: 2,
    codec.Parameter.SET_FORCE: 2,
    codec.Parameter.DIRECTION: 1,
    codec.Parameter.RELEASE_DELTA: 2,
    codec.Parameter.PREPOSITION: 2,
}
"""Number of registers of each parameter that a host may write; two registers hold a float."""
_BLOCKED = 0xF4  # error: a motion met something
_MODULE = 18  # an EGK 40 M-B
_RELEASE = 10.0  # distance by which it opens on release, until a host sets another [mm]


class SchunkEguProperties(Section, frozen=True):
    """Properties of the emulated gripper.

    Attributes:
        unit: Its number on the line.
        baudrate: Bit rate of the line [bit/s].
        stroke: Largest distance between the fingers [mm]; the smallest is 0.
        position: Distance between the fingers at power-up [mm].
        force: Largest grip force [N].
        speed: Largest speed of that distance [mm/s].
        grip_speed: Speed of a grip whose command gives no speed [mm/s].
        force_time: Time to build up the force after the contact [s].
        watch: Silence after which it stops with an error [s].
        ready: Whether it is ready at power-up, as after an earlier connection.
        haste: Factor by which it moves faster than the real one.
    """

    unit: Byte = 12
    baudrate: Rate = 115200
    stroke: Positive = 80.0
    position: float = 80.0
    force: Positive = 150.0
    speed: Positive = 200.0
    grip_speed: Positive = 40.0
    force_time: Duration = 0.1
    watch: Duration = 1.0
    ready: bool = False
    haste: Positive = 1.0


class SchunkEguEmulator(ModbusEmulator, Grasps):
    """An EGU or EGK; greater positions are more open.

    Attributes:
        axis: Both fingers; position is the distance between them [mm], effort the force [N].
        moves: Number of motions started.
        begun: Force of the last grip [%]; motions have none.
        tests: Number of brake tests.
        taken: Accepted commands, newest last, for tests.
    """

    PROPERTIES = SchunkEguProperties
    SHARED = ("unit", "baudrate")
    FAULTS = ModbusEmulator.FAULTS | frozenset(_ERRORS)
    FUNCTIONS = frozenset({0x03, 0x10})
    EXCEPTIONS = True

    def __init__(self, properties: SchunkEguProperties | None = None) -> None:
        made = self.properties = properties or SchunkEguProperties()
        super().__init__(made.unit, "rtu", baudrate=made.baudrate)
        self.axis = Axis(
            made.position,
            lower=0.0,
            upper=made.stroke,
            max_effort=_MOVE_FORCE * made.force,
            time_constant=0.01,
            resolution=_NEAR / 2,
            rating=made.force,
            enabled=True,
            self_locking=True,
        )
        self.axes = [self.axis]
        self.moves = 0
        self.begun = 0
        self.tests = 0
        self.taken: list[codec.Control] = []
        # Parameters that hosts write besides the image; the gripper keeps them.
        self._kept: dict[codec.Parameter, bytes] = {
            parameter: bytes(2 * count) for parameter, count in _WRITTEN.items()
        }
        for parameter in (codec.Parameter.RELEASE_DELTA, codec.Parameter.PREPOSITION):
            self._kept[parameter] = codec.data_of(codec.float_registers(_RELEASE))
        self._start(made.ready)

    def _start(self, ready: bool) -> None:
        self._output = codec.Output(codec.Control.RUN if ready else codec.Control(0))
        self._error = 0 if ready else codec.FAST_STOP
        self._results = codec.Status(0)
        self._toggle = False
        self._running = codec.Control(0)
        self._building = 0.0
        self._heard: float | None = None
        self._halt()

    def power_cycle(self, now: float) -> None:
        """Come back in a fast stop; encoder and brake keep the position."""
        self.line_reset()
        self.faults.discard("restart")
        self._start(False)

    def _halt(self) -> None:
        self.axis.target = self.axis.position
        self._running = codec.Control(0)

    # --- objects and faults ------------------------------------------------------------------

    def closings(self) -> Sequence[Closing]:
        """Return the closing motion of the fingers."""
        return [Closing(self.axis, self.properties.stroke, 0.0, self.properties.force)]

    def closure_at(self, width: float) -> float:
        """Return the fraction of the travel at which the fingers meet a width [m]."""
        return 1.0 - 1e3 * width / self.properties.stroke

    def on_faults(self) -> None:
        """Apply the faults: a stuck motor is blocked, and an error stops the gripper."""
        super().on_faults()
        for fault, code in _ERRORS.items():
            if fault in self.faults and fault != "brake_test":
                self._fail(code)

    def _fail(self, code: int) -> None:
        self._error = code
        self._results = codec.Status(0)
        self._halt()

    # --- registers ---------------------------------------------------------------------------

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Write the output image or a parameter, always as a whole."""
        self._hear(now)
        if address == codec.Parameter.OUTPUT.register:
            if len(values) != codec.IMAGE:
                raise Refused(ILLEGAL_VALUE)
            self._obey(codec.Output.from_registers(values))
            return
        for parameter, count in _WRITTEN.items():
            if address == parameter.register:
                if len(values) != count:
                    raise Refused(ILLEGAL_VALUE)
                self._kept[parameter] = codec.data_of(values)
                if parameter is codec.Parameter.COMMAND:
                    # The low byte first, as in every number.
                    self._obey_code(values[0] >> 8)
                return
        raise Refused(ILLEGAL_ADDRESS)

    def _hear(self, now: float) -> None:
        self.advance(now)
        self._heard = now

    def windows(self, function: int) -> Mapping[int, Sequence[int]]:
        """Return the parameters by their registers."""
        self._heard = self._clock
        return {one.register: words for one, words in self._parameters().items()}

    def _parameters(self) -> Mapping[codec.Parameter, Sequence[int]]:
        made = self.properties
        texts = {codec.Parameter.SERIAL: "EMULATED", codec.Parameter.SOFTWARE: "5.2.0"}
        module = 99 if "wrong_device" in self.faults else _MODULE
        # The word of an enumeration has its low byte first, like every number.
        found: dict[codec.Parameter, Sequence[int]] = {
            codec.Parameter.INPUT: self.image().to_registers(),
            codec.Parameter.OUTPUT: self._output.to_registers(),
            codec.Parameter.ERROR: (self._error << 8,),
            codec.Parameter.POSITION: codec.float_registers(self.axis.measured),
            codec.Parameter.SPEED: codec.float_registers(self.axis.velocity),
            codec.Parameter.MODULE: (module << 8,),
            codec.Parameter.STROKE: codec.float_registers(made.stroke),
            codec.Parameter.LEAST_POSITION: codec.float_registers(0.0),
            codec.Parameter.MOST_POSITION: codec.float_registers(made.stroke),
            codec.Parameter.MOST_SPEED: codec.float_registers(made.speed),
            codec.Parameter.MOST_GRIP_SPEED: codec.float_registers(made.grip_speed),
            codec.Parameter.MOST_FORCE: codec.float_registers(made.force),
            codec.Parameter.FIELDBUS: (7 << 8,),
        }
        for parameter, data in self._kept.items():
            found[parameter] = codec.registers(data)
        for parameter, text in texts.items():
            found[parameter] = codec.registers(
                text.encode("ascii").ljust(2 * codec.TEXTS[parameter], b"\0")
            )
        return found

    def image(self) -> codec.Input:
        """Return the input image."""
        ready = self._error == 0
        status = self._results
        # As captured from a real gripper, which after power-up reports error and brake.
        status |= codec.Status.READY if ready else codec.Status.ERROR | codec.Status.BRAKE
        status |= codec.Status.RECEIVED if self._toggle else codec.Status(0)
        return codec.Input(status, round(1e3 * self.axis.measured), self._error)

    # --- behaviour ---------------------------------------------------------------------------

    def _obey(self, output: codec.Output) -> None:
        before, self._output = self._output, output
        if not output.control & codec.Control.RUN:
            if before.control & codec.Control.RUN:
                # A fast stop is a command: it is acknowledged by the toggle, too.
                self._toggle = not self._toggle
            self._fail(codec.FAST_STOP)
            return
        # A command is given by the rising edge of its bit, or by a change of the repeat bit.
        risen = output.control & ~before.control & _COMMANDS
        if (output.control ^ before.control) & codec.Control.REPEAT:
            risen = output.control & _COMMANDS
        if risen:
            self._take(risen, output)

    def _take(self, risen: codec.Control, output: codec.Output) -> None:
        """Accept a command; ``risen`` may hold several, which is not feasible."""
        self._toggle = not self._toggle
        self.taken = [*self.taken[-63:], risen]
        if risen is codec.Control.ACKNOWLEDGE:
            self._acknowledge()
        elif self._error or (risen.bit_count() != 1):
            self._results = codec.Status.NOT_FEASIBLE
        else:
            self._command(risen, output)

    def _obey_code(self, code: int) -> None:
        """Act on a command code, with the set-points that were written as parameters."""
        if code == codec.FAST_STOP_CODE:
            self._toggle = not self._toggle
            self._fail(codec.FAST_STOP)
            return
        command = codec.COMMANDS.get(code)
        if command is None:
            raise Refused(ILLEGAL_VALUE)
        position = self._number(codec.Parameter.SET_POSITION)
        speed = self._number(codec.Parameter.SET_SPEED)
        force = self._number(codec.Parameter.SET_FORCE)
        outward = (
            codec.Control.OUTWARD
            if any(self._kept[codec.Parameter.DIRECTION])
            else codec.Control(0)
        )
        values = round(1e3 * position), round(1e3 * speed), round(force)
        self._take(command, codec.Output(codec.Control.RUN | command | outward, *values))

    def _number(self, parameter: codec.Parameter) -> float:
        return codec.float_of(codec.registers(self._kept[parameter]))

    def _acknowledge(self) -> None:
        left = [_ERRORS[f] for f in self.faults if f in _ERRORS and f != "brake_test"]
        self._error = left[0] if left else 0

    def _command(self, command: codec.Control, output: codec.Output) -> None:
        made = self.properties
        target, speed, force = self._motion(command, output)
        if target is None or not 0.0 <= target <= made.stroke or not 0.0 < speed <= made.speed:
            feasible = command in (codec.Control.STOP, codec.Control.BRAKE_TEST)
            if not feasible:
                self._results = codec.Status.NOT_FEASIBLE
                return
        self._results, self._building = codec.Status(0), 0.0
        if command is codec.Control.STOP:
            self._halt()
            self._results = codec.Status.SUCCESS | codec.Status.REACHED
        elif command is codec.Control.BRAKE_TEST:
            self.tests += 1
            if "brake_test" in self.faults:
                self._fail(_ERRORS["brake_test"])
            else:
                self._results = codec.Status.SUCCESS
        elif target is not None:
            self._running = command
            self.axis.target, self.axis.max_velocity, self.axis.max_effort = target, speed, force
            self.moves += 1
            if command in (codec.Control.GRIP, codec.Control.GRIP_AT):
                self.begun = output.force

    def _motion(
        self, command: codec.Control, output: codec.Output
    ) -> tuple[float | None, float, float]:
        """Return the target [mm], the speed [mm/s] and the force [N] of a command."""
        made = self.properties
        position, speed = output.position / 1e3, output.speed / 1e3
        outward = bool(output.control & codec.Control.OUTWARD)
        if command in (codec.Control.GRIP, codec.Control.GRIP_AT):
            # In percent, like the driver's scale of efforts.
            if not 1 <= output.force <= 100:
                return None, 0.0, 0.0
            end = made.stroke if outward else 0.0
            return end, speed or made.grip_speed, output.force / 100.0 * made.force
        free = _MOVE_FORCE * made.force
        if command is codec.Control.MOVE:
            return position, speed, free
        if command is codec.Control.MOVE_BY:
            return self.axis.position + position, speed, free
        if command is codec.Control.RELEASE:
            release = self._number(codec.Parameter.RELEASE_DELTA)
            way = -release if outward else release
            wanted = min(max(self.axis.position + way, 0.0), made.stroke)
            return wanted, made.grip_speed, free
        return None, 0.0, 0.0

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        dt = self._elapsed(now)
        silent = self._heard is not None and now - self._heard > self.properties.watch
        if silent and not self._error:
            # A break in the communication stops it; the brake holds what is gripped.
            self._fail(codec.SILENT)
        if dt > 0.0:
            self._advance_by(dt * self.properties.haste)

    def _advance_by(self, dt: float) -> None:
        self.axis.advance(dt)
        if not self._running or self.axis.moving:
            return
        there = abs(self.axis.position - self.axis.target) < _NEAR
        if self._running in (codec.Control.GRIP, codec.Control.GRIP_AT):
            self._grip(there, dt)
        elif there:
            self._running = codec.Control(0)
            self._results = codec.Status.SUCCESS | codec.Status.REACHED
        elif not self.axis.stuck:
            self._fail(_BLOCKED)

    def _grip(self, there: bool, dt: float) -> None:
        if there:
            self._running = codec.Control(0)
            self._results = codec.Status.SUCCESS | codec.Status.NO_WORKPIECE
            return
        if self.axis.stuck:
            return
        self._building += dt
        self._results = codec.Status.PRE_HOLDING
        if self._building >= self.properties.force_time:
            self._running = codec.Control(0)
            self._results = codec.Status.SUCCESS | codec.Status.GRIPPED
