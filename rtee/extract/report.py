"""The report: one HTML file with all results, and a picture of every action.

It is self-contained. Its layout is in ``report.html.jinja``.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from rtee.actions.describe import abduction_sentence, clearance_text, deeper_text, described
from rtee.actions.types import (
    Action,
    ActionKind,
    CustomAction,
    Evidence,
    Posture,
    Primitive,
    PrimitiveKind,
    Timed,
)
from rtee.child import processors
from rtee.extract.jobs import parallel_map
from rtee.hand.colours import finger_colours
from rtee.hand.model import Hand, JointRole
from rtee.hand.names import common_prefix
from rtee.hand.urdf import UrdfMimic
from rtee.render.hand import SIZE, HandRenderer
from rtee.render.image import Contact
from rtee.render.page import load_template
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, JointKind

if TYPE_CHECKING:
    from jinja2 import Template

    from rtee.extract.extraction import Extraction

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
"""Size of a close-up, as a share of a picture's width and height."""


@dataclass(frozen=True)
class Shot:
    """A picture with its caption.

    Attributes:
        image: A WebP file.
        close_up: A WebP file of the contact, if there is one.
        caption: The text below the picture.
        corner: Corner of the picture in which the close-up hides the least.
    """

    image: bytes
    close_up: bytes | None = None
    caption: str = ""
    corner: str = "top right"


@dataclass(frozen=True)
class ReportCard:
    """Card of one action.

    Attributes:
        title: Elements or name of the action.
        fingers: Fingers that the action moves.
        shots: Pictures of the action.
        posture: Set-points of the action.
        evidence: Evidence for the posture.
        description: One sentence about the action.
    """

    title: str
    fingers: tuple[str, ...]
    shots: tuple[Shot, ...] = ()
    posture: Posture | None = None
    evidence: Evidence | None = None
    description: str = ""


@dataclass(frozen=True)
class ReportSection:
    """Section with the actions of one kind.

    Attributes:
        title: The kind of the actions, such as ``MultiPinchTight_3``.
        cards: The actions.
    """

    title: str
    cards: Sequence[ReportCard] = ()


@dataclass(frozen=True, slots=True)
class TrialSummary:
    """Result of a trial of an action on an object.

    Attributes:
        action: Name of the action with its elements.
        object: The object, as on the command line.
        held: Whether the object stayed in the hand when lifted and shaken.
        note: The slip, or the reason for the loss.
    """

    action: str
    object: str
    held: bool
    note: str = ""


@dataclass(frozen=True)
class _View:
    """A picture to render."""

    u: FloatArray
    fingers: tuple[str, ...]
    caption: str = ""
    contact: Contact | None = None
    tips: tuple[str, ...] = ()


_Plan = tuple[ReportCard, tuple[_View, ...]]
"""A card without pictures, and the pictures to render for it."""


