"""The fingers of a hand with the actuators that move them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rtee.errors import ModelError
from rtee.hand.chains import Chain, fingers_of
from rtee.hand.model import Finger
from rtee.hand.names import check_name
from rtee.hand.srdf import Srdf
from rtee.hand.urdf import Urdf


def make_fingers(
    urdf: Urdf, srdf: Srdf | None, movers: Mapping[str, str]
) -> tuple[tuple[Finger, ...], list[str]]:
    """Return the fingers that the SRDF names, or else those found from the tree.

    Args:
        urdf: The hand's URDF.
        srdf: Its SRDF, if it has one.
        movers: The actuator that moves a joint, by joint; joints that nothing moves are missing.

    Returns:
        The fingers, and what was noticed, one sentence each.

    Raises:
        ModelError: Two fingers share a fingertip, or a group of fingers is not well defined.
        ConfigError: A finger's name is not allowed.
    """
    chains, notes = fingers_of(srdf, urdf) if srdf else (), []
    if not chains:
        from rtee.hand.discovery import discover_fingers

        chains = discover_fingers(urdf, frozenset(movers))
        notes.append(
            "no SRDF was given; the fingers were found from the tree"
            if srdf is None
            else "the SRDF names no finger; the fingers were found from the tree"
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
    fingers = tuple(
        Finger(
            name=chain.name,
            base=chain.links[0],
            tip=tips[chain.name],
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

    An actuator stands where its own joint stands on the way to the link, or else where the first
    joint that follows it does.
    """
    place: dict[str, int] = {}
    for position, joint in enumerate(urdf.path_to(link)):
        actuator = movers.get(joint.name)
        if actuator == joint.name:
            place[actuator] = position
        elif actuator is not None:
            place.setdefault(actuator, position)
    return tuple(sorted(place, key=place.__getitem__))


def _own(name: str, moving: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    shared = {a for other, actuators in moving.items() if other != name for a in actuators}
    return tuple(actuator for actuator in moving[name] if actuator not in shared)
