"""The report's page: one HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Final

from rtee.actions.describe import clearance_text
from rtee.actions.types import Evidence, Posture
from rtee.extract import report_tables as tables
from rtee.extract.report_style import STYLE
from rtee.hand.model import Hand
from rtee.hand.names import common_prefix

EXPLAINED: Final = {
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

_FEW: Final = 2
"""How many pairs of colliding links are named at once."""


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
    shots: tuple[Shot, ...]
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
    cards: Sequence[Card] = field(default_factory=tuple)


def page(
    hand: Hand,
    picture: bytes,
    sections: Iterable[Section],
    notes: Sequence[str],
    seconds: float,
    trials: str = "",
) -> str:
    """Return the page.

    Args:
        hand: The hand.
        picture: A WebP file of the hand at rest.
        sections: The actions by kind.
        notes: What was noticed, one sentence each.
        seconds: How long the extraction took [s].
        trials: The section on trials, as HTML.
    """
    title = escape(hand.description or hand.name)
    found = tuple(sections)
    body = "".join(_section(hand, section) for section in found)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}: grasping actions</title><style>{STYLE}</style></head><body><main>
<h1>{title}</h1>
<div class="soft">What this hand can do, found in {escape(hand.urdf.path.name)}
in {seconds:.2f} s</div>
{_hero(hand, picture, found)}
<h2>Fingers</h2><div class="panel">{tables.fingers(hand)}</div>
<h2>Actuators</h2><div class="panel">{tables.actuators(hand)}</div>
<h2>What moves what</h2><div class="panel">{tables.moves(hand)}</div>
{_folded("Joints that follow an actuator", tables.couplings(hand))}
{_folded("Notes on the model", _list(notes))}
{trials}
{body}
<footer>Angles in degrees, lengths in millimetres, positions in the frame of
<code>{escape(hand.base)}</code>. In the bars the black tick is the rest posture.</footer>
</main></body></html>
"""


def _hero(hand: Hand, picture: bytes, sections: Sequence[Section]) -> str:
    counts = (
        (len(hand.fingers), "fingers"),
        (len(hand.actuators), "actuators"),
        (len(hand.joints), "moving joints"),
    )
    tiles = "".join(f'<div class="tile"><b>{n}</b><span>{what}</span></div>' for n, what in counts)
    legend = "".join(f"<li>{tables.named(hand, finger)}</li>" for finger in hand.finger_names)
    return (
        f'<div class="hero panel"><img src="{_source(picture)}" alt="The hand at rest">'
        f'<div><div class="tiles">{tiles}</div><ul class="legend">{legend}</ul>'
        f"{_contents(sections)}</div></div>"
    )


def _contents(sections: Sequence[Section]) -> str:
    """Return links to the kinds of actions with how many there are of each."""
    links = "".join(
        f'<li><a href="#{escape(section.title)}">{escape(_heading(section))}</a>'
        f'<span class="count">{len(section.cards)}</span></li>'
        for section in sections
    )
    return f'<nav><ul class="contents">{links}</ul></nav>' if links else ""


def _heading(section: Section) -> str:
    return section.title.replace("_", " ")


def _folded(title: str, content: str) -> str:
    if not content:
        return ""
    return f'<details><summary>{title}</summary><div class="panel">{content}</div></details>'


def _list(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    return "<ul>" + "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences) + "</ul>"


def _section(hand: Hand, section: Section) -> str:
    text = EXPLAINED.get(section.title.partition("_")[0], "")
    cards = "".join(_card(hand, card) for card in section.cards)
    return (
        f'<h2 id="{escape(section.title)}">{escape(_heading(section))} '
        f'<span class="soft">({len(section.cards)})</span></h2>'
        f'<p class="soft">{escape(text)}</p><div class="grid">{cards}</div>'
    )


def _card(hand: Hand, card: Card) -> str:
    dots = "".join(tables.dot(hand, finger) for finger in card.fingers)
    text = f'<div class="soft">{escape(card.description)}</div>' if card.description else ""
    wide = {1: "", 2: " pair"}.get(len(card.shots), " wide")
    posture = _posture(hand, card.posture) if card.posture else ""
    evidence = _evidence(card.evidence) if card.evidence else ""
    return (
        f'<article class="card{wide}">{_shots(card)}<div class="body">'
        f"<h3>{dots}{escape(card.title)}</h3>{text}{evidence}{posture}</div></article>"
    )


def _shots(card: Card) -> str:
    if len(card.shots) == 1:
        shot = card.shots[0]
        close = (
            f'<img class="close {shot.corner}" src="{_source(shot.close_up)}" '
            'alt="The contact from near">'
            if shot.close_up
            else ""
        )
        image = f'<img src="{_source(shot.image)}" alt="{escape(card.title)}">'
        return f'<div class="shots">{image}{close}</div>'
    figures = "".join(
        f'<figure><img src="{_source(shot.image)}" alt="{escape(shot.caption)}">'
        f"<figcaption>{escape(shot.caption)}</figcaption></figure>"
        for shot in card.shots
    )
    return f'<div class="steps">{figures}</div>'


def _source(image: bytes) -> str:
    return "data:image/webp;base64," + base64.b64encode(image).decode()


def _posture(hand: Hand, posture: Posture) -> str:
    rows = []
    prefix = common_prefix(hand.actuator_names)
    for name in posture.involved:
        actuator = hand.actuator(name)
        value = posture.position[name]
        shown = tables.quantity(value, actuator.kind)
        short = tables.code(name.removeprefix(prefix), breaks=True)
        rows.append(
            [f'<span title="{escape(name)}">{short}</span>', shown, tables.bar(actuator, value)]
        )
    return tables.table(["actuator", "position", ""], rows, numbers=(1,))


def _evidence(evidence: Evidence) -> str:
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
    shown = "".join(f'<span class="tag">{escape(tag)}</span>' for tag in tags)
    return shown + _warning(evidence)


def _warning(evidence: Evidence) -> str:
    """Return what else collides; many pairs of links are folded."""
    pairs = [f"{a} and {b}" for a, b in evidence.colliding]
    if evidence.clear:
        text = "" if evidence.path_clear else "the way there is not clear"
    elif len(pairs) <= _FEW:
        text = f"not clear: {'; '.join(pairs)} collide"
    else:
        listed = "".join(f"<li>{escape(pair)}</li>" for pair in pairs)
        return (
            f'<details class="tag warn"><summary>not clear: {len(pairs)} pairs of links collide'
            f"</summary><ul>{listed}</ul></details>"
        )
    return f'<span class="tag warn">{escape(text)}</span>' if text else ""
