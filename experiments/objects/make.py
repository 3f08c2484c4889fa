"""Everyday things as meshes of convex parts, made from measures; public domain (CC0 1.0).

Parts reach a little into each other, so that they share no corner: parts that do are one.

Run: ``python experiments/objects/make.py [FOLDER]``; writes one STL file each, in metres.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Triangles = NDArray[np.float64]
"""Corners ``(t, 3, 3)`` [m], counter-clockwise seen from outside."""

AROUND = 32
"""Sides of round things."""

MASSES = {
    "banana": 0.12,
    "bottle": 0.35,
    "bracket": 0.10,
    "egg": 0.06,
    "marker": 0.02,
    "mug": 0.30,
    "plate": 0.25,
    "screwdriver": 0.08,
    "spray_can": 0.30,
    "wedge": 0.15,
}
"""What the things weigh [kg]."""


def revolved(profile: Sequence[tuple[float, float]]) -> Triangles:
    """Return what a profile of (radius, height) [m] sweeps about z, closed, from below to above."""
    turn = np.arange(AROUND + 1) * (2.0 * math.pi / AROUND)
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(AROUND + 1)], axis=1)
    rings = [radius * circle + (0.0, 0.0, height) for radius, height in profile]
    ends = [np.array([0.0, 0.0, profile[0][1]]), np.array([0.0, 0.0, profile[-1][1]])]
    found = []
    for i in range(AROUND):
        if profile[0][0]:
            found.append((ends[0], rings[0][i + 1], rings[0][i]))
        if profile[-1][0]:
            found.append((ends[1], rings[-1][i], rings[-1][i + 1]))
        for (low, high), (below, above) in zip(pairwise(rings), pairwise(profile), strict=True):
            if below[0]:
                found.append((low[i], low[i + 1], high[i + 1]))
            if above[0]:
                found.append((low[i], high[i + 1], high[i]))
    return np.array(found)


def box(size: Sequence[float], middle: Sequence[float] = (0.0, 0.0, 0.0)) -> Triangles:
    """Return a box with these edge lengths [m] around a middle."""
    return prism([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], size, middle)


def prism(
    outline: Sequence[tuple[float, float]],
    size: Sequence[float],
    middle: Sequence[float] = (0.0, 0.0, 0.0),
) -> Triangles:
    """Return a prism along z over a convex outline in x and y, scaled by its size [m]."""
    count = len(outline)
    low = np.array([(x, y, -0.5) for x, y in outline]) * size + middle
    high = low + np.array([0.0, 0.0, size[2]])
    found = []
    for i in range(count):
        j = (i + 1) % count
        found += [(low[i], low[j], high[j]), (low[i], high[j], high[i])]
        if 0 < i < count - 1:
            found += [(low[0], low[j], low[i]), (high[0], high[i], high[j])]
    return np.array(found)


def turned(part: Triangles, angle: float, shift: Sequence[float]) -> Triangles:
    """Return a part turned about y [rad], then shifted [m]."""
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return part @ turn.T + np.array(shift)


def banana() -> list[Triangles]:
    """Return a banana: seven conical parts along an arc of 110 mm radius."""
    radii = (0.006, 0.012, 0.016, 0.018, 0.018, 0.016, 0.012, 0.006)
    angles = np.linspace(-0.75, 0.75, len(radii))
    parts = []
    for (first, second), (begin, end) in zip(pairwise(angles), pairwise(radii), strict=True):
        middle = 0.5 * (first + second)
        half = 0.11 * math.tan(0.5 * (second - first)) * 1.05  # a little into each other
        part = revolved([(begin, -half), (end, half)])
        shift = (0.11 * (math.cos(middle) - 1.0), 0.0, 0.11 * math.sin(middle))
        parts.append(turned(part, -middle, shift))
    return parts


def bottle() -> list[Triangles]:
    """Return a bottle of half a litre with its cap, 215 mm high."""
    return [
        revolved([(0.031, 0.0), (0.033, 0.004), (0.033, 0.14)]),
        revolved([(0.033, 0.139), (0.013, 0.185)]),
        revolved([(0.013, 0.184), (0.013, 0.2)]),
        revolved([(0.016, 0.199), (0.016, 0.215)]),
    ]


def bracket() -> list[Triangles]:
    """Return an angle bracket of 6 mm sheet, 60 mm by 50 mm by 40 mm."""
    return [
        box((0.06, 0.04, 0.006), (0.03, 0.0, 0.003)),
        box((0.006, 0.0398, 0.0498), (0.003, 0.0, 0.0251)),
    ]


def egg() -> list[Triangles]:
    """Return an egg, 58 mm long and 44 mm thick, blunt end down."""
    heights = np.linspace(0.0, 1.0, 15)
    shape = [2.0 * math.sqrt(h * (1.0 - h)) * (1.0 - 0.22 * (h - 0.4)) for h in heights]
    scale = 0.022 / max(shape)
    return [revolved([(scale * r, 0.058 * h) for r, h in zip(shape, heights, strict=True)])]


def marker() -> list[Triangles]:
    """Return a marker pen, 140 mm long, with a thicker cap."""
    return [
        revolved([(0.0085, 0.0), (0.0085, 0.1)]),
        revolved([(0.0095, 0.095), (0.0095, 0.135), (0.006, 0.14)]),
    ]


def mug() -> list[Triangles]:
    """Return a mug, 80 mm wide and 95 mm high, filled, with a handle of three bars."""
    return [
        revolved([(0.037, 0.0), (0.04, 0.006), (0.04, 0.095)]),
        box((0.032, 0.012, 0.01), (0.054, 0.0, 0.075)),
        box((0.01, 0.012, 0.06), (0.066, 0.0, 0.05)),
        box((0.032, 0.012, 0.01), (0.054, 0.0, 0.025)),
    ]


def plate() -> list[Triangles]:
    """Return a dessert plate, 170 mm across, solid, with a foot."""
    return [
        revolved([(0.045, 0.0), (0.045, 0.006)]),
        revolved([(0.05, 0.004), (0.085, 0.016), (0.085, 0.019)]),
    ]


def screwdriver() -> list[Triangles]:
    """Return a screwdriver: a handle of 100 mm, a blade of 110 mm."""
    return [
        revolved([(0.011, 0.0), (0.0155, 0.012), (0.0155, 0.07), (0.012, 0.1)]),
        revolved([(0.0035, 0.098), (0.0035, 0.21)]),
    ]


def spray_can() -> list[Triangles]:
    """Return a spray can, 52 mm wide and 165 mm high, with its nozzle."""
    return [
        revolved([(0.026, 0.0), (0.026, 0.13)]),
        revolved([(0.026, 0.129), (0.014, 0.15)]),
        revolved([(0.007, 0.149), (0.007, 0.165)]),
    ]


def wedge() -> list[Triangles]:
    """Return a door stop, 100 mm long, 45 mm wide and 35 mm high."""
    return [prism([(-0.5, -0.5), (0.5, -0.5), (0.5, -0.4), (-0.5, 0.5)], (0.1, 0.035, 0.045))]


THINGS: dict[str, Callable[[], list[Triangles]]] = {
    make.__name__: make
    for make in (
        banana,
        bottle,
        bracket,
        egg,
        marker,
        mug,
        plate,
        screwdriver,
        spray_can,
        wedge,
    )
}


def stl(parts: Sequence[Triangles]) -> bytes:
    """Return parts as a binary STL file."""
    corners = np.concatenate(parts)
    record = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    triangles = np.zeros(len(corners), dtype=record)
    triangles["corners"] = np.round(corners, 6) + 0.0  # one zero, without a sign
    return bytes(80) + len(corners).to_bytes(4, "little") + triangles.tobytes()


def main() -> None:
    """Write the files."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in THINGS.items():
        (folder / f"{name}.stl").write_bytes(stl(make()))


if __name__ == "__main__":
    main()
