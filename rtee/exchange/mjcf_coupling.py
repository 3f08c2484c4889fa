"""Transmission from a model's constraints, in which every joint follows one actuator or none."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import mujoco
import numpy as np

from rtee.errors import ModelError
from rtee.exchange.mjcf_motion import (
    TINY,
    Driven,
    Follow,
    LinearCoupling,
    ModelConstraints,
    ModelMotion,
    Motor,
    PolynomialCoupling,
    bare,
    constraints_of,
    joint_name,
    joint_range,
    motor_factors,
    motor_joints,
    names_of,
    null_space,
    resting_length,
    rounded,
    tendon_joints,
)
from rtee.sample import FloatArray

_STEPS: Final = 400
"""Number of positions along the range of the moving joint: 0.2° apart for a quarter turn."""

_ROUNDS: Final = 200
"""Most Newton steps for one position: usually three to five suffice, twenty in a stretched linkage,
and 100 if springs pull far."""

_STRIDE: Final = 0.1
"""Longest step towards the equilibrium of springs [rad | m]."""

_CLOSED: Final = 1e-9
"""Residual at which a linkage counts as closed [m, rad]."""

_OPEN: Final = 1e-6
"""Residual accepted if the rounded numbers of a file allow no less [m, rad]."""

_FLAT: Final = 1e-6
"""Change of an equality below which a direction counts as open [m/rad]."""

_SINGULAR: Final = 1e-8
"""Share of the largest singular value below which others count as rounding."""

_SOFT: Final = 1e-10
"""Stiffness that counts as 0 [N·m/rad | N/m]: springs of fingers have 1e-4 or more."""

_NEAR: Final = 1e-5
"""Distance of postures whose forces are compared [rad | m]: errors of rounding and of curvature are
both below a billionth of the stiffness."""

_JUMP: Final = 20.0
"""Largest motion of another joint within one step of the moving joint, in units of that step: a
stretched linkage moves fast, and a faster motion is a jump to another solution."""

_DEGREES: Final = 24
"""Highest degree of the polynomial fitted to a joint's motion."""

_CLOSE: Final = 1e-7
"""Desired deviation of the fit [rad | m]."""

_FAR: Final = 1e-4
"""Largest accepted deviation of the fit [rad | m]: less than encoders of hands resolve."""


@dataclass(frozen=True, slots=True)
class Solved:
    """A linkage as couplings.

    Attributes:
        places: Positions of the moving joint with a closed linkage ``(n,)``, ascending [rad | m].
        positions: Positions of the other joints there ``(n, k)`` [rad | m].
        follows: Couplings of the other joints to the moving one.
        notes: Sentences about peculiarities.
    """

    places: FloatArray
    positions: FloatArray
    follows: dict[int, Follow]
    notes: tuple[str, ...]


