"""The 3D view: the measured hand, ghosts of reference and preview, object, contacts and touch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from rtee.errors import ModelError, needing_extra
from rtee.gui.bridge import Stage
from rtee.gui.colours import CONTACT, FORCE, OBJECT, PREVIEW, REFERENCE, Colour, link_colours, ramp
from rtee.hand.frames import origin, pose_in_hand, quaternion, tip_pose_and_jacobian, turn
from rtee.hand.meshes import check_mesh, unit_of
from rtee.hand.model import Hand
from rtee.hand.tessellation import Triangles, joined, solid
from rtee.hand.urdf import Urdf, UrdfGeometry, UrdfJoint
from rtee.objects.description import (
    CONTACTS,
    ObjectDescription,
    ObjectPart,
    contact_rows,
    force_arrows,
)
from rtee.sample import FloatArray
from rtee.touch import NEWTON, TouchSensor, TouchState

_UNSEEN_POSE: Final = 1e-4
"""Largest motion of the object that is not redrawn [m, and per component of the quaternion]."""

_CLEAR: Final = 0.6
"""Opacity of the object: the arrows of forces inside it stay visible."""

_SHARP: Final = 0.25
"""Smallest change of forces [N] or points [mm] that is redrawn: smaller ones would only flicker."""


class ObjectView:
    """The object at its pose relative to the hand, both taken from the channels of the states.

    ``size`` is that of the hand [m].
    """

    def __init__(self, scene: viser.SceneApi, size: float) -> None:
        self._scene, self._size = scene, size
        self._described: ObjectDescription | None = None
        self._frame: viser.FrameHandle | None = None
        self._pose = np.full(7, np.nan)
        self._arrows: viser.ArrowsHandle | None = None
        self._drawn: FloatArray = np.zeros((0, 7))

    def describe(self, description: ObjectDescription | None) -> None:
        """Draw another object, or none; it appears with the next channels."""
        if description is self._described:
            return
        if self._frame is not None:
            self._frame.remove()
            self._frame = None
        self._described = description
        self._pose = np.full(7, np.nan)
        if description is not None:
            self._frame = self._scene.add_frame("/object", show_axes=False, visible=False)
            for index, part in enumerate(description.parts):
                _add_part(self._scene, f"/object/{index}", part)

    def show(self, channels: Mapping[str, FloatArray], *, forces: bool) -> None:
        """Move the object to its pose in the channels of a state, and draw the contact forces."""
        by_kind = {name.rpartition("/")[2]: values for name, values in channels.items()}
        pose = pose_in_hand(by_kind)
        if self._frame is not None:
            self._place(self._frame, pose)
        rows = contact_rows(by_kind.get(CONTACTS, np.zeros(0))) if forces else self._drawn[:0]
        self._draw_forces(rows)

    def _place(self, frame: viser.FrameHandle, pose: FloatArray | None) -> None:
        if frame.visible != (pose is not None):
            frame.visible = pose is not None
        # The pose drawn is NaN at first, for which the comparison is false.
        if pose is None or np.abs(pose - self._pose).max() < _UNSEEN_POSE:
            return
        self._pose = pose
        frame.position, frame.wxyz = pose[:3], pose[3:]

    def _draw_forces(self, rows: FloatArray) -> None:
        drawn = self._drawn
        if rows.shape == drawn.shape:
            moved = np.abs(rows[:, :3] - drawn[:, :3]).max(initial=0.0) * 1e3
            if max(moved, np.abs(rows[:, 3:6] - drawn[:, 3:6]).max(initial=0.0)) < _SHARP:
                return
        self._drawn = rows
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None
        if len(rows):
            self._arrows = self._scene.add_arrows(
                "/forces",
                arrows_of(rows, self._size).astype(np.float32),
                FORCE,
                shaft_radius=0.008 * self._size,
                head_radius=0.02 * self._size,
                head_length=0.045 * self._size,
            )

    def summary(self, links: Sequence[str]) -> str:
        """Return the strongest drawn contacts as text; see `strongest`."""
        return strongest(self._drawn, links)

    def remove(self) -> None:
        """Remove object and forces from the scene."""
        self.describe(None)
        self._draw_forces(self._drawn[:0])


def arrows_of(rows: FloatArray, size: float) -> FloatArray:
    """Return arrows ``(k, 2, 3)`` from the contact points along the forces, see `force_arrows` [m].

    The contacts are rows of `rtee.objects.description.CONTACTS`, the size is the hand's [m].
    """
    points = rows[:, :3]
    return np.stack([points, points + size * force_arrows(rows[:, 3:6])], axis=1)


def strongest(rows: FloatArray, links: Sequence[str]) -> str:
    """Return the strongest contacts as text: ``index_tip 3.2 N, thumb_tip 3.1 N``.

    The contacts are rows of `rtee.objects.description.CONTACTS`, the links in the order of the
    URDF. The text names at most three links.
    """
    totals: dict[str, FloatArray] = {}
    for row in rows:
        index = int(row[6])
        if 0 <= index < len(links):
            totals[links[index]] = totals.get(links[index], np.zeros(3)) + row[3:6]
    forces = {name: float(np.linalg.norm(force)) for name, force in totals.items()}
    chosen = sorted(forces, key=lambda name: -forces[name])[:3]
    return ", ".join(f"{name} {forces[name]:.1f} N" for name in chosen)


def _add_part(scene: viser.SceneApi, name: str, part: ObjectPart) -> None:
    at: dict[str, Any] = {"wxyz": part.pose[3:], "position": part.pose[:3], "opacity": _CLEAR}
    if part.kind != "mesh":
        _add_solid(scene, name, part.kind, part.size, OBJECT, at)
        return
    scene.add_mesh_simple(
        name,
        part.vertices,
        part.faces,
        color=OBJECT,
        flat_shading=True,
        side="double",
        **at,
    )


def _add_solid(
    scene: viser.SceneApi,
    name: str,
    kind: str,
    dimensions: tuple[float, ...],
    colour: Colour,
    at: Mapping[str, Any],
) -> None:
    """Add a solid, given as for `rtee.hand.tessellation.solid`."""
    if kind == "box":
        w, d, h = dimensions
        scene.add_box(name, color=colour, dimensions=(w, d, h), **at)
    elif kind == "sphere":
        scene.add_icosphere(name, *dimensions, colour, **at)
    else:
        scene.add_cylinder(name, *dimensions, colour, **at)


_SHADES: Final = 32
"""Number of colours between zero and the largest value: finer steps cannot be distinguished."""

_COLOURS: Final = np.array([ramp(k / (_SHADES - 1)) for k in range(_SHADES)], dtype=np.uint8)

_STALE: Final = np.array((150, 150, 150), dtype=np.uint8)
"""Colour of taxels without fresh values: no measured value is grey."""

_LIFT: Final = 0.0006
"""Height of the points above the surface [m]: in the surface, they would flicker."""

_LEAST: Final[Mapping[str, float]] = {NEWTON: 0.5}
"""Smallest value of the brightest colour by unit, so that noise stays dark."""

_POINT: Final = 0.6
"""Size of a point as a share of the distance to the next point, so that points do not overlap."""

_ALONE: Final = 0.02
"""Size of a sensor's single taxel, as a share of the hand's size: about that of a fingertip."""

Bytes = NDArray[np.uint8]


class TaxelView:
    """The taxels of a hand's touch sensors, as coloured points on its links.

    ``size`` is that of the hand [m].
    """

    def __init__(
        self, scene: viser.SceneApi, hand: Hand, frames: Mapping[str, str], size: float
    ) -> None:
        self._scene, self._frames, self._size = scene, frames, size
        self._links = set(hand.urdf.links)
        self._sensors: dict[str, tuple[TouchSensor, ...]] = {}
        self._clouds: dict[str, viser.PointCloudHandle] = {}
        self._drawn: dict[str, Bytes] = {}
        self._most: dict[str, float] = {}

    @property
    def fingers(self) -> set[str]:
        """The fingers whose taxels are displayed."""
        placed = (
            s for sensors in self._sensors.values() for s in sensors if s.name in self._clouds
        )
        return {sensor.finger for sensor in placed if sensor.finger}

    def show(self, states: Iterable[TouchState]) -> None:
        """Colour the taxels by their values; without states, remove them."""
        states = tuple(states)
        names = [state.device for state in states]
        for device in [name for name in self._sensors if name not in names]:
            self._forget(device)
        for state in states:
            # Compare by identity: the states of one device share their tuple of sensors.
            if self._sensors.get(state.device) is not state.sensors:
                self._forget(state.device)
                self._add(state)
            for sensor in state.sensors:
                cloud = self._clouds.get(sensor.name)
                if cloud is not None:
                    self._colour(sensor, cloud, state)

    def _add(self, state: TouchState) -> None:
        self._sensors[state.device] = state.sensors
        for sensor in state.sensors:
            if sensor.placed and sensor.link in self._links:
                points = sensor.position
                if len(sensor.normal) == len(points):
                    points = points + _LIFT * sensor.normal
                self._clouds[sensor.name] = self._scene.add_point_cloud(
                    f"{self._frames[sensor.link]}/touch_{sensor.name}",
                    points.astype(np.float32),
                    np.tile(_COLOURS[0], (len(points), 1)),
                    point_size=_size(points, _ALONE * self._size),
                    point_shape="circle",
                    point_shading="flat",
                    precision="float32",
                )

    def _colour(
        self, sensor: TouchSensor, cloud: viser.PointCloudHandle, state: TouchState
    ) -> None:
        values = state.of(sensor.name)
        if state.stale:
            colours: Bytes = np.tile(_STALE, (sensor.taxels, 1))
        else:
            colours = _COLOURS[shades(values, self._brightest(sensor, values))]
        drawn = self._drawn.get(sensor.name)
        if drawn is None or not np.array_equal(colours, drawn):
            self._drawn[sensor.name] = cloud.colors = colours

    def _brightest(self, sensor: TouchSensor, values: FloatArray) -> float:
        """Return the value of the brightest colour: the largest one of its unit so far."""
        unit = sensor.unit
        largest = float(np.nanmax(values, initial=0.0))
        least = _LEAST.get(unit, 0.05 * sensor.full if math.isfinite(sensor.full) else 1.0)
        # One scale for all sensors of a unit. It never shrinks, so that released taxels turn dark.
        most = self._most[unit] = max(self._most.get(unit, least), largest)
        return most

    def _forget(self, device: str) -> None:
        for sensor in self._sensors.pop(device, ()):
            self._drawn.pop(sensor.name, None)
            cloud = self._clouds.pop(sensor.name, None)
            if cloud is not None:
                cloud.remove()

    def remove(self) -> None:
        """Remove all taxels from the scene."""
        self.show(())


def shades(values: FloatArray, most: float) -> NDArray[np.intp]:
    """Return the colour index of each value ``(n,)``; values from ``most`` on are the brightest.

    ``NaN`` counts as 0.
    """
    share = np.clip(np.nan_to_num(values) / most, 0.0, 1.0)
    return np.rint(share * (_SHADES - 1)).astype(np.intp)


def _size(points: FloatArray, alone: float) -> float:
    """Return the size of a sensor's points [m]."""
    if len(points) < 2:
        return alone
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    # The median, so that a few taxels close together do not shrink all points.
    return _POINT * float(np.median(apart.min(axis=1)))


