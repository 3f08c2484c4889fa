"""Guess facts that a URDF leaves open: joints without a motor, and actuators of a wrist."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final
from xml.sax.saxutils import quoteattr

import numpy as np

from rtee.hand.chains import Chain
from rtee.hand.frames import PARALLEL, tip_pose_and_jacobian
from rtee.hand.model import Finger, Hand
from rtee.hand.urdf import Urdf
from rtee.hand.xmlfile import Element, read_xml
from rtee.types import JointKind

_SPRUNG: Final = re.compile(r"spring|passive|complian|elastic|flexure|underactuated", re.IGNORECASE)
"""Words in the usual names of joints without a motor."""

_SPRINGS: Final = ("springStiffness", "springReference", "spring_stiffness", "spring_reference")
"""Elements and attributes that describe a spring to a simulator."""

_PLAY: Final = 0.25
"""Range below which a joint is unlikely to have a motor [rad]: 14 degrees."""

_SAME: Final = 0.01
"""Difference of the limits of two jaws that mirror each other [fraction of the range]."""


@dataclass(frozen=True, slots=True)
class UndrivenCandidate:
    """A joint that is read as an actuator but may have no motor.

    Attributes:
        joint: Its name.
        why: The evidence, as a predicate after the joint's name.
        likely: Whether the evidence is strong.
    """

    joint: str
    why: str
    likely: bool


def passive_candidates(hand: Hand) -> tuple[UndrivenCandidate, ...]:
    """Return the actuators of a hand without SRDF that may have no motor, in its order.

    Likely ones are springs (by a simulator's elements, by name, or by a range of a few degrees),
    joints without effort, velocity or transmission where others have one, and joints of a finger
    whose other joints follow a motor elsewhere, as by a tendon. A possible one is the outer of two
    parallel joints of a finger: one tendon may bend both.

    Raises:
        ModelError: if its URDF cannot be read again.
    """
    # Read again, since the model keeps only the data for kinematics.
    root = read_xml(hand.urdf.path, "URDF")[0]
    reasons: dict[str, str] = {}
    for found in (_springs(hand, root), _idle(hand), _undriven(hand, root), _pulled(hand)):
        for joint, why in found.items():
            # The reasons are in decreasing order of strength, and the first one is kept.
            reasons.setdefault(joint, why)
    likely = [UndrivenCandidate(joint, why, True) for joint, why in reasons.items()]
    possible = [
        UndrivenCandidate(joint, why, False)
        for joint, why in _outer(hand).items()
        if joint not in reasons and not reasons.keys() & set(_finger_of(hand, joint).own)
    ]
    # A hand must have an actuator, so the evidence is wrong.
    if len(likely) == len(hand.actuators):
        return ()
    order = hand.actuator_names
    return tuple(sorted((*likely, *possible), key=lambda c: order.index(c.joint)))


def _springs(hand: Hand, root: Element) -> dict[str, str]:
    sprung = {
        element.attributes.get("reference", "")
        for element in root.all("gazebo")
        if any(child.tag in _SPRINGS for child in element.children)
    }
    for element in root.all("joint"):
        dynamics = element.first("dynamics")
        if dynamics is not None and any(key in dynamics.attributes for key in _SPRINGS):
            sprung.add(element.attributes.get("name", ""))
    found = {}
    for spec in hand.actuators:
        if spec.name in sprung:
            found[spec.name] = "has a spring for the simulator"
        elif _SPRUNG.search(spec.name):
            found[spec.name] = "is called like a joint without a motor"
        elif spec.kind is JointKind.REVOLUTE and spec.upper - spec.lower <= _PLAY:
            found[spec.name] = "turns a few degrees only, like a joint on a spring"
    return found


def _idle(hand: Hand) -> dict[str, str]:
    """Return the joints without effort or velocity limit if others have one."""
    joints = [hand.urdf.joints[name] for name in hand.actuator_names]
    found: dict[str, str] = {}
    for quantity in ("effort", "velocity"):
        idle = [joint.name for joint in joints if getattr(joint, quantity) == 0.0]
        if len(idle) < len(joints):
            found |= dict.fromkeys(idle, f"has no {quantity} limit, as others have")
    return found


def _undriven(hand: Hand, root: Element) -> dict[str, str]:
    """Return the joints without a transmission if others have one."""
    driven = {
        joint.attributes.get("name", "")
        for element in root.all("transmission")
        for joint in element.all("joint")
    }
    left = [name for name in hand.actuator_names if name not in driven]
    # Many URDFs have no transmissions at all, which proves nothing.
    if len(left) == len(hand.actuators):
        return {}
    return dict.fromkeys(left, "has no <transmission>, as others have")


def _pulled(hand: Hand) -> dict[str, str]:
    """Return the joints of fingers whose other joints follow a motor outside the finger."""
    found: dict[str, str] = {}
    for finger in hand.fingers:
        way = {joint.name for joint in hand.urdf.path_to(finger.links[-1])}
        motors = [name for name in finger.own if name not in way]
        if motors:
            why = f"belongs to a finger whose other joints follow '{motors[0]}', as by a tendon"
            found |= {name: why for name in finger.own if name in way}
    return found


def _outer(hand: Hand) -> dict[str, str]:
    """Return the outer ones of parallel joints in a row, which one tendon may bend together."""
    found: dict[str, str] = {}
    for finger in hand.fingers:
        if finger.tip is None:
            continue
        way = [joint.name for joint in hand.urdf.path_to(finger.tip)]
        turning = tip_pose_and_jacobian(hand, finger.tip, hand.rest)[1][3:]
        own = sorted((name for name in finger.own if name in way), key=way.index)
        for inner, outer in pairwise(own):
            axes = [turning[:, hand.actuator_index(name)] for name in (inner, outer)]
            lengths = [float(np.linalg.norm(axis)) for axis in axes]
            # A prismatic joint has the angular velocity 0 here.
            if min(lengths) > 0.0 and abs(axes[0] @ axes[1]) >= PARALLEL * lengths[0] * lengths[1]:
                found[outer] = f"bends parallel to '{inner}', and one tendon may bend both"
    return found


@dataclass(frozen=True, slots=True)
class OneMotor:
    """Two jaws that one motor may drive.

    Attributes:
        joint: The joint that may follow.
        master: The joint that it may follow.
        factor: The factor: 1 or -1.
    """

    joint: str
    master: str
    factor: int

    @property
    def element(self) -> str:
        """The URDF element that states this, to be put inside the joint's."""
        return f'<mimic joint={quoteattr(self.master)} multiplier="{self.factor}"/>'

    def of(self, robot: Element, _whole: Urdf) -> Element:
        """Return a robot in which the joint follows the other one."""

        def coupled(each: Element) -> Element:
            if each.tag != "joint" or each.attributes.get("name", "").strip() != self.joint:
                return each
            values = {"joint": self.master, "multiplier": str(self.factor)}
            mimic = Element("mimic", values, each.line, each.path)
            return replace(each, children=[*each.children, mimic])

        return replace(robot, children=[coupled(each) for each in robot.children])


def one_motor(hand: Hand) -> OneMotor | None:
    """Return how one motor may drive the two jaws of a gripper, if they mirror each other.

    Each has one actuator; both have the same limits, or opposite ones, and move the tips towards
    each other.
    """
    if len(hand.fingers) != 2 or len(hand.actuators) != 2:
        return None
    first, second = hand.fingers
    if first.tip is None or second.tip is None or len(first.own) != 1 or len(second.own) != 1:
        return None
    a, b = hand.actuator(first.own[0]), hand.actuator(second.own[0])
    if (a.kind, a.velocity, a.effort) != (b.kind, b.velocity, b.effort):
        return None
    if not all(math.isfinite(bound) for bound in (a.lower, a.upper, b.lower, b.upper)):
        return None
    u = 0.5 * (hand.lower + hand.upper)
    poses, ways = [], []
    for tip, actuator in ((first.tip, a.name), (second.tip, b.name)):
        pose, jacobian = tip_pose_and_jacobian(hand, tip, u)
        shapes = hand.urdf.links[tip].collisions
        middle = np.mean([(pose @ [*shape.xyz, 1.0])[:3] for shape in shapes], axis=0)
        column = jacobian[:, hand.actuator_index(actuator)]
        poses.append(middle)
        ways.append(column[:3] + np.cross(column[3:], middle - pose[:3, 3]))
    between = poses[1] - poses[0]
    closing = [float(way @ between) for way in ways]
    if not all(closing):
        return None
    factor = -1 if closing[0] * closing[1] > 0.0 else 1
    limits = (b.lower, b.upper) if factor > 0 else (-b.upper, -b.lower)
    slack = _SAME * (a.upper - a.lower)
    if abs(limits[0] - a.lower) > slack or abs(limits[1] - a.upper) > slack:
        return None
    return OneMotor(b.name, a.name, factor)


def fixed_jaw(hand: Hand) -> Chain | None:
    """Return the part that may oppose the only finger of a hand: the link that carries it.

    If further links with geometry are fixed to it, it is the one farthest from the root.
    """
    if len(hand.fingers) != 1 or hand.fingers[0].tip is None:
        return None
    finger = hand.fingers[0]
    moved = {joint.name for joint in hand.joints}
    first = next(j for j in hand.urdf.path_to(finger.links[-1]) if j.child in finger.links[1:])
    welded = [first.parent]
    for link in welded:
        welded += [j.child for j in hand.urdf.joints_below[link] if j.name not in moved]
    solid = [link for link in welded if hand.urdf.links[link].collisions]
    if not solid:
        return None
    jaw = max(solid, key=lambda link: len(hand.urdf.path_to(link)))
    above = hand.urdf.joint_to.get(jaw)
    links = (jaw,) if above is None else (above.parent, jaw)
    return Chain(
        "fixed", links, f"'{jaw}', which carries the only moving finger, may be its counterpart"
    )


def _finger_of(hand: Hand, actuator: str) -> Finger:
    return next(finger for finger in hand.fingers if actuator in finger.own)


def in_words(candidates: Sequence[UndrivenCandidate]) -> list[str]:
    """Return the candidates as sentences, one for each reason."""
    reasons: dict[str, list[str]] = {}
    for candidate in candidates:
        reasons.setdefault(candidate.why, []).append(f"'{candidate.joint}'")
    return [
        f"{', '.join(joints)} may have no motor: {'it' if len(joints) == 1 else 'each'} {why}"
        for why, joints in reasons.items()
    ]


def motor_notes(hand: Hand) -> list[str]:
    """Return notes on the joints of a hand without SRDF that may have no motor.

    Raises:
        ModelError: if its URDF cannot be read again.
    """
    notes = in_words(passive_candidates(hand))
    if notes:
        notes[-1] += (
            '; such a joint is declared by <passive_joint name="JOINT"/> in the SRDF; '
            "`rtee new --ask` goes through them all"
        )
    return notes


def carriers(hand: Hand) -> tuple[str, ...]:
    """Return the actuators that move all fingers as one body, as in a wrist, in the hand's order.

    Every joint that such an actuator moves on the path to one fingertip is on the paths to all
    fingertips. The result is empty if no other actuator would be left, or with fewer than two
    fingers.
    """
    tips = [finger.tip for finger in hand.fingers if finger.tip]
    if len(tips) < 2:
        return ()
    ways = [[joint.name for joint in hand.urdf.path_to(tip)] for tip in tips]
    common = set(ways[0]).intersection(*ways[1:])
    rows = {joint.name: row for row, joint in enumerate(hand.joints)}
    moved: dict[int, set[str]] = {}
    for name in set().union(*ways):
        if name in rows:
            index = hand.transmission.moves(rows[name])
            if index is not None:
                moved.setdefault(index, set()).add(name)
    found = [hand.actuators[index].name for index in sorted(moved) if moved[index] <= common]
    # If every actuator moves all fingers, the hand has no wrist.
    return tuple(found) if len(found) < len(moved) else ()
