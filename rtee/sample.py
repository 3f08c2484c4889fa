"""Samples of a hand's actuators: quantities measured, sent, recorded and published at one moment.

`Measurements` is the only list of measured quantities. The loop's state, the recordings, the
messages, tables, plots and their labels follow from it: a new quantity is a field here and one in
the definitions of ``rtee_msgs/ActuatorState`` and ``rtee_msgs/State``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from types import MappingProxyType
from typing import Annotated, Any, Final, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from rtee.touch import TouchReading, TouchState
from rtee.values import Value

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})
"""An empty mapping, as a default."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity that every actuator has.

    Attributes:
        unit: Its unit for a revolute actuator.
        sliding_unit: Its unit for a prismatic actuator; empty: the same.
        digits: Decimals to show.
        span: Smallest span of a plot's axis, so that noise looks like noise.
        heading: Heading of its column in tables; empty: its name.
        dtype: Type of its arrays.
        default: Its value where it is not known.
    """

    unit: str = ""
    sliding_unit: str = ""
    digits: int = 0
    span: float = 1.0
    heading: str = ""
    dtype: str = "float64"
    default: float = math.nan

    def unit_for(self, kinds: Collection[str]) -> str:
        """Return the unit for actuators or joints of some kinds, see `rtee.types.JointKind`."""
        sliding_unit = self.sliding_unit or self.unit
        if sliding_unit == self.unit or "prismatic" not in kinds:
            return self.unit
        return sliding_unit if set(kinds) == {"prismatic"} else f"{self.unit} | {sliding_unit}"


@dataclass(frozen=True, slots=True)
class Measurements(Value):
    """The measured quantities of actuators; ``NaN``: not measured.

    The arrays are ``(n,)`` at one moment, ``(k, n)`` over time.

    Attributes:
        position: Position [rad | m].
        velocity: Velocity [rad/s | m/s].
        effort: Effort [N·m | N].
        current: Motor current [A].
        temperature: Temperature [°C].
    """

    position: Annotated[FloatArray, Quantity("rad", "m", digits=4, span=0.1)]
    velocity: Annotated[FloatArray, Quantity("rad/s", "m/s", digits=4, span=0.1)]
    effort: Annotated[FloatArray, Quantity("N·m", "N", digits=3, span=0.1)]
    current: Annotated[FloatArray, Quantity("A", digits=3, span=0.05)]
    temperature: Annotated[FloatArray, Quantity("°C", digits=1, span=5.0, heading="°C")]


def _quantities(kind: type) -> dict[str, Quantity]:
    # With the extras: otherwise, `get_type_hints` drops the metadata of `Annotated`.
    hints = get_type_hints(kind, include_extras=True).items()
    return {name: hint.__metadata__[0] for name, hint in hints if get_origin(hint) is Annotated}


MEASURED: Final[Mapping[str, Quantity]] = _quantities(Measurements)
"""The measured quantities, by the attribute of `Measurements`, in order."""

measured_arrays = attrgetter(*MEASURED)
"""Return the arrays of `Measurements` as a tuple, in their order."""


@functools.cache
def unmeasured(shape: tuple[int, ...]) -> FloatArray:
    """Return the shared read-only array of ``NaN`` for quantities that are not measured."""
    array = np.full(shape, np.nan)
    array.flags.writeable = False  # one array for all devices and moments
    return array


@dataclass(frozen=True, slots=True, kw_only=True)
class ActuatorState(Measurements):
    """The measured state of a device, in the order of its actuators.

    Attributes:
        stamp: Time of the measurement, CLOCK_MONOTONIC [s].
        fresh: Whether the measurement is new; ``False``: it repeats an earlier one.
        grasped: Whether each actuator holds an object, as the device itself reports; ``None``: no
            report.
        extras: Further channels by name, for example ``pressure``. ``contact_force`` is the force
            on each finger of the hand, summed over its links, in the hand's order [N]; ``NaN``:
            not measured.
        warnings: Conditions reported by the device that are not faults.
        touch: The newest reading of the sensors in ``capabilities.touch``; without a newer one,
            the same object as before, or ``None``.
    """

    stamp: float
    fresh: bool = True
    grasped: tuple[bool | None, ...] | None = None
    extras: Mapping[str, FloatArray] = field(default_factory=lambda: NOTHING)
    warnings: tuple[str, ...] = ()
    touch: TouchReading | None = None

    @classmethod
    def measured(
        cls,
        position: Sequence[float] | FloatArray,
        stamp: float,
        *,
        velocity: Sequence[float] | FloatArray | None = None,
        effort: Sequence[float] | FloatArray | None = None,
        current: Sequence[float] | FloatArray | None = None,
        temperature: Sequence[float] | FloatArray | None = None,
        grasped: tuple[bool | None, ...] | None = None,
        extras: Mapping[str, FloatArray] = NOTHING,
        warnings: tuple[str, ...] = (),
        touch: TouchReading | None = None,
        fresh: bool = True,
    ) -> ActuatorState:
        """Return a state; quantities left out count as not measured (``NaN``)."""
        positions = np.asarray(position, np.float64)
        shape = positions.shape

        def array(values: Sequence[float] | FloatArray | None) -> FloatArray:
            return unmeasured(shape) if values is None else np.asarray(values, np.float64)

        return cls(
            positions,
            array(velocity),
            array(effort),
            array(current),
            array(temperature),
            stamp=stamp,
            fresh=fresh,
            grasped=grasped,
            extras=extras,
            warnings=warnings,
            touch=touch,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TickRecord(Measurements):
    """The measurements and references of a hand at one tick.

    All arrays are in the hand's order of actuators ``(n,)``; they are never changed once they are
    in a record.

    Attributes:
        tick: Number of the tick; a missed tick leaves a gap.
        stamp: Due time of the tick, CLOCK_MONOTONIC of the hand's computer [s].
        wall_ns: Wall-clock time of the due time [ns since 1970], for log times only.
        grasped: The devices' own reports, ``int8``: 1 holding, 0 not holding, -1 no report.
        fresh: Whether each measurement is newer than at the previous tick.
        reference_position: Positions sent to the devices, after the limiter [rad | m].
        reference_velocity: Their velocities [rad/s | m/s].
        reference_effort: Effort limits sent to the devices [N·m | N]; ``inf``: the device's own.
        channels: Values of further measured channels, by ``device/channel``.
        touch: Newest states of the touch sensors, by device; a new state is a new object.
    """

    tick: int
    stamp: float
    wall_ns: int
    grasped: Annotated[NDArray[np.int8], Quantity(dtype="int8", default=-1)]
    fresh: Annotated[BoolArray, Quantity(dtype="bool", default=False)]
    reference_position: Annotated[FloatArray, Quantity("rad", "m", digits=4, heading="reference")]
    reference_velocity: Annotated[FloatArray, Quantity("rad/s", "m/s", digits=4)]
    reference_effort: Annotated[FloatArray, Quantity("N·m", "N", digits=3)]
    channels: Mapping[str, FloatArray]
    touch: Mapping[str, TouchState] = field(default_factory=lambda: NOTHING)


COLUMNS: Final[Mapping[str, Quantity]] = _quantities(TickRecord)
"""All quantities of a tick, measured and sent, by the attribute of `TickRecord`, in order."""
