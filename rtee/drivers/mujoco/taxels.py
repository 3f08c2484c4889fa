"""Touch sensors in the simulation: taxels on the fingertips, or where hand.yaml places them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import mujoco
import numpy as np

from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.solids import solid_of, turn_of
from rtee.hand.abduction import abduction
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Finger, Hand
from rtee.hand.tessellation import Triangles, solid
from rtee.hand.touch import grid_points, on_hand, taxel_count
from rtee.sample import FloatArray
from rtee.touch import TouchSensor

_COVERED: Final = 0.7
"""Share of the pad's length and width that a grid spans: real pads end before the tip's edges."""

_FACING: Final = 0.5
"""Least cosine between the pad's direction and the normals of the surface that belongs to it."""

_SPREAD: Final = 0.6
"""The taxels around a contact feel it in proportion to a bell curve with this standard deviation
[distance between taxels]: skin spreads a load over about one taxel to each side."""

_BEYOND: Final = 3.0
"""Standard deviations beyond which a taxel feels nothing of a contact."""

_LEAST_SPREAD: Final = 0.002
"""Least standard deviation [m]: contacts of hulls lie up to this far off the mesh's surface."""

_SHRUNK: Final = 0.85
"""Factor by which a taxel moves towards the pad's middle when its ray misses the tip."""

_TRIES: Final = 12
"""Steps of the search; the last point has 17 % of its first distance from the middle."""


class Taxels:
    """The touch sensors of a simulated hand.

    A taxel measures the normal force of the contacts near it: each contact's force is shared among
    the taxels around it, so that the sum over a sensor is the force on it. Contacts on the back of
    a link, or beyond the taxels, are not felt.

    Attributes:
        sensors: The sensors, in the order of their values.
    """

    def __init__(self, model: mujoco.MjModel, hand: Hand, options: SimOptions) -> None:
        self.sensors = _sensors(model, hand, options.touch)
        self._body = [int(model.body(LINK + sensor.link).id) for sensor in self.sensors]
        self._bodies = np.array(sorted(set(self._body)), dtype=np.intp)
        self._spread = [_spread(sensor.position) for sensor in self.sensors]
        self._of_geom = np.array(model.geom_bodyid, dtype=np.intp)

    def read(self, data: mujoco.MjData) -> FloatArray:
        """Return the normal forces on all taxels ``(n,)`` [N]."""
        values = [np.zeros(sensor.taxels) for sensor in self.sensors]
        if data.ncon:
            contact = data.contact
            first = contact.efc_address
            bodies = self._of_geom[contact.geom]
            # A contact that is only within the margin has no rows in the solver, and no force.
            seen = np.flatnonzero((first >= 0) & np.isin(bodies, self._bodies).any(axis=1))
            for index in seen.tolist():
                # The first row of an elliptic contact is its normal force.
                force = float(data.efc_force[first[index]])
                if force > 0.0:
                    frame = contact.frame[index].reshape(3, 3)
                    self._share(data, values, bodies[index], contact.pos[index], frame[0], force)
        return np.concatenate(values) if values else np.zeros(0)

    def _share(
        self,
        data: mujoco.MjData,
        values: list[FloatArray],
        bodies: FloatArray,
        point: FloatArray,
        normal: FloatArray,
        force: float,
    ) -> None:
        """Add the force of a contact [N] to the values of the taxels on which it presses [N].

        It acts at a point in the world [m], along the normal from the first to the second body.
        """
        for number, sensor in enumerate(self.sensors):
            body = self._body[number]
            if body not in bodies:
                continue
            turn = data.xmat[body].reshape(3, 3)
            at = (point - data.xpos[body]) @ turn
            # Out of this link's surface: towards the other body.
            out = (normal if bodies[0] == body else -normal) @ turn
            away = np.linalg.norm(sensor.position - at, axis=1) / self._spread[number]
            weights = np.exp(-0.5 * away * away) * np.maximum(sensor.normal @ out, 0.0)
            weights[away > _BEYOND] = 0.0
            total = float(weights.sum())
            if total > 0.0:
                values[number] += force / total * weights


