"""Read a URDF; every mistake in it is reported as a one-sentence error with its line."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np

from rtee.errors import UnknownLink
from rtee.hand.frames import angles, origin, pose_matrix
from rtee.hand.urdf import (
    ZERO,
    Triple,
    Urdf,
    UrdfGeometry,
    UrdfInertia,
    UrdfJoint,
    UrdfJointKind,
    UrdfLink,
    UrdfMimic,
)
from rtee.hand.vocabulary import URDF, unread
from rtee.hand.xmlfile import Element, check_expanded, read_xml, to_text

FARTHEST: Final = 1e3
"""Largest length accepted [m]: no hand is larger, and rounding errors would grow to micrometres."""

MOST: Final = 1e6
"""Largest limit, angle [rad | m] or factor accepted: larger ones are slips, such as a misplaced
decimal point."""

MOST_LINKS: Final = 300
"""Most links of a model; hands have up to 50, and whole robots 200. The work on pairs of links
grows with the square."""

MOST_SHAPES: Final = 1000
"""Most collision shapes; hands whose links are decomposed into convex parts have up to 500. The
work on them grows likewise."""

_NO_AXIS: Final = 1e-9
"""Length below which an axis has no direction, since rounding errors would determine it."""

_KINDS: Final = ("revolute", "continuous", "prismatic", "fixed")
_LIMITED: Final = ("revolute", "prismatic")
_FREE: Final = ("floating", "planar")


class Edit(Protocol):
    """A change to a robot's description that is made before anything is derived from it."""

    def of(self, robot: Element, whole: Urdf) -> Element:
        """Return the changed ``<robot>``, given the present one and the robot as it was read."""


def read_urdf(path: Path | str, edits: Sequence[Edit] = ()) -> Urdf:
    """Read a URDF, with changes such as `rtee.hand.subtree.Subtree`.

    Raises:
        UnknownLink: if a change names a link that is not there.
        ModelError: if the file does not exist, is neither XML nor a URDF, or describes no tree of
            links with well-defined joints; the message names file and line.
    """
    root, text = read_xml(path, "URDF")
    _check_root(root)
    afloat = _placing(root)
    if afloat is not None:
        still = replace(afloat, attributes={**afloat.attributes, "type": "fixed"})
        root = replace(root, children=[still if c is afloat else c for c in root.children])
        text = to_text(root)
    urdf = _urdf(root, text)
    for edit in edits:
        root = edit.of(root, urdf)
        urdf = _urdf(root, to_text(root))
    if afloat is not None and (name := afloat.required("name")) in urdf.joints:
        note = (
            f"joint '{name}' (line {afloat.line} of {urdf.path.name}) is "
            f"{afloat.required('type')}: it places the hand in the world, and is taken as fixed"
        )
        urdf = replace(urdf, unread=(note, *urdf.unread))
    return urdf


def _placing(root: Element) -> Element | None:
    """Return the floating or planar joint that carries a whole robot, if there is one.

    Such a joint says where the robot stands in the world, which no part of a hand depends on.
    """
    ends = {
        end: [
            each.attributes.get("link", "").strip()
            for joint in root.all("joint")
            for each in joint.all(end)
        ]
        for end in ("parent", "child")
    }
    for joint in root.all("joint"):
        parent = joint.first("parent")
        if parent is None or joint.attributes.get("type", "").strip() not in _FREE:
            continue
        link = parent.attributes.get("link", "").strip()
        if link not in ends["child"] and ends["parent"].count(link) == 1:
            return joint
    return None


def _urdf(root: Element, text: str) -> Urdf:
    links = _links(root)
    joints = _joints(root, links)
    base, joint_to, below = _tree(root, links, joints)
    return Urdf(
        name=root.attributes.get("name", "").strip() or root.path.stem,
        path=root.path,
        text=text,
        # Read-only, since every part of the program uses the same description.
        links=MappingProxyType(links),
        joints=MappingProxyType(_in_tree_order(base, below)),
        root=base,
        joint_to=MappingProxyType(joint_to),
        joints_below=MappingProxyType(below),
        unread=tuple(unread(root, URDF)),
    )


