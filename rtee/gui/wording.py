"""Texts of the GUI: outcomes, legends, short names, units and choices."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Sequence
from html import escape
from typing import Any, Final

import viser
from viser._messages import GuiSliderMark

from rtee.gui.colours import BAD, GOOD, WARN, line_colour, line_dash
from rtee.hand.names import common_prefix
from rtee.remote.words import ending
from rtee.sample import MEASURED
from rtee.types import Outcome, Result

JOINED: Final = " + "
"""Separator of the fingers in a choice."""

NOTHING: Final = "–"
"""Shown by a dropdown that has nothing to choose from."""


def outcome(result: Result) -> tuple[str, str]:
    """Return the outcome of a goal as a sentence and its colour."""
    bad = result.outcome is Outcome.ABORTED
    good = result.succeeded and not result.shortfall
    return ending(result), GOOD if good else BAD if bad else WARN


def effort_bar(share: float) -> str:
    """Return an effort, given as a share of its limit, as a bar of five parts."""
    return f"{'▰' * min(max(round(5.0 * share), 1), 5):▱<5}"


WRAPS: Final = "overflow-wrap:anywhere"
"""CSS of a line that may hold names of files or clients, whose length must not widen the panel."""


def small(html: str) -> str:
    """Return HTML in small print."""
    return f'<div style="font-size:0.8em;padding:0 0.75em;{WRAPS}">{html}</div>'


def coloured(text: str, colour: str) -> str:
    """Return a text, escaped, in small print of a CSS colour."""
    return small(f'<span style="color:{colour}">{escape(text)}</span>')


def swatch(number: int) -> str:
    """Return the HTML of a short piece of a line, whose number selects colour and dashes."""
    style = f"3px {'dashed' if line_dash(number) else 'solid'} {line_colour(number)}"
    return (
        '<span style="display:inline-block;width:1.3em;vertical-align:middle;'
        f'border-top:{style}"></span>'
    )


def legend(names: Iterable[tuple[int, str]], hint: str = "") -> str:
    """Return the HTML legend of a plot's lines, each given by its number and name.

    ``hint`` is HTML to append.
    """
    items = "".join(
        f'<span style="display:inline-block;margin-right:0.8em;{WRAPS}">{swatch(i)} '
        f"{escape(name)}</span>"
        for i, name in names
    )
    return (
        f'<div style="font-size:0.75em;line-height:1.5;padding:0.4em 0.75em 0">{items}'
        f'<span style="color:var(--rtee-faint)">{hint}</span></div>'
    )


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names without their common prefix: ``left_hand_Pinky`` becomes ``Pinky``."""
    prefix = common_prefix(names)
    return tuple(name.removeprefix(prefix) for name in names)


def units(quantity: str, kinds: Collection[str]) -> str:
    """Return the unit of a quantity for actuators or joints of these kinds."""
    return MEASURED[quantity].unit_for(kinds)


_DIGITS: Final = {"rad": 3, "rad/s": 2, "°": 1, "°/s": 1, "m": 4, "m/s": 3, "N·m": 2, "N": 1}
"""Number of decimals by unit: about as fine as devices measure."""


def number(value: float, unit: str) -> str:
    """Return a number with the decimals of its unit; ``–`` for NaN."""
    digits = _DIGITS.get(unit, 0)
    if math.isnan(value):
        return "–"
    # Adding 0.0 turns -0 into 0.
    return "∞" if math.isinf(value) else f"{round(value, digits) + 0.0:.{digits}f}"


class Angles:
    """The unit of angles in a window: radians, or degrees if the user has chosen them."""

    degrees = False

    def factor(self, quantity: str, kind: str) -> float:
        """Return the factor from SI to the displayed unit of a quantity of an actuator or joint."""
        turns = units(quantity, (kind,)).startswith("rad")
        return 180.0 / math.pi if self.degrees and turns else 1.0

    def unit(self, quantity: str, kinds: Collection[str]) -> str:
        """Return the unit in which a quantity of these kinds is shown."""
        unit = units(quantity, kinds)
        return unit.replace("rad", "°") if self.degrees else unit

    def text(self, value: float, quantity: str, kind: str) -> str:
        """Return a value as text in the displayed unit, with its decimals."""
        return number(value * self.factor(quantity, kind), self.unit(quantity, (kind,)))


def put(place: viser.GuiHtmlHandle, html: str) -> None:
    """Show HTML if it has changed; viser sends each assignment to the browser."""
    if place.content != html:
        place.content = html


def mark(slider: viser.GuiSliderHandle[Any], *marks: tuple[float, str]) -> None:
    """Label values of a slider; without marks, its ends are labelled."""
    shown = tuple(itertools.starmap(GuiSliderMark, marks)) or None
    # viser has no public way to change the marks of a slider; it sends each assignment.
    if slider._marks != shown:  # noqa: SLF001
        slider._marks = shown  # noqa: SLF001


def offer(dropdown: viser.GuiDropdownHandle[str], names: Iterable[str]) -> None:
    """Set the choices of a dropdown, and keep the current choice if it is among them."""
    options = tuple(names) or (NOTHING,)
    if tuple(dropdown.options) != options:
        chosen = dropdown.value
        dropdown.options = options
        dropdown.value = chosen if chosen in options else options[0]