def _spread(points: FloatArray) -> float:
    """Return the standard deviation with which taxels at some points feel a contact [m]."""
    if len(points) < 2:
        return math.inf  # the only taxel of a tip feels everything that presses on its side
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return max(_LEAST_SPREAD, _SPREAD * float(np.median(apart.min(axis=1))))


def _sensors(model: mujoco.MjModel, hand: Hand, which: str) -> tuple[TouchSensor, ...]:
    """Return the sensors that an option asks for; see `SimOptions`."""
    if which == "off":
        return ()
    if which == "hand":
        placed = [(n, taxel_count(s)) for n, s in hand.touch.items() if s.link is not None]
        return tuple(on_hand(TouchSensor(name, taxels), hand) for name, taxels in placed)
    rows, columns = map(int, which.split("x"))
    found: list[TouchSensor] = []
    for finger in hand.fingers:
        if any(sensor.link in finger.tip_links for sensor in found):
            continue
        surfaces = {link: _surface_of(model, LINK + link) for link in finger.tip_links}
        surfaces = {link: surface for link, surface in surfaces.items() if len(surface)}
        if not surfaces:
            continue
        pad = _pad(surfaces, hand, finger)
        on_pad = replace(finger, tip=pad)
        position, normal = _on_pad(surfaces[pad], hand, on_pad, (rows, columns))
        found.append(
            TouchSensor(
                f"{finger.name}_tip",
                rows * columns,
                link=pad,
                finger=finger.name,
                grid=(rows, columns),
                position=position,
                normal=normal,
            )
        )
    return tuple(found)


def _pad(surfaces: Mapping[str, FloatArray], hand: Hand, finger: Finger) -> str:
    """Return the link of a fingertip that is foremost in the closing direction of the finger.

    Its surfaces are given by link, as triangles ``(t, 3, 3)`` in the link's frame [m].
    """
    if len(surfaces) == 1:
        return next(iter(surfaces))
    poses = {link: tip_pose_and_jacobian(hand, link, hand.rest)[0] for link in surfaces}
    tip = np.linalg.inv(tip_pose_and_jacobian(hand, str(finger.tip), hand.rest)[0])
    points = {
        link: corners.reshape(-1, 3) @ (tip @ poses[link])[:3, :3].T + (tip @ poses[link])[:3, 3]
        for link, corners in surfaces.items()
    }
    towards = pad_direction(hand, finger, np.concatenate(list(points.values())).mean(axis=0))
    return max(points, key=lambda link: float((points[link] @ towards).max()))


