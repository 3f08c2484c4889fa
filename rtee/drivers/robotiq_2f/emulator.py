"""Plays a Robotiq two-finger gripper at the other end of the wire.

What no manual states is an option here: how long the activation takes and which way the automatic
release goes. Illegal requests, like bad frames, are met with silence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

from rtee.buses.modbus_frames import READ_HOLDING
from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, Framing, ModbusEmulator, Refused
from rtee.drivers.axis import Axis, VirtualObject
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.properties import Byte, Duration, Positive, Rate, read_properties
from rtee.drivers.robotiq_2f.codec import (
    COUNTS,
    INPUT,
    MODELS,
    OUTPUT,
    Activation,
    Command,
    Grasp,
    Status,
)
from rtee.drivers.scale import LinearScale

_BLOCK = 8
_FAULT_CODES = {
    "over_temperature": 0x08,
    "under_voltage": 0x0A,
    "internal": 0x0C,
    "activation_failed": 0x0D,
    "overcurrent": 0x0E,
}
_STOPPING = frozenset({0x08, 0x0A, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F})


@dataclass(frozen=True, slots=True)
class Robotiq2FProperties:
    """What the emulated gripper is like.

    Attributes:
        unit: Its number on the line.
        framing: ``rtu`` or ``tcp``.
        baudrate: Bits per second.
        model: ``2f_85``, ``2f_140`` or ``hand_e``.
        activation_time: Time of the activation [s].
        activated: It is activated at power-up, as if the host had been here before.
        position: Where the fingers are at power-up [counts].
        open_count: gPO when fully open.
        closed_count: gPO when fully closed.
        output: First register of the output block; on TCP it lies at 0, too, as with Robotiq's
            universal controller, whose clients read by function 4.
        input: First register of the input block; likewise.
        release_opens: Which way the automatic release goes; ``None``: as rARD says, 1 is opening.
        watch: Silence after which it complains [s].
        haste: How much faster than the real one it moves and activates.
        functions: Function codes that it knows.
    """

    unit: Byte = 9
    framing: Framing = "rtu"
    baudrate: Rate = 115200
    model: Literal["2f_85", "2f_140", "hand_e"] = "2f_85"
    activation_time: Duration = 1.5
    activated: bool = False
    position: float = 3.0
    open_count: Byte = 3
    closed_count: Byte = 230
    output: int = OUTPUT
    input: int = INPUT
    release_opens: bool | None = None
    watch: Duration = 1.0
    haste: Positive = 1.0
    functions: tuple[int, ...] = (3, 4, 6, 16, 23)


class Robotiq2FEmulator(ModbusEmulator, Grasps):
    """A 2F-85, 2F-140 or Hand-E.

    Attributes:
        axis: Its fingers; positions in counts of gPO, efforts in N at the fingertips.
        output: The registers that the host has written.
        activations: Activations completed since it was made.
        moves: Times a new target was taken.
        begun: The command with which that happened last.
    """

    FAULTS: ClassVar[frozenset[str]] = ModbusEmulator.FAULTS | frozenset(_FAULT_CODES)

    def __init__(self, properties: Robotiq2FProperties | None = None) -> None:
        made = self.properties = properties or Robotiq2FProperties()
        super().__init__(made.unit, made.framing, baudrate=made.baudrate, functions=made.functions)
        self.model = MODELS[made.model]
        low, high = self.model.force
        self.axis = Axis(
            made.position,
            lower=made.open_count,
            upper=made.closed_count,
            max_effort=low,
            time_constant=0.01,
            friction=0.1 * high,
            resolution=0.3,
        )
        self.axis.rating = high
        self.axis.self_locking = True  # the screw keeps the fingers where they are
        self.axis.enabled = True
        self.output = [0] * _BLOCK
        self.activations = 0
        self.moves = 0
        self.begun = Command()
        self._now: float | None = None
        self._heard: float | None = None
        self._silent = False
        self._started = False
        self._power_up(made.activated)

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self:
        """Make the gripper that a driver's options describe."""
        names = ("unit", "baudrate", "model", "open_count", "closed_count")
        fitting = {name: options[name] for name in names if options.get(name) is not None}
        if str(options.get("port", "")).startswith("tcp://"):
            fitting["framing"] = "tcp"
        if options.get("register_base") is not None:
            fitting |= {"output": options["register_base"], "input": options["register_base"]}
        return cls(read_properties(Robotiq2FProperties, options, **fitting))

    def power_cycle(self, now: float) -> None:
        """Lose activation and command; the screw keeps the fingers where they are."""
        self.line_reset()
        self._power_up(False)

    def _power_up(self, activated: bool) -> None:
        self.output = [0] * _BLOCK
        self._fault = 0
        self._activation = Activation.DONE if activated else Activation.RESET
        self._activation_left = 0.0
        self._releasing = False
        self._opening = False
        self.axis.target = self.axis.position
        if activated:
            self.output[:3] = Command(
                activate=True, go=True, position=round(self.axis.position), speed=255, force=255
            ).to_registers()
            self._apply(Command.from_registers(self.output))

    def closings(self) -> Sequence[Closing]:
        """Return how the fingers close."""
        return [Closing(self.axis, self.axis.lower, self.axis.upper, self.model.force[1])]

    def closure_at(self, width: float) -> float:
        """Return how far the fingers are closed at a width [m]."""
        return 1.0 - width / self.model.stroke

    def grip_object(self, count: int = 180, stiffness: float = 20.0, force: int = 128) -> None:
        """Close on an object met at ``count``, as if another program had gripped it before."""
        self.axis.obstacle = VirtualObject(count, stiffness)
        self._power_up(True)
        self.output[:3] = Command(
            activate=True, go=True, position=255, speed=255, force=force
        ).to_registers()
        self._apply(Command.from_registers(self.output))
        self.axis.advance(10.0)

    def inject(self, fault: str) -> None:
        """Put a fault into the gripper; the motor stops by most."""
        super().inject(fault)
        self.axis.stuck = "stuck" in self.faults
        self._fault = _FAULT_CODES.get(fault, self._fault)

    def clear(self, fault: str | None = None) -> None:
        """Take the cause of a fault away; major faults stay until the host resets the gripper."""
        super().clear(fault)
        self.axis.stuck = "stuck" in self.faults
        if self._fault == 0x08 and "over_temperature" not in self.faults:
            self._fault = 0

    # --- registers -------------------------------------------------------------------------------

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return input registers, or the output ones where their address is read."""
        self._heard_from_host(now)
        self.advance(now)
        for inputs, outputs in self._blocks():
            mixed = inputs == outputs and function == READ_HOLDING
            if inputs <= address and address + count <= inputs + _BLOCK and not mixed:
                values = [*self.status().to_registers(), *[0] * (_BLOCK - 3)]
                if "wrong_device" in self.faults:
                    values[0] |= 0xC0
                return values[address - inputs : address - inputs + count]
            if outputs <= address and address + count <= outputs + _BLOCK:
                return self.output[address - outputs : address - outputs + count]
        raise Refused(ILLEGAL_ADDRESS)

    def _blocks(self) -> list[tuple[int, int]]:
        """Return where the input and the output block begin; on TCP at 0, too."""
        own = (self.properties.input, self.properties.output)
        return [own, (0, 0)] if self.framing == "tcp" else [own]

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Merge registers into the output block, wherever they start, and obey."""
        self._heard_from_host(now)
        for _, outputs in self._blocks():
            start = address - outputs
            if start >= 0 and start + len(values) <= _BLOCK:
                self.advance(now)
                self.output[start : start + len(values)] = values
                self._apply(Command.from_registers(self.output))
                return
        raise Refused(ILLEGAL_ADDRESS)

    def status(self) -> Status:
        """Return what the gripper says."""
        command = Command.from_registers(self.output)
        going = command.activate and command.go and self._activation is Activation.DONE
        going = going and not self._releasing
        fault = self._fault or self._priority_fault(command) or (0x09 if self._silent else 0)
        self._silent = False
        return Status(
            activated=command.activate,
            going=going,
            activation=Activation.RESET if self._releasing else self._activation,
            grasp=self._grasp() if going else Grasp.MOVING,
            fault=fault,
            requested=command.position,
            position=round(min(max(self.axis.position, 0.0), 255.0)),
            raw_current=self._current(),
        )

    def _priority_fault(self, command: Command) -> int:
        if command.go and not command.activate:
            return 0x07
        if command.go and self._activation is Activation.UNDER_WAY:
            return 0x05
        return 0

    def _grasp(self) -> Grasp:
        if self._started or self.axis.velocity != 0.0:
            return Grasp.MOVING
        error = self.axis.target - self.axis.position
        blocked = abs(error) > 1.0 and self.axis.lower < self.axis.position < self.axis.upper
        if blocked or self.axis.stuck:
            return Grasp.CONTACT_CLOSING if error > 0 else Grasp.CONTACT_OPENING
        return Grasp.AT_REQUEST

    def _current(self) -> int:
        strongest = self.model.force[1]
        return min(round(abs(self.axis.effort) / strongest * 100), 255)

    # --- behaviour -------------------------------------------------------------------------------

    def _heard_from_host(self, now: float) -> None:
        if self._heard is not None and now - self._heard >= self.properties.watch:
            self._silent = True
        self._heard = now

    def _apply(self, command: Command) -> None:
        if not command.activate:
            self._activation = Activation.RESET
            self._releasing = False
            self._fault = 0 if not self._persisting() else self._fault
            self.axis.target = self.axis.position
            return
        if command.release:
            self._begin_release(command)
            return
        if self._activation is Activation.RESET and not self._releasing:
            self._activation = Activation.UNDER_WAY
            self._activation_left = self.properties.activation_time
            self._set(255, 255)
        if self._activation is Activation.DONE:
            self._obey(command)

    def _persisting(self) -> bool:
        return any(_FAULT_CODES.get(f) == self._fault for f in self.faults)

    def _set(self, speed: int, force: int) -> None:
        counts = self.axis.upper - self.axis.lower
        speed_of_tips = LinearScale(COUNTS, self.model.speed).to_si(speed)
        self.axis.max_velocity = speed_of_tips * counts / self.model.stroke
        self.axis.max_effort = LinearScale(COUNTS, self.model.force).to_si(force)

    def _obey(self, command: Command) -> None:
        if self._fault in _STOPPING or self._releasing:
            self.axis.target = self.axis.position
            return
        self._set(command.speed, command.force)
        if not command.go:
            self.axis.target = self.axis.position
        elif self.axis.target != command.position:
            self.axis.target = command.position
            self.moves += 1
            self.begun = command
            self._started = True

    def _begin_release(self, command: Command) -> None:
        if self._releasing:
            return
        self._releasing = True
        self._fault = 0x0B
        opens = self.properties.release_opens
        opens = command.direction if opens is None else opens
        self._set(0, 0)
        self.axis.target = self.axis.lower if opens else self.axis.upper

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        dt = 0.0 if self._now is None else max(0.0, now - self._now)
        self._now = now
        if dt > 0.0:
            self._started = False
        hastened = dt * self.properties.haste
        if self._activation is Activation.UNDER_WAY:
            self._calibrate(hastened)
        else:
            self.axis.advance(hastened)
        if self._fault in _STOPPING and not self._releasing:
            self.axis.target = self.axis.position
        if self._releasing and self.axis.velocity == 0.0 and dt > 0.0:
            self._fault = 0x0F
        if "over_temperature" not in self.faults and self.axis.temperature > 85.0:
            self.inject("over_temperature")

    def _calibrate(self, dt: float) -> None:
        """Close, then open, within the activation's time."""
        if "activation_failed" in self.faults:
            self._fault = 0x0D
            return
        self._activation_left -= dt
        closing = self._activation_left > self.properties.activation_time / 2
        reach = self.axis.upper - self.axis.lower
        self.axis.max_velocity = max(2.5 * reach / max(self.properties.activation_time, 1e-3), 1.0)
        self.axis.target = self.axis.upper if closing else self.axis.lower
        self.axis.advance(dt)
        if self._activation_left <= 0.0:
            self._activation = Activation.DONE
            self.activations += 1
            self.axis.target = self.axis.position
            self._obey(Command.from_registers(self.output))
