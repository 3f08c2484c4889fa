"""Emulates Robotiq's three-finger gripper on the wire.

Behaviour that no manual states is a property here: the duration of the activation and of a change
of mode. The blocks are served at both addresses that the editions of the manual name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing
from rtee.drivers.options import Duration
from rtee.drivers.robotiq_3f import codec
from rtee.drivers.robotiq_3f.codec import FAULTS as FAULTS_BY_CODE
from rtee.drivers.robotiq_common import COUNTS, INPUT, OUTPUT, Progress
from rtee.drivers.robotiq_emulator import RobotiqEmulator, RobotiqProperties
from rtee.drivers.scale import LinearScale

_SCISSOR_OF = {
    codec.Mode.BASIC: 0x89,
    codec.Mode.PINCH: 0xDC,
    codec.Mode.WIDE: 0x19,
    codec.Mode.SCISSOR: 0x19,
}
"""Rest position of the scissor [counts]: 0x89 is in the manual's frames, the others are
estimates."""

_VELOCITY = LinearScale(
    COUNTS, (codec.SPEED[0] * 255 / codec.STROKE, codec.SPEED[1] * 255 / codec.STROKE)
)
"""rSPx to [counts/s] of gPOx."""

_FORCE = LinearScale(COUNTS, codec.FORCE)
"""rFRx to [N]."""

_OPEN = 6
"""Position of a finger that is fully open [counts], as in the manual's frames."""

_OBSTRUCTED, _MODE_FAILED = 0x0A, 0x0E  # gFLT: codes of the scissor


class Robotiq3FProperties(RobotiqProperties, frozen=True):
    """Properties of the emulated gripper in addition to those of all Robotiq grippers.

    Attributes:
        activation_time: Duration of the activation [s].
        mode_time: Duration of a change of mode [s].
    """

    activation_time: Duration = 3.0
    mode_time: Duration = 1.0


