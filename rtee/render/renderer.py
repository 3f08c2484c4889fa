"""Pictures of a mesh by ray casting: soft shadows, ambient occlusion, anti-aliased edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.render.camera import Camera
from rtee.render.raycast import (
    Hits,
    Mask,
    RayCaster,
    cone,
    cosine_hemisphere,
    fibonacci_lattice,
    normalised,
)
from rtee.sample import FloatArray

_TILE: Final = 4
"""Side of a tile, whose pixels use different rays and are averaged afterwards [pixels]."""
_RAYS: Final = 4
"""Number of rays per pixel for ambient occlusion, and for the soft shadow."""
_GRID: Final = 3
"""Side of the grid of samples in each pixel at an edge."""
_EDGE: Final = 0.035
"""Difference of brightness or coverage above which neighbouring pixels form an edge."""
_NEIGHBOURS: Final = tuple((dy, dx) for dy in (0, -1, 1) for dx in (0, -1, 1))
"""Offsets of a pixel itself and of its neighbours [pixels]."""
_ALIKE: Final = 0.05
"""Difference (see `_GBuffer.light_of`) below which two points count as the same."""
_LIFT: Final = 1e-4
"""Height above a surface at which shadow rays start, so that they miss it [occlusion radii]."""
_SHADOW_REACH: Final = 10.0
"""Length of shadow rays [occlusion radii]: longer than the whole hand."""

_DIFFUSE: Final = 0.80
"""Brightness of a matt surface that faces the light; chosen by eye, like the values below."""
_AMBIENT: Final = (0.34, 0.30)
"""Brightness of all surfaces from the sky, and its increase for surfaces facing up."""
_GLOSS: Final = (0.16, 48)
"""Brightness of a highlight and its Blinn-Phong exponent, which sets its size."""
_RIM: Final = 0.10
"""Brightness from the sky of surfaces seen edge-on."""

_GROUND_STEP: Final = 4
"""Spacing of the pixels for which the shadow on the ground is computed [pixels]."""
_GROUND_RAYS: Final = 8
"""Number of shadow rays, and of occlusion rays, for each of these pixels."""
_GROUND_SHADOW: Final = (0.45, 0.55)
"""Shares of the light's shadow and of ambient occlusion in the shadow on the ground."""
_GROUND_DARKNESS: Final = 0.62
"""Coverage of the darkest shadow on the ground."""
_BORDER: Final = 0.12
"""Share of the picture over which the ground's shadow fades towards each border."""


@dataclass(frozen=True)
class Shading:
    """Colours and light of a picture.

    Attributes:
        colours: Linear colour of each link ``(l, 3)``.
        light: Unit vector towards the light.
        up: Unit vector away from the ground.
        ground: Height of the ground along ``up`` [m]; ``None`` for no ground.
        radius: Distance within which surfaces occlude ambient light [m].
    """

    colours: FloatArray
    light: FloatArray
    up: FloatArray
    ground: float | None
    radius: float

    @classmethod
    def studio(
        cls,
        colours: FloatArray,
        camera: Camera,
        up: FloatArray,
        extent: float,
        ground: float | None = None,
    ) -> Shading:
        """Return studio lighting: from above, from the left, and from behind the camera.

        Args:
            colours: Linear colour of each link ``(l, 3)``.
            camera: The camera.
            up: Unit vector away from the ground.
            extent: Diagonal of the visible part [m].
            ground: Height of the ground along ``up`` [m]; ``None`` for no ground.
        """
        # Chosen by eye: shadows fall to the lower right, as in most drawings.
        light = -0.55 * camera.right + 0.75 * up - 0.62 * camera.forward
        return cls(colours, light / np.linalg.norm(light), up, ground, 0.45 * extent)


