"""Common parts of the emulated Robotiq grippers: registers, activation, faults, automatic release.

Behaviour that no manual states is a property, such as the duration of the activation. Illegal
requests, like bad frames, are not answered.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from rtee.buses.modbus_frames import READ_HOLDING
from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, Framing, ModbusEmulator, Refused
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Grasps
from rtee.drivers.options import Byte, Duration, Positive, Rate
from rtee.drivers.robotiq_common import (
    NOT_ACTIVATED,
    Fault,
    Progress,
    RobotiqCommand,
    RobotiqStatus,
)
from rtee.hand.validation import Section

BLOCK = 8
"""Number of registers served in each block; published programs read six from a two-finger one."""

_RELEASING, _RELEASED = 0x0B, 0x0F  # gFLT: automatic release under way, completed
_ACTIVATION_FAILED = 0x0D  # gFLT: activation fault

_SELF_TEST = 800.0
"""Longest travel of a motor during an activation [counts]: three times its range, which covers the
way there and back with a margin."""


class RobotiqProperties(Section, frozen=True):
    """Properties of an emulated gripper.

    Attributes:
        unit: Its number on the line.
        framing: ``rtu`` or ``tcp``.
        baudrate: Bits per second.
        activation_time: Duration of the activation [s].
        activated: Whether it is activated at power-up, as after an earlier connection.
        functions: Supported function codes.
        haste: Factor by which it moves and activates faster than the real one.
    """

    unit: Byte = 9
    framing: Framing = "rtu"
    baudrate: Rate = 115200
    activation_time: Duration = 1.5
    activated: bool = False
    functions: tuple[int, ...] = (3, 4, 6, 16, 23)
    haste: Positive = 1.0


class RobotiqEmulator(ModbusEmulator, Grasps):
    """An emulated gripper; its subclasses define the registers and the motion of the motors.

    Attributes:
        CODES: The codes of gFLT by the names of the faults that can be injected.
        CODES_OF: All codes of gFLT.
        PASSING: The injected fault that ends with its cause; the others stay until a reset.
        WRONG: A register of the input block and bits of it that no such gripper sets.
        axes: The motors; positions in counts, efforts in N.
        output: The registers that the host has written.
        activations: Number of activations completed since the emulator was made.
        moves: Number of new targets.
        begun: The command that set the last new target.
    """

    CODES: ClassVar[Mapping[str, int]]
    CODES_OF: ClassVar[Mapping[int, Fault]]
    PASSING: ClassVar[str]
    WRONG: ClassVar[tuple[int, int]]

    def __init__(self, properties: RobotiqProperties, axes: Sequence[Axis]) -> None:
        made = self._made = properties
        super().__init__(made.unit, made.framing, baudrate=made.baudrate, functions=made.functions)
        self.axes = list(axes)
        for axis in self.axes:
            axis.enabled = True
        self.output = [0] * BLOCK
        self.activations = 0
        self.moves = 0
        self.begun: Any = self._command()
        self._power_up(made.activated)

    # --- defined by each model ---------------------------------------------------------------

    @abstractmethod
    def _command(self) -> RobotiqCommand:
        """Return the command that the output block holds."""

    @abstractmethod
    def _staying(self) -> RobotiqCommand:
        """Return the command to hold the position, as after an earlier run."""

    @abstractmethod
    def _windows(self) -> Sequence[tuple[int, int]]:
        """Return the first registers of the input and output blocks, for each pair of addresses."""

    @abstractmethod
    def status(self) -> RobotiqStatus:
        """Return the status that the gripper reports."""

    @abstractmethod
    def _follow(self, command: Any) -> bool:
        """Set the motors' speeds, forces and targets; return whether any target is a new one."""

    @abstractmethod
    def _release(self, command: Any) -> None:
        """Set the motors' speeds and targets for the automatic release."""

    # --- faults and objects ------------------------------------------------------------------

    def power_cycle(self, now: float) -> None:
        """Lose activation and command; the gears keep the fingers where they are."""
        self.line_reset()
        self._power_up(False)

    def _power_up(self, activated: bool) -> None:
        self.output = [0] * BLOCK
        self._fault = 0
        self._progress = Progress.DONE if activated else Progress.RESET
        self._left = 0.0
        self._releasing = False
        self._started = False
        self.halt()
        if activated:
            self._order(self._staying())

    def _order(self, command: RobotiqCommand) -> None:
        registers = command.to_registers()
        self.output[: len(registers)] = registers
        self._apply(command)

    def inject(self, fault: str) -> None:
        """Put a fault into the gripper; most stop it."""
        super().inject(fault)
        self._fault = self.CODES.get(fault, self._fault)

    def clear(self, fault: str | None = None) -> None:
        """Remove the cause of a fault; major faults stay until the host resets the gripper."""
        super().clear(fault)
        if self._fault == self.CODES[self.PASSING] and self.PASSING not in self.faults:
            self._fault = 0

    # --- registers ---------------------------------------------------------------------------

    def windows(self, function: int) -> Mapping[int, Sequence[int]]:
        """Return the input block, and the output block where it can be read."""
        found: dict[int, Sequence[int]] = {}
        for inputs, outputs in self._windows():
            found[outputs] = self.output
            # At a common address, function 3 reads written values, the others measured ones.
            if inputs != outputs or function != READ_HOLDING:
                found[inputs] = self._input_block()
        return found

    def _input_block(self) -> list[int]:
        values = list(self.status().to_registers())
        if "wrong_device" in self.faults:
            register, bits = self.WRONG
            values[register] |= bits
        return values + [0] * (BLOCK - len(values))

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Merge registers into the output block, wherever they start, and execute the command."""
        for _, outputs in self._windows():
            start = address - outputs
            if start >= 0 and start + len(values) <= BLOCK:
                self.advance(now)
                self.output[start : start + len(values)] = values
                self._apply(self._command())
                return
        raise Refused(ILLEGAL_ADDRESS)

    def _reported_fault(self, command: RobotiqCommand) -> int:
        """Return gFLT: a fault, or the reason why a request to move is not followed yet."""
        if self._fault or not command.go:
            return self._fault
        if not command.activate:
            return NOT_ACTIVATED
        return {Progress.ACTIVATING: 0x05, Progress.CHANGING: 0x06}.get(self._progress, 0)

    def _going(self, command: RobotiqCommand) -> bool:
        """Return gGTO."""
        done = self._progress is Progress.DONE and not self._releasing
        return command.activate and command.go and done

    # --- behaviour ---------------------------------------------------------------------------

    def _apply(self, command: RobotiqCommand) -> None:
        if not command.activate:
            self._progress = Progress.RESET
            self._releasing = False
            # A reset cannot clear a fault whose cause is still there.
            if not any(self.CODES.get(fault) == self._fault for fault in self.faults):
                self._fault = 0
            self.halt()
        elif command.release:
            if not self._releasing:
                self._releasing = True
                self._fault = _RELEASING
                self._release(command)
        elif self._progress is Progress.RESET and not self._releasing:
            self._progress, self._left = Progress.ACTIVATING, self._made.activation_time
        elif self._progress is Progress.DONE:
            self._obey(command)

    def _obey(self, command: RobotiqCommand) -> None:
        if self._blocked() or self._releasing or not command.go:
            self.halt()
        elif self._follow(command):
            self.moves += 1
            self.begun = command
            self._started = True

    def _blocked(self) -> bool:
        fault = self.CODES_OF.get(self._fault)
        return fault is not None and not fault.warning

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        dt = self._elapsed(now) * self._made.haste
        # The first reading after a command still reports motion, as on the real gripper.
        if dt > 0.0:
            self._started = False
        self._progress_by(dt)
        if self._blocked() and not self._releasing:
            self.halt()
        for axis in self.axes:
            axis.advance(dt)
        if self._releasing and dt > 0.0 and all(not axis.moving for axis in self.axes):
            self._fault = _RELEASED

    def _progress_by(self, dt: float) -> None:
        """Continue an activation under way."""
        if self._progress is Progress.ACTIVATING:
            self._activate(dt)

    def _activate(self, dt: float) -> None:
        """Close all motors, then open them, within the activation's time."""
        if "activation_failed" in self.faults:
            self._fault = _ACTIVATION_FAILED
            return
        self._left -= dt
        closing = self._left > self._made.activation_time / 2
        for axis in self.axes:
            axis.max_velocity = _SELF_TEST / max(self._made.activation_time, 1e-3)
            axis.max_effort = axis.rating
            axis.target = axis.upper if closing else axis.lower
        self._finish()

    def _finish(self) -> None:
        """End an activation, or a change of mode, whose time is over."""
        if self._left <= 0.0:
            self.activations += self._progress is Progress.ACTIVATING
            self._progress = Progress.DONE
            self.halt()
            # A target received meanwhile is followed only from here on.
            self._obey(self._command())
