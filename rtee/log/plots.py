"""Draw plots of recordings: as a picture with Matplotlib, as a self-contained page with Plotly."""

from __future__ import annotations

import html
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtee.errors import needing_extra
from rtee.log.export import replacing
from rtee.log.figure import MARK_COLOUR, Figure, PlotLine, PlotRow

_WIDTH = 14.0  # width of the drawing [inch]: two panels side by side
_LEFT = 0.075  # where the left panels begin, as a share of the width: after numbers like 0.00125
_ROW_INCHES = 1.9  # height of a panel [inch]
_LANE_INCHES = 0.22  # height of a row of labels [inch]
_DPI = 110  # dots per inch: 1540 pixels, a screen's width


def write_png(figure: Figure, path: Path) -> None:
    """Draw a plot into a PNG file.

    Raises `MissingExtra` if Matplotlib is missing, `LogError` if the file cannot be written.
    """
    with needing_extra("a plot as PNG", "plot"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure as Drawing
    head = 0.8 + _LANE_INCHES * figure.lanes
    height = head + _ROW_INCHES * len(figure.rows) + 0.5
    drawing = Drawing(figsize=(_WIDTH, height), dpi=_DPI)
    # Not by pyplot, which keeps global state and looks for a screen.
    FigureCanvasAgg(drawing)
    axes = drawing.subplots(
        len(figure.rows), 2, sharex=True, squeeze=False, gridspec_kw={"width_ratios": (3, 2)}
    )
    drawing.subplots_adjust(
        left=_LEFT, right=0.985, top=1 - head / height, bottom=0.5 / height, hspace=0.3, wspace=0.13
    )
    drawing.suptitle(figure.title, x=_LEFT, y=1 - 0.14 / height, ha="left", va="top", size=13)
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
            xytext=(2, 17 + label.lane * _LANE_INCHES * 72),
            textcoords="offset points",
            size=8,
            color=label.colour,
            fontweight="bold",
            annotation_clip=False,
        )


_ROW_HEIGHT = 210  # height of a panel [pixels]
_LANE_HEIGHT = 18  # height of a row of labels [pixels]
_HEAD = 90  # room for title and legend [pixels]


def write_html(figure: Figure, path: Path) -> None:
    """Write a plot as a self-contained page, which needs no network.

    Raises `MissingExtra` if Plotly is missing, `LogError` if the file cannot be written.
    """
    with needing_extra("a plot as page", "plot"):
        import plotly.graph_objects as go
        from plotly.subplots import make_subplots
    count = len(figure.rows)
    drawing = make_subplots(
        rows=count,
        cols=2,
        shared_xaxes="all",
        column_widths=[0.6, 0.4],
        horizontal_spacing=0.06,
        vertical_spacing=min(0.06, 0.3 / count),
    )
    shown: set[str] = set()
    for number, row in enumerate(figure.rows, start=1):
        for column, lines in ((1, row.positions), (2, row.efforts)):
            for line in lines:
                trace = _trace(go, line, named=line.group not in shown and not line.dashed)
                drawing.add_trace(trace, row=number, col=column)
                shown.add(line.group)
        left, right = row.labels(figure.effort_label)
        unit = left[left.index("[") :]
        drawing.update_yaxes(title_text=f"{html.escape(row.title)}<br>{unit}", row=number, col=1)
        drawing.update_yaxes(title_text=right, row=number, col=2)
    drawing.update_layout(shapes=[*_shapes(figure)], annotations=[*_names(figure)])
    _lay_out(drawing, figure)
    # Embedding Plotly adds some megabytes, but the page opens without a network.
    text = drawing.to_html(include_plotlyjs=True, full_html=True, config={"scrollZoom": True})
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _lay_out(drawing: Any, figure: Figure) -> None:
    count = len(figure.rows)
    head = _HEAD + _LANE_HEIGHT * figure.lanes
    drawing.update_xaxes(range=[figure.start, figure.end], title_text=None, gridcolor="#e5e5e5")
    drawing.update_xaxes(title_text="time [s]", row=count)
    drawing.update_yaxes(gridcolor="#e5e5e5", title_font_size=11)
    drawing.update_layout(
        title={
            "text": html.escape(figure.title),
            "yref": "container",
            "y": 1.0,
            "yanchor": "top",
            "pad": {"t": 14},
        },
        height=head + _ROW_HEIGHT * count,
        margin={"t": head, "l": 70, "r": 20, "b": 50},
        plot_bgcolor="white",
        hovermode="x",
        legend={"groupclick": "togglegroup", "tracegroupgap": 2},
    )


def _trace(go: Any, line: PlotLine, *, named: bool) -> Any:
    name = html.escape(line.name)
    # WebGL, since a dozen lines of 4,000 points as SVG make a browser slow.
    return go.Scattergl(
        x=np.round(line.t, 6),
        y=line.values,
        name=name,
        legendgroup=html.escape(line.group),
        showlegend=named,
        mode="lines",
        line={
            "color": line.colour,
            "width": 1.2 if line.dashed else 1.6,
            "dash": "dash" if line.dashed else "solid",
        },
        hovertemplate=f"{name}: %{{y:.5g}}<extra></extra>",
    )


def _shapes(figure: Figure) -> Iterator[dict[str, Any]]:
    """Yield the shapes that shade the spans in all panels of both columns.

    All go into the layout at once: one by one, each would be compared with those before.
    """
    for axis in ("x", "x2"):
        place = {"xref": axis, "yref": "paper", "y0": 0, "y1": 1}
        for band in figure.bands:
            start, end = max(band.span.start, figure.start), min(band.span.end, figure.end)
            if band.inner:
                line = {"width": 1, "color": band.colour}
                yield {"type": "line", "x0": start, "x1": start, "line": line, **place}
            else:
                fill = {"fillcolor": band.colour, "opacity": 0.12, "line": {"width": 0}}
                yield {"type": "rect", "x0": start, "x1": end, **fill, **place}
        for t in figure.marks:
            line = {"width": 1, "dash": "dot", "color": MARK_COLOUR}
            yield {"type": "line", "x0": t, "x1": t, "line": line, **place}


def _names(figure: Figure) -> Iterator[dict[str, Any]]:
    """Yield the names above the first panels."""
    for label in figure.labels:
        yield {
            "x": label.t,
            "xref": "x",
            "y": 1.0,
            "yref": "paper",
            "yshift": 4 + _LANE_HEIGHT * label.lane,
            "text": html.escape(label.text),
            "showarrow": False,
            "xanchor": "left",
            "yanchor": "bottom",
            "font": {"size": 11, "color": label.colour},
        }
