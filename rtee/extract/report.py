"""The report: a page with everything that was found, and a picture of every action."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from rtee.actions.sideways import sideways_words
from rtee.actions.types import (
    Action,
    ActionKind,
    CustomAction,
    Posture,
    Primitive,
    PrimitiveKind,
    Timed,
)
from rtee.extract.jobs import parallel_map, processors
from rtee.extract.report_page import (
    CLOSE_SHARE,
    Card,
    Section,
    Shot,
    Tried,
    load_template,
    page,
)
from rtee.hand.model import Hand
from rtee.hand.names import common_prefix
from rtee.render.hand import SIZE, HandRenderer
from rtee.render.image import Contact
from rtee.types import FloatArray

if TYPE_CHECKING:
    from rtee.extract.extraction import Extraction


@dataclass(frozen=True)
class _View:
    """A picture to be taken."""

    u: FloatArray
    fingers: tuple[str, ...]
    caption: str = ""
    contact: Contact | None = None
    tips: tuple[str, ...] = ()


_Plan = tuple[Card, tuple[_View, ...]]
"""A card without pictures, and the pictures to be taken for it."""


def make_report(
    hand: Hand,
    extraction: Extraction,
    actions: Iterable[Action] | None = None,
    *,
    trials: Iterable[Tried] = (),
    size: tuple[int, int] = SIZE,
    jobs: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """Return the report of a hand, a page of HTML.

    Args:
        hand: The hand.
        extraction: What was extracted from it.
        actions: Its actions (a library is some), for the composed, timed and generic ones.
        trials: What became of its actions when they were tried in simulation.
        size: Width and height of the pictures of the whole hand [pixels].
        jobs: Processes that take pictures; 0 for one per processor.
        progress: Called with the pictures taken and those there are.

    Raises:
        ConfigError: The extra ``plot`` is not installed.
        ModelError: A mesh cannot be read.
    """
    template = load_template()
    sections = {**_primitives(hand, extraction.primitives), **_custom(hand, actions or ())}
    every = [view for plans in sections.values() for _, views in plans for view in views]
    renderer = HandRenderer(hand, size, postures=[view.u for view in every])
    rest = _View(hand.rest, hand.finger_names)

    def shoot(view: _View) -> Shot:
        if view is rest:
            return Shot(renderer.picture(hand.rest, file_format="WEBP"))
        return _shot(renderer, view)

    shots = parallel_map(
        shoot, [rest, *every], jobs or processors(), progress or (lambda done, total: None)
    )
    taken = iter(shots[1:])
    cards = [
        Section(
            title, [replace(card, shots=tuple(islice(taken, len(views)))) for card, views in plans]
        )
        for title, plans in sections.items()
    ]
    notes = (*hand.notes, *extraction.notes)
    return page(template, hand, shots[0].image, cards, notes, extraction.seconds, trials)


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
        tips = tuple(tip for f in fingers if (tip := hand.finger(f).tip) is not None)
    view = _View(_position(hand, primitive.posture), fingers, contact=contact, tips=tips)
    title = " + ".join(primitive.elements)
    said = sideways_words(hand, primitive, common_prefix(hand.actuator_names))
    return Card(title, fingers, (), primitive.posture, evidence, said), (view,)


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
                said = _said(action)
                plan = Card(action.name, fingers, (), action.posture, None, said), (view,)
        groups.setdefault(action.action_kind, []).append(plan)
    return {kind.capitalize(): groups[kind] for kind in ActionKind if kind in groups}


def _said(action: CustomAction) -> str:
    if action.description or not action.uses:
        return action.description
    parts = (
        " ".join([use.action, *use.elements]) + (f" × {use.scale:g}" if use.scale != 1 else "")
        for use in action.uses
    )
    return " + ".join(parts)


def _timed(hand: Hand, action: Timed) -> _Plan:
    """Plan a picture after every step; actuators that a step leaves alone stay where they are."""
    u = np.array(hand.rest)
    views = []
    for i, step in enumerate(action.steps, 1):
        u = u.copy()
        for name in step.posture.involved:
            u[hand.actuator_index(name)] = step.posture.position[name]
        caption = f"{i}. {step.alias}: {step.before:g} s before, {step.after:g} s after"
        views.append(_View(u, _moved(hand, step.posture), caption))
    involved = {finger for view in views for finger in view.fingers}
    fingers = tuple(name for name in hand.finger_names if name in involved)
    return Card(action.name, fingers, description=action.description), tuple(views)


def _position(hand: Hand, posture: Posture) -> FloatArray:
    return np.array([posture.position[name] for name in hand.actuator_names])


def _moved(hand: Hand, posture: Posture) -> tuple[str, ...]:
    return tuple(
        finger.name for finger in hand.fingers if set(finger.actuators) & set(posture.involved)
    )
