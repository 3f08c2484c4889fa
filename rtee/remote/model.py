"""The model of a running hand: from its folder on this computer, or from its description."""

from __future__ import annotations

from dataclasses import replace

from rtee.errors import RteeError
from rtee.hand.chains import Chain, tip_links
from rtee.hand.files import temporary_folder
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Finger, Hand
from rtee.hand.urdf import Urdf
from rtee.remote.client import RemoteHand
from rtee.remote.hand_info import HandInfo


def _fingers(info: HandInfo, urdf: Urdf) -> tuple[Finger, ...]:
    chains = {f.name: Chain(f.name, tuple(f.links), "") for f in info.fingers}
    tips = tip_links(tuple(chains.values()), urdf)
    return tuple(
        Finger(
            name=f.name,
            base=f.base,
            tip=f.tip or None,
            tip_links=tips[f.name] if f.tip else (),
            links=f.links,
            actuators=f.actuators,
            own=tuple(
                name
                for name in f.actuators
                if sum(name in other.actuators for other in info.fingers) == 1
            ),
            reason="as the running hand says",
        )
        for f in info.fingers
    )


def from_info(info: HandInfo) -> Hand:
    """Return the model of a hand on another computer, from its description.

    Raises `ModelError` if that cannot be used, for example because its meshes are missing.
    """
    # By way of a file, since models are only read from files.
    with temporary_folder(None) as folder:
        path = folder / "hand.urdf"
        path.write_text(info.urdf, encoding="utf-8")
        rest = {a.name: a.rest for a in info.actuators}
        hand = load_model(path, name=info.name, rest=rest, actuators=info.actuator_names)
        return replace(hand, fingers=_fingers(info, hand.urdf))


async def model_of(remote: RemoteHand, configured: Hand | None = None) -> Hand:
    """Return the model of a running hand: the local one if it matches, otherwise the hand's own.

    The local one is looked up by name unless given.
    """
    info = await remote.info()
    try:
        hand = load_hand(remote.name) if configured is None else configured
    except RteeError:
        return from_info(info)
    # The local configuration may be another version of the hand.
    fits = hand.actuator_names == info.actuator_names and hand.joint_names == info.joints
    return hand if fits else from_info(info)
