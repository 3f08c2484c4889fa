from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from rtee.errors import UnknownLink
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.kinematics import Kinematics
from rtee.hand.load import load_hand
from rtee.hand.model import Hand

OURS = ("schunk_svh", "robotiq_3f", "heri_ii")


def postures(hand: Hand, count: int = 5) -> np.ndarray:
    return np.random.default_rng(1).uniform(hand.lower, hand.upper, (count, len(hand.actuators)))


def test_links_stand_where_pinocchios_own_reader_puts_them(real: Path, real_hand: Hand) -> None:
    model = pin.buildModelFromUrdf(str(real / f"{real.name}.urdf"))
    data = model.createData()
    kinematics = Kinematics(real_hand)
    for u in postures(real_hand, 3):
        q = pin.neutral(model)
        for name, value in zip(
            real_hand.joint_names, real_hand.transmission.joints(u), strict=True
        ):
            q[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, q)
        placements = kinematics.placements(u)
        for i, frame in enumerate(model.frames):
            if frame.name in placements:
                np.testing.assert_allclose(
                    placements[frame.name], data.oMf[i].homogeneous, atol=1e-12
                )


@pytest.mark.parametrize("name", OURS)
def test_tip_jacobian_is_the_derivative_of_the_tips_pose(name: str) -> None:
    hand = load_hand(name)
    kinematics = Kinematics(hand)
    step = 1e-6
    for u in postures(hand, 2):
        for finger in hand.fingers:
            pose, jacobian = tip_pose_and_jacobian(hand, str(finger.tip), u)
            np.testing.assert_allclose(pose, kinematics.link_pose(str(finger.tip), u), atol=1e-12)
            for i, direction in enumerate(np.eye(len(u))):
                ends = [
                    pin.SE3(kinematics.link_pose(str(finger.tip), u + s * direction))
                    for s in (-step, step)
                ]
                linear = (ends[1].translation - ends[0].translation) / (2 * step)
                angular = pin.log3(ends[1].rotation @ ends[0].rotation.T) / (2 * step)
                np.testing.assert_allclose(jacobian[:3, i], linear, atol=1e-6)
                np.testing.assert_allclose(jacobian[3:, i], angular, atol=1e-6)


def test_an_actuator_of_another_finger_does_not_move_the_tip() -> None:
    hand = load_hand("heri_ii")
    tip = str(hand.finger("thumb").tip)
    jacobian = tip_pose_and_jacobian(hand, tip, hand.rest)[1]
    thumb = hand.actuator_index(hand.finger("thumb").actuators[0])
    others = [i for i in range(len(hand.actuators)) if i != thumb]
    assert not jacobian[:, others].any()


def test_unknown_names_are_refused() -> None:
    kinematics = Kinematics(load_hand("schunk_svh"))
    with pytest.raises(UnknownLink):
        kinematics.link_pose("no_such_link", kinematics.hand.rest)
    with pytest.raises(UnknownLink):
        tip_pose_and_jacobian(kinematics.hand, "no_such_link", kinematics.hand.rest)
