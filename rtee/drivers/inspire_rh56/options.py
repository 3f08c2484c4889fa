"""Options of an RH56, and the motors and scales of its actuators."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, field

from rtee.drivers import wiring
from rtee.drivers.capabilities import GripForce
from rtee.drivers.inspire_rh56.codec import FINGERS, MOST, MOST_TACTILE, OPEN
from rtee.drivers.inspire_rh56.tactile import AREAS, Area
from rtee.drivers.options import DeviceOptions, Length, Moment, Pause
from rtee.drivers.scale import LinearScale
from rtee.errors import ConfigError
from rtee.hand.validation import Section, values_given
from rtee.types import DeviceSpec

LEAST = 100
"""Smallest force limit for which the curves hold [g]; below it, lines to 0 replace them."""

_GRAVITY = 9.80665e-3  # weight of a gram [N]


@dataclass(frozen=True, slots=True)
class ForceCurve:
    """The force curve of a finger, and the lever with which its force acts on the actuator.

    Attributes:
        newton_per_gram: Slope of the curve [N/g].
        offset: Force of the curve at 0 g [N].
        arm: Effort of the actuator per force at the fingertip [N·m/N].
    """

    newton_per_gram: float
    offset: float
    arm: float

    def newtons(self, grams: float) -> float:
        """Return the force at the fingertip [N] for a reading or limit in grams."""
        if abs(grams) < LEAST:
            return grams / LEAST * self.newtons(LEAST)
        return self.newton_per_gram * grams + (self.offset if grams > 0.0 else -self.offset)

    def grams(self, newtons: float) -> float:
        """Return the grams for a force at the fingertip [N], which must not be negative."""
        least = self.newtons(LEAST)
        if newtons < least:
            return newtons / least * LEAST
        return (newtons - self.offset) / self.newton_per_gram


# The arms follow from the lengths of the phalanges and their couplings, with fingers half bent.
FORCES = {
    "little": ForceCurve(6.965e-3, -0.198, 0.085),
    "ring": ForceCurve(6.965e-3, -0.198, 0.10),
    "middle": ForceCurve(6.452e-3, 0.018, 0.10),
    "index": ForceCurve(7.478e-3, -0.414, 0.10),
    "thumb_bend": ForceCurve(12.547e-3, 0.384, 0.15),
    "thumb_rotate": ForceCurve(_GRAVITY, 0.0, 0.07),
}
"""The default force curves of the fingers, by name."""


class MotorScale:
    """Converts between the registers of a motor and its actuator's units.

    Args:
        lower: Position of the actuator at `OPEN` [rad].
        upper: Position of the actuator at 0 counts [rad].
        force: Its force curve.
        most: Largest force limit of the hand [g].
        travel_time: Time for the whole travel at the largest speed [s].
        reverse: Whether counts rise with the position instead.

    Attributes:
        position: Angle counts to [rad].
    """

    def __init__(
        self,
        lower: float,
        upper: float,
        force: ForceCurve,
        *,
        most: int,
        travel_time: float,
        reverse: bool = False,
    ) -> None:
        counts = (0.0, float(OPEN)) if reverse else (float(OPEN), 0.0)
        self.position = LinearScale(counts, (lower, upper))
        self._force = force
        self._most = most
        self._sign = -1.0 if reverse else 1.0
        self._fastest = (upper - lower) / travel_time

    def effort(self, grams: float) -> float:
        """Convert a measured force [g] to an effort [N·m]."""
        return self._sign * self._force.newtons(grams) * self._force.arm

    def limit(self, effort: float) -> int:
        """Convert an effort limit [N·m], which may be infinite, to a force limit [g]."""
        if math.isinf(effort):
            return self._most
        # At least 1: no source says whether 0 switches the motor off.
        return min(max(round(self._force.grams(effort / self._force.arm)), 1), self._most)

    def speed(self, velocity: float) -> int:
        """Convert a velocity limit [rad/s], which may be infinite, to a speed count."""
        share = min(velocity / self._fastest, 1.0)
        # At least 1: at speed 0 a finger would never arrive.
        return max(round(MOST * share), 1)

    @property
    def grip(self) -> GripForce:
        """Forces at the fingertip for the smallest and the largest effort limit."""
        force = self._force
        # From LEAST on: no force was measured below it, so none is promised there.
        low, high = force.newtons(LEAST), force.newtons(self._most)
        return GripForce((low * force.arm, high * force.arm), (low,), (high,))


Finger = Literal["little", "ring", "middle", "index", "thumb_bend", "thumb_rotate"]

TURNAROUND = 0.0025
"""Time from a request to its answer, in addition to that on the wire [s]: recorded exchanges of 29
bytes at 115,200 baud took 6.6 ms: 2.5 ms for the bytes, the rest for hand and computer."""


class ForceOptions(Section, frozen=True):
    """A force calibration of one finger that replaces the default.

    Attributes:
        newton_per_gram: Force at the fingertip per gram in the registers [N/g].
        offset: Force at 0 g [N].
        arm: Effort of the actuator per force at the fingertip [N·m/N].
    """

    newton_per_gram: Annotated[float, Meta(gt=0, le=0.1)] | None = None
    offset: float | None = None
    arm: Length | None = None


class InspireRh56Options(DeviceOptions, frozen=True):
    """Options of an RH56."""

    port: str = "/dev/ttyUSB0"
    """A tty, socket:// or rfc2217:// (serial), or tcp://host:6000 (Modbus TCP)."""
    protocol: Literal["frames", "modbus"] = "frames"
    """On a serial line: the hand's own frames, or Modbus RTU."""
    unit: Annotated[int, Meta(ge=1, le=254)] = 1
    """Number of the hand, also its Modbus number."""
    baudrate: Literal[115_200, 57_600, 19_200, 921_600] = 115_200
    model: Literal["dfx", "dfq", "bfx", "dftp"] = "dfx"
    """``dftp`` has tactile sensors and force limits up to 3000 g, not 1000."""
    fingers: dict[str, Finger] = field(default_factory=dict)
    """The motor that drives each actuator; by default by its name."""
    reverse: frozenset[Finger] = frozenset()
    """Motors whose counts rise with the actuator's position."""
    forces: dict[Finger, ForceOptions] = field(default_factory=dict)
    """Meaning of a finger's grams, where it is known."""
    travel_time: Moment = 0.3
    """Time for the full travel at speed 1000 [s]; published: 0.18 to 0.30."""
    calibration: Path | None = None
    """File of a calibration (``rtee calibrate``): the forces of an idle hand."""
    reading: Literal["auto", "block", "separate"] = "auto"
    """Angles and the rest in one exchange, or in two; ``auto`` tries."""
    touch: Literal["off", "tips", "fingers", "all"] = "off"
    """Taxels of a ``dftp`` that are read over Modbus TCP: those of the tips, of the fingers, or
    all."""
    check_every: Annotated[int, Meta(ge=1)] = 50
    """Number of exchanges between readings of the set-points."""
    retries: Annotated[int, Meta(ge=0, le=10)] = 1
    turnaround: Pause = TURNAROUND
    """Time per answer that the bytes do not explain [s]."""

    @property
    def modbus(self) -> bool:
        """Whether the hand is connected by Modbus."""
        return self.protocol == "modbus" or self.port.startswith("tcp://")

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        if self.touch != "off" and not (self.model == "dftp" and self.port.startswith("tcp://")):
            raise ValueError("touch needs model dftp and Modbus TCP (port: tcp://HOST:6000)")

    @property
    def areas(self) -> tuple[Area, ...]:
        """The arrays of taxels to read."""
        match self.touch:
            case "off":
                return ()
            case "tips":
                return tuple(area for area in AREAS if area.name.endswith(("_tip", "_top")))
            case "fingers":
                return tuple(area for area in AREAS if area.name != "palm")
            case _:
                return AREAS

    @property
    def most(self) -> int:
        """Largest force limit [g]."""
        return MOST_TACTILE if self.model == "dftp" else MOST


