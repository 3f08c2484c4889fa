"""Draw a plot of a recording as a picture, with Matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rtee.errors import needing_extra
from rtee.log.export import replacing
from rtee.log.figure import MARK_COLOUR, Figure, PlotRow

_WIDTH = 14.0  # of the drawing [inch]: two panels beside each other
_ROW_HEIGHT = 1.9  # of a panel [inch]
_LANE_HEIGHT = 0.22  # of a row of labels [inch]
_DPI = 110  # dots per inch: 1540 pixels, a screen's width


def write_png(figure: Figure, path: Path) -> None:
    """Draw a plot into a PNG file.

    Raises `MissingExtra` if Matplotlib is missing, `LogError` if the file cannot be written.
    """
    with needing_extra("a plot as PNG", "plot"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure as Drawing
    head = 0.8 + _LANE_HEIGHT * figure.lanes
    height = head + _ROW_HEIGHT * len(figure.rows) + 0.5
    drawing = Drawing(figsize=(_WIDTH, height), dpi=_DPI)
    # Not by pyplot, which keeps global state and looks for a screen.
    FigureCanvasAgg(drawing)
    axes = drawing.subplots(
        len(figure.rows), 2, sharex=True, squeeze=False, gridspec_kw={"width_ratios": (3, 2)}
    )
    drawing.subplots_adjust(
        left=0.06, right=0.985, top=1 - head / height, bottom=0.5 / height, hspace=0.3, wspace=0.13
    )
    drawing.suptitle(figure.title, x=0.06, y=1 - 0.14 / height, ha="left", va="top", size=13)
    for row, (left, right) in zip(figure.rows, axes, strict=True):
        _row(row, left, right, figure)
        for panel in (left, right):
            _shade(panel, figure)
            panel.set_xlim(figure.start, figure.end)
            panel.grid(visible=True, color="#dddddd", linewidth=0.6)
            panel.set_axisbelow(True)
            panel.tick_params(labelsize=8)
            for side in ("top", "right"):
                panel.spines[side].set_visible(False)
    _name(axes[0][0], figure)
    for panel in axes[-1]:
        panel.set_xlabel("time [s]", size=9)
    with replacing(path) as temporary:
        drawing.savefig(temporary, format="png")


def _row(row: PlotRow, left: Any, right: Any, figure: Figure) -> None:
    for panel, lines in ((left, row.positions), (right, row.efforts)):
        for line in lines:
            panel.plot(
                line.t,
                line.values,
                color=line.colour,
                linewidth=1.0 if line.dashed else 1.3,
                linestyle=(0, (4, 2)) if line.dashed else "-",
                alpha=0.8 if line.dashed else 1.0,
                label="_" if line.dashed else line.name,
            )
    shown, beside = row.labels(figure.effort_label)
    left.set_ylabel(shown.replace(" [", "\n["), size=8)
    right.set_ylabel(beside, size=8)
    title = row.title if row.unit else f"{row.title}   (dashed: reference)"
    left.set_title(title, loc="left", size=9, pad=3)
    if len(row.positions) > 2 or row.unit:
        left.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 0.97),
            fontsize=7,
            frameon=False,
            ncols=4,
            borderaxespad=0.0,
            columnspacing=1.2,
        )
    if not row.efforts:
        right.text(
            0.5, 0.5, "not measured", transform=right.transAxes, ha="center", color="#888888"
        )


def _shade(panel: Any, figure: Figure) -> None:
    """Shade the spans and draw where inner actions and marks begin."""
    across = {"transform": panel.get_xaxis_transform()}  # from the lower to the upper edge
    for colour in dict.fromkeys(band.colour for band in figure.bands):
        # All of a colour at once: an hour may have thousands.
        bands = [band for band in figure.bands if band.colour == colour]
        ends = [(max(b.span.start, figure.start), min(b.span.end, figure.end)) for b in bands]
        shaded = [(a, z - a) for b, (a, z) in zip(bands, ends, strict=True) if not b.inner]
        panel.broken_barh(shaded, (0, 1), color=colour, alpha=0.13, linewidth=0, **across)
        starts = [start for start, _ in ends]
        panel.vlines(starts, 0, 1, color=colour, linewidth=0.7, alpha=0.7, **across)
    panel.vlines(figure.marks, 0, 1, color=MARK_COLOUR, linewidth=0.8, linestyle=":", **across)


def _name(panel: Any, figure: Figure) -> None:
    """Write the names above a panel."""
    for label in figure.labels:
        panel.annotate(
            label.text,
            xy=(label.t, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(2, 17 + label.lane * _LANE_HEIGHT * 72),
            textcoords="offset points",
            size=8,
            color=label.colour,
            fontweight="bold",
            annotation_clip=False,
        )