LinkTriangles = Callable[[str], Triangles]
"""Returns a link's vertices ``(v, 3)`` [m] in the link's frame, and its faces ``(f, 3)``."""

_COAL_ONLY: Final = (".3ds", ".fbx")
"""Mesh formats that trimesh does not read."""


def link_triangles(hand: Hand) -> LinkTriangles:
    """Return a function that returns the triangles of a link's collision shapes.

    Both functions raise `ModelError` if a mesh is missing or cannot be read. This one raises
    `MissingExtra` if a mesh has a format that only Coal reads, and Coal is not installed.
    """
    shapes = (shape for link in hand.urdf.links.values() for shape in link.collisions)
    formats = {Path(shape.mesh).suffix.lower() for shape in shapes if shape.kind == "mesh"}
    for unread in formats.intersection(_COAL_ONLY):
        with needing_extra(f"a mesh in the format {unread}", "extract"):
            from rtee.hand.geometry import HandGeometry
        return HandGeometry(hand).triangles

    @cache
    def triangles(link: str) -> Triangles:
        shapes = hand.urdf.links[link].collisions
        return joined((_of_shape(hand, each), origin(each.xyz, each.rpy)) for each in shapes)

    return triangles


def _of_shape(hand: Hand, shape: UrdfGeometry) -> Triangles:
    if shape.kind != "mesh":
        return solid(shape.kind, shape.dimensions)
    path = check_mesh(shape, hand.urdf, hand.package_dirs)
    try:
        # Unprocessed, since merging vertices takes seconds and makes no visible difference.
        mesh = trimesh.load_mesh(str(path), process=False)
        points, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # each reader of trimesh raises its own exceptions
        raise _refusal(hand, shape, f"cannot be read: {error}") from error
    if not len(faces):
        raise _refusal(hand, shape, "has no triangles")
    if not np.isfinite(points).all():
        raise _refusal(hand, shape, "has a vertex that is not finite")
    return points * (unit_of(path) * np.array(shape.scale)), faces


