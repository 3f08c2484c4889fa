"""Correspondence of a hand's fingers to human fingers: ``retarget.yaml`` in the hand's folder."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Final

from msgspec import Meta, field, to_builtins

from rtee.actions.openings import model_of
from rtee.errors import ActionError, ConfigError
from rtee.hand.files import write_atomically
from rtee.hand.model import Hand
from rtee.hand.validation import Amount, Section, checked
from rtee.hand.yamlfile import emit, read_yaml

FILE_NAME: Final = "retarget.yaml"
"""Name of the file in a hand's folder."""

FORMAT: Final = 1
"""Version of the file format."""

Vector = tuple[float, float, float]


class Human(StrEnum):
    """A human finger; ``nearest`` is the one of the four whose tip is nearest to the thumb's."""

    THUMB = "thumb"
    INDEX = "index"
    MIDDLE = "middle"
    RING = "ring"
    LITTLE = "little"
    NEAREST = "nearest"


class Palm(Section, frozen=True):
    """The palm's axes, unit vectors in the hand's base frame.

    Attributes:
        palmar: Out of the palm, towards the side to which the fingers close.
        radial: Towards the thumb's side.
        distal: Towards the tips of the open fingers.
    """

    palmar: Vector
    radial: Vector
    distal: Vector


class FingerMap(Section, frozen=True):
    """A finger of the hand, and the human finger that it follows.

    Attributes:
        human: The human finger.
        base: Base of the finger, in the hand's base frame [m].
        tip: Tip of the finger, in the frame of its tip link [m].
        reach: Largest distance of the tip from the base [m], which matches a straight human finger.
        scale: Factor on the reach, to make a finger go less or more far.
        follow: Weight of the human tip's position, 0 or more.
    """

    human: Human
    base: Vector
    tip: Vector
    reach: Amount
    scale: Amount = 1.0
    follow: Amount = 1.0


class Pinch(Section, frozen=True):
    """Two fingertips that meet.

    Attributes:
        fingers: The fingers, the thumb's first.
        contact: The positions at which their surfaces touch [rad | m], from the extraction; empty
            if it found no pinch.
        widths: For grippers, decreasing distances between their surfaces [m]; the first belongs to
            human tips that are fully apart.
        positions: The positions at these distances [rad | m], by actuator.
    """

    fingers: tuple[str, str]
    contact: dict[str, float] = field(default_factory=dict)
    widths: tuple[float, ...] = ()
    positions: dict[str, tuple[float, ...]] = field(default_factory=dict)


class Correspondence(Section, frozen=True):
    """Mapping from a person's hand to this hand.

    Attributes:
        format: Version of the file format.
        model: Fingerprint of the URDF for which it was made.
        palm: The palm's axes.
        fingers: The fingers that follow a human finger, by name.
        closed: Closed positions of the actuators that close the fingers [rad | m].
        pinches: The pairs of tips that meet when the person's tips do.
    """

    format: int
    model: str
    palm: Palm
    fingers: Annotated[dict[str, FingerMap], Meta(min_length=1)]
    closed: dict[str, float] = field(default_factory=dict)
    pinches: tuple[Pinch, ...] = ()


def read_correspondence(folder: Path, hand: Hand) -> Correspondence | None:
    """Read the correspondence of a hand's folder; ``None`` if it has no such file.

    Raises:
        ConfigError: if the file cannot be read, or is for another model or format.
        ActionError: if the file is invalid; names the line.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    found = checked(Correspondence, read_yaml(path, "the retargeting"), ActionError)
    again = f"`rtee retarget {hand.name} --save` makes a new one"
    if found.format != FORMAT:
        raise ConfigError(f"has format {found.format}, not {FORMAT}; {again}", path=path)
    if found.model != model_of(hand):
        raise ConfigError(f"was made for another model of the hand; {again}", path=path)
    fingers, actuators = {*found.fingers}, {*found.closed}
    for pinch in found.pinches:
        fingers.update(pinch.fingers)
        actuators.update(pinch.contact, pinch.positions)
        if {len(each) for each in pinch.positions.values()} - {len(pinch.widths)}:
            raise ConfigError("a pinch needs one position per width for each actuator", path=path)
    tips = {finger.name for finger in hand.fingers if finger.tip_links}
    for name in sorted(fingers):
        if name not in tips or name not in found.fingers:
            raise ConfigError(
                f"the finger '{name}' has no tip, or no finger of the person to follow", path=path
            )
    for name in sorted(actuators):
        hand.actuator_index(name)
    return found


def write_correspondence(folder: Path, hand: Hand, found: Correspondence) -> Path:
    """Write a correspondence into a hand's folder, and return the path of the file.

    Raises `ConfigError` if the file cannot be written.
    """
    path = folder / FILE_NAME
    lines = (
        f"How a person's hand moves this one, made by `rtee retarget {hand.name} --save`.",
        "You can edit which finger follows which human finger, how far, and where tips meet.",
    )
    write_atomically(path, emit(_plain(to_builtins(found)), lines))
    return path


def _plain(value: Any) -> Any:
    """Return plain data, with lists instead of tuples, and without empty values."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items() if each not in ({}, ())}
    return [*map(_plain, value)] if isinstance(value, tuple) else value