def _check_root(root: Element) -> None:
    if root.tag != "robot":
        other = {"sdf": "an SDF", "mujoco": "a MuJoCo model", "COLLADA": "a COLLADA mesh"}
        what = other.get(root.tag, f"<{root.tag}>")
        remedy = "; give it by --mjcf" if root.tag == "mujoco" else ""
        raise root.error(f"is {what}, not a URDF, whose root element is <robot>{remedy}")
    check_expanded(root)


def _links(root: Element) -> dict[str, UrdfLink]:
    links: dict[str, UrdfLink] = {}
    for_gazebo = {each.attributes.get("reference", ""): each for each in root.all("gazebo")}
    for element in root.all("link"):
        name = element.required("name")
        if name in links:
            raise element.error(f"link '{name}' is defined twice, first in line {links[name].line}")
        inertial = element.first("inertial")
        mass = inertial.first("mass") if inertial else None
        links[name] = UrdfLink(
            name=name,
            line=element.line,
            collisions=_shapes(element, "collision", name),
            visuals=_shapes(element, "visual", name),
            has_inertial=inertial is not None,
            mass=_mass(mass) if mass else 0.0,
            inertia=None if inertial is None else _inertia(inertial),
            friction=_friction(element, for_gazebo.get(name)),
        )
    if not 0 < len(links) <= MOST_LINKS:
        raise root.error(f"has {len(links)} links instead of 1 to {MOST_LINKS}")
    if (shapes := sum(len(link.collisions) for link in links.values())) > MOST_SHAPES:
        raise root.error(f"has {shapes} collision shapes; a hand has at most {MOST_SHAPES}")
    return links


def _mass(element: Element) -> float:
    mass = element.number("value")
    if mass < 0.0:
        raise element.error(f"a mass of {mass:g} kg is negative")
    return mass


def _friction(link: Element, for_gazebo: Element | None) -> float | None:
    """Return the friction of a link; ``None`` if it is not given, or invalid."""
    contact = link.first("contact")
    found = contact.first("lateral_friction") if contact is not None else None
    if for_gazebo is not None:
        found = for_gazebo.first("mu1") or found
    if found is None:
        return None
    try:
        value = float(found.attributes.get("value", "") or found.text)
    except ValueError:  # meant for other programs, which may accept another format
        return None
    # NaN fails this comparison, too.
    return value if 0.0 <= value <= MOST else None


