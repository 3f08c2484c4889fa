"""Plays Robotiq's three-finger gripper at the other end of the wire.

What no manual states, or where its editions differ, is an option here: how long activation and
change of mode take, where the blocks lie on TCP (both places are served), the scale of currents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from rtee.buses.modbus_frames import READ_INPUT
from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, Framing, ModbusEmulator, Refused
from rtee.drivers.axis import Axis, VirtualObject
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.properties import Byte, Duration, Positive, Rate, read_properties
from rtee.drivers.robotiq_3f.codec import (
    COUNT,
    COUNTS,
    FAULTS,
    FORCE,
    INPUT,
    OUTPUT,
    SPEED,
    STROKE,
    AxisStatus,
    Command,
    Contact,
    Mode,
    Motion,
    Progress,
    Request,
    Status,
)
from rtee.drivers.scale import LinearScale

_FAULT_CODES = {
    "scissor_obstructed": 0x0A,
    "activation_failed": 0x0D,
    "mode_change_failed": 0x0E,
}
_SCISSOR_OF = {Mode.BASIC: 0x89, Mode.PINCH: 0xDC, Mode.WIDE: 0x19, Mode.SCISSOR: 0x19}
_VELOCITY = LinearScale(COUNTS, (SPEED[0] * 255 / STROKE, SPEED[1] * 255 / STROKE))
"""rSPx to [counts/s] of gPOx."""
_FORCE = LinearScale(COUNTS, FORCE)
"""rFRx to [N]."""
_OPEN = 6
"""Count of a finger that is fully open."""


@dataclass(frozen=True, slots=True)
class Robotiq3FProperties:
    """What the emulated gripper is like.

    Attributes:
        unit: Its number on the line.
        framing: ``rtu`` or ``tcp``.
        baudrate: Bits per second.
        activation_time: Time of the activation [s].
        mode_time: Time of a change of mode [s].
        activated: It is activated at power-up, as if the host had been here before.
        functions: Function codes that it knows.
        haste: How much faster than the real one it moves and activates.
    """

    unit: Byte = 9
    framing: Framing = "rtu"
    baudrate: Rate = 115200
    activation_time: Duration = 3.0
    mode_time: Duration = 1.0
    activated: bool = False
    functions: tuple[int, ...] = (3, 4, 6, 16, 23)
    haste: Positive = 1.0


class Robotiq3FEmulator(ModbusEmulator, Grasps):
    """The three-finger gripper.

    Attributes:
        axes: Fingers a, b, c and the scissor; positions in counts, efforts in N.
        output: The registers that the host has written.
        moves: Times a new target was taken by any motor.
        begun: The command with which that happened last.
    """

    FAULTS: ClassVar[frozenset[str]] = ModbusEmulator.FAULTS | frozenset(_FAULT_CODES)

    def __init__(self, properties: Robotiq3FProperties | None = None) -> None:
        made = self.properties = properties or Robotiq3FProperties()
        super().__init__(made.unit, made.framing, baudrate=made.baudrate, functions=made.functions)
        self.axes = [*(self._made(_OPEN, _OPEN) for _ in range(3)), self._made(0x89, 0)]
        self.output = [0] * COUNT
        self.moves = 0
        self.begun = Command()
        self._now: float | None = None
        self._power_up(made.activated)

    @staticmethod
    def _made(position: float, lower: int) -> Axis:
        axis = Axis(
            position, lower=lower, upper=255, time_constant=0.01, friction=2.0, resolution=0.3
        )
        axis.rating = 60.0
        axis.enabled = True
        return axis

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self:
        """Make the gripper that a driver's options describe."""
        fitting = {k: options[k] for k in ("unit", "baudrate") if options.get(k) is not None}
        if str(options.get("port", "")).startswith("tcp://"):
            fitting["framing"] = "tcp"
        return cls(read_properties(Robotiq3FProperties, options, **fitting))

    def power_cycle(self, now: float) -> None:
        """Lose activation and command; the gears keep the fingers where they are."""
        self.line_reset()
        self._power_up(False)

    def _power_up(self, activated: bool) -> None:
        self.output = [0] * COUNT
        self._fault = 0
        self._progress = Progress.DONE if activated else Progress.RESET
        self._left = 0.0
        self._mode = Mode.BASIC
        self._releasing = False
        self._started = False
        for axis in self.axes:
            axis.target = axis.position
        if activated:
            there = tuple(Request(round(axis.position), 255, 255) for axis in self.axes)
            self._take(
                Command(activate=True, go=True, axes=(there[0], there[1], there[2], there[3]))
            )

    def closings(self) -> Sequence[Closing]:
        """Return how the fingers close; the scissor meets nothing."""
        return [Closing(axis, _OPEN, axis.upper, FORCE[1]) for axis in self.axes[:3]]

    def grip_object(self, count: int = 150, stiffness: float = 10.0, force: int = 128) -> None:
        """Close on an object met at ``count``, as if another program had gripped it before."""
        for axis in self.axes[:3]:
            axis.obstacle = VirtualObject(count, stiffness)
        self._power_up(True)
        close = Request(255, 255, force)
        self._take(Command(activate=True, go=True, axes=(close, Request(), Request(), Request())))
        for axis in self.axes:
            axis.advance(10.0)

    def inject(self, fault: str) -> None:
        """Put a fault into the gripper."""
        super().inject(fault)
        self._hamper()
        self._fault = _FAULT_CODES.get(fault, self._fault)

    def clear(self, fault: str | None = None) -> None:
        """Take the cause of a fault away; major faults stay until the host resets the gripper."""
        super().clear(fault)
        self._hamper()
        if self._fault == 0x0A and "scissor_obstructed" not in self.faults:
            self._fault = 0

    def _hamper(self) -> None:
        for axis in self.axes:
            axis.stuck = "stuck" in self.faults

    # --- registers -------------------------------------------------------------------------------

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return registers: the input block at 07D0, at 0 by function 4; else the output block."""
        self.advance(now)
        sources = [(INPUT, True), (OUTPUT, False), (0, function == READ_INPUT)]
        for base, wanted in sources:
            if base <= address and address + count <= base + COUNT:
                block = list(self.status().to_registers()) if wanted else self.output
                if wanted and "wrong_device" in self.faults:
                    block[1] |= 0xF000
                return block[address - base : address - base + count]
        raise Refused(ILLEGAL_ADDRESS)

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Merge registers into the output block, wherever they start, and obey."""
        for base in (OUTPUT, 0):
            start = address - base
            if start >= 0 and start + len(values) <= COUNT:
                self.advance(now)
                self.output[start : start + len(values)] = values
                self._apply(Command.from_registers(self.output))
                return
        raise Refused(ILLEGAL_ADDRESS)

    def status(self) -> Status:
        """Return what the gripper says."""
        command = Command.from_registers(self.output)
        going = command.activate and command.go and not self._releasing
        going = going and self._progress is Progress.DONE
        contacts = [self._contact(axis) if going else Contact.MOVING for axis in self.axes]
        echoes = [
            command.axes[0].position,
            command.axes[1].position if command.individual else 0,
            command.axes[2].position if command.individual else 0,
            command.axes[3].position if command.scissor else 0,
        ]
        axes = tuple(
            AxisStatus(contact, echo, _count(axis.position), self._current(axis))
            for contact, echo, axis in zip(contacts, echoes, self.axes, strict=True)
        )
        return Status(
            activated=command.activate,
            mode=self._mode,
            going=going,
            progress=Progress.RESET if self._releasing else self._progress,
            motion=self._motion(contacts[:3]) if going else Motion.MOVING,
            fault=self._fault or self._priority_fault(command),
            axes=axes,
        )

    def _priority_fault(self, command: Command) -> int:
        if command.go and not command.activate:
            return 0x07
        if command.go and self._progress is Progress.ACTIVATING:
            return 0x05
        if command.go and self._progress is Progress.CHANGING:
            return 0x06
        return 0

    def _contact(self, axis: Axis) -> Contact:
        if self._started or axis.velocity != 0.0:
            return Contact.MOVING
        error = axis.target - axis.position
        if abs(error) <= 1.0:
            return Contact.AT_REQUEST
        return Contact.CLOSING if error > 0 else Contact.OPENING

    @staticmethod
    def _motion(contacts: Sequence[Contact]) -> Motion:
        if Contact.MOVING in contacts:
            return Motion.MOVING
        short = sum(contact is not Contact.AT_REQUEST for contact in contacts)
        if not short:
            return Motion.ALL_REACHED
        return Motion.ALL_SHORT if short == 3 else Motion.SOME_SHORT

    @staticmethod
    def _current(axis: Axis) -> int:
        return min(round(abs(axis.effort) / axis.rating * 100), 255)

    # --- behaviour -------------------------------------------------------------------------------

    def _apply(self, command: Command) -> None:
        if not command.activate:
            self._progress = Progress.RESET
            self._releasing = False
            self._mode = Mode.BASIC
            if not any(_FAULT_CODES.get(f) == self._fault for f in self.faults):
                self._fault = 0
            self._halt()
        elif command.release:
            self._begin_release()
        elif self._progress is Progress.RESET and not self._releasing:
            self._progress, self._left = Progress.ACTIVATING, self.properties.activation_time
        elif self._progress is Progress.DONE and command.mode is not self._mode:
            self._change_mode(command.mode)
        elif self._progress is Progress.DONE:
            self._obey(command)

    def _take(self, command: Command) -> None:
        self.output = list(command.to_registers())
        self._obey(command)

    def _halt(self) -> None:
        for axis in self.axes:
            axis.target = axis.position

    def _blocked(self) -> bool:
        fault = FAULTS.get(self._fault)
        return fault is not None and not fault.warning

    def _obey(self, command: Command) -> None:
        if self._blocked() or self._releasing or not command.go:
            self._halt()
            return
        wanted = [command.axes[0]] * 3 if not command.individual else list(command.axes[:3])
        scissor = Request(_SCISSOR_OF[self._mode], 255, 255)
        changed = False
        for axis, request in zip(
            self.axes, [*wanted, command.axes[3] if command.scissor else scissor], strict=True
        ):
            axis.max_velocity = _VELOCITY.to_si(request.speed)
            axis.max_effort = _FORCE.to_si(request.force)
            # A position beyond the end is replaced by the end, and that counts as reached.
            target = min(max(float(request.position), axis.lower), axis.upper)
            changed |= axis.target != target
            axis.target = target
        if changed:
            self.moves += 1
            self.begun = command
            self._started = True

    def _begin_release(self) -> None:
        if self._releasing:
            return
        self._releasing = True
        self._fault = 0x0B
        for axis in self.axes[:3]:
            axis.max_velocity = _VELOCITY.to_si(0)
            axis.target = _OPEN

    def _change_mode(self, mode: Mode) -> None:
        if self._blocked():
            return
        self._mode = mode
        self._progress, self._left = Progress.CHANGING, self.properties.mode_time
        self.axes[3].max_velocity = 300.0 / max(self.properties.mode_time, 1e-3)
        self.axes[3].target = _SCISSOR_OF[mode]

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        dt = 0.0 if self._now is None else max(0.0, now - self._now) * self.properties.haste
        self._now = now
        if dt > 0.0:
            self._started = False
        if self._progress is Progress.ACTIVATING:
            self._self_test(dt)
        if self._blocked() and not self._releasing:
            self._halt()
        for axis in self.axes:
            axis.advance(dt)
        if self._progress is Progress.CHANGING and self._fault not in (0x0A, 0x0E):
            self._left -= dt
            self._finish()
        if self._releasing and dt > 0.0 and all(axis.velocity == 0.0 for axis in self.axes):
            self._fault = 0x0F

    def _self_test(self, dt: float) -> None:
        """Cycle all fingers and the scissor within the activation's time."""
        if "activation_failed" in self.faults:
            self._fault = 0x0D
            return
        self._left -= dt
        closing = self._left > self.properties.activation_time / 2
        for axis in self.axes:
            axis.max_velocity = 800.0 / max(self.properties.activation_time, 1e-3)
            axis.target = 255 if closing else _OPEN
        self.axes[3].target = 240 if closing else 0x89
        self._finish()

    def _finish(self) -> None:
        if self._left <= 0.0:
            self._progress = Progress.DONE
            self._halt()
            command = Command.from_registers(self.output)
            if command.mode is self._mode:
                self._obey(command)


def _count(position: float) -> int:
    return min(max(round(position), 0), 255)
