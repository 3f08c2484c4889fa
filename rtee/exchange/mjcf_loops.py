"""Closed linkages: followers of a joint, solved numerically and fitted by polynomials.

MuJoCo computes the residuals of all equalities and their Jacobian. For a position of one joint,
Newton's method finds those of the others, from one position to the next along its range.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from rtee.errors import ModelError
from rtee.exchange.mjcf_motion import (
    TINY,
    Follow,
    LinearCoupling,
    joint_name,
    joint_range,
    names_of,
    null_space,
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
"""Stiffness that counts as none [N·m/rad | N/m]: springs of fingers have 1e-4 or more."""

_NEAR: Final = 1e-5
"""Distance of postures whose forces are compared [rad | m]: errors of rounding and of curvature are
both below a billionth of the stiffness."""

_JUMP: Final = 20.0
"""Largest motion of another joint within one step of the moving joint, in such steps: a stretched
linkage moves fast, and a faster motion is a jump to another solution."""

_DEGREES: Final = 24
"""Highest degree of the polynomial fitted to a joint's motion."""

_CLOSE: Final = 1e-7
"""Desired deviation of the fit [rad | m]."""

_FAR: Final = 1e-4
"""Deviation of the fit from which it is refused [rad | m]: less than encoders of hands resolve."""


@dataclass(frozen=True, slots=True)
class Solved:
    """A linkage as couplings.

    Attributes:
        places: Positions of the moving joint at which it was closed ``(n,)``, ascending [rad | m].
        positions: Positions of the others there ``(n, k)`` [rad | m].
        follows: Couplings of the other joints to it.
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
        others: The others.
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
            others: The others.
            equalities: The numbers of the equalities to solve.
            fixed: Positions of the joints that are held [rad | m].
            springs: Springs, which with the joints' limits decide the directions that the
                equalities leave open.
            cords: Spatial tendons with springs, which decide them together with these.
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
        energy [J]. The second is the change of the springs' lengths by all joints.
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
        """Return the springs' forces on the others ``(n,)`` [N·m | N]."""
        lacking, pull = self._springs(x, q)
        return np.asarray(pull[:, 1:].T @ lacking)

    def _stiffness(self, x: float, q: FloatArray, left: FloatArray) -> FloatArray:
        """Return the springs' stiffness ``(k, k)`` along open directions ``(n, k)`` [N·m/rad].

        The levers of cords and the open directions turn with the posture, which adds to it; so it
        is a difference of the forces along the open directions of neighbouring postures.
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
        """Return the velocities of the others per that of the joint ``(n,)``, in a closed linkage.

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
        """Return a basis ``(n, k)`` of the open directions of the others."""
        return null_space(self._held(x, q)[1], _FLAT)

    def close(self, x: float, q: FloatArray) -> FloatArray | None:
        """Return the positions of the others near ``q`` for the joint at ``x``, or ``None``."""
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
        """Stop the joints beyond their limits at these; return whether there were any."""
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
    """Solve a closed linkage: how its joints follow one of them.

    Args:
        linkage: The linkage.
        limits: Range of the joint relative to the model's posture [rad | m].
        what: Name of the constraint that closes the linkage, for messages.

    Raises:
        ModelError: The linkage leaves the others free, cannot be closed near the model's posture,
            or no polynomial fits its motion.
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
            f"{upper:.4g}, which are its limits"
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
    """Return the coupling of a joint: linear if possible, else a polynomial."""
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
