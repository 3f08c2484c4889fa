"""Extract the hand from the description of a whole robot: the subtree below a link."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from rtee.errors import UnknownLink
from rtee.hand.config_schema import Outside
from rtee.hand.frames import angles, origin
from rtee.hand.srdf import Srdf
from rtee.hand.urdf import Urdf, UrdfJoint
from rtee.hand.xmlfile import Element


@dataclass(frozen=True, slots=True)
class Subtree:
    """Selection of the hand in a robot.

    Attributes:
        root: The hand's base link, whose frame is that of the hand.
        outside: Treatment of everything that is not below it.
    """

    root: str
    outside: Outside = Outside.ABSENT

    def of(self, robot: Element, whole: Urdf) -> Element:
        """Return the ``<robot>`` of the hand alone.

        Joints outside are fixed at 0. Elements of simulators and controllers are kept unless they
        refer to links or joints outside.

        Raises:
            UnknownLink: if the robot has no such link.
            ModelError: if a joint of the hand follows one outside.
        """
        if self.root not in whole.links:
            raise UnknownLink(self.root, tuple(whole.links), path=whole.path)
        inside = {self.root}
        for joint in whole.joints.values():  # in the order of the tree
            if joint.parent in inside:
                inside.add(joint.child)
        moving = {name for name, joint in whole.joints.items() if joint.parent in inside}
        for name in moving:
            mimic = whole.joints[name].mimic
            if mimic is not None and mimic.of in whole.joints and mimic.of not in moving:
                raise whole.error(
                    f"joint '{name}' follows '{mimic.of}', which is outside the hand below "
                    f"'{self.root}'; take a link above both as the root",
                    mimic.line,
                )
        if self.outside is Outside.RIGID:
            children = self._with_rigid(robot, whole, moving)
        else:
            children = [
                each for each in robot.children if not _is_outside(each, inside, moving, whole)
            ]
        return replace(robot, children=children)

    def _with_rigid(self, robot: Element, whole: Urdf, moving: Collection[str]) -> list[Element]:
        """Return the elements with all joints outside fixed, hanging below the hand's root."""
        above = {joint.name for joint in whole.path_to(self.root)}
        children = []
        for each in robot.children:
            name = each.attributes.get("name", "").strip()
            if each.tag != "joint" or name in moving or name not in whole.joints:
                children.append(each)
                continue
            children.append(_fixed(each, whole.joints[name], turned=name in above))
        return children


def _fixed(element: Element, joint: UrdfJoint, *, turned: bool) -> Element:
    """Return a joint fixed at 0, with parent and child exchanged if ``turned``."""
    pose, ends = origin(joint.xyz, joint.rpy), (joint.parent, joint.child)
    if turned:
        pose, ends = np.asarray(np.linalg.inv(pose), dtype=np.float64), ends[::-1]
    children = [
        ("origin", {"xyz": _text(pose[:3, 3]), "rpy": _text(angles(pose[:3, :3]))}),
        ("parent", {"link": ends[0]}),
        ("child", {"link": ends[1]}),
    ]
    made = [Element(tag, values, element.line, element.path) for tag, values in children]
    attributes = {**element.attributes, "type": "fixed"}
    return Element("joint", attributes, element.line, element.path, made)


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _is_outside(
    element: Element, inside: Collection[str], moving: Collection[str], whole: Urdf
) -> bool:
    """Return whether an element of a robot belongs to parts outside the hand."""
    name = element.attributes.get("name", "").strip()
    match element.tag:
        case "link":
            return name not in inside
        case "joint":
            return name not in moving
        case "gazebo":
            about = element.attributes.get("reference", "")
            known = about in whole.links or about in whole.joints
            return known and about not in inside and about not in moving
        case "transmission" | "ros2_control":
            named = {joint.attributes.get("name", "").strip() for joint in element.all("joint")}
            return not named <= set(moving)
    return False


def srdf_within(srdf: Srdf, urdf: Urdf) -> Srdf:
    """Return the part of a whole robot's SRDF that concerns the hand."""
    links, joints = urdf.links, urdf.joints
    groups = {}
    for group in srdf.groups.values():
        chains = tuple(
            replace(chain, base=chain.base if chain.base in links else urdf.root)
            for chain in group.chains
            if chain.tip in links and chain.tip != urdf.root
        )
        groups[group.name] = replace(
            group,
            chains=chains,
            links=_kept(group.links, links),
            joints=_kept(group.joints, joints),
        )
    # Groups that consist of empty groups go, too, however deeply they are nested.
    while True:
        left = {
            name: replace(group, subgroups=_kept(group.subgroups, groups))
            for name, group in groups.items()
            if group.chains or group.links or group.joints or _kept(group.subgroups, groups)
        }
        if left.keys() == groups.keys():
            break
        groups = left
    return replace(
        srdf,
        groups=MappingProxyType(left),
        end_effectors=tuple(e for e in srdf.end_effectors if e.group in left),
        passive=_kept(srdf.passive, joints),
        states=tuple(
            replace(state, values={j: v for j, v in state.values.items() if j in joints})
            for state in srdf.states
            if state.group in left
        ),
        disabled=tuple(p for p in srdf.disabled if p.link1 in links and p.link2 in links),
    )


def _kept(lines: Mapping[str, int], known: Collection[str]) -> Mapping[str, int]:
    return MappingProxyType({name: line for name, line in lines.items() if name in known})
