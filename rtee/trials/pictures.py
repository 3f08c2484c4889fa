"""Pictures of a simulated hand with the object and the table, and strips of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtee.drivers.mujoco.objects import OBJECT
from rtee.drivers.mujoco.simulation import Simulation
from rtee.drivers.mujoco.surroundings import TABLE
from rtee.drivers.mujoco.taxels import geom_triangles
from rtee.hand.frames import homogeneous
from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.render.camera import choose_view, fit_camera
from rtee.render.hand import link_colours
from rtee.render.image import encode, linear_rgb
from rtee.render.mesh import HandMesh, Mesh
from rtee.render.raycast import RayCaster, check_pictures
from rtee.render.renderer import Renderer, Shading
from rtee.render.strip import SIZE
from rtee.render.strip import write_strip as write_strip
from rtee.sample import FloatArray
from rtee.trials.headless import HeadlessHand

_TABLE_COLOUR = "#c9ccd1"
_REACH = np.array([[0.0, 0.0, -0.03], [0.0, 0.0, 0.04]])
"""Paths of the hand in a trial, relative to its start."""


class SimulationRenderer:
    """Renders one simulation, always from the same place."""

    def __init__(
        self,
        simulation: Simulation,
        hand: Hand,
        reach: FloatArray,
        size: tuple[int, int] = SIZE,
        back: FloatArray | None = None,
    ) -> None:
        """Set the camera up.

        Args:
            simulation: The simulation in view.
            hand: The hand in it.
            reach: Displacements ``(k, 3)`` [m] that the hand will make from its present place and
                that must fit into the picture.
            size: Width and height [pixels].
            back: Vector ``(3,)`` in the world from the scene towards the camera; by default from
                above, where the closing is seen well.

        Raises:
            MissingExtra: if the extra ``plot`` is not installed.
        """
        check_pictures()
        self.simulation = simulation
        self._hand = hand
        self._mesh = HandMesh(HandGeometry(hand, visual=True))
        self._extras = self._find_extras()
        self._up = np.array([0.0, 0.0, 1.0])
        if back is None:
            turn = simulation.surroundings.base_pose[:3, :3]
            back = turn @ choose_view(self._mesh.geometry)[0]
            # Never from below, where the table would hide everything.
            back[2] = abs(back[2])
        table = [i for i, (geom, *_) in enumerate(self._extras) if self._is_table(geom)]
        # The table is much wider than the hand, which would be small beside all of it.
        mesh = self._posed(leave_out=table)
        points = mesh.corners.reshape(-1, 3)
        points = np.concatenate([points, *(points + way for way in reach)])
        self._camera = fit_camera(points, back / np.linalg.norm(back), self._up, size)
        extent = float(np.linalg.norm(np.ptp(mesh.corners.reshape(-1, 3), axis=0)))
        self._shading = Shading.studio(self._colours(), self._camera, self._up, extent)

    def picture(self) -> bytes:
        """Return a PNG picture of the present state."""
        picture = Renderer(RayCaster(self._posed()), self._camera, self._shading).render()
        return encode(picture, "#ffffff", self._camera, (), "PNG")

    def _is_table(self, geom: int) -> bool:
        return bool(self.simulation.model.geom(geom).name == TABLE)

    def _find_extras(self) -> list[tuple[int, Mesh]]:
        model = self.simulation.model
        found: list[tuple[int, Mesh]] = []
        for geom in range(model.ngeom):
            name = model.geom(geom).name
            if name.startswith((OBJECT, TABLE)):
                link = len(self._mesh.links) + len(found)
                found.append((geom, Mesh.of(geom_triangles(model, geom), link)))
        return found

    def _posed(self, leave_out: Sequence[int] = ()) -> Mesh:
        simulation = self.simulation
        hand = self._mesh.at(simulation.hand_position)
        meshes = [hand.placed(simulation.surroundings.base_pose)]
        for index, (geom, mesh) in enumerate(self._extras):
            if index not in leave_out:
                turn = simulation.data.geom_xmat[geom].reshape(3, 3)
                meshes.append(mesh.placed(homogeneous(turn, simulation.data.geom_xpos[geom])))
        return Mesh.joined(meshes)

    def _colours(self) -> FloatArray:
        rows = [*link_colours(self._hand, self._mesh.links)]
        for geom, *_ in self._extras:
            rgba = self.simulation.model.geom_rgba[geom][:3]
            code = "#" + "".join(f"{round(255 * float(v)):02x}" for v in rgba)
            rows.append(linear_rgb(_TABLE_COLOUR if self._is_table(geom) else code))
        return np.array(rows)


class Stills:
    """Pictures of the moments of a trial; pass it as ``watch``.

    A further try replaces the previous one. All pictures of one try show the same section.

    Attributes:
        taken: The moments' names and PNG pictures.
    """

    def __init__(self, hand: Hand, reach: FloatArray, back: FloatArray | None = None) -> None:
        """Start without pictures.

        Args:
            hand: The hand.
            reach: Displacements ``(k, 3)`` [m] that the hand will make from its first place.
            back: Vector ``(3,)`` in the world towards the camera; see `SimulationRenderer`.
        """
        self.taken: list[tuple[str, bytes]] = []
        self._hand = hand
        self._reach, self._back = reach, back
        self._renderer: SimulationRenderer | None = None

    @classmethod
    def of_trial(cls, hand: Hand, back: FloatArray | None = None) -> Stills:
        """Return the recorder of a trial's pictures."""
        return cls(hand, _REACH, back)

    def __call__(self, moment: str, headless: HeadlessHand[Simulation]) -> None:
        """Take a picture."""
        if moment == "start":
            self.taken.clear()
        simulation = headless.simulation
        if self._renderer is None or self._renderer.simulation is not simulation:
            self._renderer = SimulationRenderer(
                simulation, self._hand, self._reach, back=self._back
            )
        self.taken.append((moment, self._renderer.picture()))
