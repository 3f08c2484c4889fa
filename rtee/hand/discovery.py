"""Find the fingers of a hand and their actuators, from its SRDF or else from its tree."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Final

from rtee.errors import ModelError
from rtee.hand.chains import Chain, fingers_of, tip_links
from rtee.hand.linkages import Linked, Mover, join_linkages
from rtee.hand.model import Finger
from rtee.hand.names import check_name, safe_name, shared_length, unique_names
from rtee.hand.srdf import Srdf
from rtee.hand.urdf import Urdf
from rtee.hand.whole_robot import without_geometry

WORDS: Final = ("thumb", "index", "middle", "ring", "little", "pinky")

PREFIXES: Final = {"th": "thumb", "ff": "index", "mf": "middle", "rf": "ring", "lf": "little"}
"""Abbreviations of fingers at the start of names of links and joints, as for the Shadow Hand."""

_PREFIX: Final = re.compile(
    rf"(?<![a-z0-9])({'|'.join(PREFIXES)})(?=[^a-z]|$|tip|distal|middle|proximal|knuckle|metacarpal"
    r"|base|hub|link|joint|j[0-9])"
)

_WORD: Final = re.compile(rf"(?<![a-z])({'|'.join(WORDS)})")

_NUMBER: Final = re.compile(r"(?<![a-z0-9])f(?:inger)?_?([0-9]+)")
"""``finger_1``, ``finger1``, ``f1``."""


def make_fingers(
    urdf: Urdf, srdf: Srdf | None, movers: Mapping[str, Mover]
) -> tuple[tuple[Finger, ...], list[str]]:
    """Return the fingers that the SRDF names, otherwise those found from the tree.

    Args:
        urdf: The hand's URDF.
        srdf: Its SRDF, if it has one.
        movers: What moves each joint; joints that no actuator moves are missing.

    Returns:
        The fingers, and notes of one sentence each.

    Raises:
        ModelError: if two fingers share a fingertip, or a group of fingers is not well defined.
        ConfigError: if a finger's name is not allowed.
    """
    given, notes = fingers_of(srdf, urdf) if srdf else (), []
    branches = find_branches(urdf, movers)
    inside = {link for chain in given for link in chain.links}
    branches = [branch for branch in branches if branch.links[-1] not in inside]
    if given:
        _tips(given, urdf, srdf)  # before linkages join fingers that have the same tip by mistake
        linked = join_linkages(given, branches, urdf, movers)
        notes += [
            f"'{chain.name}' is a bar of a linkage, not a finger of its own"
            for chain in given
            if all(chain is not each.chain for each in linked)
        ]
    else:
        linked = _named(join_linkages(branches, (), urdf, movers), urdf, movers)
        said = "no SRDF was given" if srdf is None else "the SRDF names no finger"
        notes.append(
            f"{said}; the fingers were found from the tree"
            if linked
            else f"{said}, and none was found: a finger is a branch that an actuator moves and "
            "whose end has collision geometry"
        )
    chains = [each.chain for each in linked]
    notes += [
        f"link '{link}' moves, but it has no collision geometry, and so touches nothing"
        for link in without_geometry(urdf, movers)
    ]
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
            bars=bars,
        )
        for chain, bars in linked
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


def _moving(urdf: Urdf, link: str, movers: Mapping[str, Mover]) -> tuple[str, ...]:
    """Return the actuators that move a link, nearest the root first.

    The place of an actuator is that of its joint on the path to the link, or else that of the first
    joint that follows it.
    """
    place: dict[str, int] = {}
    for position, joint in enumerate(urdf.path_to(link)):
        mover = movers.get(joint.name)
        if mover is None:
            continue
        actuator = mover.actuator
        if actuator == joint.name:
            place[actuator] = position
        else:
            # An actuator that is not on the path, such as in the forearm, gets the place of the
            # first joint that follows it.
            place.setdefault(actuator, position)
    return tuple(sorted(place, key=place.__getitem__))


def _own(name: str, moving: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    shared = {a for other, actuators in moving.items() if other != name for a in actuators}
    return tuple(actuator for actuator in moving[name] if actuator not in shared)


def _named(found: Sequence[Linked], urdf: Urdf, movers: Mapping[str, Mover]) -> list[Linked]:
    """Return the fingers that were found in the tree with their names and the reasons for them.

    A finger is a branch of the tree that carries a joint moved by an actuator and ends in a link
    with collision geometry; its base is the link where it separates from the other branches. Ends
    that are fixed to one another are one finger.
    """
    ends = [each.chain.links[-1] for each in found]
    named = []
    for (name, why), (chain, bars) in zip(name_fingers(ends, urdf), found, strict=True):
        links, end = chain.links, chain.links[-1]
        moving = [j.name for j in urdf.path_to(end) if j.name in movers and j.child in links[1:]]
        reason = (
            f"branch from '{links[0]}' to '{end}', its last link with geometry, carries "
            f"{len(moving)} moved joint{'s' if len(moving) > 1 else ''}"
        )
        if bars:
            reason += f", in a linkage with {', '.join(repr(bar) for bar in bars)}"
        named.append(Linked(Chain(name, links, f"{reason}; {why}"), bars))
    return named


def find_branches(urdf: Urdf, moved: Container[str]) -> list[Chain]:
    """Return the branches of a tree that a joint moves and that end in collision geometry.

    They have no names yet; their base is the link where they separate from the others, or from
    which the first joint moves this branch alone.
    """
    ends = _ends(urdf, moved)
    if len(ends) == 1:
        links = urdf.links_to(ends[0])
        first = next(j for j in urdf.path_to(ends[0]) if j.name in moved)
        return [Chain("", links[links.index(first.parent) :], "")]
    return [Chain("", _branch(end, ends, urdf), "") for end in ends]


def _ends(urdf: Urdf, moved: Container[str]) -> list[str]:
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


def _body(link: str, urdf: Urdf, moved: Container[str]) -> str | None:
    """Return the last moved joint above a link; ``None`` if the link does not move."""
    return next((j.name for j in reversed(urdf.path_to(link)) if j.name in moved), None)


def _branch(end: str, ends: Sequence[str], urdf: Urdf) -> tuple[str, ...]:
    """Return the links of a branch, from where it separates from all others down to its end."""
    path = urdf.links_to(end)
    others = (urdf.links_to(other) for other in ends if other != end)
    # The last common link is the base at which both separate.
    return path[max((shared_length([path, other]) - 1 for other in others), default=0) :]


def name_fingers(ends: Sequence[str], urdf: Urdf) -> list[tuple[str, str]]:
    """Name fingers after words in their links and joints, or after the distinct part of their ends.

    The words are the usual ones (``index``), the prefixes of the Shadow Hand (``ff``), or numbers
    (``finger_1``, ``f1``). Fingers that have none, or the same one, are named after the distinct
    part of the names of their ends.

    Returns:
        The name of each finger, and the reason for it.
    """
    called = [_called(end, ends, urdf) for end in ends]
    count = Counter(name for name, _ in filter(None, called))
    parts = [safe_name(name, "finger") for name in _distinct_parts(ends)]
    found = []
    for part, each in zip(parts, called, strict=True):
        if each is not None and count[each[0]] == 1:
            found.append(each)
        else:
            why = "named after the distinct part of its end's name"
            shared = "" if each is None else f", as another finger is called '{each[0]}', too"
            found.append((part, why + shared))
    names = unique_names(name for name, _ in found)
    return [(name, why) for name, (_, why) in zip(names, found, strict=True)]


def _called(end: str, ends: Sequence[str], urdf: Urdf) -> tuple[str, str] | None:
    """Return the usual name of a finger, and the reason; ``None`` if its links do not agree."""
    links = _branch(end, ends, urdf)[1:]
    texts = [text.lower() for link in links for text in (link, urdf.joint_to[link].name)]
    # The first word of a name: `index_middle` is the middle phalanx of the index finger. Only at
    # the beginning of a word, since "spring" contains "ring".
    words = dict.fromkeys(found[1] for text in texts if (found := _WORD.search(text)))
    if len(words) == 1:
        return next(iter(words)), "named after the word in its links and joints"
    if words:
        first, *rest = words
        others = ", ".join(f"'{word}'" for word in rest)
        return first, f"named after the first word in its links and joints, among {others}"
    text = " ".join(texts)
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
        # A bare number would tell people nothing.
        yield kept if kept and not kept.isdigit() else f"finger_{kept}" if kept else name
