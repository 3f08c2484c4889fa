"""Find the fingers of a hand and their actuators, from its SRDF or else from its tree."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from rtee.errors import ModelError
from rtee.hand.chains import Chain, fingers_of, tip_links
from rtee.hand.model import Finger
from rtee.hand.names import check_name, safe_name, shared_length
from rtee.hand.srdf import Srdf
from rtee.hand.urdf import Urdf

WORDS: Final = ("thumb", "index", "middle", "ring", "little", "pinky")

PREFIXES: Final = {"th": "thumb", "ff": "index", "mf": "middle", "rf": "ring", "lf": "little"}
"""Abbreviations of fingers at the start of names of links and joints, as for the Shadow Hand."""

_PREFIX: Final = re.compile(
    rf"(?<![a-z0-9])({'|'.join(PREFIXES)})(?=[^a-z]|$|tip|distal|middle|proximal|knuckle|metacarpal"
    r"|base|hub|link|joint|j[0-9])"
)

_NUMBER: Final = re.compile(r"(?<![a-z0-9])f(?:inger)?_?([0-9]+)")
"""``finger_1``, ``finger1``, ``f1``."""


def make_fingers(
    urdf: Urdf, srdf: Srdf | None, movers: Mapping[str, str]
) -> tuple[tuple[Finger, ...], list[str]]:
    """Return the fingers that the SRDF names, or else those found from the tree.

    Args:
        urdf: The hand's URDF.
        srdf: Its SRDF, if it has one.
        movers: The actuator that moves each joint; joints that no actuator moves are missing.

    Returns:
        The fingers, and notes of one sentence each.

    Raises:
        ModelError: Two fingers share a fingertip, or a group of fingers is not well defined.
        ConfigError: A finger's name is not allowed.
    """
    chains, notes = fingers_of(srdf, urdf) if srdf else (), []
    if not chains:
        chains = discover_fingers(urdf, frozenset(movers))
        given = "no SRDF was given" if srdf is None else "the SRDF names no finger"
        notes.append(
            f"{given}; the fingers were found from the tree"
            if chains
            else f"{given}, and none was found: a finger is a branch that an actuator moves and "
            "whose end has collision geometry"
        )
    tips = _tips(chains, urdf, srdf)
    notes += [
        f"finger '{name}' has no collision geometry: no pinches for it"
        for name, tip in tips.items()
        if tip is None
    ]
    moving = {
        chain.name: _moving(urdf, tips[chain.name] or chain.links[-1], movers) for chain in chains
    }
    welded = tip_links(chains, urdf)
    fingers = tuple(
        Finger(
            name=chain.name,
            base=chain.links[0],
            tip=tips[chain.name],
            tip_links=welded[chain.name],
            links=chain.links,
            actuators=moving[chain.name],
            own=_own(chain.name, moving),
            reason=chain.reason,
        )
        for chain in chains
    )
    return fingers, notes


def _tips(chains: Sequence[Chain], urdf: Urdf, srdf: Srdf | None) -> dict[str, str | None]:
    path = urdf.path if srdf is None else srdf.path
    owner: dict[str, str] = {}
    tips: dict[str, str | None] = {}
    for chain in chains:
        line = chain.line or None
        check_name(chain.name, "finger", path, line)
        tip = tips[chain.name] = chain.tip(urdf)
        if tip is not None and owner.setdefault(tip, chain.name) != chain.name:
            raise ModelError(
                f"fingers '{owner[tip]}' and '{chain.name}' have the same fingertip '{tip}'",
                path=path,
                line=line,
            )
    return tips


def _moving(urdf: Urdf, link: str, movers: Mapping[str, str]) -> tuple[str, ...]:
    """Return the actuators that move a link, nearest the root first.

    The place of an actuator is that of its joint on the path to the link, or else that of the first
    joint that follows it.
    """
    place: dict[str, int] = {}
    for position, joint in enumerate(urdf.path_to(link)):
        actuator = movers.get(joint.name)
        if actuator == joint.name:
            place[actuator] = position
        elif actuator is not None:
            # An actuator that is not on the path, such as in the forearm, gets the place of the
            # first joint that follows it.
            place.setdefault(actuator, position)
    return tuple(sorted(place, key=place.__getitem__))


def _own(name: str, moving: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    shared = {a for other, actuators in moving.items() if other != name for a in actuators}
    return tuple(actuator for actuator in moving[name] if actuator not in shared)


def discover_fingers(urdf: Urdf, moved: frozenset[str]) -> tuple[Chain, ...]:
    """Find the fingers of a hand without an SRDF, in the tree's order.

    A finger is a branch of the tree that carries a joint moved by an actuator and ends in a link
    with collision geometry; its base is the link where it separates from the other branches. Ends
    that are fixed to one another are one finger.
    """
    ends = _ends(urdf, moved)
    chains = []
    for (name, why), end in zip(name_fingers(ends, urdf), ends, strict=True):
        links = _branch(end, ends, urdf)
        moving = [j.name for j in urdf.path_to(end) if j.name in moved and j.child in links[1:]]
        chains.append(
            Chain(
                name,
                links,
                f"branch from '{links[0]}' to '{end}', its last link with geometry, carries "
                f"{len(moving)} moved joint{'s' if len(moving) > 1 else ''}; {why}",
            )
        )
    return tuple(chains)


def _ends(urdf: Urdf, moved: frozenset[str]) -> list[str]:
    """Return the last links with geometry of the branches that move, one per rigid body."""
    # A finger ends at a link with geometry below which no link has any.
    solid = {name for name, link in urdf.links.items() if link.collisions}
    followed: set[str] = set()
    for link in solid:
        followed.update(joint.parent for joint in urdf.path_to(link))
    bodies: dict[str, str] = {}
    for joint in urdf.joints.values():
        link = joint.child
        if link not in solid or link in followed:
            continue
        body = _body(link, urdf, moved)
        if body is not None:
            # Of several ends on the same rigid body, the tip is the one with the longest path.
            ends = (bodies.get(body, link), link)
            bodies[body] = max(ends, key=lambda end: len(urdf.path_to(end)))
    order = list(urdf.joint_to)
    return sorted(bodies.values(), key=order.index)


def _body(link: str, urdf: Urdf, moved: frozenset[str]) -> str | None:
    """Return the last moved joint above a link; ``None`` if the link does not move."""
    return next((j.name for j in reversed(urdf.path_to(link)) if j.name in moved), None)


def _branch(end: str, ends: Sequence[str], urdf: Urdf) -> tuple[str, ...]:
    """Return the links of a branch, from where it separates from all others down to its end."""
    path = (urdf.root, *(joint.child for joint in urdf.path_to(end)))
    shared = 0
    for other in ends:
        if other == end:
            continue
        way = (urdf.root, *(joint.child for joint in urdf.path_to(other)))
        common = sum(1 for a, b in zip(path, way, strict=False) if a == b)
        # The last common link is the base at which both separate.
        shared = max(shared, common - 1)
    return path[shared:]


def name_fingers(ends: Sequence[str], urdf: Urdf) -> list[tuple[str, str]]:
    """Name fingers after words in their links and joints, or after the distinct part of their ends.

    The words are the usual ones (``index``), the prefixes of the Shadow Hand (``ff``), or numbers
    (``finger_1``, ``f1``). They are used only if every finger has one and all are different.

    Returns:
        The name of each finger, and the reason for it.
    """
    called = [_called(end, ends, urdf) for end in ends]
    names = [name for name, _ in filter(None, called)]
    if len(names) == len(set(names)) == len(ends):
        return [found for found in called if found]
    distinct = _unique([safe_name(name, "finger") for name in _distinct_parts(ends)])
    return [(name, "named after the distinct part of its end's name") for name in distinct]


def _called(end: str, ends: Sequence[str], urdf: Urdf) -> tuple[str, str] | None:
    """Return the usual name of a finger, and the reason; ``None`` if its links do not agree."""
    links = _branch(end, ends, urdf)[1:]
    text = " ".join([*links, *(urdf.joint_to[link].name for link in links)]).lower()
    # Only at the beginning of a word, since "spring" contains "ring".
    words = [word for word in WORDS if re.search(rf"(?<![a-z]){word}", text)]
    if len(words) == 1:
        return words[0], "named after the word in its links and joints"
    prefixes = set(_PREFIX.findall(text))
    if len(prefixes) == 1:
        prefix = prefixes.pop()
        return PREFIXES[prefix], f"named for the prefix '{prefix}' of its links and joints"
    numbers = set(_NUMBER.findall(text))
    if len(numbers) == 1:
        number = numbers.pop()
        return f"finger_{number}", "named after the number in its links and joints"
    return None


def _distinct_parts(names: Sequence[str]) -> Iterable[str]:
    """Return the names without the parts with which all begin or end."""
    parts = [name.split("_") for name in names]
    head = shared_length(parts)
    tail = shared_length([part[head:][::-1] for part in parts])
    for name, part in zip(names, parts, strict=True):
        kept = "_".join(part[head : len(part) - tail])
        # A number alone would not be a name for people.
        yield kept if kept and not kept.isdigit() else f"finger_{kept}" if kept else name


def _unique(names: Sequence[str]) -> list[str]:
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        # Numbered from the second on; the first keeps its name.
        unique.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return unique
