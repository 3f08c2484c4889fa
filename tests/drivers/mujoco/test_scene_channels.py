"""What is seen of a simulation besides the hand: the object as it is, and forces that add up."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco
import trimesh

from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.frames import pose_in_hand, pose_matrix
from rtee.hand.load import load_hand
from rtee.messages.convert import OBJECT
from rtee.objects.description import BASE_POSE, CONTACTS, MOST_CONTACTS, OBJECT_POSE, contact_rows
from rtee.planning.objects import read_object

GRIPPER = "robotiq_2f_85"
PERIOD = 0.005


def simulated(**options: object) -> Simulation:
    hand = load_hand(GRIPPER)
    return make_simulation(hand, SimOptions(**options), hand.actuator_names, PERIOD)


def squeezed(**options: object) -> Simulation:
    simulation = simulated(**options)
    for _ in range(400):
        simulation.command(np.array([0.8]), np.array([5.0]), np.array([True]))
        simulation.advance()
    return simulation


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("sphere:0.03", [("sphere", (0.03,))]),
        ("cylinder:0.02x0.1", [("cylinder", (0.02, 0.1))]),
        ("box:0.02x0.03x0.1", [("box", (0.02, 0.03, 0.1))]),
    ],
)
def test_a_shape_is_described_as_it_was_asked(
    text: str, parts: list[tuple[str, tuple[float, ...]]]
) -> None:
    obj = simulated(object=text, object_mass=0.25).object_description
    assert obj is not None
    assert (obj.name, obj.mass) == (text, pytest.approx(0.25))
    assert [part.kind for part in obj.parts] == [kind for kind, _ in parts]
    assert obj.parts[0].size == pytest.approx(parts[0][1])
    assert obj.parts[0].pose == pytest.approx([0, 0, 0, 1, 0, 0, 0])


def test_without_an_object_there_is_none() -> None:
    simulation = simulated()
    assert simulation.object_description is None
    assert OBJECT_POSE not in simulation.scene_channels


def test_a_mesh_is_described_where_its_file_puts_it(tmp_path: Path) -> None:
    """MuJoCo moves a mesh to its centre of mass; its description must not."""
    mesh = trimesh.creation.cone(radius=0.02, height=0.05)
    mesh.apply_translation([0.01, 0.02, 0.0])
    mesh.export(tmp_path / "cone.stl")
    obj = simulated(object=str(tmp_path / "cone.stl")).object_description
    assert obj is not None
    assert obj.name == "cone.stl", "the folder is nobody's business"
    (part,) = OBJECT.decode(OBJECT.encode(obj)).parts
    pose = pose_matrix(part.pose)
    corners = part.vertices[part.faces].reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    assert corners.min(axis=0) == pytest.approx(mesh.bounds[0], abs=1e-5)
    assert corners.max(axis=0) == pytest.approx(mesh.bounds[1], abs=1e-5)


def test_the_parts_of_a_mesh_are_solids_of_their_own(repository: Path) -> None:
    """What is between a mug and its handle stays free, as the planner has it."""
    file = str(repository / "experiments/objects/mug.stl")
    simulation = simulated(object=file, object_mass=0.3)
    obj = simulation.object_description
    assert obj is not None
    assert obj.mass == pytest.approx(0.3)
    assert not [note for note in simulation.notes if "mug.stl" in note]
    corners = [part.vertices @ pose_matrix(part.pose)[:3, :3].T for part in obj.parts]
    sizes = [np.ptp(points, axis=0) for points in corners]
    wanted = [np.ptp(piece.points, axis=0) for piece in read_object(file).pieces]
    assert np.sort(sizes, axis=0) == pytest.approx(np.sort(wanted, axis=0), abs=1e-4)


def test_an_open_mesh_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "coacd", None)  # which would divide what has hollows
    mesh = trimesh.creation.box((0.03, 0.03, 0.03))
    mesh.export(tmp_path / "closed.stl")
    trimesh.Trimesh(mesh.vertices, mesh.faces[1:]).export(tmp_path / "open.stl")
    beside = mesh.copy().apply_translation((0.03, 0.03, 0.0))
    trimesh.util.concatenate([mesh, beside]).export(tmp_path / "corner.stl")
    notes = {
        name: [note for note in simulated(object=str(tmp_path / name)).notes if name in note]
        for name in ("closed.stl", "open.stl", "corner.stl")
    }
    assert notes["closed.stl"] == []
    assert "its convex hull: hollows, handles and holes are filled" in notes["corner.stl"][-1]
    (note,) = notes["open.stl"]
    assert note.startswith("open.stl: the mesh is open, 3 of its edges have only one face; ")


@pytest.mark.heavy
def test_a_mesh_with_too_many_triangles_is_described_by_its_hull(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "coacd", None)  # which would divide it
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=0.02)
    assert len(mesh.faces) > 20_000
    # A dent, so that the hull has fewer triangles than the mesh.
    below = mesh.vertices[:, 2] < 0.0
    mesh.vertices[below, 2] *= 0.1
    mesh.vertices[:, :2] *= np.where(mesh.vertices[:, 2:] > 0.01, 0.5, 1.0)
    mesh.export(tmp_path / "ball.stl")
    obj = simulated(object=str(tmp_path / "ball.stl")).object_description
    assert obj is not None
    (part,) = obj.parts
    assert 0 < len(part.faces) <= 20_000
    corners = part.vertices[np.unique(part.faces)] @ pose_matrix(part.pose)[:3, :3].T
    assert np.ptp(corners, axis=0) == pytest.approx(np.ptp(mesh.vertices, axis=0), abs=1e-4)


def test_a_drill_has_a_handle_a_motor_and_a_trigger() -> None:
    obj = simulated(object="drill").object_description
    assert obj is not None
    handle, _, _, motor, trigger = obj.parts  # the handle has a round edge on either side
    assert motor.pose[2] > handle.pose[2]
    assert trigger.pose[1] > 0.02


def test_a_capsule_is_a_cylinder_between_two_balls() -> None:
    obj = simulated(object="capsule:0.01x0.06", object_mass=0.2).object_description
    assert obj.name == "capsule:0.01x0.06"
    assert obj.mass == pytest.approx(0.2)
    tube, low, high = obj.parts
    assert (tube.kind, tube.size) == ("cylinder", pytest.approx((0.01, 0.04)))
    assert [(end.kind, end.size) for end in (low, high)] == [("sphere", (0.01,))] * 2
    assert [end.pose[2] for end in (low, high)] == pytest.approx([-0.02, 0.02])


def test_contact_forces_are_on_the_object_from_both_sides_and_carry_it() -> None:
    simulation = squeezed(object="box:0.04x0.04x0.1", object_mass=0.3)
    assert simulation.surroundings.unsupported
    rows = contact_rows(simulation.scene_channels[CONTACTS])
    assert 2 <= len(rows) <= MOST_CONTACTS
    links = list(load_hand(GRIPPER).urdf.links)
    sides = {links[int(row[6])] for row in rows}
    assert len(sides) >= 2
    strength = np.linalg.norm(rows[:, 3:6], axis=1)
    assert (np.diff(strength) <= 1e-9).all(), "the strongest first"
    # They press towards the object's middle, and together carry its weight.
    pose = pose_in_hand(simulation.scene_channels)
    assert pose is not None
    strong = rows[strength > 1.0]
    assert ((pose[:3] - strong[:, :3]) * strong[:, 3:6]).sum() > 0.0
    assert rows[:, 3:6].sum(axis=0) == pytest.approx([0.0, 0.0, 0.3 * 9.81], abs=0.3)
    # The fingertips feel how they are pressed, and not the weight along their surface.
    # The fingertips feel the part across the surface alone.
    normal, force = 0.0, np.zeros(6)
    for number in range(simulation.data.ncon):
        mujoco.mj_contactForce(simulation.model, simulation.data, number, force)
        normal += force[0]
    assert simulation.contact_forces == pytest.approx([0.5 * normal] * 2, rel=0.01)


def test_contacts_are_renewed_thirty_times_a_second_at_most() -> None:
    simulation = simulated(object="sphere:0.03")
    seen = []
    for _ in range(200):
        simulation.advance()
        seen.append(simulation.scene_channels[CONTACTS])
    renewed = sum(one is not other for one, other in pairwise(seen))
    assert renewed <= 30 * 200 * PERIOD


def test_a_carried_hand_says_where_it_is() -> None:
    simulation = squeezed(object="sphere:0.025", carrier="arm")
    before = pose_in_hand(simulation.scene_channels)
    base = simulation.scene_channels[BASE_POSE]
    lift = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    for _ in range(400):
        simulation.surroundings.carry(lift)
        simulation.advance()
    after = pose_in_hand(simulation.scene_channels)
    assert simulation.scene_channels[BASE_POSE][2] - base[2] == pytest.approx(0.1, abs=0.01)
    assert before is not None
    assert after is not None
    assert after[:3] == pytest.approx(before[:3], abs=0.02), "it came along"
