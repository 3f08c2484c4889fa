"""The table of the report that tells which objects each action held when it was tried."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

from rtee.extract import report_tables as tables


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


def section(tried: Iterable[Tried]) -> str:
    """Return the section with the table, as HTML; empty if nothing was tried."""
    found = list(tried)
    if not found:
        return ""
    held = sum(one.held for one in found)
    return (
        f'<h2 id="trials">Does it hold? <span class="soft">({held} of {len(found)})</span></h2>'
        '<p class="soft">Each action was tried on each object in simulation: approach, grasp, '
        "lift, hold, shake. Sizes in mm (radius and height of cylinders, radius of spheres). "
        "● held, ○ lost; a pointer on a sign tells more.</p>"
        f'<div class="panel tried">{_table(found)}</div>'
    )


def _table(found: Sequence[Tried]) -> str:
    objects = list(dict.fromkeys(one.object for one in found))
    rows: dict[str, dict[str, Tried]] = {}
    for one in found:
        rows.setdefault(one.action, {})[one.object] = one
    html = tables.table(
        ["action", "held", *objects],
        (
            [
                escape(action),
                f"{sum(one.held for one in row.values())} of {len(row)}",
                *(_sign(row.get(name)) for name in objects),
            ]
            for action, row in rows.items()
        ),
        numbers=range(1, len(objects) + 2),
    )
    for name in objects:
        html = html.replace(f">{escape(name)}</th>", f">{_short(name)}</th>")
    return html


def _short(name: str) -> str:
    """Return an object's kind over its size in millimetres, as HTML."""
    kind, _, size = name.partition(":")
    try:
        numbers = "×".join(f"{float(part) * 1e3:g}" for part in size.split("x"))
    except ValueError:
        return escape(name)
    return f"{escape(kind)}<br>{numbers}"


def _sign(one: Tried | None) -> str:
    if one is None:
        return ""
    word = "held" if one.held else "lost"
    note = escape(f"{word}; {one.note}" if one.note else word)
    return f'<span title="{note}">{"●" if one.held else "○"}</span>'
