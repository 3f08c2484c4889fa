"""The report's page: one HTML file that needs nothing beside it, from ``report.html.jinja``."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rtee.actions.describe import clearance_text
from rtee.actions.types import Evidence, Posture
from rtee.errors import MissingExtra
from rtee.hand.colours import finger_colours
from rtee.hand.model import Hand, JointRole
from rtee.hand.names import common_prefix
from rtee.hand.urdf import UrdfMimic
from rtee.types import ActuatorSpec, JointKind

if TYPE_CHECKING:
    from jinja2 import Template

_TEMPLATE: Final = Path(__file__).with_name("report.html.jinja")

_EXPLAINED: Final = {
    "Trig": "All actuators that move only this finger, as far as they go.",
    "TipFlex": "Only the actuator nearest the fingertip bends.",
    "FingFlex": "Only the actuator nearest the palm bends; the finger moves as a whole.",
    "PinchTight": "Two fingertips press against each other. The mark shows the contact and the "
    "directions from which the tips come.",
    "PinchLoose": "Two fingertips come as near as the limits allow; wider limits would let them "
    "touch. The mark shows the middle of the gap.",
    "MultiPinchTight": "Several fingertips press against each other at once.",
    "SingleJointMultipleTips": "One actuator moves several fingertips together.",
    "Composed": "Combinations of actions, each with a scale.",
    "Timed": "Actions one after the other.",
    "Generic": "Set-points given directly.",
}

CLOSE_SHARE: Final = 0.4
"""How much of a picture's width and height a close-up covers."""


@dataclass(frozen=True)
class Shot:
    """A picture with what stands below it.

    Attributes:
        image: A WebP file.
        close_up: A WebP file of the contact, if there is one.
        caption: What stands below it.
        corner: Where in the picture the close-up covers least.
    """

    image: bytes
    close_up: bytes | None = None
    caption: str = ""
    corner: str = "top right"


@dataclass(frozen=True)
class Card:
    """One action.

    Attributes:
        title: Its elements, or its name.
        fingers: The fingers it moves.
        shots: Its pictures.
        posture: Its set-points.
        evidence: What was found at its posture.
        description: One sentence for people.
    """

    title: str
    fingers: tuple[str, ...]
    shots: tuple[Shot, ...] = ()
    posture: Posture | None = None
    evidence: Evidence | None = None
    description: str = ""


@dataclass(frozen=True)
class Section:
    """Actions of one kind.

    Attributes:
        title: Their kind, as in ``MultiPinchTight_3``.
        cards: The actions.
    """

    title: str
    cards: Sequence[Card] = ()


@dataclass(frozen=True, slots=True)
class Tried:
    """How one action did with one object.

    Attributes:
        action: The action with its elements, in words.
        object: The object, as on the command line.
        held: It was lifted, held and shaken, and stayed in the hand.
        note: What else there is to say: how far it slipped, or why it was lost.
    """

    action: str
    object: str
    held: bool
    note: str = ""


def load_template() -> Template:
    """Return the template of the page, which `page` fills in.

    Raises:
        MissingExtra: The extra ``plot`` is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError:
        raise MissingExtra("a report", "plot") from None
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATE.parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "bar": _bar,
        "effort": _effort,
        "law": _law,
        "quantity": _quantity,
        "size": _size,
        "source": _source,
        "tags": _tags,
    }
    return environment.get_template(_TEMPLATE.name)


def page(
    template: Template,
    hand: Hand,
    picture: bytes,
    sections: Iterable[Section],
    notes: Sequence[str],
    seconds: float,
    trials: Iterable[Tried] = (),
) -> str:
    """Return the page.

    Args:
        template: What `load_template` gave.
        hand: The hand.
        picture: A WebP file of the hand at rest.
        sections: The actions by kind.
        notes: What was noticed, one sentence each.
        seconds: How long the extraction took [s].
        trials: What became of the actions when they were tried.
    """
    tried = list(trials)
    rows: dict[str, dict[str, Tried]] = {}
    for one in tried:
        rows.setdefault(one.action, {})[one.object] = one
    return template.render(
        title=hand.description or hand.name,
        hand=hand,
        colours=finger_colours(hand),
        prefix=common_prefix(hand.actuator_names),
        followers=[
            joint
            for joint in hand.joints
            if joint.role in (JointRole.PASSIVE, JointRole.IGNORED)
            or hand.urdf.joints[joint.name].mimic is not None
        ],
        picture=picture,
        sections=list(sections),
        explained=_EXPLAINED,
        notes=notes,
        seconds=seconds,
        trials=tried,
        tried_by_action=rows,
    )


def _source(image: bytes) -> str:
    """Return a WebP file as the address of an image."""
    return "data:image/webp;base64," + base64.b64encode(image).decode()


def _quantity(value: float, kind: JointKind, unit: str = "") -> str:
    """Return a position, or a rate with ``unit`` ``/s``, in the units people read."""
    if not math.isfinite(value):
        return "unlimited"
    if kind is JointKind.PRISMATIC:
        return f"{value * 1e3:.1f} mm{unit}"
    return f"{math.degrees(value):.1f}°{unit}"


def _effort(actuator: ActuatorSpec) -> str:
    if not math.isfinite(actuator.effort):
        return "not given"
    unit = "N" if actuator.kind is JointKind.PRISMATIC else "N·m"
    return f"{actuator.effort:g} {unit}"


def _bar(value: float, actuator: ActuatorSpec) -> dict[str, str] | None:
    """Return the bar from rest to a value over the actuator's range [%]; none without limits."""
    if not math.isfinite(actuator.lower) or not math.isfinite(actuator.upper):
        return None
    span = actuator.upper - actuator.lower
    rest, at = ((v - actuator.lower) / span * 100 for v in (actuator.rest, value))
    bar = {"left": min(rest, at), "width": abs(at - rest), "rest": rest}
    return {name: f"{percent:.1f}" for name, percent in bar.items()}


def _law(mimic: UrdfMimic) -> str:
    """Return a joint's position as a function of that of the joint x that it follows."""
    if mimic.expression is not None:
        return mimic.expression
    offset = f"{mimic.offset:+g}" if mimic.offset else ""
    return f"{mimic.multiplier:g} · x{offset}"


def _size(name: str) -> tuple[str, str]:
    """Return the kind of an object and its size [mm]; an object without a size is all kind."""
    kind, _, size = name.partition(":")
    try:
        return kind, "×".join(f"{float(part) * 1e3:g}" for part in size.split("x"))
    except ValueError:
        return name, ""


def _tags(evidence: Evidence) -> list[str]:
    """Return what was found at a posture, in a few words each."""
    tags = []
    if evidence.depth > 0:
        tags.append(f"depth {evidence.depth * 1e3:.1f} mm")
    elif evidence.distance > 0:
        tags.append(f"distance {evidence.distance * 1e3:.1f} mm")
    tags += [f"{a} and {b}: {depth * 1e3:.1f} mm" for a, b, depth in evidence.pairs]
    if evidence.contact_at is not None:
        tags.append(f"touch at {evidence.contact_at:.0%}")
    opposition = evidence.opposition
    if opposition is not None:
        angles = " and ".join(f"{math.degrees(angle):.0f}°" for angle in opposition.angles)
        tags.append(f"normals {angles} off the closing")
        closure = "holds" if opposition.force_closure else "does not hold"
        tags.append(f"{closure} a ball at friction {opposition.friction:g}")
    if evidence.clearance is not None:
        tags.append(f"clearance {clearance_text(evidence.clearance)}")
    return tags
