"""Read the fingers of a hand from its SRDF, and check the SRDF against the URDF."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from rtee.errors import ModelError, UnknownJoint, UnknownLink, suggestion
from rtee.hand.srdf import Srdf, SrdfGroup
from rtee.hand.urdf import Urdf

GROUP_OF_FINGERS = "end_effector_fingers"


@dataclass(frozen=True, slots=True)
class Chain:
    """The chain of links of a finger, before its actuators are known.

    Attributes:
        name: The finger's name.
        links: Its links from base to end.
        reason: Why the chain is a finger.
        line: Line in the SRDF; 0 if it was found in the tree.
    """

    name: str
    links: tuple[str, ...]
    reason: str
    line: int = 0

    def tip(self, urdf: Urdf) -> str | None:
        """Return the last link with collision geometry below the base, if there is one."""
        # The base is the palm, except for a finger of a single link.
        below = reversed(self.links[1:] or self.links)
        return next((link for link in below if urdf.links[link].collisions), None)


def tip_links(chains: Sequence[Chain], urdf: Urdf) -> dict[str, tuple[str, ...]]:
    """Return the links that form the fingertip of each finger, its `Chain.tip` first.

    A fingertip is one rigid body, however many links it is modelled by: a pad, a marker or a sensor
    that fixed joints weld to the distal link is a part of it. Neither the base, which may be the
    palm of a fixed jaw, nor the links of other fingers belong to it.
    """
    return {
        chain.name: _welded(
            chain, urdf, {link for other in chains if other is not chain for link in other.links}
        )
        for chain in chains
    }


def _welded(chain: Chain, urdf: Urdf, others: Collection[str]) -> tuple[str, ...]:
    tip = chain.tip(urdf)
    if tip is None:
        return ()
    top, own = tip, [link for link in chain.links[1:] if link not in others]
    while (above := urdf.joint_to.get(top)) is not None and not above.moving:
        if above.parent not in own:
            break
        top = above.parent
    welded = [top]
    for link in welded:
        below = urdf.joints_below[link]
        welded += [j.child for j in below if not j.moving and j.child not in others]
    return tip, *(link for link in welded if link != tip and urdf.links[link].collisions)


def check_srdf(srdf: Srdf, urdf: Urdf) -> list[str]:
    """Check an SRDF against its URDF.

    Returns:
        Notes on harmless mistakes, one sentence each.

    Raises:
        ModelError: if the SRDF names a link, joint or group that does not exist, or a chain whose
            tip is not below its base; the message names file and line.
    """
    for group in srdf.groups.values():
        _check_group(srdf, group, urdf)
    notes = [*srdf.unread, *_check_passive(srdf, urdf)]
    for state in srdf.states:
        for name in state.values:
            if name not in urdf.joints:
                raise UnknownJoint(name, tuple(urdf.joints), path=srdf.path, line=state.line)
        if state.group not in srdf.groups:
            notes.append(
                f"group_state '{state.name}' (line {state.line} of the SRDF) belongs to the "
                f"unknown group '{state.group}'"
            )
    for pair in srdf.disabled:
        notes.extend(
            f"disable_collisions (line {pair.line} of the SRDF) names the unknown link '{link}'"
            for link in (pair.link1, pair.link2)
            if link not in urdf.links
        )
    if srdf.name and srdf.name != urdf.name:
        notes.append(f"the SRDF is for robot '{srdf.name}', the URDF is of '{urdf.name}'")
    return notes


def _check_group(srdf: Srdf, group: SrdfGroup, urdf: Urdf) -> None:
    for chain in group.chains:
        for link in (chain.base, chain.tip):
            if link not in urdf.links:
                raise UnknownLink(link, tuple(urdf.links), path=srdf.path, line=chain.line)
        if chain.base == chain.tip or urdf.chain(chain.base, chain.tip) is None:
            what = f"tip '{chain.tip}' of the chain of group '{group.name}' is not below its base"
            raise ModelError(f"{what} '{chain.base}'", path=srdf.path, line=chain.line)
    for link, line in group.links.items():
        if link not in urdf.links:
            raise UnknownLink(link, tuple(urdf.links), path=srdf.path, line=line)
    for joint, line in group.joints.items():
        if joint not in urdf.joints:
            raise UnknownJoint(joint, tuple(urdf.joints), path=srdf.path, line=line)
    for name, line in group.subgroups.items():
        if name not in srdf.groups:
            hint = suggestion(name, srdf.groups)
            raise ModelError(f"unknown group '{name}'; {hint}", path=srdf.path, line=line)


def _check_passive(srdf: Srdf, urdf: Urdf) -> list[str]:
    notes = []
    for name, line in srdf.passive.items():
        joint = urdf.joints.get(name)
        if joint is None:
            raise UnknownJoint(name, tuple(urdf.joints), path=srdf.path, line=line)
        if not joint.moving:
            notes.append(f"passive joint '{name}' (line {line} of the SRDF) is fixed")
        # The joint that it follows determines its position, whether it is passive or not.
        elif joint.mimic is not None:
            notes.append(f"joint '{name}' is both mimic and passive; it is taken as a mimic")
    return notes


def fingers_of(srdf: Srdf, urdf: Urdf) -> tuple[Chain, ...]:
    """Return the fingers that an SRDF names; none if it names no chains for them.

    If there are groups of groups, the fingers are the members of one of them: the group of the
    ``<end_effector>``, or ``end_effector_fingers``, or the largest one. If the group of the
    ``<end_effector>`` holds links, joints or several chains, as MoveIt writes it, it names the hand
    and not its fingers. Otherwise every group that is a chain is a finger, except chains that carry
    others, such as that of an arm.

    Raises:
        ModelError: if a member of the group of fingers is not a single chain, or groups contain one
            another.
    """
    chosen = _group_of_fingers(srdf)
    if chosen is None:
        chains = [_chain(each, urdf, "chain") for each in srdf.groups.values()]
        found = [chain for chain in chains if chain is not None]
        carried = {link for chain in found for link in urdf.links_to(chain.links[0])}
        return tuple(chain for chain in found if chain.links[-1] not in carried)
    group, why = chosen
    if not group.subgroups:
        inside = _joints_in([group], urdf)
        others = [g for g in srdf.groups.values() if g is not group]
        return tuple(
            chain
            for chain in (_chain(other, urdf, "chain") for other in others)
            if chain is not None
            and {urdf.joint_to[link].name for link in chain.links[1:]} <= inside
        )
    fingers = []
    for member in _members(srdf, group, (), set()):
        chain = _chain(member, urdf, why)
        if chain is None:
            raise ModelError(
                f"group '{member.name}' is in the group of fingers '{group.name}' but is not "
                "one chain of links",
                path=srdf.path,
                line=member.line,
            )
        fingers.append(chain)
    return tuple(fingers)


def joints_of_hand(srdf: Srdf, urdf: Urdf) -> frozenset[str] | None:
    """Return the joints inside the groups of the hand; ``None`` if the SRDF names none.

    These are the joints of the group that `fingers_of` uses and of its subgroups, and those between
    its links; without such a group, the joints of the fingers.
    """
    chosen = _group_of_fingers(srdf)
    if chosen is None:
        links = {link for chain in fingers_of(srdf, urdf) for link in chain.links[1:]}
        return frozenset(urdf.joint_to[link].name for link in links) or None
    return _joints_in((chosen[0], *_members(srdf, chosen[0], (), set())), urdf) or None


def _joints_in(groups: Sequence[SrdfGroup], urdf: Urdf) -> frozenset[str]:
    chains = [urdf.chain(c.base, c.tip) or () for group in groups for c in group.chains]
    found = {urdf.joint_to[link].name for chain in chains for link in chain[1:]}
    found |= {joint for group in groups for joint in group.joints}
    links = {link for group in groups for link in group.links}
    above = [urdf.joint_to[link] for link in links if link in urdf.joint_to]
    # The joint that moves the first link, such as an arm's, does not belong to the group.
    found |= {joint.name for joint in above if joint.parent in links}
    return frozenset(found or {joint.name for joint in above})


def _group_of_fingers(srdf: Srdf) -> tuple[SrdfGroup, str] | None:
    """Return the hand's group and how it was chosen, or ``None``."""
    collections = [group for group in srdf.groups.values() if group.subgroups]
    for effector in srdf.end_effectors:
        group = srdf.groups.get(effector.group)
        # A single chain is a finger like others, whatever else the end-effector has.
        if group is not None and (group.subgroups or not _is_chain(group)):
            return group, f"end-effector '{effector.name}', group '{group.name}'"
    for group in collections:
        if group.name == GROUP_OF_FINGERS:
            return group, f"group '{group.name}'"
    if not collections:
        return None
    # Otherwise, the group with the most members is the likeliest one to have all fingers.
    named = [group for group in collections if "finger" in group.name.lower()]
    group = max(named or collections, key=lambda g: len(g.subgroups))
    return group, f"group '{group.name}'"