class Linkage:
    """The equalities of a model as a function of the position of some joints.

    Attributes:
        model: The model.
        joint: The joint that moves the others.
        others: The other joints.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joint: int,
        others: Sequence[int],
        equalities: Collection[int],
        fixed: Mapping[int, float],
        springs: Sequence[LinearCoupling],
        cords: Sequence[int] = (),
    ) -> None:
        """Prepare a model.

        Args:
            model: The model; its contacts and limits are switched off.
            joint: The joint that moves the others.
            others: The other joints.
            equalities: The numbers of the equalities to solve.
            fixed: Positions of the joints that are held [rad | m].
            springs: Springs, which with the joints' limits decide the directions that the
                equalities leave open.
            cords: Spatial tendons with springs, which also decide these directions.
        """
        flags = mujoco.mjtDisableBit
        # Contacts and limits would move the joints, but only the equalities are solved here.
        model.opt.disableflags |= flags.mjDSBL_CONTACT | flags.mjDSBL_LIMIT
        # Dense, so that `efc_J` is a plain matrix.
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.model, self.joint, self.others = model, joint, list(others)
        self._data = mujoco.MjData(model)
        self._equalities = list(equalities)
        self._drawn = model.qpos0.copy()
        for held, position in fixed.items():
            self._drawn[held] += position
        # With the root of the stiffness, least squares minimise the energy of the springs.
        root = np.sqrt([spring.weight for spring in springs])
        factors = [[spring.factors.get(o, 0.0) for o in (joint, *others)] for spring in springs]
        pull = root[:, None] * np.array(factors).reshape(-1, 1 + len(self.others))
        self._moved, self._pull = pull[:, 0], pull[:, 1:]
        self._rest = root * np.array([spring.value for spring in springs])
        self._cords = list(cords)
        self._ranges = [joint_range(model, other) for other in others]
        self._stopped: dict[int, float] = {}
        self._by_springs = False

    def _at(self, x: float, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals ``(r,)`` and their derivatives by all joints ``(r, 1 + n)``."""
        model, data = self.model, self._data
        data.qpos[:] = self._drawn
        data.qpos[self.joint] += x
        data.qpos[self.others] += q
        mujoco.mj_fwdPosition(model, data)
        own = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        own &= np.isin(data.efc_id, self._equalities)
        jacobian = data.efc_J.reshape(-1, model.nv)[own]
        return data.efc_pos[own].copy(), jacobian[:, [self.joint, *self.others]]

    def _springs(self, x: float, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the deflections of the springs ``(s,)`` and their gradients ``(s, 1 + n)``.

        Both are scaled by the root of the stiffness, so that half the square of the first is the
        energy [J]. The gradients are those of the springs' lengths by all joints.
        """
        lacking = self._rest - self._moved * x - self._pull @ q
        pull = np.column_stack([self._moved, self._pull])
        if not self._cords:
            return lacking, pull
        self._at(x, q)
        model, data = self.model, self._data
        root = np.sqrt(model.tendon_stiffness[self._cords])
        lower, upper = model.tendon_lengthspring[self._cords].T
        length = data.ten_length[self._cords]
        levers = np.zeros((len(self._cords), model.nv))
        for row, cord in zip(levers, self._cords, strict=True):
            first = model.ten_J_rowadr[cord]
            entries = slice(first, first + model.ten_J_rownnz[cord])
            row[model.ten_J_colind[entries]] = data.ten_J[entries]
        apart = root * (np.clip(length, lower, upper) - length)
        # Between the two lengths, such a tendon is slack.
        levers[(lower < length) & (length < upper)] = 0.0
        levers = levers[:, [self.joint, *self.others]]
        return np.append(lacking, apart), np.vstack([pull, root[:, None] * levers])

    def _force(self, x: float, q: FloatArray) -> FloatArray:
        """Return the springs' forces on the other joints ``(n,)`` [N·m | N]."""
        lacking, pull = self._springs(x, q)
        return np.asarray(pull[:, 1:].T @ lacking)

    def _stiffness(self, x: float, q: FloatArray, left: FloatArray) -> FloatArray:
        """Return the springs' stiffness ``(k, k)`` along the free directions ``(n, k)`` [N·m/rad].

        The levers of cords and the open directions turn with the posture, which adds stiffness. So
        the stiffness is a difference of the forces along the open directions of neighbouring
        postures.
        """
        pull = self._springs(x, q)[1][:, 1:] @ left
        if not self._cords:
            return np.asarray(pull.T @ pull)
        columns = []
        for direction in left.T:
            sides = []
            for side in (q - _NEAR * direction, q + _NEAR * direction):
                open_there = self._open(x, side)
                sides.append(open_there @ (open_there.T @ self._force(x, side)))
            columns.append(left.T @ (sides[0] - sides[1]) / (2.0 * _NEAR))
        stiffness = np.array(columns)
        stiffness = 0.5 * (stiffness + stiffness.T)
        # Far from the equilibrium, the energy may be concave; the levers alone lead downhill there.
        if np.linalg.eigvalsh(stiffness)[0] > _SOFT:
            return stiffness
        return np.asarray(pull.T @ pull)

    def slopes(self, x: float, q: FloatArray) -> FloatArray:
        """Return the others' velocities relative to the joint's ``(n,)``, in a closed linkage.

        Approximate if springs decide them, since springs count as rigid here.
        """
        rows = np.vstack([self._at(x, q)[1], self._springs(x, q)[1]])
        return np.asarray(-np.linalg.pinv(rows[:, 1:], rcond=_SINGULAR) @ rows[:, 0])

    def settle(self, x: float) -> tuple[FloatArray | None, int]:
        """Close the linkage near the model's posture, with the joint at ``x``.

        From then on, springs and the joints' stops decide the directions that the equalities leave
        open.

        Returns:
            Positions of the others ``(n,)``, or ``None`` if the linkage cannot be closed; and the
            number of their remaining degrees of freedom.
        """
        q = self.close(x, np.zeros(len(self.others)))
        if q is None or not self._open(x, q).shape[1]:
            return q, 0
        self._by_springs = True
        q = self.close(x, q)
        if q is None:
            return None, 0
        left = self._open(x, q)
        if not left.size:
            return q, 0
        decided = np.linalg.matrix_rank(self._stiffness(x, q, left), tol=_SOFT, hermitian=True)
        return q, left.shape[1] - int(decided)

    def _held(self, x: float, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals and derivatives like `_at`, including those of joints at stops."""
        residual, jacobian = self._at(x, q)
        stops = list(self._stopped)
        away = q[stops] - np.array(list(self._stopped.values()))
        return np.append(residual, away), np.vstack([jacobian[:, 1:], np.eye(len(q))[stops]])

    def _open(self, x: float, q: FloatArray) -> FloatArray:
        """Return a basis ``(n, k)`` of the directions in which the other joints can still move."""
        return null_space(self._held(x, q)[1], _FLAT)

    def close(self, x: float, q: FloatArray) -> FloatArray | None:
        """Return the other joints' positions near ``q`` for the joint at ``x``, or ``None``."""
        best, least = q, math.inf
        for _ in range(_ROUNDS):
            residual, jacobian = self._held(x, q)
            size = float(np.abs(residual).max(initial=0.0))
            # With springs, the residual may grow before they reach equilibrium.
            if size < least or self._by_springs:
                best, least = q, size
            if size < _CLOSED and not self._by_springs:
                break
            # By the pseudo-inverse, since equalities of a linkage are often redundant: in a plane,
            # one of the three equations of a `connect` always holds.
            step = -np.linalg.pinv(jacobian, rcond=_SINGULAR) @ residual
            if self._by_springs:
                # Along the open directions, to the equilibrium of the springs.
                left = null_space(jacobian, _FLAT)
                force = left.T @ self._force(x, q + step)
                stiffness = self._stiffness(x, q, left)
                along = left @ np.linalg.pinv(stiffness, rcond=_SINGULAR, hermitian=True) @ force
                # In small steps, since the path of a linkage is straight only over short distances.
                step = step + along * min(1.0, _STRIDE / max(float(np.abs(along).max()), TINY))
            q = q + step
            if not np.all(np.isfinite(q)):
                return None
            if not self._by_springs:
                continue
            still = size < _CLOSED and float(np.abs(step).max(initial=0.0)) < _CLOSED
            if not self._meet_stops(q) and still and not self._leave_stop(x, q):
                break
        return best if least < _OPEN else None

    def _meet_stops(self, q: FloatArray) -> bool:
        """Stop joints that are beyond their limits at these limits; return whether any were."""
        met = {
            i: limit
            for i, (lower, upper) in enumerate(self._ranges)
            for limit, beyond in ((lower, lower - q[i]), (upper, q[i] - upper))
            if beyond > _CLOSED and i not in self._stopped
        }
        self._stopped |= met
        return bool(met)

    def _leave_stop(self, x: float, q: FloatArray) -> bool:
        """Release a joint that springs pull away from its stop; return whether there was one."""
        if not self._stopped:
            return False
        force = self._force(x, q)
        jacobian = self._held(x, q)[1]
        # Equalities and stops bear the springs' forces, but a stop can only push.
        borne = np.linalg.pinv(jacobian.T, rcond=_SINGULAR) @ force
        for i, push in zip(list(self._stopped), borne[-len(self._stopped) :], strict=True):
            outward = 1.0 if self._stopped[i] == self._ranges[i][1] else -1.0
            if outward * push < -TINY:
                del self._stopped[i]
                return True
        return False


def horner(coefficients: Sequence[float], variable: str = "x") -> str:
    """Return a polynomial as an expression in Horner's form, which loses no digits."""
    text = repr(float(coefficients[-1]))
    for coefficient in reversed(coefficients[:-1]):
        text = f"{float(coefficient)!r} + {variable}*({text})"
    return text


def solve_loop(linkage: Linkage, limits: tuple[float, float], what: str) -> Solved:
    """Solve a closed linkage for the motion of its joints by one of them.

    Args:
        linkage: The linkage.
        limits: Range of the joint relative to the model's posture [rad | m].
        what: Name of the constraint that closes the linkage, for messages.

    Raises:
        ModelError: if the linkage leaves the others free, cannot be closed near the model's
            posture, or no polynomial fits its motion.
    """
    model, joint, others = linkage.model, linkage.joint, linkage.others
    start = min(max(0.0, limits[0]), limits[1])
    first, free = linkage.settle(start)
    if first is None:
        raise ModelError(f"{what} cannot be closed at the start of its range")
    if free > 0:
        raise ModelError(
            f"{what} leaves joints {names_of(model, [joint, *others])} {free + 1} degrees of "
            "freedom that no spring decides, and one actuator moves them; couple them, or give "
            "each an actuator"
        )
    step = (limits[1] - limits[0]) / _STEPS
    x, y = _closed_between(linkage, limits, step, start, first)
    lower, upper = float(x[0]), float(x[-1])
    notes = [
        f"{what} is solved: joints {names_of(model, others)} follow '{joint_name(model, joint)}'"
    ]
    if lower > limits[0] + step or upper < limits[1] - step:
        notes.append(
            f"{what} closes only while '{joint_name(model, joint)}' is between {lower:.4g} and "
            f"{upper:.4g}, which become its limits"
        )
    if upper - lower < step:
        raise ModelError(f"{what} cannot move")
    follows = {
        other: _fitted(model, joint, other, x, y[:, i], what) for i, other in enumerate(others)
    }
    return Solved(x, y, follows, tuple(notes))


def _closed_between(
    linkage: Linkage, limits: tuple[float, float], step: float, start: float, first: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Move a linkage from a closed posture towards both limits for as long as it stays closed.

    Return the positions of the moving joint ``(n,)``, ascending, ``step`` apart, and those of the
    others ``(n, k)``, which are ``first`` at ``start``.
    """
    places, positions = [start], [first]
    jump = _JUMP * step
    if linkage.model.jnt_type[linkage.joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        # The shorter the levers of hinges, the more radians per metre they follow a slide.
        jump *= max(1.0, float(np.abs(linkage.slopes(start, first)).max()))
    for end in limits:
        at, q, before = start, first, first
        while abs(end - at) > TINY:
            ahead = math.copysign(min(step, abs(end - at)), end - at)
            # Start from an extrapolation of the last step, so that the linkage does not fold over.
            closed = linkage.close(at + ahead, 2.0 * q - before)
            # After a jump, Newton's method has found another solution.
            if closed is None or float(np.abs(closed - q).max()) > jump:
                break
            at, q, before = at + ahead, closed, q
            places.append(at)
            positions.append(q)
    order = np.argsort(places)
    return np.array(places)[order], np.array(positions)[order]


def _fitted(
    model: mujoco.MjModel,
    joint: int,
    other: int,
    x: FloatArray,
    y: FloatArray,
    what: str,
) -> Follow:
    """Return the coupling of a joint: linear if possible, otherwise a polynomial."""
    middle, half = float(0.5 * (x[0] + x[-1])), float(0.5 * (x[-1] - x[0]))
    # Scaled to -1 … 1, since high powers of the plain positions would lose digits.
    t = (x - middle) / half
    error = math.inf
    for degree in (1, *range(2, _DEGREES + 1)):
        fit = np.polynomial.Chebyshev.fit(t, y, degree, domain=[-1.0, 1.0])
        error = float(np.abs(fit(t) - y).max())
        if error <= (_CLOSED * 10 if degree == 1 else _CLOSE):
            break
    if error > _FAR:
        raise ModelError(
            f"{what}: joint '{joint_name(model, other)}' follows '{joint_name(model, joint)}' "
            f"along a path that no polynomial fits within {_FAR:g}"
        )
    powers = fit.convert(kind=np.polynomial.Polynomial).coef
    if len(powers) <= 2:
        factor = float(powers[1] / half) if len(powers) > 1 else 0.0
        return Follow(joint, factor, float(powers[0]) - factor * middle)
    return Follow(
        joint,
        expression=horner(powers.tolist(), f"((x - {middle!r})/{half!r})".replace("- -", "+ ")),
    )


_SLACK = 1e-6
"""Largest excess of a tendon's length over its limits that counts as rounding [rad | m]."""


@dataclass(slots=True, kw_only=True)
class _Group(ModelConstraints):
    """Joints that depend on one another and on no other joints, with their constraints.

    Attributes:
        joints: The joints, in the model's order.
    """

    joints: list[int]


def motion_of(model: mujoco.MjModel) -> ModelMotion:
    """Return the motion of a model's hinge and slide joints.

    Raises:
        ModelError: if the couplings leave a number of degrees of freedom other than that of the
            motors, or a joint follows several motors, or a linkage cannot be solved.
    """
    constraints = constraints_of(model)
    # Do this first, since held joints drop their motors, and their followers need no solution.
    _hold(constraints)
    motion = ModelMotion(fixed=dict(constraints.fixed), notes=list(constraints.notes))
    held = [motor for motor in constraints.motors if motor.joint in constraints.fixed]
    motion.notes += [
        f"actuator '{motor.name}' moves a joint that is held, so it is left out" for motor in held
    ]
    constraints.motors = [motor for motor in constraints.motors if motor not in held]
    without_motors = not constraints.motors
    _peel(model, constraints, motion)
    constraints.lines += [
        LinearCoupling(
            {c.joint: 1.0, c.of: -c.coefficients[1]}, c.coefficients[0], equality=c.equality
        )
        for c in constraints.curves
        if c.straight
    ]
    constraints.curves = [curve for curve in constraints.curves if not curve.straight]
    if without_motors:
        constraints.motors = _supposed_motors(model, constraints, motion)
        if constraints.motors:
            motion.notes.append(
                "the model has no actuators, so every joint that is free to move counts as one"
            )
    unread = set(constraints.cords)
    for group in _groups(model, constraints, motion):
        if not group.motors:
            # Joints coupled only to each other stay in the position of the model.
            motion.passive += group.joints
        elif group.loops or group.curves:
            _solve_numerically(model, group, motion)
            unread -= set(group.cords)
        else:
            _solve_lines(model, group, motion)
    motion.notes += [
        f"the spring of the spatial tendon '{model.tendon(cord).name}' is ignored, since its "
        "joints are not those of one closed linkage with a motor"
        for cord in sorted(unread)
    ]
    if not motion.driven:
        raise ModelError("has no joint that a motor could move")
    return motion


def _hold(constraints: ModelConstraints) -> None:
    """Hold joints that follow only held joints, and the masters of held linear followers."""
    left: list[PolynomialCoupling] = []
    # Until nothing changes: a joint that is held may hold its followers in turn.
    while len(left) != len(constraints.curves):
        left, constraints.curves = constraints.curves, []
        for curve in left:
            joint, of = constraints.fixed.get(curve.joint), constraints.fixed.get(curve.of)
            c0, c1, *_ = curve.coefficients
            if of is not None:
                position = float(np.polynomial.polynomial.polyval(of, curve.coefficients))
                constraints.fixed.setdefault(curve.joint, position)
            elif joint is not None and curve.straight and abs(c1) > TINY:
                constraints.fixed[curve.of] = (joint - c0) / c1
            else:
                constraints.curves.append(curve)


def _peel(model: mujoco.MjModel, constraints: ModelConstraints, motion: ModelMotion) -> None:
    """Remove the joints that only follow another one, starting at the ends of chains."""
    # A tendon with a spring may also pull such a joint, but the rigid coupling prevails.
    while True:
        used = [joint for curve in constraints.curves for joint in (curve.joint, curve.of)]
        for line in (*constraints.lines, *_sums(constraints.springs)):
            used += line.factors
        for loop in constraints.loops:
            used += loop.joints
        for motor in constraints.motors:
            used += motor_joints(model, motor)
        leaves = [c for c in constraints.curves if used.count(c.joint) == 1 and c.of != c.joint]
        if not leaves:
            return
        for curve in leaves:
            c0, c1, *_ = curve.coefficients
            if curve.straight:
                motion.follows[curve.joint] = Follow(curve.of, c1, c0)
            else:
                motion.follows[curve.joint] = Follow(
                    curve.of, expression=horner(curve.coefficients)
                )
        constraints.curves = [curve for curve in constraints.curves if curve not in leaves]


def _sums(springs: Sequence[LinearCoupling]) -> list[LinearCoupling]:
    """Return the springs that couple several joints, leaving out those on a single joint."""
    return [spring for spring in springs if len(spring.factors) > 1]


def _supposed_motors(
    model: mujoco.MjModel, constraints: ModelConstraints, motion: ModelMotion
) -> list[Motor]:
    """Return a motor for each free joint if the model has no motors."""
    motors = []
    for group in _groups(model, constraints, motion):
        free = len(group.joints)
        if group.loops or group.curves:
            # One motor moves the linkage; solving the linkage shows whether one is enough.
            free = 1
        elif group.lines:
            free -= int(np.linalg.matrix_rank(_matrix(group.lines, group.joints)))
        chosen: list[int] = []
        for joint in group.joints:
            lines = [*group.lines, *(LinearCoupling({each: 1.0}, 0.0) for each in (*chosen, joint))]
            # A joint that the couplings and the chosen ones already determine needs no motor.
            rank = int(np.linalg.matrix_rank(_matrix(lines, group.joints)))
            if len(chosen) < free and (group.loops or group.curves or rank == len(lines)):
                chosen.append(joint)
        motors += [Motor("", joint, None) for joint in chosen]
    return motors


def _groups(
    model: mujoco.MjModel, constraints: ModelConstraints, motion: ModelMotion
) -> list[_Group]:
    """Return the remaining joints in independent groups."""
    left = [j for j in range(model.njnt) if j not in motion.fixed and j not in motion.follows]
    # Coupled joints share one set object, so that identity tells the groups apart below.
    group = {joint: {joint} for joint in left}

    def join(joints: Iterable[int]) -> None:
        members: set[int] = set()
        for joint in joints:
            members |= group.get(joint, set())
        for joint in members:
            group[joint] = members

    moved = [motor_joints(model, motor) for motor in constraints.motors]
    for joints in moved:
        join(joints)
    for line in (*constraints.lines, *_sums(constraints.springs)):
        join(line.factors)
    for curve in constraints.curves:
        join([curve.joint, curve.of])
    for loop in constraints.loops:
        join(loop.joints)
    lines, springs = (
        [_without_held(line, motion.fixed) for line in each]
        for each in (constraints.lines, constraints.springs)
    )
    groups = [
        _Group(
            [m for m, joints in zip(constraints.motors, moved, strict=True) if members & joints],
            joints=sorted(members),
            lines=[line for line in lines if members & set(line.factors)],
            springs=[spring for spring in springs if members & set(spring.factors)],
            curves=[curve for curve in constraints.curves if members & {curve.joint, curve.of}],
            loops=[loop for loop in constraints.loops if members & loop.joints],
            cords=[
                cord
                for cord in constraints.cords
                if tendon_joints(model, cord) - motion.fixed.keys() <= members
            ],
        )
        for members in {id(members): members for members in group.values()}.values()
    ]
    return sorted(groups, key=lambda each: each.joints)


def _without_held(line: LinearCoupling, fixed: dict[int, float]) -> LinearCoupling:
    held = sum(factor * fixed[joint] for joint, factor in line.factors.items() if joint in fixed)
    factors = {joint: factor for joint, factor in line.factors.items() if joint not in fixed}
    return replace(line, factors=factors, value=line.value - held)


def _matrix(lines: Sequence[LinearCoupling], joints: Sequence[int]) -> FloatArray:
    return np.array([[line.factors.get(j, 0.0) for j in joints] for line in lines]).reshape(
        -1, len(joints)
    )


def _solve_lines(model: mujoco.MjModel, group: _Group, motion: ModelMotion) -> None:
    """Solve a group of linear couplings.

    Springs decide the degrees of freedom that the couplings leave open, as at rest without load.
    Without springs, the joints of a motor's tendon share its travel in proportion to their factors.
    """
    q, free = _positions(model, group)
    shared = {
        joint
        for joint, row in zip(group.joints, free, strict=True)
        if np.abs(row).max(initial=0) > TINY
    }
    pulled = [motor_joints(model, motor) for motor in group.motors]
    on_tendons = {joint for joints in pulled if len(joints) > 1 for joint in joints}
    if shared & on_tendons:
        motion.notes.append(
            f"joints {names_of(model, shared & on_tendons)} share a tendon in proportion to its "
            "factors, since nothing else says how"
        )
    loose = sorted(shared - on_tendons - {motor.joint for motor in group.motors})
    motion.passive += loose
    joints = {*group.joints} - {*loose}
    rows = {joint: row for joint, row in zip(group.joints, q, strict=True) if joint in joints}
    mixed = differential_motion(model, group.motors, rows)
    if mixed is not None:
        motion.notes += mixed.notes
        motion.fixed |= mixed.fixed
        motion.driven |= mixed.driven
        motion.dropped |= mixed.dropped
        motion.follows |= mixed.follows
    else:
        _take(model, group, q, joints, motion)


def _positions(model: mujoco.MjModel, group: _Group) -> tuple[FloatArray, FloatArray]:
    """Return the positions of a group's joints for those of its motors.

    Returns:
        The positions ``(n, 1 + motors)``: a constant, then slopes by the motors' positions; and a
        basis ``(n, k)`` of the directions in which nothing decides them.
    """
    pulls = [LinearCoupling(motor_factors(model, motor) or {}, 0.0) for motor in group.motors]
    rigid = _matrix(group.lines, group.joints)
    given = np.vstack([rigid, _matrix(pulls, group.joints)])
    lines, motors = len(group.lines), len(pulls)
    rank = len(group.joints) - null_space(given).shape[1]
    if rank < np.linalg.matrix_rank(rigid, tol=TINY) + motors:
        names = ", ".join(f"'{motor.name}'" for motor in group.motors)
        raise ModelError(
            f"actuators {names} move joints {names_of(model, group.joints)}, whose couplings leave "
            "fewer degrees of freedom than there are actuators"
        )
    # The joints are a + B · u with the motors' positions u; columns of `right`: constants, then u.
    right = np.zeros((len(given), 1 + motors))
    right[:lines, 0] = [line.value for line in group.lines]
    right[lines:, 1:] = np.eye(motors)
    # In the minimum-norm solution, the joints of a tendon share its travel by their factors.
    q = np.linalg.pinv(given) @ right
    return q, _springs_decide(group, q, null_space(given))


def _springs_decide(group: _Group, q: FloatArray, free: FloatArray) -> FloatArray:
    """Move joints ``q`` along the free directions ``(n, k)`` to the equilibrium of the springs.

    Changes ``q``; returns a basis of the directions that the springs leave open.
    """
    if not (group.springs and free.shape[1]):
        return free
    # With the root of the stiffness, least squares minimise the energy of the springs.
    root = np.sqrt([[spring.weight] for spring in group.springs])
    pull = root * _matrix(group.springs, group.joints)
    rest = np.zeros((len(group.springs), q.shape[1]))
    rest[:, :1] = root * [[spring.value] for spring in group.springs]
    q += free @ np.linalg.pinv(pull @ free) @ (rest - pull @ q)
    return np.asarray(free @ null_space(pull @ free))


def _take(
    model: mujoco.MjModel,
    group: _Group,
    q: FloatArray,
    joints: set[int],
    motion: ModelMotion,
) -> None:
    """Store a solved group: one joint of each motor is the actuator, and the others follow it."""
    rows = dict(zip(group.joints, q, strict=True))
    chosen: list[int] = []
    for k, motor in enumerate(group.motors, start=1):
        joint = _actuator(model, rows, k, motor)
        if joint is None:
            raise ModelError(
                f"no joint follows actuator '{motor.name}' alone; rtee's joints follow one "
                "actuator each"
            )
        if joint != motor.joint and motor.joint is not None:
            motion.dropped.add(motor.joint)
        chosen.append(joint)
        motion.driven[joint] = _driven(model, joint, motor, rows[joint][0], rows[joint][k])
    for joint in sorted(joints - set(chosen) - motion.dropped):
        row = rows[joint]
        moved_by = [k for k in range(1, len(row)) if abs(row[k]) > TINY]
        if not moved_by:
            motion.fixed[joint] = float(row[0])
            continue
        if len(moved_by) > 1:
            names = " and ".join(f"'{group.motors[k - 1].name}'" for k in moved_by)
            raise ModelError(
                f"joint '{joint_name(model, joint)}' follows {names} at once; rtee's joints follow "
                "one actuator each"
            )
        k = moved_by[0]
        master = chosen[k - 1]
        factor = float(row[k] / rows[master][k])
        offset = float(row[0] - factor * rows[master][0])
        motion.follows[joint] = Follow(master, rounded(factor), rounded(offset))


def _actuator(
    model: mujoco.MjModel, rows: dict[int, FloatArray], k: int, motor: Motor
) -> int | None:
    """Return the joint that represents a motor.

    This is the motor's own joint, unless that carries no link and a follower has the actuator's
    name: the follower then belongs to the hand, and the motor pulls it through springs.
    """
    alone = [j for j, row in rows.items() if abs(row[k]) > TINY and _only(row, k)]
    named = [j for j in alone if joint_name(model, j) == motor.name]
    if motor.joint is not None:
        if named and named[0] != motor.joint and bare(model, motor.joint):
            return named[0]
        return motor.joint
    pulled = [joint for joint in motor_factors(model, motor) or {} if joint in alone]
    return next(iter([*named, *pulled, *alone]), None)


def _only(row: FloatArray, k: int) -> bool:
    return all(abs(value) <= TINY for i, value in enumerate(row) if i not in (0, k))


def _driven(model: mujoco.MjModel, joint: int, motor: Motor, offset: float, slope: float) -> Driven:
    """Return the limits of a joint that moves as ``offset + slope · u`` with a motor."""
    lower, upper = joint_range(model, joint)
    drawn = resting_length(model, motor_factors(model, motor) or {})
    own = (-math.inf, math.inf) if motor.joint is None else joint_range(model, motor.joint)
    for low, high in ((motor.lower - drawn, motor.upper - drawn), own):
        ends = sorted((offset + slope * low, offset + slope * high))
        lower, upper = max(lower, ends[0]), min(upper, ends[1])
    return Driven(rounded(lower), rounded(upper), rounded(motor.effort / abs(slope)))


def _solve_numerically(model: mujoco.MjModel, group: _Group, motion: ModelMotion) -> None:
    """Solve a closed linkage for the joints that follow its motor."""
    what = ", ".join([loop.what for loop in group.loops] or ["joint equalities"])
    if len(group.motors) != 1:
        raise ModelError(
            f"{what}: {len(group.motors)} actuators move joints {names_of(model, group.joints)} "
            "together; rtee's joints follow one actuator each"
        )
    motor = group.motors[0]
    factors = motor_factors(model, motor)
    # The first joint represents a tendon, whose length no joint has alone.
    joint = min(factors or group.joints)
    lower, upper = joint_range(model, joint)
    if motor.joint is not None:
        drawn = float(model.qpos0[joint])
        lower, upper = max(lower, motor.lower - drawn), min(upper, motor.upper - drawn)
    if not (math.isfinite(lower) and math.isfinite(upper)):
        raise ModelError(
            f"joint '{joint_name(model, joint)}' moves a closed linkage ({what}) and has no range; "
            "give it one"
        )
    others = [other for other in group.joints if other != joint]
    numbers = {loop.equality for loop in group.loops} | {line.equality for line in group.lines}
    numbers = (numbers | {curve.equality for curve in group.curves}) - {-1}
    linkage = Linkage(model, joint, others, numbers, motion.fixed, group.springs, group.cords)
    solved = solve_loop(linkage, (lower, upper), what) if others else None
    # A tendon's force is not the effort of one joint: its lever is not known here.
    effort = 0.0 if motor.tendon is not None else motor.effort
    if solved is None:
        motion.driven[joint] = Driven(lower, upper, effort)
    else:
        lower, upper = solved.places[0], solved.places[-1]
        if motor.tendon is not None and factors is not None:
            lower, upper = _within_targets(model, motor, factors, joint, others, solved)
        motion.driven[joint] = Driven(float(lower), float(upper), effort)
        motion.follows |= solved.follows
        motion.notes += solved.notes
    if factors is None:
        motion.notes.append(
            f"the spatial tendon of '{motor.name}' moves joint '{joint_name(model, joint)}', which "
            "is the actuator; the tendon's lever is ignored"
        )


def _within_targets(
    model: mujoco.MjModel,
    motor: Motor,
    factors: Mapping[int, float],
    joint: int,
    others: Sequence[int],
    solved: Solved,
) -> tuple[float, float]:
    """Return the range of a joint in which its motor's tendon stays within the motor's targets."""
    length = resting_length(model, factors) + factors.get(joint, 0.0) * solved.places
    length = length + solved.positions @ np.array([factors.get(other, 0.0) for other in others])
    inside = (length >= motor.lower - _SLACK) & (length <= motor.upper + _SLACK)
    if not inside.any():
        return math.inf, -math.inf
    return float(solved.places[inside][0]), float(solved.places[inside][-1])


def differential_motion(
    model: mujoco.MjModel, motors: Sequence[Motor], rows: Mapping[int, FloatArray]
) -> ModelMotion | None:
    """Return the motion of joints of which some follow several motors, as in a differential.

    As many joints as there are motors represent the motors, if each other joint follows one of
    them. A driver then mixes the positions of these joints into those of its motors.

    Args:
        model: The model.
        motors: The motors that move the joints together.
        rows: Position of each joint ``(1 + motors,)``: a constant, then slopes by the motors'
            positions.

    Returns:
        The motion; ``None`` if no joint follows several motors, or no joints can represent them.
    """
    mixing = [j for j, row in rows.items() if np.sum(np.abs(row[1:]) > TINY) > 1]
    own = {motor.joint for motor in motors}
    # The joint of a motor that carries no link is part of the motor.
    idle = {joint for joint in rows if joint in own and bare(model, joint)}
    carrying = [joint for joint in rows if joint not in idle]
    if not mixing:
        return None
    for chosen in itertools.combinations(carrying, len(motors)):
        slopes = np.array([rows[joint][1:] for joint in chosen])
        # Joints whose positions do not determine those of the motors cannot represent them.
        if abs(np.linalg.det(slopes)) < TINY:
            continue
        motors_by_joints = np.linalg.inv(slopes)
        by_joints = {j: rows[j][1:] @ motors_by_joints for j in carrying}
        if any(np.sum(np.abs(row) > TINY) > 1 for row in by_joints.values()):
            continue
        motion = ModelMotion(dropped=idle)
        for i, joint in enumerate(chosen):
            motion.driven[joint] = _driven_by_several(
                model, joint, motors, rows[joint], motors_by_joints[:, i]
            )
        for joint in sorted({*carrying} - {*chosen}):
            row = by_joints[joint]
            i = int(np.argmax(np.abs(row)))
            if abs(row[i]) <= TINY:
                motion.fixed[joint] = float(rows[joint][0])
                continue
            offset = float(rows[joint][0] - row[i] * rows[chosen[i]][0])
            motion.follows[joint] = Follow(chosen[i], rounded(float(row[i])), rounded(offset))
        names = " and ".join(f"'{motor.name}'" for motor in motors)
        motion.notes.append(
            f"actuators {names} move joints {names_of(model, chosen)} together (a differential), "
            "so that these joints count as the actuators: the driver mixes them, and where one is "
            "at its limit the other may have less than its range"
        )
        return motion
    return None


def _driven_by_several(
    model: mujoco.MjModel,
    joint: int,
    motors: Sequence[Motor],
    row: FloatArray,
    levers: FloatArray,
) -> Driven:
    """Return the limits of a joint that several motors move.

    Args:
        model: The model.
        joint: The joint.
        motors: The motors.
        row: Position of the joint ``(1 + motors,)``: a constant, then slopes by the motors'
            positions.
        levers: Slopes of the motors' positions by the joint's ``(motors,)``, which by virtual work
            are also the torques at the joint per torque of each motor.
    """
    lower, upper = joint_range(model, joint)
    low = high = float(row[0])
    for motor, slope in zip(motors, row[1:], strict=True):
        if abs(slope) <= TINY:
            continue
        drawn = resting_length(model, motor_factors(model, motor) or {})
        ends = sorted((slope * (motor.lower - drawn), slope * (motor.upper - drawn)))
        low, high = low + ends[0], high + ends[1]
    moving = [
        (motor.effort, abs(r)) for motor, r in zip(motors, levers, strict=True) if abs(r) > TINY
    ]
    known = all(effort > 0.0 for effort, _ in moving)
    effort = sum(effort * lever for effort, lever in moving) if known else 0.0
    return Driven(rounded(max(lower, low)), rounded(min(upper, high)), rounded(effort))
