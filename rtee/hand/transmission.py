"""Map actuator positions to joint positions, for mimic joints, chains of them and expressions.

Every moving joint follows at most one actuator, directly or through a chain of mimics. Its position
is the composition of the couplings in that chain: ``multiplier · q + offset`` for a linear one, an
expression of ``q`` for a non-linear one. Passive joints stay at rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from rtee.errors import ExpressionError, UnknownJoint
from rtee.hand.urdf import Urdf, UrdfJoint, UrdfMimic
from rtee.sample import FloatArray
from rtee.types import readonly

if TYPE_CHECKING:
    from rtee.hand.expression import Expression

_SAMPLES: Final = 65
"""Number of actuator positions at which a coupling is checked: enough to find a pole or a root of a
usual formula."""


@dataclass(frozen=True, slots=True)
class Linear:
    """A linear coupling ``factor · q + offset``."""

    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Coupling:
    """Coupling of a joint to an actuator.

    Attributes:
        actuator: Index of the actuator; ``None`` for a joint that does not move.
        stages: Functions applied in order from the actuator to the joint; never two linear ones in
            a row.
    """

    actuator: int | None
    stages: tuple[Linear | Expression, ...] = (Linear(),)

    @property
    def linear(self) -> bool:
        """Whether the joint is a linear function of the actuator."""
        return len(self.stages) == 1 and isinstance(self.stages[0], Linear)

    def then(self, stage: Linear | Expression) -> Coupling:
        """Return the coupling of a joint that follows this one by ``stage``."""
        last = self.stages[-1]
        if isinstance(stage, Linear) and isinstance(last, Linear):
            # Merged, so that long chains of mimics cost no more than a single one.
            merged = Linear(stage.factor * last.factor, stage.factor * last.offset + stage.offset)
            return Coupling(self.actuator, (*self.stages[:-1], merged))
        # Drop the identity that every coupling begins with.
        if last == Linear() and len(self.stages) == 1:
            return Coupling(self.actuator, (stage,))
        return Coupling(self.actuator, (*self.stages, stage))

    def value(self, q: float) -> float:
        """Return the joint's position [rad | m] at actuator position ``q``."""
        for stage in self.stages:
            q = stage.factor * q + stage.offset if isinstance(stage, Linear) else stage(q)
        return q

    def dual(self, q: float) -> tuple[float, float]:
        """Return the joint's position and its derivative by the actuator's position."""
        slope = 1.0
        for stage in self.stages:
            if isinstance(stage, Linear):
                q, change = stage.factor * q + stage.offset, stage.factor
            else:
                q, change = stage.dual(q)
            slope *= change
        return q, slope


def _value(coupling: Coupling, q: float) -> float:
    # An expression may raise an error for NaN instead of returning NaN.
    return coupling.value(q) if math.isfinite(q) else math.nan


def _slope(coupling: Coupling, q: float) -> float:
    return coupling.dual(q)[1] if math.isfinite(q) else math.nan


