"""Ray-traced pictures on the processor alone: soft shadows, ambient light, smooth edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.extract.report_camera import Camera
from rtee.extract.report_sampling import (
    blurred,
    cone,
    enlarged,
    hemisphere,
    lattice,
    margin,
    normalised,
)
from rtee.extract.report_trace import Hits, Mask, Tracer
from rtee.types import FloatArray

_TILE: Final = 4
"""Pixels of a tile of this many squared use different rays and are averaged afterwards."""
_RAYS: Final = 4
"""Rays for ambient light, and as many for the soft shadow, per pixel."""
_GRID: Final = 3
"""Samples per pixel at edges, squared."""
_EDGE: Final = 0.035
"""Neighbours that differ more than this in brightness or cover have an edge between them."""
_GROUND_STEP: Final = 4
_AROUND: Final = tuple((dy, dx) for dy in (0, -1, 1) for dx in (0, -1, 1))
"""Pixels around one, itself first."""
_ALIKE: Final = 0.05
"""Points that differ less than this show the same spot."""


@dataclass(frozen=True)
class Look:
    """What the rays of a picture need to know.

    Attributes:
        colours: Linear colour of each link ``(l, 3)``.
        light: Unit vector towards the light.
        up: Unit vector away from the ground.
        ground: Height of the ground along ``up`` [m]; ``None`` for no ground.
        reach: Distance beyond which nothing darkens its surroundings [m].
    """

    colours: FloatArray
    light: FloatArray
    up: FloatArray
    ground: float | None
    reach: float


class _Seen:
    """What the pixels of a picture show, and how it is lit."""

    def __init__(
        self,
        hits: Hits,
        y: NDArray[np.int64],
        x: NDArray[np.int64],
        shape: tuple[int, int],
    ) -> None:
        self.hits = hits
        self.y, self.x, self.shape = y, x, shape
        self.normals = np.zeros((*shape, 3))
        self.normals[y, x] = hits.normals
        self.depth = np.full(shape, np.inf)
        self.depth[y, x] = hits.depth
        self.links = np.full(shape, -1)
        self.links[y, x] = hits.links
        self.light = np.zeros((*shape, 2))

    def set_light(self, light: FloatArray, sky: FloatArray) -> None:
        """Set what was found pixel by pixel, averaged over tiles that show the same surface."""
        self.light[self.y, self.x] = np.stack([light, sky], axis=1)
        total, weight = np.zeros((len(self.y), 2)), np.zeros(len(self.y))
        for dy in range(-(_TILE // 2), _TILE - _TILE // 2):
            for dx in range(-(_TILE // 2), _TILE - _TILE // 2):
                y, x = self._beside(self.y, self.x, dy, dx)
                same = np.einsum("ij,ij->i", self.normals[y, x], self.hits.normals) > 0.9
                step = np.abs(self.depth[y, x] - self.hits.depth)
                same &= step < 0.004 * self.hits.depth * (abs(dx) + abs(dy) + 1)
                total += np.where(same[:, None], self.light[y, x], 0.0)
                weight += same
        self.light[self.y, self.x] = total / np.maximum(weight, 1)[:, None]

    def light_of(
        self, hits: Hits, y: NDArray[np.int64], x: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the light at points in given pixels: that of the nearest likeness around."""
        best = np.full(len(y), np.inf)
        found = np.ones((len(y), 2))
        left = np.arange(len(y))
        for dy, dx in _AROUND:
            beside = self._beside(y[left], x[left], dy, dx)
            unlike = 1 - np.einsum("ij,ij->i", self.normals[beside], hits.normals[left])
            unlike += 20 * np.abs(self.depth[beside] - hits.depth[left]) / hits.depth[left]
            unlike += 9.0 * (self.links[beside] != hits.links[left])
            better = unlike < best[left]
            best[left[better]] = unlike[better]
            found[left[better]] = self.light[beside][better]
            left = left[best[left] > _ALIKE]
        return found[:, 0], found[:, 1]

    def _beside(
        self, y: NDArray[np.int64], x: NDArray[np.int64], dy: int, dx: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        height, width = self.shape
        return np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)


