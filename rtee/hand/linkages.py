"""Join the branches of a tree that are one finger: the finger and the bars of its linkage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from rtee.hand.chains import Chain
from rtee.hand.frames import PARALLEL, origin
from rtee.hand.urdf import Urdf, UrdfJoint
from rtee.sample import FloatArray

_TOGETHER: Final = 0.5
"""Least cosine of the angle between the paths of the ends of a linkage's bars: 60 degrees. The
fingers of an iris, which turn in one direction about parallel axes, go 90 degrees or more apart."""

_SAME_AXIS: Final = 1e-4
"""Distance below which two joints are on one axis [m]: the rounding of models."""


class Mover(NamedTuple):
    """The actuator of a joint, and the joint's motion per unit of it at mid-range."""

    actuator: str
    rate: float


class Linked(NamedTuple):
    """A finger with the bars of its linkage.

    Attributes:
        chain: The chain to its tip.
        bars: The links of its bars.
    """

    chain: Chain
    bars: tuple[str, ...]


def join_linkages(
    chains: Sequence[Chain], spare: Sequence[Chain], urdf: Urdf, movers: Mapping[str, Mover]
) -> list[Linked]:
    """Join the branches that are parts of one linkage.

    Two branches are one finger if the same actuators move both, they turn in the same direction
    (the other side of a gripper turns in the opposite one), and their joints lie behind each other
    in the plane of the motion. Joints beside each other along their axis are those of two fingers,
    such as index and middle finger of a hand with one motor. The tip is on the branch that reaches
    out farthest.

    Args:
        chains: The fingers as given or found.
        spare: Further branches, which are not fingers by themselves.
        urdf: The hand's URDF.
        movers: What moves each joint; joints that no actuator moves are missing.
    """
    poses = _poses(urdf)
    branches = [_Branch.of(chain, urdf, movers, poses) for chain in (*chains, *spare)]
    groups: list[list[int]] = []
    for i, branch in enumerate(branches):
        beside = [
            group for group in groups if any(branch.linked(branches[k], branches) for k in group)
        ]
        groups = [group for group in groups if group not in beside]
        groups.append(sorted([i, *(k for group in beside for k in group)]))
    found = []
    for group in sorted(groups):
        fingers = [k for k in group if k < len(chains)]
        if fingers:
            tip = max(fingers, key=lambda k: branches[k].reach)
            own = branches[tip].chain.links
            bars = [link for k in group if k != tip for link in branches[k].chain.links[1:]]
            bars = [link for link in dict.fromkeys(bars) if link not in own]
            found.append(Linked(branches[tip].chain, tuple(bars)))
    return found


@dataclass(frozen=True, slots=True)
class _Branch:
    """A branch and how it moves.

    Attributes:
        chain: Its chain of links.
        actuators: The actuators that move it against its base.
        moved: The joints that move it from the root on, each with its actuator.
        turning: Angular velocity of its first turning joint per unit of the actuator, in the root
            frame ``(3,)``; zero if none turns, or if the axes of its joints are not parallel.
        at: Place of that joint ``(3,)`` [m].
        velocity: Velocity of the middle of its last shape per unit of the actuators ``(3,)``; zero
            if that is a mesh, which is not read here.
        reach: Distance from the base to the middle of its last shape [m].
    """

    chain: Chain
    actuators: frozenset[str]
    moved: tuple[tuple[str, str], ...]
    turning: FloatArray
    at: FloatArray
    velocity: FloatArray
    reach: float

    @classmethod
    def of(
        cls, chain: Chain, urdf: Urdf, movers: Mapping[str, Mover], poses: Mapping[str, FloatArray]
    ) -> _Branch:
        path = [joint for joint in urdf.path_to(chain.links[-1]) if joint.name in movers]
        own = [joint for joint in path if joint.child in chain.links[1:]]
        last = chain.tip(urdf) or chain.links[-1]
        shapes = urdf.links[last].collisions
        middle = np.mean([shape.xyz for shape in shapes], axis=0) if shapes else np.zeros(3)
        end = (poses[last] @ [*middle, 1.0])[:3]
        turning, at, velocity, planar = np.zeros(3), np.zeros(3), np.zeros(3), True
        for joint in own:
            pose = poses[joint.child]
            motion = movers[joint.name].rate * (pose[:3, :3] @ np.array(joint.axis))
            if joint.kind == "prismatic":
                velocity += motion
                continue
            velocity += np.cross(motion, end - pose[:3, 3])
            if not turning.any():
                turning, at = motion, pose[:3, 3]
            planar &= abs(_cosine(turning, motion)) >= PARALLEL
        reach = float(np.linalg.norm(end - poses[chain.links[0]][:3, 3]))
        return cls(
            chain,
            frozenset(movers[joint.name].actuator for joint in own),
            tuple((joint.name, movers[joint.name].actuator) for joint in path),
            turning if planar else np.zeros(3),
            at,
            velocity if all(shape.kind != "mesh" for shape in shapes) else np.zeros(3),
            reach,
        )

    def linked(self, other: _Branch, all_: Sequence[_Branch]) -> bool:
        """Return whether both are parts of one linkage of a hand with these branches."""
        common = [a for a, b in zip(self.moved, other.moved, strict=False) if a == b]
        if common:
            behind = {
                actuator for branch in (self, other) for _, actuator in branch.moved[len(common) :]
            }
            # They separate behind a joint of the one actuator that moves both from there on.
            if behind <= {common[-1][1]}:
                return True
        if not self.actuators or self.actuators != other.actuators:
            return False
        if not self.turning.any() or not other.turning.any():
            return False
        if _cosine(self.turning, other.turning) < PARALLEL:
            return False
        if self.velocity.any() and other.velocity.any():
            together = _cosine(self.velocity, other.velocity) >= _TOGETHER
        else:
            # The two sides of a linkage turn against each other; those of an iris do not.
            same = (each for each in all_ if each.actuators == self.actuators)
            together = any(_cosine(self.turning, each.turning) <= -PARALLEL for each in same)
        if not together:
            return False
        axis = self.turning / np.linalg.norm(self.turning)
        between = other.at - self.at
        along = abs(float(between @ axis))
        across = float(np.linalg.norm(between - (between @ axis) * axis))
        return along <= max(across, _SAME_AXIS)


def _cosine(first: FloatArray, second: FloatArray) -> float:
    lengths = float(np.linalg.norm(first)) * float(np.linalg.norm(second))
    return float(first @ second) / lengths if lengths > 0.0 else 0.0


def _poses(urdf: Urdf) -> dict[str, FloatArray]:
    """Return the pose ``(4, 4)`` of every link where all joints are at 0."""
    poses = {urdf.root: np.eye(4)}
    joint: UrdfJoint
    for joint in urdf.joints.values():
        poses[joint.child] = poses[joint.parent] @ origin(joint.xyz, joint.rpy)
    return poses
