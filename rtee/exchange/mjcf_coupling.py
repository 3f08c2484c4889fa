"""Transmission from a model's constraints, in which every joint follows one actuator or none."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from rtee.errors import ModelError
from rtee.exchange.mjcf_loops import Linkage, Solved, horner, solve_loop
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
        ModelError: The couplings leave a number of degrees of freedom other than that of the
            motors, or a joint follows several motors, or a linkage cannot be solved.
    """
    constraints = constraints_of(model)
    # First of all, since held joints drop their motors, and their followers need no solution.
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
        f"the spring of the spatial tendon '{model.tendon(cord).name}' is not read, since its "
        "joints are not those of one closed linkage with a motor"
        for cord in sorted(unread)
    ]
    if not motion.driven:
        raise ModelError("has no joint that a motor could move")
    return motion


def _hold(constraints: ModelConstraints) -> None:
    """Hold the joints that follow only held ones, and the masters of held linear followers."""
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
    """Remove the joints that only follow another one, from the ends of chains on."""
    # A tendon with a spring may also pull such a joint, but the rigid coupling decides.
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
    """Return a motor for each joint that is free to move, where the model has none."""
    motors = []
    for group in _groups(model, constraints, motion):
        free = len(group.joints)
        if group.loops or group.curves:
            # One that moves the linkage; solving it shows whether one is enough.
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
    # Coupled joints share one set, which is found by its identity in the end.
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
            f"actuators {names} move joints {names_of(model, group.joints)}, which couplings leave "
            "fewer degrees of freedom than that"
        )
    # The joints are a + B · u with the motors' positions u; columns of `right`: constants, then u.
    right = np.zeros((len(given), 1 + motors))
    right[:lines, 0] = [line.value for line in group.lines]
    right[lines:, 1:] = np.eye(motors)
    # In the minimum-norm solution, the joints of a tendon share its travel by their factors.
    q = np.linalg.pinv(given) @ right
    return q, _springs_decide(group, q, null_space(given))


def _springs_decide(group: _Group, q: FloatArray, free: FloatArray) -> FloatArray:
    """Move joints ``q`` along open directions ``(n, k)`` to the equilibrium of the springs.

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
            "is the actuator; its lever is not taken over"
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