class Painter:
    """Paints one picture.

    Args:
        tracer: The surface to be seen.
        camera: Where it is seen from.
        look: Colours and light.
    """

    def __init__(self, tracer: Tracer, camera: Camera, look: Look) -> None:
        self.tracer = tracer
        self.camera = camera
        self.look = look

    def paint(self) -> FloatArray:
        """Return the picture ``(height, width, 4)``: linear colours times cover, and cover."""
        width, height = self.camera.size
        y, x = self._window()
        hits = self.tracer.cast(
            self.camera.position,
            self.camera.rays(x.astype(np.float64) + 0.5, y.astype(np.float64) + 0.5),
        )
        seen = _Seen(hits, y[hits.which], x[hits.which], (height, width))
        seen.set_light(*self._lit(hits, x, y))
        picture = np.zeros((height, width, 4))
        picture[seen.y, seen.x] = self._shaded(hits, *seen.light[seen.y, seen.x].T)
        self._refine(picture, seen)
        return self._grounded(picture)

    def cover(self) -> FloatArray:
        """Return which part of each pixel shows the surface ``(height, width)``, in steps."""
        width, height = self.camera.size
        total = np.zeros((height, width))
        y, x = self._window()
        for dx, dy in ((0.125, 0.625), (0.375, 0.125), (0.625, 0.875), (0.875, 0.375)):
            hits = self.tracer.cast(
                self.camera.position,
                self.camera.rays(x.astype(np.float64) + dx, y.astype(np.float64) + dy),
            )
            total[y[hits.which], x[hits.which]] += 0.25
        return total

    def _window(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and columns of the pixels in which the surface may be seen."""
        width, height = self.camera.size
        spots = self.camera.project(self.tracer.surface.corners.reshape(-1, 3))
        left, top = np.clip(np.floor(spots.min(axis=0)).astype(int) - 1, 0, [width, height])
        right, bottom = np.clip(np.ceil(spots.max(axis=0)).astype(int) + 1, 0, [width, height])
        y, x = np.mgrid[top:bottom, left:right]
        return y.ravel(), x.ravel()

    def _lit(
        self, hits: Hits, x: NDArray[np.int64], y: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray]:
        """Return how much of the light and of the sky each point sees ``(k,)``."""
        cells = _TILE * _TILE
        cell = (y[hits.which] % _TILE) * _TILE + x[hits.which] % _TILE
        start = hits.points + hits.flat * (1e-4 * self.look.reach)
        light, sky = np.zeros(len(start)), np.zeros(len(start))
        for ray in range(_RAYS):
            a, b = lattice(cell + cells * ray, cells * _RAYS)
            toward = cone(self.look.light, a, b)
            facing = np.einsum("ij,ij->i", hits.flat, toward) > 0
            light += facing & ~self.tracer.blocked(start, toward, 10 * self.look.reach)
            around = hemisphere(hits.normals, a, b)
            above = np.einsum("ij,ij->i", hits.flat, around) > 0
            sky += above & ~self.tracer.blocked(start, around, self.look.reach)
        return light / _RAYS, sky / _RAYS

    def _shaded(self, hits: Hits, light: FloatArray, sky: FloatArray) -> FloatArray:
        """Return colour and cover ``(k, 4)`` of points."""
        look = self.look
        base = look.colours[hits.links]
        toward = -normalised(hits.points - self.camera.position)
        facing = np.clip(hits.normals @ look.light, 0, 1) * light
        half = normalised(toward + look.light)
        gloss = np.clip(np.einsum("ij,ij->i", hits.normals, half), 0, 1) ** 48 * light
        rim = (1 - np.clip(np.einsum("ij,ij->i", hits.normals, toward), 0, 1)) ** 3 * sky
        above = 0.5 + 0.5 * (hits.normals @ look.up)
        ambient = (sky**1.15) * (0.34 + 0.30 * above)
        colour = base * (ambient + 0.80 * facing)[:, None]
        colour += (0.16 * gloss + 0.10 * rim)[:, None]
        return np.concatenate([colour, np.ones((len(colour), 1))], axis=1)

    def _refine(self, picture: FloatArray, seen: _Seen) -> None:
        """Sample the pixels at edges more finely, with the light of the pixels around."""
        y, x = np.nonzero(_edges(picture))
        if not len(x):
            return
        total = np.zeros((len(x), 4))
        for i in range(_GRID * _GRID):
            row, column = divmod(i, _GRID)
            # A turned grid: no two samples share a row or a column.
            fx = (column + (row + 0.5) / _GRID) / _GRID
            fy = (row + (column + 0.5) / _GRID) / _GRID
            hits = self.tracer.cast(
                self.camera.position,
                self.camera.rays(x.astype(np.float64) + fx, y.astype(np.float64) + fy),
            )
            light, sky = seen.light_of(hits, y[hits.which], x[hits.which])
            total[hits.which] += self._shaded(hits, light, sky)
        picture[y, x] = total / _GRID**2

    def _grounded(self, picture: FloatArray) -> FloatArray:
        """Put the shadow on the ground behind what is there."""
        look, camera = self.look, self.camera
        if look.ground is None:
            return picture
        width, height = camera.size
        step = _GROUND_STEP
        rows, columns = -(-height // step) + 1, -(-width // step) + 1
        y, x = np.divmod(np.arange(rows * columns), columns)
        rays = camera.rays(x * float(step), y * float(step))
        drop = rays @ look.up
        distance = np.where(drop < -1e-6, (look.ground - camera.position @ look.up) / drop, -1.0)
        which = np.flatnonzero(distance > 0)
        points = camera.position + rays[which] * distance[which, None]
        centre = self.tracer.surface.corners.reshape(-1, 3).mean(axis=0)
        away = np.linalg.norm(
            (points - centre) - np.outer((points - centre) @ look.up, look.up), axis=1
        )
        fade = np.clip(1.6 - away / (1.4 * look.reach), 0, 1)
        near = fade > 0
        which, points, fade = which[near], points[near], fade[near]
        up = np.broadcast_to(look.up, points.shape)
        start = points + up * (1e-4 * look.reach)
        dark = np.zeros(len(points))
        rounds = 8
        for ray in range(rounds):
            a, b = lattice((x[which] * 7 + y[which] * 3) % 16 + 16 * ray, 16 * rounds)
            dark += 0.45 * self.tracer.blocked(start, cone(look.light, a, b), 10 * look.reach)
            dark += 0.55 * self.tracer.blocked(start, hemisphere(up, a, b), look.reach)
        shade = np.zeros(rows * columns)
        shade[which] = 0.62 * fade * dark / rounds
        shade = blurred(shade.reshape(rows, columns))
        cover = enlarged(shade, step)[:height, :width] * margin(height, width)
        result = picture.copy()
        # The shadow is black with that cover, behind the surface.
        result[..., 3] += (1 - picture[..., 3]) * cover
        return result


def _edges(picture: FloatArray) -> Mask:
    """Return the pixels that differ from a neighbour, and those neighbours."""
    shown = np.sqrt(np.clip(picture, 0, 1))
    edge = np.zeros(picture.shape[:2], dtype=bool)
    down = np.abs(np.diff(shown, axis=0)).max(axis=2) > _EDGE
    side = np.abs(np.diff(shown, axis=1)).max(axis=2) > _EDGE
    edge[1:] |= down
    edge[:-1] |= down
    edge[:, 1:] |= side
    edge[:, :-1] |= side
    return edge
