"""Joints that several motors of a MuJoCo model move together: a differential."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from rtee.exchange.mjcf_motion import (
    TINY,
    Driven,
    Follow,
    Motion,
    Motor,
    bare,
    joint_range,
    motor_factors,
    names_of,
    resting_length,
    rounded,
)
from rtee.sample import FloatArray


def differential_motion(
    model: mujoco.MjModel, motors: Sequence[Motor], rows: Mapping[int, FloatArray]
) -> Motion | None:
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
        motion = Motion(dropped=idle)
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