def _is_chain(group: SrdfGroup) -> bool:
    return len(group.chains) == 1 and not group.links and not group.joints


def _members(
    srdf: Srdf, group: SrdfGroup, above: tuple[str, ...], seen: set[str]
) -> Iterator[SrdfGroup]:
    """Yield the groups without subgroups inside a group, each once and in order."""
    # Groups that contain each other would recurse without end.
    if group.name in above:
        raise ModelError(f"group '{group.name}' contains itself", path=srdf.path, line=group.line)
    if group.name in seen:
        return
    seen.add(group.name)
    for name in group.subgroups:
        member = srdf.groups[name]
        if member.subgroups:
            yield from _members(srdf, member, (*above, group.name), seen)
        elif name not in seen:
            seen.add(name)
            yield member


def _chain(group: SrdfGroup, urdf: Urdf, why: str) -> Chain | None:
    """Return the chain of a group, or ``None`` if the group is not a single chain."""
    if _is_chain(group):
        links = urdf.chain(group.chains[0].base, group.chains[0].tip)
        line = group.chains[0].line
    elif not group.chains and not group.subgroups:
        links = _as_path({*group.links, *(urdf.joints[j].child for j in group.joints)}, urdf)
        line = group.line
    else:
        return None
    if links is None:
        return None
    return Chain(group.name, links, f"SRDF line {line}: {why}", line)


def _as_path(links: set[str], urdf: Urdf) -> tuple[str, ...] | None:
    """Return the path through some links, or ``None`` if they are not all on one path."""
    if not links:
        return None
    # Sorted, so that equally deep links give the same result on every run.
    deepest = max(sorted(links), key=lambda link: len(urdf.path_to(link)))
    path = urdf.links_to(deepest)
    if not links <= set(path):
        return None
    first = min(path.index(link) for link in links)
    # From the link above the first one, which is the base of the chain.
    return path[max(first - 1, 0) :]