def _inertia(inertial: Element) -> UrdfInertia | None:
    tensor = inertial.first("inertia")
    if tensor is None:
        return None
    xyz, rpy = _origin(inertial)
    xx, xy, xz, yy, yz, zz = (
        tensor.number(name, 0.0, most=MOST) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return UrdfInertia(xyz, rpy, (xx, xy, xz, yy, yz, zz))


def _shapes(element: Element, tag: str, link: str) -> tuple[UrdfGeometry, ...]:
    return tuple(shape for each in element.all(tag) for shape in _geometry(each, link))


def _geometry(element: Element, link: str) -> tuple[UrdfGeometry, ...]:
    """Return the shapes of a ``<visual>`` or ``<collision>``: one, or three for a capsule."""
    geometry = element.first("geometry")
    shape = geometry.children[0] if geometry and geometry.children else None
    if shape is None:
        raise element.error(f"<{element.tag}> of link '{link}' has no geometry")
    xyz, rpy = _origin(element)
    made = partial(UrdfGeometry, xyz=xyz, rpy=rpy, line=shape.line)

    def measure(name: str) -> float:
        return _positive(shape, shape.number(name, most=FARTHEST))

    # A program's prefix: drake:capsule was there before the capsule of URDF 1.1.
    match shape.tag.rpartition(":")[2]:
        case "mesh":
            return (made("mesh", mesh=shape.required("filename"), scale=_scale(shape)),)
        case "box":
            size = _triple(shape.numbers("size", 3, most=FARTHEST))
            _positive(shape, min(size))
            return (made("box", size=size),)
        case "sphere":
            return (made("sphere", radius=measure("radius")),)
        case "cylinder":
            return (made("cylinder", radius=measure("radius"), length=measure("length")),)
        case "capsule":
            radius, length = measure("radius"), measure("length")
            # The cylinder's length counts, as in Pinocchio and urdfdom; the caps stand out of it.
            ends = ((origin(xyz, rpy) @ [0, 0, way, 1])[:3] for way in (-length / 2, length / 2))
            caps = (made("sphere", radius=radius, xyz=_triple(tuple(end))) for end in ends)
            return made("cylinder", radius=radius, length=length), *caps
        case other:
            raise shape.error(
                f"unknown geometry <{other}> of link '{link}'; valid: mesh, box, sphere, "
                "cylinder and capsule"
            )


def _positive(shape: Element, value: float) -> float:
    if value <= 0:
        raise shape.error(f"<{shape.tag}> has a dimension that is not positive")
    return value


def _scale(shape: Element) -> Triple:
    scale = _triple(shape.numbers("scale", 3, (1.0, 1.0, 1.0), most=MOST))
    if 0.0 in scale:
        raise shape.error("the mesh's scale is zero")
    return scale


def _origin(element: Element) -> tuple[Triple, Triple]:
    origin = element.first("origin")
    if origin is None:
        return ZERO, ZERO
    xyz = _triple(origin.numbers("xyz", 3, ZERO, most=FARTHEST))
    if "quat_xyzw" not in origin.attributes:
        return xyz, _triple(origin.numbers("rpy", 3, ZERO, most=MOST))
    if "rpy" in origin.attributes:
        raise origin.error("has both rpy and quat_xyzw; one of them gives the orientation")
    x, y, z, w = origin.numbers("quat_xyzw", 4, most=MOST)
    if math.hypot(x, y, z, w) < _NO_AXIS:
        raise origin.error("quat_xyzw is zero, and gives no orientation")
    pose = np.array([0.0, 0.0, 0.0, w, x, y, z])
    return xyz, angles(pose_matrix(pose)[:3, :3])


def _triple(values: tuple[float, ...]) -> Triple:
    x, y, z = values
    return float(x), float(y), float(z)


def _joints(root: Element, links: Mapping[str, UrdfLink]) -> dict[str, UrdfJoint]:
    joints: dict[str, UrdfJoint] = {}
    for element in root.all("joint"):
        joint = _joint(element, links)
        if joint.name in joints:
            first = joints[joint.name].line
            raise element.error(f"joint '{joint.name}' is defined twice, first in line {first}")
        joints[joint.name] = joint
    return joints


def _joint(element: Element, links: Mapping[str, UrdfLink]) -> UrdfJoint:
    name = element.required("name")
    kind = _kind(element, name)
    lower, upper = _limits(element, name, kind)
    xyz, rpy = _origin(element)
    # URDF 1.2 distinguishes deceleration from acceleration; the smaller limit holds for both, and 0
    # means unlimited.
    up, down = (_greatest(element, name, each) for each in ("acceleration", "deceleration"))
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=_link_of(element, "parent", name, links),
        child=_link_of(element, "child", name, links),
        xyz=xyz,
        rpy=rpy,
        axis=_axis(element, name) if kind != "fixed" else (1.0, 0.0, 0.0),
        lower=lower,
        upper=upper,
        soft=_soft_limits(element, lower, upper) if kind in _LIMITED else None,
        velocity=_greatest(element, name, "velocity"),
        acceleration=min(up or down, down or up),
        jerk=_greatest(element, name, "jerk"),
        effort=_greatest(element, name, "effort"),
        mimic=_mimic(element) if kind != "fixed" else None,
        line=element.line,
    )


def _kind(element: Element, name: str) -> UrdfJointKind:
    kind = element.required("type")
    # A comparison with each, so that the type checker infers the literal type.
    for known in _KINDS:
        if kind == known:
            return known
    raise element.error(
        f"joint '{name}' has the type '{kind[:40]}'; a hand may have {', '.join(_KINDS)}"
    )


def _link_of(element: Element, end: str, joint: str, links: Mapping[str, UrdfLink]) -> str:
    child = element.first(end)
    if child is None:
        raise element.error(f"joint '{joint}' has no <{end}>")
    link = child.required("link")
    if link not in links:
        raise UnknownLink(link, tuple(links), path=child.path, line=child.line)
    return link


def _axis(element: Element, name: str) -> Triple:
    axis = element.first("axis")
    if axis is None:
        return (1.0, 0.0, 0.0)
    x, y, z = axis.numbers("xyz", 3, (1.0, 0.0, 0.0))
    norm = math.hypot(x, y, z)
    if norm < _NO_AXIS:
        raise axis.error(f"the axis of joint '{name}' is zero")
    # The axes in URDFs are rounded, but the kinematics need unit vectors.
    return x / norm, y / norm, z / norm


