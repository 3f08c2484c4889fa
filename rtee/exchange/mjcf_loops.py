"""Closed linkages: where one joint has the others, solved numerically and fitted.

MuJoCo gives the residuals of all equalities and their Jacobian. With the position of one joint
given, Newton's method finds the others, from one position to the next along its range.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from rtee.errors import ModelError
from rtee.exchange.mjcf_motion import TINY, Follow, Line, joint_name, joint_range, names_of
from rtee.sample import FloatArray

_STEPS: Final = 400
"""Positions along the range of the moving joint: steps of 0.2 degrees for a quarter turn."""

_ROUNDS: Final = 200
"""Newton steps for one position; three to five do, twenty where the linkage is stretched, and 100
where springs pull far."""

_STRIDE: Final = 0.1
"""Longest step towards where springs are at rest [rad | m]."""

_CLOSED: Final = 1e-9
"""Residual at which a linkage counts as closed [m, rad]."""

_OPEN: Final = 1e-6
"""Residual that is accepted where the rounded numbers of a file allow no less [m, rad]."""

_FLAT: Final = 1e-6
"""Change of an equality below which a direction counts as open [m/rad]."""

_SINGULAR: Final = 1e-8
"""Singular values below this share of the largest are rounding."""

_JUMP: Final = 20.0
"""Most that another joint moves within one step of the moving one, in such steps: linkages that are
stretched move fast, and what moves faster has jumped to another way of closing."""

_DEGREES: Final = 24
"""Highest degree of the polynomial that is fitted to a joint's way."""

_CLOSE: Final = 1e-7
"""Deviation of the fit that is striven for [rad | m]."""

_FAR: Final = 1e-4
"""Deviation of the fit that is refused [rad | m]: less than encoders of hands resolve."""