def _refusal(hand: Hand, shape: UrdfGeometry, why: str) -> ModelError:
    return ModelError(f"mesh '{shape.mesh}' {why}", path=hand.urdf.path, line=shape.line)


_UNSEEN = 1e-4
"""Largest motion of a joint that is not sent [rad | m]: it would be invisible on the screen."""


class HandBody:
    """A hand in the scene, measured or a ghost; ``frames`` has the name of each link's frame."""

    def __init__(
        self,
        scene: viser.SceneApi,
        root: str,
        hand: Hand,
        triangles: LinkTriangles,
        colours: Mapping[str, Colour],
        *,
        opacity: float | None = None,
        visible: bool = True,
    ) -> None:
        """Build the tree of frames below a root frame; a body without an opacity is solid."""
        self.root = root
        self._scene = scene
        self._opacity = opacity
        self._frame = scene.add_frame(root, show_axes=False, visible=visible)
        self._moving: list[tuple[viser.FrameHandle, FloatArray, bool]] = []
        self._last = np.full(len(hand.joints), np.nan)
        self.frames: dict[str, str] = {}
        self._build(hand, triangles, colours)

    def _build(self, hand: Hand, triangles: LinkTriangles, colours: Mapping[str, Colour]) -> None:
        urdf = hand.urdf
        below: dict[str, list[UrdfJoint]] = {}
        for joint in urdf.joints.values():
            below.setdefault(joint.parent, []).append(joint)
        frames: dict[str, tuple[viser.FrameHandle, FloatArray, bool]] = {}
        pending = [(urdf.root, self.root)]
        while pending:
            link, path = pending.pop()
            self.frames[link] = path
            self._add_shapes(urdf, link, path, triangles, colours[link])
            for joint in below.get(link, ()):
                place = f"{path}/{joint.name}"
                self._scene.add_frame(
                    place, show_axes=False, wxyz=quaternion(joint.rpy), position=joint.xyz
                )
                if joint.moving:
                    place = f"{place}/q"  # the frame that moves, below the fixed one of the joint
                    frame = self._scene.add_frame(place, show_axes=False)
                    frames[joint.name] = (frame, np.array(joint.axis), joint.kind == "prismatic")
                pending.append((joint.child, place))
        self._moving = [frames[name] for name in hand.joint_names]

    def _add_shapes(
        self, urdf: Urdf, link: str, path: str, triangles: LinkTriangles, colour: Colour
    ) -> None:
        scene, shapes = self._scene, urdf.links[link].collisions
        look: dict[str, Any] = {"opacity": self._opacity, "cast_shadow": self._opacity is None}
        # The browser draws simple shapes from their sizes; only meshes are sent as triangles.
        if any(shape.kind == "mesh" for shape in shapes):
            vertices, faces = triangles(link)
            scene.add_mesh_simple(
                f"{path}/mesh",
                np.asarray(vertices, dtype=np.float32),
                np.asarray(faces, dtype=np.uint32),
                color=colour,
                flat_shading=True,
                side="double",
                **look,
            )
            return
        for index, shape in enumerate(shapes):
            at = {"wxyz": quaternion(shape.rpy), "position": shape.xyz, **look}
            _add_solid(scene, f"{path}/shape{index}", shape.kind, shape.dimensions, colour, at)

    @property
    def visible(self) -> bool:
        """Whether the body is visible."""
        return bool(self._frame.visible)

    @visible.setter
    def visible(self, shown: bool) -> None:
        # viser sends each assignment to every window.
        if shown != self._frame.visible:
            self._frame.visible = shown

    def moved(self, position: FloatArray) -> list[int]:
        """Return the indices of joints that would visibly move to positions ``(m,)`` [rad | m]."""
        # "Not less", so that NaN, the value before the first drawing, counts as a motion.
        seen = np.isfinite(position) & ~(np.abs(position - self._last) < _UNSEEN)
        return np.flatnonzero(seen).tolist()

    def set_joints(self, position: FloatArray) -> None:
        """Move to joint positions ``(m,)`` [rad | m]; send only joints that visibly move."""
        for index in self.moved(position):
            frame, axis, slides = self._moving[index]
            # The position last sent, not last measured: a slow motion adds up until it is visible.
            value = self._last[index] = float(position[index])
            if slides:
                frame.position = value * axis
            else:
                frame.wxyz = turn(axis, value)

    def remove(self) -> None:
        """Remove the body from the scene."""
        self._frame.remove()


