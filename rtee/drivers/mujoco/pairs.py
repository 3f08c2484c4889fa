"""Pairs of links that can touch in the simulation: those that the extraction allows."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from rtee.drivers.mujoco.contacts import make_pair_hard
from rtee.drivers.mujoco.couplings import motor_joint
from rtee.errors import ModelError
from rtee.hand.model import Hand
from rtee.sample import FloatArray

LINK = "link/"
"""Prefix of the name of a link's body: a link may be called ``world``, MuJoCo's own body."""

_INTERPENETRATING = 5e-3  # deeper overlap of two fingers at rest is an error of the model [m]
_OUTER = 0.9
"""Share of a finger's reach beyond which its shapes count as outer ones: as for openings, parts
nearer to the joint close less than the tips, and would stop them before they meet."""


def leave_pairs_out(
    spec: mujoco.MjSpec, hand: Hand, resting: mujoco.MjData, touch: Callable[[str, str], bool]
) -> list[str]:
    """Exclude contacts of links that the SRDF disables, that are joined, or that touch at rest.

    Args:
        spec: The hand's model.
        hand: The hand.
        resting: The hand at rest, with the contacts of all pairs of links.
        touch: Returns whether the exact geometries of two links touch at rest.

    Returns:
        The pairs left out because they touch at rest, one sentence each.

    Raises:
        ModelError: if links of two fingers are deep inside each other at rest.
    """
    never = [(first, second) for first, second, _ in hand.disabled_collisions]
    left_out = {frozenset(pair) for pair in [*never, *_adjacent(hand)]}
    # Each pair once, since SRDFs usually disable joined links, too.
    for first, second in dict.fromkeys([*never, *_adjacent(hand)]):
        spec.add_exclude(bodyname1=LINK + first, bodyname2=LINK + second)
    return _exclude_touching_at_rest(spec, hand, resting, touch, left_out)


def _finger_of(hand: Hand) -> dict[str, str]:
    """Return the finger of each link that belongs to exactly one."""
    found: dict[str, set[str]] = {}
    for finger in hand.fingers:
        for link in finger.body:
            found.setdefault(link, set()).add(finger.name)
    return {link: next(iter(names)) for link, names in found.items() if len(names) == 1}


def _joined(hand: Hand) -> list[tuple[str, str]]:
    """Return the pairs of links with shapes that one moving joint joins."""
    group: dict[str, str] = {hand.urdf.root: hand.urdf.root}
    for joint in hand.urdf.joints.values():
        group[joint.child] = joint.child if joint.moving else group[joint.parent]
    members: dict[str, list[str]] = {}
    for link, head in group.items():
        if hand.urdf.links[link].collisions:
            members.setdefault(head, []).append(link)
    return [
        (first, second)
        for joint in hand.urdf.joints.values()
        if joint.moving
        for first in members.get(group[joint.parent], [])
        for second in members.get(joint.child, [])
    ]


def _adjacent(hand: Hand) -> list[tuple[str, str]]:
    """Return the pairs of links that are joined and never checked.

    Pairs of fingertips are not among them: a claw closes against the fixed jaw on which it turns.
    """
    return [pair for pair in _joined(hand) if not set(pair) <= hand.tip_links.keys()]


def _add_jaws(spec: mujoco.MjSpec, data: mujoco.MjData, first: str, second: str) -> None:
    """Let the outer shapes of two joined fingertips meet, though the links are excluded.

    Near their joint the links always touch; that does not count as a contact of the jaws. Outer
    shapes are those whose centres are further from the joint's axis than `_OUTER` of the shorter
    link's reach, and that are apart at rest.
    """
    model = data.model
    joint = max(int(model.body(LINK + name).jntadr[0]) for name in (first, second))
    anchor, axis = data.xanchor[joint], data.xaxis[joint]
    arms: list[dict[str, float]] = []
    for link in (first, second):
        geoms = np.flatnonzero(model.geom_bodyid == model.body(LINK + link).id)
        away = np.linalg.norm(np.cross(data.geom_xpos[geoms] - anchor, axis), axis=1)
        names = [model.geom(int(geom)).name for geom in geoms]
        arms.append(dict(zip(names, away.tolist(), strict=True)))
    least = _OUTER * min(max(arm.values()) for arm in arms)
    outer = [[name for name, away in arm.items() if away > least] for arm in arms]
    inside = {
        frozenset((model.geom(int(a)).name, model.geom(int(b)).name)) for a, b in data.contact.geom
    }
    for one in outer[0]:
        for other in outer[1]:
            if frozenset((one, other)) not in inside:
                make_pair_hard(
                    spec.add_pair(geomname1=one, geomname2=other), pair_friction(spec, one, other)
                )


def pair_friction(spec: mujoco.MjSpec, first: str, second: str) -> float:
    """Return the friction of a pair of shapes: the larger of the two, as in MuJoCo's own rule."""
    return max(float(spec.geom(name).friction[0]) for name in (first, second))


