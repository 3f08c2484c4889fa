"""Forward kinematics of a hand with Pinocchio.

The searches of the extraction evaluate it millions of times. For occasional evaluations,
`rtee.hand.frames` works without Pinocchio.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from rtee.errors import UnknownLink
from rtee.hand.model import Hand
from rtee.hand.urdf import Triple, UrdfJoint
from rtee.sample import FloatArray


class Kinematics:
    """Forward kinematics of a hand.

    Every moving joint of the URDF is a joint of the Pinocchio model, in the order of
    ``hand.joints``; only the hand's transmission contains couplings between joints. Links connected
    by fixed joints form one body. A continuous joint is a revolute one without limits, so that each
    joint position is one number.

    Attributes:
        hand: The hand.
        model: Its Pinocchio model; joint ``i + 1`` is ``hand.joints[i]``.
        bodies: For each link, the index of the joint that carries it (0: the base) and its pose in
            that joint's frame.
    """

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self.model = pin.Model()
        self.model.name = hand.name
        base = pin.SE3.Identity()
        self.bodies: dict[str, tuple[int, pin.SE3]] = {hand.base: (0, base)}
        index = {joint.name: i for i, joint in enumerate(hand.joints)}
        for joint in hand.urdf.joints.values():
            parent, placement = self.bodies[joint.parent]
            placement = placement * pose(joint.xyz, joint.rpy)
            if joint.moving:
                added = self.model.addJoint(parent, _joint_model(joint), placement, joint.name)
                # Pinocchio numbers joints in the order in which they are added, which must be that
                # of arrays of joints.
                if added != index[joint.name] + 1:
                    what = f"joint '{joint.name}' is not in the order of the tree"
                    raise hand.urdf.error(what, joint.line)
                self.bodies[joint.child] = (added, pin.SE3.Identity())
            else:
                self.bodies[joint.child] = (parent, placement)
        self.data = self.model.createData()

    def body(self, link: str) -> int:
        """Return the index of the joint that carries a link, 0 for the base.

        Raises:
            UnknownLink: if the hand has no such link.
        """
        return self._body(link)[0]

    def support(self, body: int) -> FloatArray:
        """Return a mask of the joints that move a body: 1 or 0 per joint ``(m,)``."""
        mask = np.zeros(self.model.nv)
        for joint in self.model.supports[body]:
            # Joint 0 is Pinocchio's universe, which never moves.
            if joint:
                mask[joint - 1] = 1.0
        return mask

    def link_pose(self, link: str, u: FloatArray) -> FloatArray:
        """Return a link's pose in the base frame at actuator positions ``(n,)`` [rad | m].

        Returns:
            Homogeneous transform ``(4, 4)``, lengths in metres.

        Raises:
            UnknownLink: if the hand has no such link.
        """
        body, placement = self._body(link)
        self._forward(u)
        return np.array((self.data.oMi[body] * placement).homogeneous)

    def placements(self, u: FloatArray) -> Mapping[str, FloatArray]:
        """Return every link's pose ``(4, 4)`` in the base frame at positions ``(n,)`` [rad | m]."""
        self._forward(u)
        return {
            link: np.array((self.data.oMi[body] * placement).homogeneous)
            for link, (body, placement) in self.bodies.items()
        }

    def _body(self, link: str) -> tuple[int, pin.SE3]:
        try:
            return self.bodies[link]
        except KeyError:
            raise UnknownLink(link, tuple(self.bodies)) from None

    def _forward(self, u: FloatArray) -> None:
        pin.forwardKinematics(self.model, self.data, self.hand.transmission.joints(u))


def pose(xyz: Triple, rpy: Triple) -> pin.SE3:
    """Return the transform of a URDF ``origin``: position [m], then roll, pitch, yaw [rad]."""
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))


def _joint_model(joint: UrdfJoint) -> pin.JointModel:
    axis = np.array(joint.axis)
    if joint.kind == "prismatic":
        return pin.JointModelPrismaticUnaligned(axis)
    # The position of Pinocchio's continuous joint has two numbers, cosine and sine.
    return pin.JointModelRevoluteUnaligned(axis)