class Robotiq3FEmulator(RobotiqEmulator):
    """The three-finger gripper; its axes are fingers a, b, c and the scissor."""

    PROPERTIES = Robotiq3FProperties
    SHARED = ("unit", "baudrate")
    CODES: ClassVar[Mapping[str, int]] = {
        "scissor_obstructed": _OBSTRUCTED,
        "activation_failed": 0x0D,
        "mode_change_failed": _MODE_FAILED,
    }
    FAULTS = RobotiqEmulator.FAULTS | frozenset(CODES)
    CODES_OF = FAULTS_BY_CODE
    PASSING = "scissor_obstructed"
    WRONG = (1, 0xF000)

    def __init__(self, properties: Robotiq3FProperties | None = None) -> None:
        made = self.properties = properties or Robotiq3FProperties()
        fingers = [_axis(_OPEN, _OPEN) for _ in range(3)]
        super().__init__(made, [*fingers, _axis(_SCISSOR_OF[codec.Mode.BASIC], 0)])

    def _power_up(self, activated: bool) -> None:
        self._mode = codec.Mode.BASIC
        super()._power_up(activated)

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the fingers; the scissor does not close on an object."""
        return [Closing(axis, _OPEN, axis.upper, codec.FORCE[1]) for axis in self.axes[:3]]

    # --- registers ---------------------------------------------------------------------------

    def _windows(self) -> Sequence[tuple[int, int]]:
        return [(INPUT, OUTPUT), (0, 0)]

    def _command(self) -> codec.Command:
        return codec.Command.from_registers(self.output)

    def _staying(self) -> codec.Command:
        a, b, c, scissor = (codec.Request(round(axis.position), 255, 255) for axis in self.axes)
        return codec.Command(activate=True, go=True, axes=(a, b, c, scissor))

    def status(self) -> codec.Status:
        """Return the status that the gripper reports."""
        command = self._command()
        going = self._going(command)
        contacts = [_contact(axis, self._started or not going) for axis in self.axes]
        echoes = [
            command.axes[0].position,
            command.axes[1].position if command.individual else 0,
            command.axes[2].position if command.individual else 0,
            command.axes[3].position if command.scissor else 0,
        ]
        axes = tuple(
            codec.AxisStatus(contact, echo, _count(axis.measured), _current(axis))
            for contact, echo, axis in zip(contacts, echoes, self.axes, strict=True)
        )
        return codec.Status(
            activated=command.activate,
            mode=self._mode,
            going=going,
            progress=Progress.RESET if self._releasing else self._progress,
            motion=_motion(contacts[:3]) if going else codec.Motion.MOVING,
            fault=self._reported_fault(command),
            axes=axes,
        )

    # --- behaviour ---------------------------------------------------------------------------

    def _apply(self, command: Any) -> None:
        moves = command.activate and not command.release and self._progress is Progress.DONE
        if not command.activate:
            self._mode = codec.Mode.BASIC
        if moves and command.mode is not self._mode:
            self._change_mode(command.mode)
        else:
            super()._apply(command)

    def _obey(self, command: Any) -> None:
        # Until the mode has changed, the fingers do not follow requests made for the new one.
        if command.mode is self._mode:
            super()._obey(command)

    def _follow(self, command: codec.Command) -> bool:
        fingers = list(command.axes[:3]) if command.individual else [command.axes[0]] * 3
        scissor = codec.Request(_SCISSOR_OF[self._mode], 255, 255)
        requests = [*fingers, command.axes[3] if command.scissor else scissor]
        changed = False
        for axis, request in zip(self.axes, requests, strict=True):
            axis.max_velocity = _VELOCITY.to_si(request.speed)
            axis.max_effort = _FORCE.to_si(request.force)
            # A position beyond the end is replaced by the end, and that counts as reached.
            target = min(max(float(request.position), axis.lower), axis.upper)
            changed |= axis.target != target
            axis.target = target
        return changed

    def _release(self, command: codec.Command) -> None:
        for axis in self.axes[:3]:
            axis.max_velocity = _VELOCITY.to_si(0)
            axis.target = _OPEN

    def _change_mode(self, mode: codec.Mode) -> None:
        if self._blocked():
            return
        self._mode = mode
        self._progress, self._left = Progress.CHANGING, self.properties.mode_time
        # The scissor's whole range, 255 counts, with a margin, within the time of a change.
        self.axes[3].max_velocity = 300.0 / max(self.properties.mode_time, 1e-3)
        self.axes[3].target = _SCISSOR_OF[mode]

    def _activate(self, dt: float) -> None:
        """Cycle all fingers and the scissor, which ends at its position in basic mode."""
        super()._activate(dt)
        scissor = self.axes[3]
        if self._progress is Progress.ACTIVATING and scissor.target == scissor.lower:
            scissor.target = _SCISSOR_OF[codec.Mode.BASIC]

    def _progress_by(self, dt: float) -> None:
        super()._progress_by(dt)
        if self._progress is Progress.CHANGING and self._fault not in (_OBSTRUCTED, _MODE_FAILED):
            self._left -= dt
            self._finish()


def _axis(position: float, lower: int) -> Axis:
    return Axis(
        position,
        lower=lower,
        upper=255,
        time_constant=0.01,
        friction=2.0,
        resolution=0.3,
        # Currents are reported relative to the strongest grip, independent of the commanded force.
        rating=codec.FORCE[1],
    )


def _contact(axis: Axis, moving: bool) -> codec.Contact:
    if moving or axis.moving:
        return codec.Contact.MOVING
    error = axis.target - axis.position
    if abs(error) <= 1.0:
        return codec.Contact.AT_REQUEST
    return codec.Contact.CLOSING if error > 0 else codec.Contact.OPENING


def _motion(contacts: Sequence[codec.Contact]) -> codec.Motion:
    if codec.Contact.MOVING in contacts:
        return codec.Motion.MOVING
    short = sum(contact is not codec.Contact.AT_REQUEST for contact in contacts)
    if not short:
        return codec.Motion.ALL_REACHED
    return codec.Motion.ALL_SHORT if short == codec.FINGERS else codec.Motion.SOME_SHORT


def _current(axis: Axis) -> int:
    return min(round(abs(axis.effort) / axis.rating * 100), 255)


def _count(position: float) -> int:
    return min(max(round(position), 0), 255)