def make_report(
    hand: Hand,
    extraction: Extraction,
    actions: Iterable[Action] | None = None,
    *,
    trials: Iterable[TrialSummary] = (),
    size: tuple[int, int] = SIZE,
    jobs: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """Return the report of a hand as an HTML page.

    Args:
        hand: The hand.
        extraction: Result of the extraction.
        actions: Further actions of the hand, such as its library; primitives are ignored.
        trials: Results of trials of the hand's actions in simulation.
        size: Width and height of the pictures of the whole hand [pixels].
        jobs: Number of processes that render pictures; 0 for one per processor.
        progress: Called with the number of rendered pictures and the total.

    Raises:
        ConfigError: The extra ``plot`` is not installed.
        ModelError: A mesh cannot be read, or the hand has no shapes at all.
    """
    template = load_template(
        Path(__file__).with_name("report.html.jinja"),
        "a report",
        bar=_bar,
        effort=_effort,
        law=_law,
        quantity=_quantity,
        size=_size,
        source=_source,
        tags=_tags,
    )
    sections = {**_primitives(hand, extraction.primitives), **_custom(hand, actions or ())}
    every = [view for plans in sections.values() for _, views in plans for view in views]
    renderer = HandRenderer(hand, size, postures=[view.u for view in every])
    rest = _View(hand.rest, hand.finger_names)

    def shoot(view: _View) -> Shot:
        # Compare by identity, since the rest posture gets a plain picture at the top of the page.
        if view is rest:
            return Shot(renderer.picture(hand.rest, file_format="WEBP"))
        return _shot(renderer, view)

    # Render all pictures at once, since they take most of the time and use all processors.
    shots = parallel_map(
        shoot, [rest, *every], jobs or processors(), progress or (lambda done, total: None)
    )
    taken = iter(shots[1:])
    cards = [
        ReportSection(
            title, [replace(card, shots=tuple(islice(taken, len(views)))) for card, views in plans]
        )
        for title, plans in sections.items()
    ]
    notes = (*hand.notes, *extraction.notes)
    return _page(template, hand, shots[0].image, cards, notes, extraction.seconds, trials)


def _shot(renderer: HandRenderer, view: _View) -> Shot:
    image = renderer.picture(
        view.u,
        highlight=view.fingers,
        contacts=[view.contact] if view.contact else [],
        ghost=True,
        file_format="WEBP",
    )
    if not (view.contact and view.tips):
        return Shot(image, caption=view.caption)
    corner = renderer.free_corner(view.u, view.contact, view.fingers, CLOSE_SHARE)
    close = renderer.close_up(view.u, view.contact, view.tips, file_format="WEBP")
    return Shot(image, close, view.caption, corner)


def _primitives(hand: Hand, primitives: Iterable[Primitive]) -> dict[str, list[_Plan]]:
    """Return the primitives by kind."""
    order = list(PrimitiveKind)
    groups: dict[str, list[_Plan]] = {}
    for primitive in sorted(primitives, key=lambda p: (order.index(p.kind), p.tips)):
        groups.setdefault(primitive.name, []).append(_primitive(hand, primitive))
    return groups


def _primitive(hand: Hand, primitive: Primitive) -> _Plan:
    fingers = primitive.fingers or primitive.elements
    evidence = primitive.evidence[0] if primitive.evidence else None
    contact: Contact | None = None
    tips: tuple[str, ...] = ()
    if evidence is not None and evidence.point is not None and evidence.normal is not None:
        contact = (evidence.point, evidence.normal)
        tips = tuple(link for f in fingers for link in hand.finger(f).tip_links)
    view = _View(_position(hand, primitive.posture), fingers, contact=contact, tips=tips)
    title = " + ".join(primitive.elements)
    sideways = abduction_sentence(hand, primitive, common_prefix(hand.actuator_names))
    summary = sideways or deeper_text(primitive)
    return ReportCard(title, fingers, (), primitive.posture, evidence, summary), (view,)


def _custom(hand: Hand, actions: Iterable[Action]) -> dict[str, list[_Plan]]:
    """Return the composed, timed and generic actions by kind."""
    groups: dict[str, list[_Plan]] = {}
    plan: _Plan
    for action in actions:
        match action:
            case Primitive():
                continue
            case Timed():
                plan = _timed(hand, action)
            case _:
                fingers = _moved(hand, action.posture)
                view = _View(_position(hand, action.posture), fingers)
                summary = _summary(action)
                plan = ReportCard(action.name, fingers, (), action.posture, None, summary), (view,)
        groups.setdefault(action.action_kind, []).append(plan)
    return {kind.capitalize(): groups[kind] for kind in ActionKind if kind in groups}


def _summary(action: CustomAction) -> str:
    if action.description or not action.uses:
        return action.description
    return " + ".join(map(described, action.uses))


def _timed(hand: Hand, action: Timed) -> _Plan:
    """Plan a picture after every step; actuators that a step does not move keep their position."""
    u = np.array(hand.rest)
    views = []
    for i, step in enumerate(action.steps, 1):
        # A copy, since each view keeps its posture and the next step starts from this one.
        u = u.copy()
        for name in step.posture.involved:
            u[hand.actuator_index(name)] = step.posture.position[name]
        caption = f"{i}. {step.alias}: {step.before:g} s before, {step.after:g} s after"
        views.append(_View(u, _moved(hand, step.posture), caption))
    involved = {finger for view in views for finger in view.fingers}
    fingers = tuple(name for name in hand.finger_names if name in involved)
    return ReportCard(action.name, fingers, description=action.description), tuple(views)


def _position(hand: Hand, posture: Posture) -> FloatArray:
    return np.array([posture.position[name] for name in hand.actuator_names])


def _moved(hand: Hand, posture: Posture) -> tuple[str, ...]:
    return tuple(
        finger.name for finger in hand.fingers if set(finger.actuators) & set(posture.involved)
    )


def _page(
    template: Template,
    hand: Hand,
    picture: bytes,
    sections: Iterable[ReportSection],
    notes: Sequence[str],
    seconds: float,
    trials: Iterable[TrialSummary] = (),
) -> str:
    """Return the page, with the results of trials by action and object."""
    tried = list(trials)
    rows: dict[str, dict[str, TrialSummary]] = {}
    for trial in tried:
        rows.setdefault(trial.action, {})[trial.object] = trial
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
    """Return a WebP file as a data URL."""
    return "data:image/webp;base64," + base64.b64encode(image).decode()


def _quantity(value: float, kind: JointKind, unit: str = "") -> str:
    """Return a position in mm or degrees, or a rate if ``unit`` is ``/s``."""
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
    """Return the bar from rest to a value over an actuator's range [%]; ``None`` without limits."""
    if not math.isfinite(actuator.lower) or not math.isfinite(actuator.upper):
        return None
    span = actuator.upper - actuator.lower
    rest, at = ((v - actuator.lower) / span * 100 for v in (actuator.rest, value))
    bar = {"left": min(rest, at), "width": abs(at - rest), "rest": rest}
    return {name: f"{percent:.1f}" for name, percent in bar.items()}


def _law(mimic: UrdfMimic) -> str:
    """Return the law of a joint's position as text; x is the position of the joint it follows."""
    if mimic.expression is not None:
        return mimic.expression
    offset = f"{mimic.offset:+g}" if mimic.offset else ""
    return f"{mimic.multiplier:g} · x{offset}"


def _size(name: str) -> tuple[str, str]:
    """Return the kind of an object and its size [mm]; empty for an object without a size."""
    kind, _, size = name.partition(":")
    try:
        return kind, "×".join(f"{float(part) * 1e3:g}" for part in size.split("x"))
    except ValueError:
        return name, ""


def _tags(evidence: Evidence) -> list[str]:
    """Return the evidence for a posture as short texts."""
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
        tags.append(f"normals {angles} off the closing directions")
        closure = "holds" if opposition.force_closure else "does not hold"
        tags.append(f"{closure} a ball at friction {opposition.friction:g}")
    if evidence.clearance is not None:
        tags.append(f"clearance {clearance_text(evidence.clearance)}")
    return tags