class Transmission:
    """The map from actuator positions ``u`` to joint positions ``q``.

    If every coupling is linear, ``q = matrix · u + offset``.

    Attributes:
        couplings: The coupling of each joint.
        n_joints: Number of joints m.
        matrix: Linear part ``(m, n)``; rows of non-linear joints are zero.
        offset: Constant part ``(m,)`` [rad | m]; entries of non-linear joints are zero.
        linear: Whether every coupling is linear.
    """

    def __init__(self, couplings: Sequence[Coupling], n_actuators: int) -> None:
        self.couplings = tuple(couplings)
        self.n_joints = len(self.couplings)
        matrix = np.zeros((self.n_joints, n_actuators))
        offset = np.zeros(self.n_joints)
        for row, coupling in enumerate(self.couplings):
            if not coupling.linear:
                continue
            stage = coupling.stages[0]
            assert isinstance(stage, Linear)  # noqa: S101 - narrows the type
            offset[row] = stage.offset
            if coupling.actuator is not None:
                matrix[row, coupling.actuator] = stage.factor
        # All callers share the array, so it must not be changed in place.
        matrix.flags.writeable = False
        self.matrix: FloatArray = matrix
        self.offset = readonly(offset)
        self._curved = [
            (row, coupling.actuator, coupling)
            for row, coupling in enumerate(self.couplings)
            if coupling.actuator is not None and not coupling.linear
        ]
        self.linear = not self._curved
        # A joint follows at most one actuator. Indexing instead of a matrix product keeps the NaN
        # of an unmeasured actuator from the joints of all others, since 0 · NaN is NaN.
        follows = [coupling.actuator or 0 for coupling in self.couplings]
        self._follows = np.array(follows, dtype=np.intp)
        self._factor = matrix[np.arange(self.n_joints), self._follows]
        self._still = np.flatnonzero([coupling.actuator is None for coupling in self.couplings])

    def joints(self, u: FloatArray) -> FloatArray:
        """Return joint positions.

        Args:
            u: Actuator positions ``(n,)`` or ``(k, n)`` [rad | m]; ``NaN``: not measured.

        Returns:
            Joint positions ``(m,)`` or ``(k, m)`` [rad | m]; ``NaN`` for the joints that follow
            an actuator that is not measured, and for no others.
        """
        u = np.asarray(u, dtype=np.float64)
        q: FloatArray = u[..., self._follows] * self._factor + self.offset
        # Joints at rest were computed with actuator 0, whose NaN must not reach them.
        if self._still.size:
            q[..., self._still] = self.offset[self._still]
        for row, actuator, coupling in self._curved:
            if u.ndim == 1:
                q[row] = _value(coupling, float(u[actuator]))
            else:
                q[:, row] = [_value(coupling, v) for v in u[:, actuator].tolist()]
        return q

    def velocities(self, u: FloatArray, rates: FloatArray) -> FloatArray:
        """Return joint velocities.

        Args:
            u: Actuator positions ``(n,)`` or ``(k, n)`` [rad | m]; ``NaN``: not measured.
            rates: Actuator velocities of the same shape [rad/s | m/s]; ``NaN``: not measured.

        Returns:
            Joint velocities ``(m,)`` or ``(k, m)`` [rad/s | m/s]; ``NaN`` as in `joints`.
        """
        v: FloatArray = rates[..., self._follows] * self._factor
        if self._still.size:
            v[..., self._still] = 0.0
        for row, actuator, coupling in self._curved:
            if u.ndim == 1:
                v[row] = _slope(coupling, float(u[actuator])) * rates[actuator]
            else:
                slopes = [_slope(coupling, q) for q in u[:, actuator].tolist()]
                v[:, row] = np.array(slopes) * rates[:, actuator]
        return v

    def jacobian(self, u: FloatArray) -> FloatArray:
        """Return the derivative ``(m, n)`` of the joints by the actuators at positions ``(n,)``."""
        # A copy, since the matrix is shared and read-only.
        jacobian: FloatArray = self.matrix.copy()
        for row, actuator, coupling in self._curved:
            jacobian[row, actuator] = coupling.dual(float(u[actuator]))[1]
        return jacobian

    def moves(self, joint: int) -> int | None:
        """Return the index of the actuator that moves a joint, if any does.

        A joint coupled with the factor zero is moved by none.
        """
        coupling = self.couplings[joint]
        if coupling.linear and not self.matrix[joint].any():
            return None
        return coupling.actuator


def make_transmission(
    urdf: Urdf, actuators: Sequence[str], standing: Mapping[str, float]
) -> Transmission:
    """Make the transmission of a hand.

    Args:
        urdf: The hand's URDF.
        actuators: Names of the actuators; their order is that of ``u``.
        standing: Passive joints that follow nothing, with their positions [rad | m].

    Returns:
        The transmission to all moving joints, in the URDF's order.

    Raises:
        ModelError: if a joint mimics a missing or fixed joint, or mimics form a loop, or an
            expression cannot be read or has no finite value somewhere within the actuator's limits.
    """
    index = {name: i for i, name in enumerate(actuators)}
    known: dict[str, Coupling] = {name: Coupling(i) for name, i in index.items()}
    known |= {name: Coupling(None, (Linear(0.0, at),)) for name, at in standing.items()}
    for joint in urdf.joints.values():
        if joint.moving:
            _resolve(urdf, joint, known)
    couplings = [known[joint.name] for joint in urdf.joints.values() if joint.moving]
    _check_range(urdf, [urdf.joints[name] for name in actuators], known)
    return Transmission(couplings, len(actuators))


