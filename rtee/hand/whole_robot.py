"""Whole robots: which of their subtrees are hands, and which joints are those of an arm."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rtee.hand.chains import Chain
from rtee.hand.linkages import Mover
from rtee.hand.model import Hand, JointRole
from rtee.hand.names import shared_length
from rtee.hand.urdf import Urdf, UrdfJoint, UrdfLink

_ARM_JOINTS: Final = 3
"""Fewest joints in a row without a branch that form an arm, not a wrist or a fold of the palm, when
parts of a robot are compared."""

_SURELY_ARM: Final = 4
"""Fewest such joints that form an arm, whatever their names: a wrist has at most three."""

_LIMB: Final = 6
"""Fewest actuators of one branch that form an arm or a leg: a human-like thumb has five."""

_ARM: Final = re.compile(
    r"shoulder|elbow|forearm|waist|torso|(?<![a-z])(?:upper_?|lower_?)?arm(?![a-z])"
)
_FINGER: Final = re.compile(r"finger|thumb|jaw|claw|(?<![a-z])(?:index|middle|ring|little|pinky)")
_HAND: Final = re.compile(r"hand|gripper|palm|eef|end_?effector")

_SIDE: Final = re.compile(r"left|right|(?<![a-z])(?:l|r|lh|rh)(?![a-z])")
"""Words for the two sides of a robot."""


@dataclass(frozen=True, slots=True)
class FoundHand:
    """A hand in a robot.

    Attributes:
        link: The link below which it is.
        ends: The last links of its fingers.
        arm: The joints above it that carry nothing else.
    """

    link: str
    ends: tuple[str, ...]
    arm: tuple[str, ...]


def find_hands(
    branches: Sequence[Chain], urdf: Urdf, movers: Mapping[str, Mover]
) -> tuple[FoundHand, ...]:
    """Return the subtrees of a robot that end in several fingertips, in the tree's order.

    Where a link carries several parts with several tips each, it is the body of a robot if arms
    lead to them or if they are the left and the right one of a pair; otherwise it is a palm.
    Branches of six actuators or more are arms or legs without a hand.
    """
    ends = [chain.links[-1] for chain in branches]
    limbs = {
        chain.links[-1]
        for chain in branches
        if len({movers[j.name].actuator for j in _own(chain, urdf) if j.name in movers}) >= _LIMB
    }
    return tuple(_below(urdf.root, [end for end in ends if end not in limbs], urdf, movers))


def arm_joints(
    branches: Sequence[Chain], urdf: Urdf, movers: Mapping[str, Mover]
) -> tuple[str, ...]:
    """Return the joints of the arm that carries the hand, nearest the root first.

    An arm has four joints or more in a row, or names such as ``shoulder``. With a single finger,
    such as one jaw, it ends where names begin that are those of a finger, otherwise before the last
    joint that moves.
    """
    if len(branches) > 1:
        hands = find_hands(branches, urdf, movers)
        return hands[0].arm if len(hands) == 1 and _is_arm(hands[0].arm, urdf) else ()
    if not branches:
        return ()
    end = branches[0].links[-1]
    path = [joint for joint in urdf.path_to(end) if joint.name in movers]
    # A jaw without geometry is not a finger, but the links above it belong to the arm.
    jaw = any(urdf.joint_to[link].name in movers for link in urdf.links_below(end)[1:])
    fingers = (i for i, j in enumerate(path) if _FINGER.search(f"{j.name} {j.child}".lower()))
    above = path if jaw else path[: next(fingers, len(path) - 1)]
    arm = tuple(joint.name for joint in above)
    return arm if _is_arm(arm, urdf) else ()


def without_geometry(urdf: Urdf, movers: Collection[str]) -> list[str]:
    """Return the moving links with no collision geometry in them or below.

    Motor shafts and tendons are not among them: links without any shape, whose joint is followed by
    others that move collision geometry.
    """

    def moved(joint: UrdfJoint) -> list[UrdfLink]:
        return [urdf.links[link] for link in urdf.links_below(joint.child)]

    touching = {j.name for j in urdf.joints.values() if any(link.collisions for link in moved(j))}
    drives = {urdf.master(name) for name in touching}
    return [
        joint.child
        for joint in urdf.joints.values()
        if joint.name in movers
        and joint.name not in touching
        and (joint.name not in drives or any(link.visuals for link in moved(joint)))
    ]


def check_one_hand(hand: Hand) -> None:
    """Refuse a robot with several hands, or with other parts besides its hand; name the hands.

    Raises:
        ModelError: if the robot has several hands, or other parts besides one, or limbs and no
            hand.
    """
    # Joints of an arm count as moving here, though the hand ignores them.
    still = {joint.name for joint in hand.joints if joint.role is JointRole.PASSIVE}
    masters = {joint.name: hand.urdf.master(joint.name) for joint in hand.joints}
    movers = {name: Mover(master, 1.0) for name, master in masters.items() if master not in still}
    branches = [Chain(finger.name, finger.links, "") for finger in hand.fingers]
    hands = find_hands(branches, hand.urdf, movers)
    whole = len(hands) == 1 and len(hands[0].ends) == len(branches)
    if whole or (not hands and len(branches) < 2):
        return
    if not hands:
        raise hand.urdf.error(
            f"no hand was found: the {len(branches)} branches that move end in one link each, as "
            "arms and legs do; give the hand's base link with --root LINK"
        )
    named = " or ".join(f"--root {each.link} ({len(each.ends)} fingers)" for each in hands)
    what = "a hand and other parts" if len(hands) == 1 else f"{len(hands)} hands"
    raise hand.urdf.error(f"is a robot with {what}; take a hand by {named}")


def _is_arm(joints: Sequence[str], urdf: Urdf) -> bool:
    texts = [f"{name} {urdf.joints[name].child}".lower() for name in joints]
    return len(joints) >= _SURELY_ARM or any(_ARM.search(text) for text in texts)


def _own(chain: Chain, urdf: Urdf) -> list[UrdfJoint]:
    return [urdf.joint_to[link] for link in chain.links[1:]]


def _below(
    link: str, ends: Sequence[str], urdf: Urdf, movers: Mapping[str, Mover]
) -> list[FoundHand]:
    above = urdf.joint_to.get(link)
    arm = [above.name] if above is not None and above.name in movers else []
    paths = {end: urdf.links_to(end) for end in ends}
    while len(ends) > 1:
        parts: dict[str, list[str]] = {}
        for end in ends:
            path = paths[end]
            inside = path[path.index(link) + 1 :] if link in path else path
            parts.setdefault(inside[0] if inside else link, []).append(end)
        if len(parts) > 1:
            several = [part for part in parts if len(parts[part]) > 1]
            found = {part: _below(part, parts[part], urdf, movers) for part in several}
            if _is_body(found, urdf):
                return [hand for hands in found.values() for hand in hands]
            return [FoundHand(_base(link, urdf), tuple(ends), tuple(arm))]
        (link,) = parts
        if urdf.joint_to[link].name in movers:
            arm.append(urdf.joint_to[link].name)
    return []


def _is_body(found: Mapping[str, Sequence[FoundHand]], urdf: Urdf) -> bool:
    """Return whether parts with several tips each are separate hands, not parts of one palm."""
    if any(len(hands) > 1 for hands in found.values()):
        return True
    if any(len(hand.arm) >= _ARM_JOINTS for hands in found.values() for hand in hands):
        return True
    shapes = [_plain(part, urdf) for part in found]
    return len(shapes) > 1 and all(shape == shapes[0] for shape in shapes)


def _plain(part: str, urdf: Urdf) -> list[str]:
    """Return the names of a part's links without words for sides and the prefix of the part."""
    names = [link.lower() for link in urdf.links_below(part)]
    sides = sorted(_SIDE.sub("#", name) for name in names)
    if any("#" in name for name in sides):
        return sides
    prefix = shared_length(names)
    return sorted(name[prefix:] for name in names)


def _base(link: str, urdf: Urdf) -> str:
    """Return the topmost link welded to a palm that is called like a hand, otherwise the palm."""
    base = at = link
    while (joint := urdf.joint_to.get(at)) is not None and not joint.moving:
        at = joint.parent
        if _HAND.search(at.lower()):
            base = at
    return base