class _GBuffer:
    """Normal, depth, link and light of each pixel of a picture."""

    def __init__(
        self, hits: Hits, y: NDArray[np.int64], x: NDArray[np.int64], shape: tuple[int, int]
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

    def set_light(self, direct: FloatArray, ambient: FloatArray) -> None:
        """Set the light of each pixel, averaged over the tile around it on the same surface."""
        self.light[self.y, self.x] = np.stack([direct, ambient], axis=1)
        total, weight = np.zeros((len(self.y), 2)), np.zeros(len(self.y))
        for dy in range(-(_TILE // 2), _TILE - _TILE // 2):
            for dx in range(-(_TILE // 2), _TILE - _TILE // 2):
                y, x = self._beside(self.y, self.x, dy, dx)
                # The same surface has nearly the same normal (within 26°) and depth.
                same = np.einsum("ij,ij->i", self.normals[y, x], self.hits.normals) > 0.9
                step = np.abs(self.depth[y, x] - self.hits.depth)
                same &= step < 0.004 * self.hits.depth * (abs(dx) + abs(dy) + 1)
                total += np.where(same[:, None], self.light[y, x], 0.0)
                weight += same
        self.light[self.y, self.x] = total / np.maximum(weight, 1)[:, None]

    def light_of(
        self, hits: Hits, y: NDArray[np.int64], x: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the light at points in given pixels: that of the most similar pixel nearby."""
        best = np.full(len(y), np.inf)
        light = np.ones((len(y), 2))
        left = np.arange(len(y))
        for dy, dx in _NEIGHBOURS:
            beside = self._beside(y[left], x[left], dy, dx)
            difference = 1 - np.einsum("ij,ij->i", self.normals[beside], hits.normals[left])
            difference += 20 * np.abs(self.depth[beside] - hits.depth[left]) / hits.depth[left]
            difference += 9.0 * (self.links[beside] != hits.links[left])
            better = difference < best[left]
            best[left[better]] = difference[better]
            light[left[better]] = self.light[beside][better]
            # Most points match their own pixel; only the others search its neighbours.
            left = left[best[left] > _ALIKE]
        return light[:, 0], light[:, 1]

    def _beside(
        self, y: NDArray[np.int64], x: NDArray[np.int64], dy: int, dx: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        height, width = self.shape
        return np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)


class Renderer:
    """Renders one picture."""

    def __init__(self, caster: RayCaster, camera: Camera, shading: Shading) -> None:
        self.caster = caster
        self.camera = camera
        self.shading = shading

    def render(self) -> FloatArray:
        """Return linear colours times coverage, and the coverage ``(height, width, 4)``."""
        width, height = self.camera.size
        y, x = self._window()
        hits = self._cast(x, y, 0.5, 0.5)
        pixels = _GBuffer(hits, y[hits.rays], x[hits.rays], (height, width))
        pixels.set_light(*self._light(hits, x, y))
        picture = np.zeros((height, width, 4))
        picture[pixels.y, pixels.x] = self._shaded(hits, *pixels.light[pixels.y, pixels.x].T)
        self._antialias(picture, pixels)
        return self._with_ground(picture)

    def coverage(self) -> FloatArray:
        """Return the share of each pixel covered by the mesh ``(height, width)``, in quarters."""
        width, height = self.camera.size
        total = np.zeros((height, width))
        y, x = self._window()
        # Four rays per pixel on a rotated grid, on which no two share a row or a column.
        for dx, dy in ((0.125, 0.625), (0.375, 0.125), (0.625, 0.875), (0.875, 0.375)):
            hits = self._cast(x, y, dx, dy)
            total[y[hits.rays], x[hits.rays]] += 0.25
        return total

    def _cast(self, x: NDArray[np.int64], y: NDArray[np.int64], dx: float, dy: float) -> Hits:
        """Return the hits of rays through pixels, at an offset within each pixel [pixels]."""
        rays = self.camera.rays(x.astype(np.float64) + dx, y.astype(np.float64) + dy)
        return self.caster.cast(self.camera.position, rays)

    def _window(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and columns of the pixels that may show the mesh."""
        width, height = self.camera.size
        spots = self.camera.project(self.caster.mesh.corners.reshape(-1, 3))
        left, top = np.clip(np.floor(spots.min(axis=0)).astype(int) - 1, 0, [width, height])
        right, bottom = np.clip(np.ceil(spots.max(axis=0)).astype(int) + 1, 0, [width, height])
        y, x = np.mgrid[top:bottom, left:right]
        return y.ravel(), x.ravel()

    def _light(
        self, hits: Hits, x: NDArray[np.int64], y: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the visible shares of light and sky at each point ``(k,)``, 0 to 1."""
        shading = self.shading
        cells = _TILE * _TILE
        cell = (y[hits.rays] % _TILE) * _TILE + x[hits.rays] % _TILE
        start = hits.points + hits.face_normals * (_LIFT * shading.radius)
        direct, ambient = np.zeros(len(start)), np.zeros(len(start))
        for ray in range(_RAYS):
            a, b = fibonacci_lattice(cell + cells * ray, cells * _RAYS)
            toward = cone(shading.light, a, b)
            # A smooth normal may face the light although the triangle does not.
            facing = np.einsum("ij,ij->i", hits.face_normals, toward) > 0
            reach = _SHADOW_REACH * shading.radius
            direct += facing & ~self.caster.occluded(start, toward, reach)
            around = cosine_hemisphere(hits.normals, a, b)
            above = np.einsum("ij,ij->i", hits.face_normals, around) > 0
            ambient += above & ~self.caster.occluded(start, around, shading.radius)
        return direct / _RAYS, ambient / _RAYS

    def _shaded(self, hits: Hits, direct: FloatArray, ambient: FloatArray) -> FloatArray:
        """Return the colour and coverage ``(k, 4)`` of points, by the model of Blinn and Phong."""
        shading = self.shading
        base = shading.colours[hits.links]
        toward = -normalised(hits.points - self.camera.position)
        diffuse = np.clip(hits.normals @ shading.light, 0, 1) * direct
        half = normalised(toward + shading.light)
        strength, exponent = _GLOSS
        gloss = np.clip(np.einsum("ij,ij->i", hits.normals, half), 0, 1) ** exponent * direct
        rim = (1 - np.clip(np.einsum("ij,ij->i", hits.normals, toward), 0, 1)) ** 3 * ambient
        above = 0.5 + 0.5 * (hits.normals @ shading.up)
        sky = (ambient**1.15) * (_AMBIENT[0] + _AMBIENT[1] * above)
        colour = base * (sky + _DIFFUSE * diffuse)[:, None]
        colour += (strength * gloss + _RIM * rim)[:, None]
        return np.concatenate([colour, np.ones((len(colour), 1))], axis=1)

    def _antialias(self, picture: FloatArray, pixels: _GBuffer) -> None:
        """Sample the pixels at edges more finely, with the light of nearby pixels."""
        y, x = np.nonzero(_edges(picture))
        if not len(x):
            return
        total = np.zeros((len(x), 4))
        for i in range(_GRID * _GRID):
            row, column = divmod(i, _GRID)
            # On a rotated grid, no two samples share a row or a column.
            dx = (column + (row + 0.5) / _GRID) / _GRID
            dy = (row + (column + 0.5) / _GRID) / _GRID
            hits = self._cast(x, y, dx, dy)
            light = pixels.light_of(hits, y[hits.rays], x[hits.rays])
            total[hits.rays] += self._shaded(hits, *light)
        picture[y, x] = total / _GRID**2

    def _with_ground(self, picture: FloatArray) -> FloatArray:
        """Return the picture with the mesh's shadow on the ground behind it."""
        shading, camera = self.shading, self.camera
        if shading.ground is None:
            return picture
        width, height = camera.size
        step = _GROUND_STEP
        rows, columns = -(-height // step) + 1, -(-width // step) + 1
        y, x = np.divmod(np.arange(rows * columns), columns)
        rays = camera.rays(x * float(step), y * float(step))
        drop = rays @ shading.up
        height_over = shading.ground - camera.position @ shading.up
        distance = np.where(drop < -1e-6, height_over / drop, -1.0)
        which = np.flatnonzero(distance > 0)
        points = camera.position + rays[which] * distance[which, None]
        away = points - self.caster.mesh.corners.reshape(-1, 3).mean(axis=0)
        away = np.linalg.norm(away - np.outer(away @ shading.up, shading.up), axis=1)
        # The shadow is full up to 0.84 occlusion radii from the hand and ends at 2.24.
        fade = np.clip(1.6 - away / (1.4 * shading.radius), 0, 1)
        near = fade > 0
        which, points, fade = which[near], points[near], fade[near]
        shade = np.zeros(rows * columns)
        # Neighbouring pixels use different rays.
        turns = (x[which] * 7 + y[which] * 3) % 16
        shade[which] = _GROUND_DARKNESS * fade * self._ground_shadow(points, turns)
        shade = _blurred(shade.reshape(rows, columns))
        # For a soft shadow, every fourth pixel is enough.
        coverage = _enlarged(shade, step)[:height, :width] * _border_fade(height, width)
        result = picture.copy()
        # The shadow is black with this coverage, behind the mesh.
        result[..., 3] += (1 - picture[..., 3]) * coverage
        return result

    def _ground_shadow(self, points: FloatArray, turns: NDArray[np.int64]) -> FloatArray:
        """Return the shadow ``(n,)``, 0 to 1, at points ``(n, 3)`` [m] of the ground.

        ``turns`` selects one of 16 sets of rays for each point.
        """
        shading = self.shading
        up = np.broadcast_to(shading.up, points.shape)
        start = points + up * (_LIFT * shading.radius)
        reach = _SHADOW_REACH * shading.radius
        dark = np.zeros(len(points))
        for ray in range(_GROUND_RAYS):
            a, b = fibonacci_lattice(turns + 16 * ray, 16 * _GROUND_RAYS)
            toward, around = cone(shading.light, a, b), cosine_hemisphere(up, a, b)
            dark += _GROUND_SHADOW[0] * self.caster.occluded(start, toward, reach)
            dark += _GROUND_SHADOW[1] * self.caster.occluded(start, around, shading.radius)
        return dark / _GROUND_RAYS


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


def _border_fade(height: int, width: int) -> FloatArray:
    """Return factors ``(height, width)`` that fade to 0 towards the picture's border."""
    y, x = (
        np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5) / (_BORDER * n)
        for n in (height, width)
    )
    y, x = (np.clip(v, 0, 1) for v in (y, x))
    fade: FloatArray = (y * y * (3 - 2 * y))[:, None] * (x * x * (3 - 2 * x))[None]
    return fade


def _blurred(values: FloatArray) -> FloatArray:
    """Return values averaged twice with their neighbours."""
    for _ in range(2):
        padded = np.pad(values, 1, mode="edge")
        values = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
        values = (values[:, :-2] + 2 * values[:, 1:-1] + values[:, 2:]) / 4
    return values


def _enlarged(values: FloatArray, step: int) -> FloatArray:
    """Return values at all pixels, interpolated bilinearly from every ``step``-th pixel."""
    rows, columns = values.shape
    y = np.arange((rows - 1) * step) / step
    x = np.arange((columns - 1) * step) / step
    i, j = y.astype(int), x.astype(int)
    fy, fx = (y - i)[:, None], (x - j)[None]
    above = values[i][:, j] * (1 - fx) + values[i][:, j + 1] * fx
    below = values[i + 1][:, j] * (1 - fx) + values[i + 1][:, j + 1] * fx
    result: FloatArray = above * (1 - fy) + below * fy
    return result
