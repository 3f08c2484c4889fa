"""Texts of the GUI: results, uses of actions, small print, legends, short names, units, choices."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from html import escape
from typing import Final

import viser

from rtee.actions.types import ActionReference
from rtee.gui.colours import BAD, GOOD, WARN, line_colour, line_dash
from rtee.hand.names import common_prefix
from rtee.remote.words import ending
from rtee.sample import MEASURED
from rtee.types import Outcome, Result

NOTHING: Final = "–"
"""Shown by a dropdown that has nothing to choose from."""


def outcome(result: Result) -> tuple[str, str]:
    """Return the outcome of a goal: a sentence, and its colour."""
    bad = result.outcome is Outcome.ABORTED
    return ending(result), GOOD if result.succeeded else BAD if bad else WARN


def described(use: ActionReference) -> str:
    """Return a use of an action as text: ``Trig thumb × 0.3``."""
    name = " ".join((use.action, *use.elements))
    return name if use.scale == 1.0 else f"{name} × {use.scale:g}"


def effort_bar(share: float) -> str:
    """Return an effort as a bar of five parts, given as a share of its limit."""
    return f"{'▰' * min(max(round(5.0 * share), 1), 5):▱<5}"


WRAPS: Final = "overflow-wrap:anywhere"
"""CSS of a line that may hold names of files and clients: a long word must not widen the panel."""


def small(html: str) -> str:
    """Return HTML in small print."""
    return f'<div style="font-size:0.8em;padding:0 0.75em;{WRAPS}">{html}</div>'


def coloured(text: str, colour: str) -> str:
    """Return a text, escaped, in small print of a colour ``#rrggbb``."""
    return small(f'<span style="color:{colour}">{escape(text)}</span>')


def legend(names: Iterable[tuple[int, str]], hint: str = "") -> str:
    """Return the HTML legend of the lines of a plot, whose index selects colour and dashes.

    A hint in HTML may follow.
    """
    items = "".join(
        '<span style="white-space:nowrap;margin-right:0.8em">'
        '<span style="display:inline-block;width:1.3em;vertical-align:middle;'
        f'border-top:3px {"dashed" if line_dash(i) else "solid"} {line_colour(i)}"></span> '
        f"{escape(name)}</span>"
        for i, name in names
    )
    return (
        f'<div style="font-size:0.75em;line-height:1.5;padding:0.4em 0.75em 0">{items}'
        f'<span style="color:#5f6570">{hint}</span></div>'
    )


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names without the prefix that all share: ``left_hand_Pinky`` becomes ``Pinky``."""
    prefix = common_prefix(names)
    return tuple(name.removeprefix(prefix) for name in names)


def units(quantity: str, kinds: Collection[str]) -> str:
    """Return the unit of a quantity for actuators or joints of these kinds."""
    return MEASURED[quantity].unit_for(kinds)


def put(place: viser.GuiHtmlHandle, html: str) -> None:
    """Show HTML; viser sends each assignment, so that only changes are made."""
    if place.content != html:
        place.content = html


def offer(dropdown: viser.GuiDropdownHandle[str], names: Iterable[str]) -> None:
    """Set the choices of a dropdown; the chosen one stays chosen if it is among them."""
    options = tuple(names) or (NOTHING,)
    if tuple(dropdown.options) != options:
        chosen = dropdown.value
        dropdown.options = options
        dropdown.value = chosen if chosen in options else options[0]
