"""Draw a plot of a recording as one self-contained page, with Plotly."""

from __future__ import annotations

import html
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtee.errors import needing_extra
from rtee.log.export import replacing
from rtee.log.figure import MARK_COLOUR, Figure, PlotLine

_ROW_HEIGHT = 210  # of a panel [pixels]
_LANE_HEIGHT = 18  # of a row of labels [pixels]
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