def _exclude_touching_at_rest(
    spec: mujoco.MjSpec,
    hand: Hand,
    data: mujoco.MjData,
    touch: Callable[[str, str], bool],
    left_out: set[frozenset[str]],
) -> list[str]:
    """Exclude pairs that touch at rest, as the extraction does; raises `ModelError`.

    MuJoCo uses the convex hulls of meshes. If only the hulls of two links touch at rest, the pair
    is excluded too, and noted.
    """
    model = data.model
    finger = _finger_of(hand)
    touching: dict[tuple[str, str], float] = {}
    for contact in data.contact:
        bodies = (model.geom_bodyid[contact.geom1], model.geom_bodyid[contact.geom2])
        # In a fixed order, so that a pair is found again whichever link MuJoCo names first.
        names = sorted(model.body(int(b)).name.removeprefix(LINK) for b in bodies)
        pair = (names[0], names[1])
        if names[0] == names[1] or frozenset(pair) in left_out:
            continue
        touching[pair] = min(float(contact.dist), touching.get(pair, 0.0))
    notes = []
    hinged = {frozenset(pair) for pair in _joined(hand)}
    for (first, second), distance in sorted(touching.items()):
        fingers = (finger.get(first), finger.get(second))
        spec.add_exclude(bodyname1=LINK + first, bodyname2=LINK + second)
        if frozenset((first, second)) in hinged:
            _add_jaws(spec, data, first, second)
            notes.append(
                f"links '{first}' and '{second}' touch at their joint, so only their outer shapes "
                "are checked"
            )
            continue
        if not touch(first, second):
            notes.append(
                f"the convex hulls of links '{first}' and '{second}' overlap at rest, so their "
                "contact is not simulated"
            )
            continue
        if None not in fingers and fingers[0] != fingers[1] and distance < -_INTERPENETRATING:
            raise ModelError(
                f"links '{first}' and '{second}' of two fingers are {-distance * 1e3:.1f} mm "
                "inside each other at rest, so the hand cannot be simulated; correct the collision "
                "shapes or the rest posture, or disable the pair in the SRDF",
                path=hand.urdf.path,
            )
        notes.append(f"links '{first}' and '{second}' touch at rest and are not checked")
    return notes


def rest_position(
    model: mujoco.MjModel, hand: Hand, posture: FloatArray | None = None
) -> FloatArray:
    """Return generalised positions ``(nq,)``: the hand in a posture, everything else as modelled.

    The posture is given as actuator positions ``(n,)`` [rad | m]; by default it is rest.
    """
    u = hand.rest if posture is None else posture
    position = model.qpos0.copy()
    for name, value in zip(hand.joint_names, hand.transmission.joints(u), strict=True):
        position[model.joint(name).qposadr[0]] = value
    for name, value in zip(hand.actuator_names, u, strict=True):
        position[model.joint(motor_joint(hand, name)).qposadr[0]] = value
    return np.asarray(position, dtype=np.float64)
