"""Read an SRDF: groups, passive joints, named postures and disabled collisions, with lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from rtee.hand.vocabulary import SRDF, unread
from rtee.hand.xmlfile import Element, check_expanded, read_xml


@dataclass(frozen=True, slots=True)
class SrdfChain:
    """A chain of links from base to tip."""

    base: str
    tip: str
    line: int


@dataclass(frozen=True, slots=True)
class SrdfGroup:
    """A group of chains, links, joints or other groups.

    Attributes:
        name: Its name.
        line: Line in the SRDF.
        chains: Its chains.
        links: Lines of its single links, by name.
        joints: Lines of its single joints, by name.
        subgroups: Lines of its subgroups, by name.
    """

    name: str
    line: int
    chains: tuple[SrdfChain, ...] = ()
    links: Mapping[str, int] = field(default_factory=dict)
    joints: Mapping[str, int] = field(default_factory=dict)
    subgroups: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SrdfState:
    """A named posture of a group.

    Attributes:
        name: Its name.
        group: The group's name.
        values: Joint positions [rad | m], by joint.
        line: Line in the SRDF.
    """

    name: str
    group: str
    values: Mapping[str, float]
    line: int


@dataclass(frozen=True, slots=True)
class SrdfEndEffector:
    """An end-effector and its group."""

    name: str
    group: str
    line: int


@dataclass(frozen=True, slots=True)
class SrdfDisabled:
    """A pair of links that are never checked for collision."""

    link1: str
    link2: str
    reason: str
    line: int


@dataclass(frozen=True)
class Srdf:
    """A semantic robot description.

    Attributes:
        name: The robot's name.
        path: The file it was read from.
        groups: Groups by name, in the file's order.
        end_effectors: The end-effectors.
        passive: Lines of the passive joints, by name.
        states: Named postures.
        disabled: Pairs of links that are never checked for collision.
        unread: Ignored content of the file, one sentence each.
    """

    name: str
    path: Path
    groups: Mapping[str, SrdfGroup]
    end_effectors: tuple[SrdfEndEffector, ...] = ()
    passive: Mapping[str, int] = field(default_factory=dict)
    states: tuple[SrdfState, ...] = ()
    disabled: tuple[SrdfDisabled, ...] = ()
    unread: tuple[str, ...] = ()


def read_srdf(path: Path | str) -> Srdf:
    """Read an SRDF.

    Raises:
        ModelError: if the file does not exist, is not an SRDF, or defines a name twice.
    """
    root, _ = read_xml(path, "SRDF")
    if root.tag != "robot":
        raise root.error(f"is <{root.tag}>, not an SRDF, whose root element is <robot>")
    check_expanded(root)
    # Without this check, a URDF would be read as an SRDF without groups.
    joint = next(root.all("joint"), None)
    if joint is not None:
        raise joint.error(
            "an SRDF cannot define joints, only name them; define this joint in the URDF"
        )
    groups: dict[str, SrdfGroup] = {}
    for element in root.all("group"):
        group = _group(element)
        if group.name in groups:
            first = groups[group.name].line
            raise element.error(f"group '{group.name}' is defined twice, first in line {first}")
        groups[group.name] = group
    return Srdf(
        name=root.attributes.get("name", "").strip(),
        path=Path(path),
        groups=MappingProxyType(groups),
        end_effectors=tuple(
            SrdfEndEffector(e.attributes.get("name", ""), e.attributes.get("group", ""), e.line)
            for e in root.all("end_effector")
        ),
        passive=_named(root, "passive_joint"),
        states=tuple(_state(element) for element in root.all("group_state")),
        disabled=tuple(_disabled(element) for element in root.all("disable_collisions")),
        unread=tuple(unread(root, SRDF)),
    )


def _named(element: Element, tag: str) -> Mapping[str, int]:
    found: dict[str, int] = {}
    for child in element.all(tag):
        name = child.required("name")
        # Refused, since the second one may be a misspelling of another name.
        if name in found:
            raise child.error(f"<{tag}> '{name}' occurs twice, first in line {found[name]}")
        found[name] = child.line
    return MappingProxyType(found)


def _group(element: Element) -> SrdfGroup:
    chains = tuple(
        SrdfChain(chain.required("base_link"), chain.required("tip_link"), chain.line)
        for chain in element.all("chain")
    )
    return SrdfGroup(
        name=element.required("name"),
        line=element.line,
        chains=chains,
        links=_named(element, "link"),
        joints=_named(element, "joint"),
        subgroups=_named(element, "group"),
    )


def _state(element: Element) -> SrdfState:
    values: dict[str, float] = {}
    for joint in element.all("joint"):
        name = joint.required("name")
        if name in values:
            raise joint.error(f"joint '{name}' occurs twice in this group_state")
        values[name] = joint.number("value")
    return SrdfState(
        name=element.required("name"),
        group=element.attributes.get("group", ""),
        values=MappingProxyType(values),
        line=element.line,
    )


def _disabled(element: Element) -> SrdfDisabled:
    return SrdfDisabled(
        element.required("link1"),
        element.required("link2"),
        element.attributes.get("reason", ""),
        element.line,
    )
