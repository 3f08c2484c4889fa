"""The tables of the report: fingers, actuators, what moves what, couplings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

from rtee.hand.colours import finger_colours
from rtee.hand.model import Hand, JointRole
from rtee.types import ActuatorSpec, JointKind


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return a table.

    Args:
        head: The titles of its columns.
        rows: Its cells, already HTML.
        numbers: Indices of columns that hold numbers.
    """

    def cell(tag: str, i: int, text: str) -> str:
        kind = ' class="number"' if i in numbers else ""
        return f"<{tag}{kind}>{text}</{tag}>"

    top = "".join(cell("th", i, escape(text)) for i, text in enumerate(head))
    body = "".join(
        "<tr>" + "".join(cell("td", i, text) for i, text in enumerate(row)) + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def code(text: str, *, breaks: bool = False) -> str:
    """Return a name as code; it may break at underscores where room is scarce."""
    shown = escape(text).replace("_", "_<wbr>") if breaks else escape(text)
    return f"<code>{shown}</code>"


def dot(hand: Hand, finger: str) -> str:
    """Return the dot in a finger's colour."""
    colour = finger_colours(hand).get(finger, "#9aa0a6")
    return f'<span class="dot" style="background:{colour}"></span>'


def named(hand: Hand, finger: str) -> str:
    """Return a finger's dot and name."""
    return f'<span class="name">{dot(hand, finger)}{escape(finger)}</span>'


def quantity(value: float, kind: JointKind, unit: str = "") -> str:
    """Return a position, or a rate with ``unit`` ``/s``, in the units people read."""
    if not math.isfinite(value):
        return "unlimited"
    if kind is JointKind.PRISMATIC:
        return f"{value * 1e3:.1f} mm{unit}"
    return f"{math.degrees(value):.1f}°{unit}"


def fingers(hand: Hand) -> str:
    """Return the table of fingers."""
    return table(
        ["finger", "fingertip", "moved by it alone", "moved with others", "why it is one"],
        (
            [
                named(hand, finger.name),
                code(finger.tip) if finger.tip else "none: no collision geometry",
                "<br>".join(map(code, finger.own)) or "-",
                "<br>".join(code(a) for a in finger.actuators if a not in finger.own) or "-",
                f'<span class="soft">{escape(finger.reason)}</span>',
            ]
            for finger in hand.fingers
        ),
    )


def actuators(hand: Hand) -> str:
    """Return the table of actuators."""
    return table(
        ["actuator", "kind", "from", "to", "rest", "velocity", "effort"],
        (
            [
                code(a.name),
                str(a.kind),
                quantity(a.lower, a.kind),
                quantity(a.upper, a.kind),
                quantity(a.rest, a.kind),
                quantity(a.velocity, a.kind, "/s"),
                _effort(a),
            ]
            for a in hand.actuators
        ),
        numbers=(2, 3, 4, 5, 6),
    )


def _effort(actuator: ActuatorSpec) -> str:
    if not math.isfinite(actuator.effort):
        return "not given"
    unit = "N" if actuator.kind is JointKind.PRISMATIC else "N·m"
    return f"{actuator.effort:g} {unit}"


def bar(actuator: ActuatorSpec, value: float) -> str:
    """Return a bar from rest to a value over the actuator's range; nothing without limits."""
    if not math.isfinite(actuator.lower) or not math.isfinite(actuator.upper):
        return ""
    span = actuator.upper - actuator.lower
    rest, at = ((v - actuator.lower) / span * 100 for v in (actuator.rest, value))
    left, width = min(rest, at), abs(at - rest)
    return (
        f'<div class="bar"><i style="left:{left:.1f}%;width:{width:.1f}%"></i>'
        f'<u style="left:calc({rest:.1f}% - 1px)"></u></div>'
    )


def moves(hand: Hand) -> str:
    """Return the table of which actuator moves which fingertip."""
    return table(
        ["", *hand.finger_names],
        (
            [
                code(a.name),
                *(dot(hand, f) if f in a.fingers else "" for f in hand.finger_names),
            ]
            for a in hand.actuators
        ),
    )


def couplings(hand: Hand) -> str:
    """Return the table of joints that are not actuators; empty if there are none."""
    rows = []
    for joint in hand.joints:
        mimic = hand.urdf.joints[joint.name].mimic
        if joint.role is JointRole.PASSIVE:
            rows.append([code(joint.name), "passive", "stands at rest"])
        elif joint.role is JointRole.IGNORED:
            rows.append([code(joint.name), "ignored", "stands at rest, like a fixed joint"])
        elif mimic is not None:
            how = (
                f"{mimic.multiplier:g} · x{mimic.offset:+g}"
                if mimic.expression is None and mimic.offset
                else f"{mimic.multiplier:g} · x"
                if mimic.expression is None
                else escape(mimic.expression)
            )
            rows.append([code(joint.name), code(mimic.of), f"<code>{how}</code>"])
    return table(["joint", "follows (x)", "position"], rows) if rows else ""