def _limits(element: Element, name: str, kind: UrdfJointKind) -> tuple[float, float]:
    """Return the position limits."""
    limit = element.first("limit")
    if limit is None and kind in _LIMITED:
        raise element.error(f"joint '{name}' is {kind}, so it needs a <limit>")
    if kind == "continuous":
        # Some files give a continuous joint position limits, which have no meaning.
        return -math.inf, math.inf
    if limit is None or kind == "fixed":
        return 0.0, 0.0
    lower, upper = (limit.number(end, 0.0, most=MOST) for end in ("lower", "upper"))
    if lower > upper:
        raise limit.error(
            f"joint '{name}' has its lower limit {lower:g} above its upper limit {upper:g}"
        )
    return lower, upper


def _greatest(element: Element, name: str, quantity: str) -> float:
    """Return the limit of a quantity that has no sign; 0 when it is not given."""
    limit = element.first("limit")
    value = 0.0 if limit is None else limit.number(quantity, 0.0)
    if limit is not None and value < 0.0:
        raise limit.error(f"joint '{name}' has a negative {quantity} limit")
    return value


def _soft_limits(element: Element, lower: float, upper: float) -> tuple[float, float] | None:
    """Return the limits of a ``<safety_controller>`` if they are tighter than the hard ones."""
    controller = element.first("safety_controller")
    if controller is None:
        return None
    low, high = (
        controller.number(f"soft_{end}_limit", 0.0, most=MOST) for end in ("lower", "upper")
    )
    # Both are 0 unless given, as in urdfdom.
    if low == high == 0.0:
        return None
    soft = max(low, lower), min(high, upper)
    if soft[0] >= soft[1]:
        raise controller.error(
            f"the soft limits {low:g} … {high:g} leave nothing of {lower:g} … {upper:g}"
        )
    return None if soft == (lower, upper) else soft


def _mimic(element: Element) -> UrdfMimic | None:
    mimic = element.first("mimic")
    if mimic is None:
        return None
    return UrdfMimic(
        of=mimic.required("joint"),
        multiplier=mimic.number("multiplier", 1.0, most=MOST),
        offset=mimic.number("offset", 0.0, most=MOST),
        # An extension of URDF for non-linear couplings, as in HERI II's description.
        expression=mimic.attributes.get("nlFunPos"),
        line=mimic.line,
    )


def _tree(
    root: Element, links: Mapping[str, UrdfLink], joints: Mapping[str, UrdfJoint]
) -> tuple[str, dict[str, UrdfJoint], dict[str, tuple[UrdfJoint, ...]]]:
    """Return the root link, the joint above each link and the joints below each link."""
    joint_to: dict[str, UrdfJoint] = {}
    below: dict[str, list[UrdfJoint]] = {link: [] for link in links}
    for joint in joints.values():
        if joint.child in joint_to:
            other = joint_to[joint.child].name
            what = f"hangs on two joints, '{other}' and '{joint.name}'; a URDF is a tree"
            raise root.error(f"link '{joint.child}' {what}", joint.line)
        joint_to[joint.child] = joint
        below[joint.parent].append(joint)
    roots = [link for link in links if link not in joint_to]
    if len(roots) > 1:
        what = f"links '{roots[0]}' and '{roots[1]}' both have no parent; a URDF has one root"
        raise root.error(what, links[roots[1]].line)
    # With one root, a joint that cannot be reached from it is part of a loop.
    reached = _in_tree_order(roots[0], below) if roots else {}
    loop = next((joint for name, joint in joints.items() if name not in reached), None)
    if loop is not None:
        raise root.error(
            f"joint '{loop.name}' is part of a loop, but a URDF must be a tree", loop.line
        )
    return roots[0], joint_to, {link: tuple(found) for link, found in below.items()}


def _in_tree_order(
    base: str, below: Mapping[str, list[UrdfJoint] | tuple[UrdfJoint, ...]]
) -> dict[str, UrdfJoint]:
    ordered: dict[str, UrdfJoint] = {}
    # A stack instead of recursion, since the tree may be deeper than Python's stack.
    pending = list(reversed(below[base]))
    while pending:
        joint = pending.pop()
        ordered[joint.name] = joint
        pending.extend(reversed(below[joint.child]))
    return ordered