Contact = tuple[tuple[float, float, float], tuple[float, float, float]]
"""A contact point [m] and its unit normal in the base frame."""

_WHOLE = 1.3
"""Aspect ratio, width by height, below which the camera backs off to see the whole hand."""

_FARTHEST = 2.0
"""Largest factor by which the camera backs off: on narrower pages, panels fold."""

_GHOST = 0.35
"""Opacity of a ghost: the hand stays visible through it."""


class HandScene:
    """The hand in the 3D view, with the object, the contact forces and the hand's taxels."""

    def __init__(self, stage: Stage, hand: Hand) -> None:
        """Add a hand to the scene and aim the camera at it."""
        self.hand = hand
        self._stage = stage
        scene = stage.scene
        self._triangles = link_triangles(hand)
        ghost = dict.fromkeys(hand.urdf.links, REFERENCE)
        preview = dict.fromkeys(hand.urdf.links, PREVIEW)
        scene.set_up_direction("+z")
        # Without a graphics card, shadows would cost most of the frame rate.
        scene.configure_default_lights(cast_shadow=False)
        self._body = HandBody(scene, "/hand", hand, self._triangles, link_colours(hand))
        self._reference = HandBody(
            scene, "/reference", hand, self._triangles, ghost, opacity=_GHOST, visible=False
        )
        self._preview = HandBody(
            scene, "/preview", hand, self._triangles, preview, opacity=_GHOST, visible=False
        )
        rest = hand.transmission.joints(hand.rest)
        for body in (self._body, self._reference, self._preview):
            body.set_joints(rest)
        self._contacts: list[viser.IcosphereHandle | viser.ArrowsHandle] = []
        self._pressures: dict[str, viser.IcosphereHandle] = {}
        self._labels: dict[str, viser.LabelHandle] = {}
        self._size = self._aim()
        self.seen = ObjectView(scene, self._size)
        self.taxels = TaxelView(scene, hand, self._body.frames, self._size)

    def _aim(self) -> float:
        """Aim the camera at the hand, and return the hand's size [m]."""
        points = []
        for name, link in self.hand.urdf.links.items():
            if link.collisions:
                pose, _ = tip_pose_and_jacobian(self.hand, name, self.hand.rest)
                points.append(self._triangles(name)[0] @ pose[:3, :3].T + pose[:3, 3])
        cloud = np.concatenate(points) if points else np.zeros((1, 3))
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        size = max(float(np.linalg.norm(high - low)), 0.05)  # a model may have no shapes
        middle = 0.5 * (low + high)
        stage = self._stage
        window = isinstance(stage, viser.ClientHandle)
        camera = stage.camera if window else stage.initial_camera
        # A window that is taller than wide shows less to the sides.
        far = size * min(max(1.0, _WHOLE / stage.camera.aspect if window else 1.0), _FARTHEST)
        camera.position = tuple(middle + far * self._side(middle))
        camera.look_at = tuple(middle)
        # In proportion to the hand, so that a close view of a small hand is not clipped.
        camera.near = 0.01 * size
        self._stage.scene.add_grid(
            "/floor",
            width=4.0 * size,
            height=4.0 * size,
            cell_size=0.02 if size < 1.0 else 0.2,
            section_size=0.1 if size < 1.0 else 1.0,
            cell_color=(190, 194, 200),  # visible on light and on dark pages
            section_color=(150, 156, 164),
            position=(float(middle[0]), float(middle[1]), float(low[2])),
            plane="xy",
        )
        return size

    def _side(self, middle: FloatArray) -> FloatArray:
        """Return the unit vector from the hand to a camera that sees the grasp."""
        hand = self.hand
        tips = [finger.tip for finger in hand.fingers if finger.tip is not None]
        if len(tips) < 2:
            return np.array([0.68, 0.59, 0.43])
        reach = np.clip(
            [(a.lower, a.upper) for a in hand.actuators] - hand.rest[:, None], -1.5, 1.5
        )
        closed = hand.rest + np.where(-reach[:, 0] > reach[:, 1], *reach.T)
        at_rest, closing = (
            np.array([tip_pose_and_jacobian(hand, tip, where)[0][:3, 3] for tip in tips])
            for where in (hand.rest, closed)
        )
        centre = at_rest.mean(axis=0)
        # The finger farthest from all others closes against them: the thumb, if there is one.
        apart = at_rest[np.argmax(np.linalg.norm(at_rest - centre, axis=1))] - centre
        apart /= max(float(np.linalg.norm(apart)), 1e-6)
        side = np.cross(centre - middle, apart)
        side /= max(float(np.linalg.norm(side)), 1e-6)
        # Fingers bend towards the palm; look from there, not from the back or from below.
        bends = float(side @ (closing - at_rest).mean(axis=0))
        side *= np.sign(bends if abs(bends) > 1e-3 else side @ (0.1, 0.2, 1.0))
        view = side + 0.5 * apart + (0.0, 0.0, 0.35)
        view[2] = max(view[2], 0.25)
        unit: FloatArray = view / np.linalg.norm(view)
        return unit

    def show(self, position: FloatArray) -> None:
        """Show measured joint positions ``(m,)`` [rad | m]."""
        if self._body.moved(position):
            with self._stage.atomic():
                self._body.set_joints(position)

    def show_reference(self, actuators: FloatArray | None) -> None:
        """Show the reference, actuator positions ``(n,)``, as a ghost; ``None`` hides it."""
        self._ghost(self._reference, actuators)

    def show_preview(self, actuators: FloatArray | None) -> None:
        """Show the target of an action, actuator positions ``(n,)``; ``None`` hides it."""
        self._ghost(self._preview, actuators)

    def _ghost(self, body: HandBody, actuators: FloatArray | None) -> None:
        if actuators is None or not np.isfinite(actuators).all():
            body.visible = False
            return
        body.set_joints(self.hand.transmission.joints(actuators))
        body.visible = True

    def show_fingers(self, said: Mapping[str, str]) -> None:
        """Write a text at each fingertip, given by finger name; clear those of other fingers."""
        for number, finger in enumerate(self.hand.fingers):
            text, label = said.get(finger.name, ""), self._labels.get(finger.name)
            if label is None and text:
                # Below the link's frame, so that it moves with the link.
                place = f"{self._body.frames[finger.tip or finger.body[-1]]}/label"
                # Alternately to the left and the right, so that neighbours overlap less.
                label = self._stage.scene.add_label(
                    place,
                    text,
                    font_screen_scale=0.85,
                    anchor="bottom-left" if number % 2 else "bottom-right",
                )
                self._labels[finger.name] = label
            if label is not None and (label.text, label.visible) != (text, bool(text)):
                label.text, label.visible = text, bool(text)

    def show_contacts(self, contacts: Sequence[Contact]) -> None:
        """Mark contact points with their normals [m], in the hand's base frame."""
        for handle in self._contacts:
            handle.remove()
        self._contacts.clear()
        radius = 0.015 * self._size
        for index, (point, normal) in enumerate(contacts):
            where = np.array(point)
            reach = np.array(normal) * 0.12 * self._size
            self._contacts.append(
                self._stage.scene.add_icosphere(
                    f"/contacts/{index}/point", radius, CONTACT, position=tuple(where)
                )
            )
            self._contacts.append(
                self._stage.scene.add_arrows(
                    f"/contacts/{index}/normal",
                    np.array([[where - reach, where], [where + reach, where]], dtype=np.float32),
                    CONTACT,
                    shaft_radius=0.004 * self._size,
                    head_radius=0.012 * self._size,
                    head_length=0.03 * self._size,
                )
            )

    def show_pressure(self, share: Mapping[str, float]) -> None:
        """Show pressures as spheres at the tips, given by finger name as a share of the largest."""
        for finger in self.hand.fingers:
            handle = self._pressures.get(finger.name)
            if finger.tip is None or (handle is None and finger.name not in share):
                continue
            strength = min(max(share.get(finger.name, 0.0), 0.0), 1.0)
            if handle is None:
                handle = self._stage.scene.add_icosphere(
                    f"{self._body.frames[finger.tip]}/pressure",
                    0.04 * self._size,
                    ramp(strength),
                    opacity=0.6,
                )
                self._pressures[finger.name] = handle
            handle.color = ramp(strength)
            handle.visible = strength > 0.01

    def remove(self) -> None:
        """Remove everything of this hand from the scene."""
        self.show_contacts(())
        self.seen.remove()
        self.taxels.remove()
        for body in (self._body, self._reference, self._preview):
            body.remove()
