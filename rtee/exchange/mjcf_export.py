"""Export of a hand as MJCF: the model that rtee simulates, with the names of the hand's files.

For other programs, it also has visual shapes, ranges of the actuators' targets, touch sensors on
the fingertips, and the rest posture as a keyframe.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final
from xml.etree import ElementTree

import mujoco
import numpy as np
from msgspec import structs

from rtee.drivers.mujoco.couplings import fit, followers, span
from rtee.drivers.mujoco.model import CARRIER, add_shape
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK, rest_position
from rtee.drivers.mujoco.scene import build_hand
from rtee.drivers.mujoco.servos import effort_note
from rtee.drivers.mujoco.solids import turn_of
from rtee.hand.model import Hand
from rtee.types import JointKind

CLOSE: Final = 1e-4
"""Largest deviation of a polynomial from a coupling that needs no note [rad | m]: less than hands'
encoders resolve."""

TOUCH: Final = "touch/"
"""Prefix of the touch sensors' names; the finger's name follows."""

REST: Final = "rest"
"""Name of the keyframe with the rest posture."""

_VISIBLE, _COLLISION = 2, 3
"""Groups of shapes that MuJoCo's viewers show and hide by default."""

_SKIN = 1e-3
"""Margin of a touch sensor's zone around the fingertip [m], for the margin and the penetration of
MuJoCo's soft contacts."""

_EXACT: Final = {
    "body": ("pos", "quat"),
    "joint": ("axis", "range"),
    "geom": ("pos", "quat", "size"),
    "site": ("pos", "quat", "size"),
}
"""Attributes written with all digits; MuJoCo writes only six, a resolution of 1 µm in 1 m."""

_DEFAULTS: Final = {
    "pos": (0.0, 0.0, 0.0),
    "quat": (1.0, 0.0, 0.0, 0.0),
    "axis": (0.0, 0.0, 1.0),
    "polycoef": (0.0, 1.0, 0.0, 0.0, 0.0),
}
"""Values that MuJoCo does not write, by attribute."""


def mjcf_of(hand: Hand) -> tuple[str, list[str]]:
    """Return a hand as MJCF, and notes about differences from the hand's model.

    Raises:
        ModelError: if the hand cannot be simulated; the message says why.
    """
    plain, notes = _rigid_where_curved(hand)
    built = build_hand(plain, SimOptions())
    spec = built.spec
    _add_visuals(spec, hand)
    _limit_targets(spec, hand)
    _add_touch(spec, hand)
    # The steps above find the bodies by rtee's names.
    names = _own_names(spec, hand)
    # The keyframe, which is also written, needs the compiled model.
    model = spec.compile()
    spec.add_key(
        name=REST,
        qpos=rest_position(model, plain),
        ctrl=[hand.rest[hand.actuator_index(motor.name)] for motor in spec.actuators],
    )
    # Again, since the model now has the keyframe.
    model = spec.compile()
    told = [*effort_note(hand), *built.notes, *names, *notes]
    return _in_full(spec.to_xml(), spec, model), told


def _rigid_where_curved(hand: Hand) -> tuple[Hand, list[str]]:
    """Return the hand without springs along curves, and notes about errors of polynomials.

    MuJoCo's springs are linear. rtee updates their tangents during a simulation; a file cannot.
    """
    notes, rigid = [], dict(hand.dynamics)
    for follower in followers(hand):
        if follower.coupling.linear:
            continue
        name = follower.actuator.name
        if follower.elastic and rigid[name].joints:
            rigid[name] = structs.replace(rigid[name], coupling=None, joints=None, shares=None)
            notes.append(
                f"the joints of '{name}' follow curves, so they are coupled rigidly, not by springs"
            )
        error = fit(follower.coupling, *span(follower.actuator))[1]
        if error > CLOSE:
            kind = hand.joints[hand.joint_index(follower.joint)].kind
            unit = "m" if kind is JointKind.PRISMATIC else "rad"
            notes.append(
                f"joint '{follower.joint}' follows '{name}' by a curve that MuJoCo's polynomial "
                f"fits within {error:.2g} {unit}"
            )
    return replace(hand, dynamics=rigid), notes


