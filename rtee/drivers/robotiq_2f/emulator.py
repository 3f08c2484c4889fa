"""Emulates a Robotiq two-finger gripper on the wire.

Behaviour that no manual states is a property here: the duration of the activation and the direction
of the automatic release.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing
from rtee.drivers.options import Byte, Duration
from rtee.drivers.robotiq_2f.codec import FAULTS as FAULTS_BY_CODE
from rtee.drivers.robotiq_2f.codec import MODELS, Command, Grasp, Status
from rtee.drivers.robotiq_common import COUNTS, INPUT, OUTPUT, Progress
from rtee.drivers.robotiq_emulator import RobotiqEmulator, RobotiqProperties
from rtee.drivers.scale import LinearScale

_SILENT = 0x09  # gFLT: no communication for at least a second
_HOTTEST = 85.0
"""Temperature of the motor above which it reports over temperature [°C]; no manual states it."""


class Robotiq2FProperties(RobotiqProperties, frozen=True):
    """Properties of the emulated gripper in addition to those of all Robotiq grippers.

    Attributes:
        model: ``2f_85``, ``2f_140``, ``hand_e`` or ``hand_e_c10``.
        position: Position of the fingers at power-up [counts].
        open_count: gPO when fully open.
        closed_count: gPO when fully closed.
        output: First register of the output block; on TCP it is at 0, too, as in Robotiq's
            universal controller, whose clients read by function 4.
        input: First register of the input block; likewise.
        release_opens: Whether the automatic release opens; ``None``: if the bit rARD is set.
        watch: Silence after which it reports lost communication [s].
    """

    model: Literal["2f_85", "2f_140", "hand_e", "hand_e_c10"] = "2f_85"
    position: float = 3.0
    open_count: Byte = 3
    closed_count: Byte = 230
    output: int = OUTPUT
    input: int = INPUT
    release_opens: bool | None = None
    watch: Duration = 1.0


class Robotiq2FEmulator(RobotiqEmulator):
    """A 2F-85, 2F-140 or Hand-E.

    Attributes:
        axis: Its fingers; positions in counts of gPO, efforts in N at the fingertips.
    """

    PROPERTIES = Robotiq2FProperties
    SHARED = ("unit", "baudrate", "model", "open_count", "closed_count")
    CODES: ClassVar[Mapping[str, int]] = {
        "over_temperature": 0x08,
        "under_voltage": 0x0A,
        "internal": 0x0C,
        "activation_failed": 0x0D,
        "overcurrent": 0x0E,
    }
    FAULTS = RobotiqEmulator.FAULTS | frozenset(CODES)
    CODES_OF = FAULTS_BY_CODE
    PASSING = "over_temperature"
    WRONG = (0, 0xC0)

    def __init__(self, properties: Robotiq2FProperties | None = None) -> None:
        made = self.properties = properties or Robotiq2FProperties()
        self.model = MODELS[made.model]
        low, high = self.model.force
        self.axis = Axis(
            made.position,
            lower=made.open_count,
            upper=made.closed_count,
            max_effort=low,
            time_constant=0.01,
            friction=0.5 * low,  # it moves even with its weakest grip
            resolution=0.3,
            rating=high,
            self_locking=True,  # the screw keeps the fingers where they are
        )
        counts = (made.closed_count - made.open_count) / self.model.stroke  # [1/m]
        slow, fast = self.model.speed
        self._speed = LinearScale(COUNTS, (slow * counts, fast * counts))
        self._force = LinearScale(COUNTS, self.model.force)
        self._heard: float | None = None
        self._silent = False
        super().__init__(made, [self.axis])

    @classmethod
    def fitting(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the properties that follow from a driver's options."""
        base = options.get("register_base")
        places = {} if base is None else {"output": base, "input": base}
        return {**super().fitting(options), **places}

    def closings(self) -> Sequence[Closing]:
        """Return the closing motion of the fingers."""
        return [Closing(self.axis, self.axis.lower, self.axis.upper, self.model.force[1])]

    def closure_at(self, width: float) -> float:
        """Return the fraction of the travel at which the fingers meet a width [m]."""
        return self.model.closure(width)

    # --- registers ---------------------------------------------------------------------------

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return registers; after a long silence of the host, the status reports it once."""
        self._hear(now)
        return super().read(function, address, count, now)

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Merge registers into the output block, wherever they start, and execute the command."""
        self._hear(now)
        super().write(address, values, now)

    def _hear(self, now: float) -> None:
        if self._heard is not None and now - self._heard >= self.properties.watch:
            self._silent = True
        self._heard = now

    def _windows(self) -> Sequence[tuple[int, int]]:
        own = (self.properties.input, self.properties.output)
        return [own, (0, 0)] if self.framing == "tcp" else [own]

    def _command(self) -> Command:
        return Command.from_registers(self.output)

    def _staying(self) -> Command:
        here = round(self.axis.position)
        return Command(activate=True, go=True, position=here, speed=255, force=255)

    def status(self) -> Status:
        """Return the status that the gripper reports."""
        command = self._command()
        going = self._going(command)
        grasp = self._grasp() if going else Grasp.MOVING
        # At rest without an object it draws no current, not even at the end of its travel.
        holds = grasp in (Grasp.CONTACT_CLOSING, Grasp.CONTACT_OPENING)
        effort = abs(self.axis.effort) if holds or self.axis.velocity != 0.0 else 0.0
        fault = self._reported_fault(command) or (_SILENT if self._silent else 0)
        self._silent = False
        return Status(
            activated=command.activate,
            going=going,
            progress=Progress.RESET if self._releasing else self._progress,
            grasp=grasp,
            fault=fault,
            requested=command.position,
            position=round(min(max(self.axis.measured, 0.0), 255.0)),
            raw_current=min(round(effort / self.axis.rating * 100), 255),
        )

    def _grasp(self) -> Grasp:
        if self._started or self.axis.moving:
            return Grasp.MOVING
        error = self.axis.target - self.axis.position
        blocked = abs(error) > 1.0 and self.axis.lower < self.axis.position < self.axis.upper
        if blocked or self.axis.stuck:
            return Grasp.CONTACT_CLOSING if error > 0 else Grasp.CONTACT_OPENING
        return Grasp.AT_REQUEST

    # --- behaviour ---------------------------------------------------------------------------

    def _follow(self, command: Command) -> bool:
        self._set(command.speed, command.force)
        changed = self.axis.target != command.position
        self.axis.target = command.position
        return changed

    def _set(self, speed: int, force: int) -> None:
        self.axis.max_velocity = self._speed.to_si(speed)
        self.axis.max_effort = self._force.to_si(force)

    def _release(self, command: Command) -> None:
        opens = self.properties.release_opens
        opens = command.direction if opens is None else opens
        self._set(0, 0)
        self.axis.target = self.axis.lower if opens else self.axis.upper

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        super().advance(now)
        if "over_temperature" not in self.faults and self.axis.temperature > _HOTTEST:
            self.inject("over_temperature")