def check_mimics(urdf: Urdf) -> None:
    """Refuse joints that mimic missing or fixed joints, and mimics that form a loop.

    Raises:
        ModelError: if there are some.
    """
    free = {j.name: Coupling(None) for j in urdf.joints.values() if j.moving and not j.mimic}
    for joint in urdf.joints.values():
        if joint.moving:
            _resolve(urdf, joint, dict(free))


def _resolve(urdf: Urdf, joint: UrdfJoint, known: dict[str, Coupling]) -> None:
    """Add the coupling of a joint, after those of the joints it follows."""
    chain: list[tuple[UrdfJoint, UrdfMimic]] = []
    on_chain: set[str] = set()
    # Up to a joint that is known; then down again, so that a file's order does not matter.
    while joint.name not in known:
        mimic = joint.mimic
        if mimic is None:
            what = f"joint '{joint.name}' is neither an actuator nor mimic nor passive"
            raise urdf.error(what, joint.line)
        if joint.name in on_chain:
            names = " -> ".join(f"'{j.name}'" for j, _ in chain)
            raise urdf.error(f"mimic loop: {names} -> '{joint.name}'", mimic.line)
        on_chain.add(joint.name)
        chain.append((joint, mimic))
        joint = _master(urdf, joint, mimic)
    coupling = known[joint.name]
    for follower, mimic in reversed(chain):
        coupling = coupling.then(_stage(urdf, follower, mimic))
        # A joint that follows a joint at rest is at rest, too, at the position of its formula.
        if coupling.actuator is None:
            coupling = Coupling(None, (Linear(0.0, coupling.value(0.0)),))
        known[follower.name] = coupling


def _master(urdf: Urdf, joint: UrdfJoint, mimic: UrdfMimic) -> UrdfJoint:
    master = urdf.joints.get(mimic.of)
    moving = [name for name, other in urdf.joints.items() if other.moving]
    if master is None:
        raise UnknownJoint(mimic.of, moving, path=urdf.path, line=mimic.line)
    if not master.moving:
        what = f"joint '{joint.name}' mimics '{master.name}', which is fixed"
        raise urdf.error(what, mimic.line)
    return master


def _stage(urdf: Urdf, joint: UrdfJoint, mimic: UrdfMimic) -> Linear | Expression:
    if mimic.expression is None:
        return Linear(mimic.multiplier, mimic.offset)
    from rtee.hand.expression import Expression  # few hands have any

    try:
        return Expression(mimic.expression)
    except ExpressionError as error:
        raise ExpressionError(
            f"nlFunPos of joint '{joint.name}': {error.message}",
            column=error.column,
            path=urdf.path,
            line=mimic.line,
        ) from None


def _check_range(urdf: Urdf, actuators: Sequence[UrdfJoint], known: Mapping[str, Coupling]) -> None:
    """Refuse non-linear couplings without a finite value or slope within the limits."""
    for name, coupling in known.items():
        if coupling.actuator is None and not math.isfinite(coupling.value(0.0)):
            raise _undefined(urdf, name, "value at the position of the joint it follows")
        if coupling.linear or coupling.actuator is None:
            continue
        actuator = actuators[coupling.actuator]
        for q in sample(actuator.lower, actuator.upper):
            if not all(math.isfinite(v) for v in coupling.dual(q)):
                raise _undefined(urdf, name, f"value and slope at {actuator.name} = {q:g}")


def _undefined(urdf: Urdf, joint: str, what: str) -> ExpressionError:
    mimic, text = urdf.joints[joint].mimic, f"nlFunPos of joint '{joint}' has no finite {what}"
    return ExpressionError(text, path=urdf.path, line=mimic.line if mimic else None)


def sample(lower: float, upper: float) -> list[float]:
    """Return positions spread evenly over a range; over one turn if it is unlimited."""
    if not math.isfinite(lower) or not math.isfinite(upper):
        lower, upper = -math.pi, math.pi
    return [lower + (upper - lower) * i / (_SAMPLES - 1) for i in range(_SAMPLES)]