@dataclass(frozen=True, slots=True)
class Solved:
    """A linkage as couplings.

    Attributes:
        places: Positions of the moving joint at which it was closed ``(n,)``, ascending [rad | m].
        ways: Where the others are there ``(n, k)``.
        follows: How the other joints follow it.
        notes: What was found, one sentence each.
    """

    places: FloatArray
    ways: FloatArray
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
        springs: Sequence[Line],
    ) -> None:
        """Prepare a model.

        Args:
            model: The model; its contacts and limits are switched off.
            joint: The joint that moves the others.
            others: The others.
            equalities: The numbers of the equalities that count.
            fixed: Joints that are held, with their positions [rad | m].
            springs: Springs, which decide with the joints' limits what equalities leave open.
        """
        flags = mujoco.mjtDisableBit
        # Contacts and limits would push the joints about; only the equalities are solved here.
        model.opt.disableflags |= flags.mjDSBL_CONTACT | flags.mjDSBL_LIMIT
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.model, self.joint, self.others = model, joint, list(others)
        self._data = mujoco.MjData(model)
        self._equalities = list(equalities)
        self._drawn = model.qpos0.copy()
        for held, position in fixed.items():
            self._drawn[held] += position
        # Weighted by the root, so that least squares minimise the energy of the springs.
        root = np.sqrt([spring.weight for spring in springs])
        factors = [[spring.factors.get(o, 0.0) for o in (joint, *others)] for spring in springs]
        pull = root[:, None] * np.array(factors).reshape(-1, 1 + len(self.others))
        self._moved, self._pull = pull[:, 0], pull[:, 1:]
        self._rest = root * np.array([spring.value for spring in springs])
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

    def slopes(self, x: float, q: FloatArray) -> FloatArray:
        """Return how fast the others move with the joint ``(n,)``, where the linkage is closed.

        Roughly where springs decide it: they count as if they held rigidly.
        """
        springs = np.column_stack([self._moved, self._pull])
        rows = np.vstack([self._at(x, q)[1], springs])
        return np.asarray(-np.linalg.pinv(rows[:, 1:], rcond=_SINGULAR) @ rows[:, 0])

    def settle(self, x: float) -> tuple[FloatArray | None, int]:
        """Close the linkage as it is drawn, with the joint at ``x``.

        Where equalities leave something open, springs and the joints' stops decide from now on.

        Returns:
            Where the others are ``(n,)``; ``None`` if it cannot be closed. And how many degrees of
            freedom are left to them.
        """
        q = self.close(x, np.zeros(len(self.others)))
        if q is None or not self._open(x, q).shape[1]:
            return q, 0
        self._by_springs = True
        q = self.close(x, q)
        if q is None:
            return None, 0
        left = self._open(x, q)
        decided = np.linalg.matrix_rank(self._pull @ left, tol=_FLAT) if left.size else 0
        return q, left.shape[1] - int(decided)

    def _held(self, x: float, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals and derivatives as `_at` does, those of the joints at stops included."""
        residual, jacobian = self._at(x, q)
        stops = list(self._stopped)
        away = q[stops] - np.array(list(self._stopped.values()))
        return np.append(residual, away), np.vstack([jacobian[:, 1:], np.eye(len(q))[stops]])

    def _open(self, x: float, q: FloatArray) -> FloatArray:
        """Return a basis ``(n, k)`` of what is left open to the others."""
        return _flat_directions(self._held(x, q)[1])

    def close(self, x: float, q: FloatArray) -> FloatArray | None:
        """Return where the others are with the joint at ``x``, near ``q``; ``None`` if nowhere."""
        best, least = q, math.inf
        for _ in range(_ROUNDS):
            residual, jacobian = self._held(x, q)
            size = float(np.abs(residual).max(initial=0.0))
            # With springs the residual may grow on the way to where they are at rest.
            if size < least or self._by_springs:
                best, least = q, size
            if size < _CLOSED and not self._by_springs:
                break
            step = -np.linalg.pinv(jacobian, rcond=_SINGULAR) @ residual
            if self._by_springs:
                # Within what is left open, to where the springs are at rest.
                left = _flat_directions(jacobian)
                pull = self._pull @ left
                lacking = self._rest - self._moved * x - self._pull @ (q + step)
                along = left @ np.linalg.pinv(pull, rcond=_SINGULAR) @ lacking
                # In small steps: the way of a linkage is straight over short distances only.
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
        """Stop the joints that are beyond their limits; return whether there are any."""
        found = {
            i: limit
            for i, (lower, upper) in enumerate(self._ranges)
            for limit, beyond in ((lower, lower - q[i]), (upper, q[i] - upper))
            if beyond > _CLOSED and i not in self._stopped
        }
        self._stopped |= found
        return bool(found)

    def _leave_stop(self, x: float, q: FloatArray) -> bool:
        """Let a joint go that springs pull away from its stop; return whether there is one."""
        if not self._stopped:
            return False
        force = self._pull.T @ (self._rest - self._moved * x - self._pull @ q)
        jacobian = self._held(x, q)[1]
        # The springs' forces are borne by the equalities and the stops; a stop can only push back.
        borne = np.linalg.pinv(jacobian.T, rcond=_SINGULAR) @ force
        for i, push in zip(list(self._stopped), borne[-len(self._stopped) :], strict=True):
            outward = 1.0 if self._stopped[i] == self._ranges[i][1] else -1.0
            if outward * push < -TINY:
                del self._stopped[i]
                return True
        return False


def _flat_directions(jacobian: FloatArray) -> FloatArray:
    """Return a basis ``(n, k)`` of the directions in which nothing changes."""
    if not jacobian.size:
        return np.eye(jacobian.shape[1])
    _, sizes, directions = np.linalg.svd(jacobian)
    return np.asarray(directions[int(np.sum(sizes > _FLAT)) :].T)


def horner(coefficients: Sequence[float], variable: str = "x") -> str:
    """Return a polynomial as an expression in nested form, which loses no digits."""
    text = repr(float(coefficients[-1]))
    for coefficient in reversed(coefficients[:-1]):
        text = f"{float(coefficient)!r} + {variable}*({text})"
    return text


def solve_loop(linkage: Linkage, limits: tuple[float, float], what: str, path: object) -> Solved:
    """Find how the joints of a closed linkage follow one of them.

    Args:
        linkage: The linkage.
        limits: The range of the joint [rad | m], from the position as drawn.
        what: What closes the linkage, for messages.
        path: The model's file, for messages.

    Raises:
        ModelError: The linkage leaves the others free, cannot be closed as drawn, or closes along
            ways that no polynomial follows.
    """
    model, joint, others = linkage.model, linkage.joint, linkage.others
    start = min(max(0.0, limits[0]), limits[1])
    first, free = linkage.settle(start)
    if first is None:
        raise ModelError(f"{what} cannot be closed at the start of its range", path=str(path))
    if free > 0:
        raise ModelError(
            f"{what} leaves joints {names_of(model, [joint, *others])} {free + 1} degrees of "
            "freedom that no spring decides, and one actuator moves them; couple them, or give "
            "each an actuator",
            path=str(path),
        )
    places, ways = [start], [first]
    step = (limits[1] - limits[0]) / _STEPS
    jump = _JUMP * step
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        # Hinges follow it by as many radians per metre as their levers are short.
        jump *= max(1.0, float(np.abs(linkage.slopes(start, first)).max()))
    for end in limits:
        at, q, before = start, first, first
        while abs(end - at) > TINY:
            ahead = math.copysign(min(step, abs(end - at)), end - at)
            # From where the last step leads on, so that the linkage does not fold over.
            found = linkage.close(at + ahead, 2.0 * q - before)
            # A jump: Newton's method has found another way in which the linkage closes.
            if found is None or float(np.abs(found - q).max()) > jump:
                break
            at, q, before = at + ahead, found, q
            places.append(at)
            ways.append(q)
    order = np.argsort(places)
    x, y = np.array(places)[order], np.array(ways)[order]
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
        raise ModelError(f"{what} cannot move", path=str(path))
    follows = {
        other: _fitted(model, joint, other, x, y[:, i], what, path)
        for i, other in enumerate(others)
    }
    return Solved(x, y, follows, tuple(notes))


def _fitted(
    model: mujoco.MjModel,
    joint: int,
    other: int,
    x: FloatArray,
    y: FloatArray,
    what: str,
    path: object,
) -> Follow:
    """Return how a joint follows: a line where it is one, else a polynomial."""
    middle, half = float(0.5 * (x[0] + x[-1])), float(0.5 * (x[-1] - x[0]))
    # To -1 … 1: powers of the plain positions would lose the digits of a high degree.
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
            f"along a way that no polynomial meets within {_FAR:g}",
            path=str(path),
        )
    powers = fit.convert(kind=np.polynomial.Polynomial).coef
    if len(powers) <= 2:
        factor = float(powers[1] / half) if len(powers) > 1 else 0.0
        return Follow(joint, factor, float(powers[0]) - factor * middle)
    return Follow(
        joint,
        expression=horner(powers.tolist(), f"((x - {middle!r})/{half!r})".replace("- -", "+ ")),
    )