def _add_visuals(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Add the visual shapes of each link; show its collision shapes instead of a visual mesh."""
    for link in hand.urdf.links.values():
        body = spec.body(LINK + link.name)
        if not link.visuals or any(shape.kind == "mesh" for shape in link.visuals):
            for geom in body.geoms:
                geom.group = _VISIBLE
            continue
        for index, shape in enumerate(link.visuals):
            geom = add_shape(spec, body, shape, f"{link.name}/visual/{index}", _no_triangles)
            # A visual shape has no contacts and no mass.
            geom.contype = geom.conaffinity = 0
            geom.mass = 0.0
            geom.group = _VISIBLE


def _no_triangles() -> tuple[np.ndarray, np.ndarray]:
    raise AssertionError  # visual meshes are not added


def _limit_targets(spec: mujoco.MjSpec, hand: Hand) -> None:
    for motor in spec.actuators:
        actuator = hand.actuator(motor.name)
        # A continuous joint has limits only if hand.yaml gives it some.
        if math.isfinite(actuator.lower) and math.isfinite(actuator.upper):
            motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
            motor.ctrlrange = [actuator.lower, actuator.upper]


def _add_touch(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Add a touch sensor to each fingertip: the sum of the normal forces in a box around it [N].

    MuJoCo's sensor counts the contacts of one body, so that each link of a fingertip has its own.
    """
    # The bounding boxes of meshes are known only after compilation.
    model = spec.compile()
    for link, finger in hand.tip_links.items():
        own = np.flatnonzero(model.geom_bodyid == model.body(LINK + link).id).tolist()
        corners = np.vstack([_corners(model, geom) for geom in own if model.geom_contype[geom]])
        lower, upper = corners.min(axis=0), corners.max(axis=0)
        name = TOUCH + (finger if link == hand.finger(finger).tip else f"{finger}/{link}")
        spec.body(LINK + link).add_site(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=0.5 * (lower + upper),
            size=0.5 * (upper - lower) + _SKIN,
            group=4,  # not shown
        )
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_TOUCH,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=name,
        )


def _corners(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the corners ``(8, 3)`` of a shape's box in its body's frame [m]."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    return np.asarray(
        model.geom_pos[geom] + (centre + signs * half) @ turn_of(model.geom_quat[geom]).T
    )


def _own_names(spec: mujoco.MjSpec, hand: Hand) -> list[str]:
    """Give bodies the names of their links; return notes about names that had to differ."""
    notes = []
    names = {LINK + link: link for link in hand.urdf.links}
    if "world" in hand.urdf.links:
        names[LINK + "world"] = LINK + "world"
        notes.append("link 'world' is called 'link/world', since MuJoCo has a body of that name")
    if CARRIER in hand.urdf.links:
        names[CARRIER] = f"{CARRIER}/{hand.name}"
    for body in spec.bodies:
        body.name = names.get(body.name, body.name)
    for pair in spec.excludes:
        pair.bodyname1, pair.bodyname2 = names[pair.bodyname1], names[pair.bodyname2]
    return notes


def _in_full(text: str, spec: mujoco.MjSpec, model: mujoco.MjModel) -> str:
    """Return MuJoCo's text of a model, with all digits of the geometry's numbers."""
    root = ElementTree.fromstring(text)  # noqa: S314 - made by MuJoCo just now
    world = root.find("worldbody")
    assert world is not None  # noqa: S101 - every model has one
    for tag, attributes in _EXACT.items():
        for element in world.iter(tag):
            obj = getattr(spec, tag)(element.get("name", ""))
            for attribute in attributes:
                _set(element, attribute, getattr(obj, attribute))
    for element in root.iterfind("./equality/joint"):
        _set(element, "polycoef", spec.equality(element.get("name", "")).data[:5])
    for element in root.iterfind("./tendon/fixed"):
        tendon = model.tendon(element.get("name", ""))
        first = int(model.tendon_adr[tendon.id])
        _set(element, "springlength", model.tendon_lengthspring[tendon.id, :1])
        for i, joint in enumerate(element.iterfind("joint")):
            _set(joint, "coef", model.wrap_prm[first + i : first + i + 1])
    for element in root.iterfind("./actuator/*"):
        _set(element, "ctrlrange", model.actuator(element.get("name", "")).ctrlrange)
    for element in root.iterfind("./keyframe/key"):
        key = spec.key(element.get("name", ""))
        _set(element, "qpos", key.qpos)
        _set(element, "ctrl", key.ctrl)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _set(element: ElementTree.Element, attribute: str, values: Iterable[float]) -> None:
    """Write all digits of an attribute that MuJoCo has written, or has rounded to its default."""
    numbers = [float(value) for value in values]
    written = element.get(attribute)
    if written is None:
        default: Sequence[float] | None = _DEFAULTS.get(attribute)
        if default is None or tuple(numbers) == default or not all(map(math.isfinite, numbers)):
            return
    else:
        # As many numbers as MuJoCo writes: a sphere has one size, a cylinder two.
        numbers = numbers[: len(written.split())]
    element.set(attribute, " ".join(map(repr, numbers)))
