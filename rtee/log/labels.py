"""Spans and marks of a plot, and the layout of their names above it, without overlap."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from rtee.log.recording import Span

SPAN_COLOURS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#b8860b", "#439894", "#e45756")
MARK_COLOUR = "#444444"
_CHARACTER = 0.0098
"""Width of a character of a label, as a share of the left panels' width: estimated from the
pictures."""
_LONGEST = 40  # characters of a label; longer ones end in an ellipsis
_LANES = 3  # rows of labels above the panels; a name that fits into none is left out


@dataclass(frozen=True, slots=True)
class Band:
    """A span with its colour; `inner` for an inner action of a timed one."""

    span: Span
    colour: str
    inner: bool

    @property
    def text(self) -> str:
        """The name, with the outcome unless the goal was reached."""
        if self.span.outcome in ("reached", "ended"):
            return self.span.name
        return f"{self.span.name} ({self.span.outcome.replace('_', ' ')})"


@dataclass(frozen=True, slots=True)
class Label:
    """A text above the first row, which begins at a time [s]; lanes are counted from below."""

    t: float
    lane: int
    text: str
    colour: str


def bands_of(spans: Sequence[Span], start: float, end: float) -> tuple[Band, ...]:
    """Return the visible spans, with colours by name."""
    bands: list[Band] = []
    colours: dict[str, str] = {}

    def colour(name: str) -> str:
        return colours.setdefault(name, SPAN_COLOURS[len(colours) % len(SPAN_COLOURS)])

    for span in spans:
        if span.end < start or span.start > end:
            continue
        bands.append(Band(span, colour(span.name), inner=False))
        bands += [
            Band(inner, colour(span.name), inner=True)
            for inner in span.inner
            if inner.end >= start and inner.start <= end
        ]
    return tuple(bands)


_Text = tuple[float, float, str, str]
"""Begin and end of what has a name [s], the name and its colour."""


def labels_of(
    bands: Sequence[Band], marks: Sequence[tuple[float, str]], start: float, end: float
) -> Iterator[Label]:
    """Lay out the names: inner actions below, actions above them, marks on top.

    Each kind has a few lanes. Where there are too many names for them, the longest spans get
    theirs first.
    """
    kinds: tuple[list[_Text], ...] = (
        [(b.span.start, b.span.end, b.text, b.colour) for b in bands if b.inner],
        [(b.span.start, b.span.end, b.text, b.colour) for b in bands if not b.inner],
        [(t, t, text, MARK_COLOUR) for t, text in marks],
    )
    base = 0
    for texts in kinds:
        # In the order of time, names take the fewest lanes.
        labels = _laid_out(sorted(texts), start, end)
        if len(labels) < len(texts):
            longest = sorted(texts, key=lambda text: (text[0] - text[1], text))
            labels = _laid_out(longest, start, end)
        for label in labels:
            yield replace(label, lane=base + label.lane)
        # The next kind begins above the lanes of this one.
        base += max((label.lane + 1 for label in labels), default=0)


def _laid_out(texts: Sequence[_Text], start: float, end: float) -> list[Label]:
    """Return labels, each in the lowest lane where it has room; the others are left out."""
    duration = max(end - start, 1e-9)
    labels: list[Label] = []
    lanes: list[list[tuple[float, float]]] = []  # from where to where each is taken [s]
    for t, _, text, colour in texts:
        shown = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
        width = (len(shown) + 1) * _CHARACTER * duration
        at = max(start, min(t, end - width))
        free = (all(at + width <= a or b <= at for a, b in taken) for taken in lanes)
        lane = next((k for k, is_free in enumerate(free) if is_free), len(lanes))
        if lane == _LANES:
            continue
        if lane == len(lanes):
            lanes.append([])
        lanes[lane].append((at, at + width))
        labels.append(Label(at, lane, shown, colour))
    return labels