def pad_direction(hand: Hand, finger: Finger, middle: FloatArray) -> FloatArray:
    """Return the direction in which a fingertip moves when its finger bends, in the tip's frame.

    The pad faces this way. It is a unit vector ``(3,)``, computed half-way between rest and the
    actuators' farthest positions, given the middle of the tip in its frame ``(3,)`` [m].
    """
    assert finger.tip is not None  # noqa: S101 - narrows the type
    sideways = abduction(hand, finger)
    bending = [n for n in finger.own or finger.actuators if n not in sideways]
    way = np.zeros(len(hand.actuators))
    for name in bending or finger.actuators:
        i = hand.actuator_index(name)
        far = hand.actuators[i].farthest
        way[i] = far - hand.rest[i] if math.isfinite(far) else 1.0
    pose, jacobian = tip_pose_and_jacobian(hand, finger.tip, hand.rest + 0.5 * way)
    speed = jacobian @ way
    motion = pose[:3, :3].T @ (speed[:3] + np.cross(speed[3:], pose[:3, :3] @ middle))
    length = float(np.linalg.norm(motion))
    # A tip that nothing moves has no pad, so any direction will do.
    return motion / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def _on_pad(
    corners: FloatArray, hand: Hand, finger: Finger, grid: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return the positions of a grid's taxels on a fingertip and their normals ``(n, 3)``.

    The tip's surface is given as triangles ``(t, 3, 3)`` in its frame [m], the grid as rows along
    the pad's longer side and columns along the other.
    """
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    facing = pad_direction(hand, finger, 0.5 * (low + high))
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crossed, axis=1)
    # Degenerate triangles have no normal; they are left out below.
    normals = crossed / np.maximum(areas, 1e-18)[:, None]
    pad = corners[(normals @ facing > _FACING) & (areas > 0.0)]
    pad = (pad if len(pad) else corners).reshape(-1, 3)
    along, across = _axes(pad, facing)
    flat = pad @ np.stack([along, across], axis=1)
    start, end = flat.min(axis=0), flat.max(axis=0)
    middle = 0.5 * (start + end)
    pitch = _COVERED * (end - start) / np.array(grid)
    offsets = grid_points(grid, pitch.tolist())[:, :2]
    # Rays have to begin outside the tip.
    height = float((pad @ facing).max()) + float(np.linalg.norm(high - low))
    positions, outward = np.empty((len(offsets), 3)), np.empty((len(offsets), 3))
    for number, offset in enumerate(offsets):
        for attempt in range(_TRIES):
            where = middle + _SHRUNK**attempt * offset
            begin = where[0] * along + where[1] * across + height * facing
            hit = _first_hit(corners, begin, -facing)
            if hit is not None:
                break
        else:
            # The tip has a hole in its middle: the nearest corner of the pad is used instead.
            hit = pad[np.argmin(np.linalg.norm(pad - begin, axis=1))], -1
        positions[number], triangle = hit
        normal = facing if triangle < 0 else normals[triangle]
        # The triangles of some meshes have the wrong orientation.
        outward[number] = normal if normal @ facing >= 0.0 else -normal
    return positions, outward


def _axes(points: FloatArray, facing: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the axes across a direction along which points extend most and least."""
    flat = points - np.outer(points @ facing, facing)
    _, _, axes = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    along = axes[0] - (axes[0] @ facing) * facing
    along /= np.linalg.norm(along)
    # SVD leaves the sign open; the same model must always give the same grid.
    along *= math.copysign(1.0, along[np.argmax(np.abs(along))])
    return along, np.cross(facing, along)


def _first_hit(
    corners: FloatArray, begin: FloatArray, direction: FloatArray
) -> tuple[FloatArray, int] | None:
    """Return the first point where a ray meets a triangle, and its index; ``None``: nowhere.

    The test is that of Möller and Trumbore (Fast, minimum storage ray/triangle intersection, 1997).
    """
    origin = corners[:, 0]
    first, second = corners[:, 1] - origin, corners[:, 2] - origin
    across = np.cross(direction, second)
    size = np.einsum("ij,ij->i", first, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = begin - origin
        u = np.einsum("ij,ij->i", offset, across) / size
        side = np.cross(offset, first)
        v = side @ direction / size
        far = np.einsum("ij,ij->i", second, side) / size
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (far > 0.0)
    if not inside.any():
        return None
    triangle = int(np.flatnonzero(inside)[np.argmin(far[inside])])
    return begin + far[triangle] * direction, triangle


def _surface_of(model: mujoco.MjModel, body: str) -> FloatArray:
    """Return the shapes of a body as triangles ``(t, 3, 3)`` [m] in the body's frame."""
    number = int(model.body(body).id)
    triangles = [np.zeros((0, 3, 3))]
    for geom in np.flatnonzero(model.geom_bodyid == number).tolist():
        points, faces = geom_triangles(model, geom)
        turned = points @ turn_of(model.geom_quat[geom]).T
        triangles.append((turned + model.geom_pos[geom])[faces])
    return np.concatenate(triangles)


def geom_triangles(model: mujoco.MjModel, geom: int) -> Triangles:
    """Return the triangles of a geom in its own frame [m]."""
    kind, size = solid_of(model, geom)
    if kind:
        return solid(kind, size)
    mesh = int(model.geom_dataid[geom])
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return vertices, np.array(model.mesh_face[first : first + count], dtype=np.int64)