def motors_of(spec: DeviceSpec, options: InspireRh56Options) -> tuple[int, ...]:
    """Return the motor of each actuator, by its index in `FINGERS`; raises `ConfigError`."""
    guess = partial(wiring.finger_motor, motors=FINGERS)
    return wiring.motors_of(spec, "fingers", options.fingers, FINGERS, guess)


def scales_of(
    spec: DeviceSpec, options: InspireRh56Options, motors: tuple[int, ...]
) -> tuple[MotorScale, ...]:
    """Return the scale of each actuator; raises `ConfigError` if an actuator has no limits."""
    scales = []
    for actuator, motor in zip(spec.actuators, motors, strict=True):
        ends = spec.mechanism(actuator)
        # Written with `not`, so that limits of NaN are refused, too.
        if not ends.upper - ends.lower < float("inf"):
            raise ConfigError(f"device '{spec.name}': actuator '{actuator.name}' has no limits")
        finger = FINGERS[motor]
        given = options.forces.get(finger)  # type: ignore[call-overload]
        changes = {} if given is None else values_given(given)
        force = replace(FORCES[finger], **changes)
        scales.append(
            MotorScale(
                ends.lower,
                ends.upper,
                force,
                most=options.most,
                travel_time=options.travel_time,
                reverse=finger in options.reverse,
            )
        )
    return tuple(scales)
