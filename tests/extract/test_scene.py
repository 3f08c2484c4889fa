from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from extract.models import Model, box, mesh, sphere
from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
from rtee.extract.space import make_space, real_limits
from rtee.extract.surface import winding_number
from rtee.hand.load import load_hand
from rtee.hand.tessellation import box as box_triangles
from rtee.hand.tessellation import sphere as sphere_triangles


def write_stl(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    records = [struct.pack("<12fH", 0, 0, 0, *vertices[face].ravel(), 0) for face in faces]
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(records)) + b"".join(records))
    return path


def slider(folder: Path, fixed: tuple[str, ...], moving: tuple[str, ...]) -> Scene:
    """Return a scene with one link that stands and one that slides along x."""
    model = Model().link("fixed", *fixed).joint("hold", "base", "fixed", kind="fixed")
    model.link("moving", *moving)
    model.joint("slide", "base", "moving", kind="prismatic", axis=(1, 0, 0), limits=(-1, 1))
    return Scene(model.finger("a", "fixed").finger("b", "moving").load(folder))


def at(scene: Scene, x: float) -> LinkPair:
    scene.place(np.array([x]))
    return scene.pairs["fixed", "moving"]


@pytest.mark.parametrize("name", ["schunk_svh", "heri_ii", "robotiq_3f"])
@pytest.mark.parametrize("turned", [False, True])
def test_the_slope_is_the_derivative_of_the_distance(name: str, turned: bool) -> None:
    hand = load_hand(name)
    scene = Scene(hand)
    random = np.random.default_rng(0)
    step = 1e-6
    for pair in list(scene.tips.values())[:4]:
        tips = pair.reversed() if turned else pair
        space = make_space(hand, sorted(tips.actuators), real_limits(hand))
        good = 0
        for y in random.uniform(0.05, 0.95, (6, space.size)):
            scene.place(space.posture(y))
            slope = scene.derivative(tips, space)
            measured = []
            for direction in np.eye(space.size):
                values = []
                for s in (-step, step):
                    scene.place(space.posture(y + s * direction))
                    values.append(scene.distance(tips))
                measured.append((values[1] - values[0]) / (2 * step))
            good += bool(np.abs(slope - measured).max() < 1e-4)
        assert good >= 4  # some points lie at kinks


def test_turning_a_pair_turns_its_witness() -> None:
    scene = Scene(load_hand("schunk_svh"))
    pair = next(iter(scene.tips.values()))
    there, back = scene.witness(pair), scene.witness(pair.reversed())
    np.testing.assert_array_equal(there.first, back.second)
    np.testing.assert_array_equal(there.normal, -back.normal)


def test_distances_do_not_depend_on_what_was_asked_before() -> None:
    hand = load_hand("schunk_svh")
    scene = Scene(hand)
    postures = np.random.default_rng(0).uniform(hand.lower, hand.upper, (60, len(hand.rest)))

    def ask(order: range) -> np.ndarray:
        found = np.zeros((60, len(scene.tips)))
        for i in order:
            scene.place(postures[i])
            found[i] = [scene.distance(pair) for pair in scene.tips.values()]
        return found

    np.testing.assert_array_equal(ask(range(60)), ask(range(59, -1, -1)))


def test_the_nearest_of_several_shapes_counts(tmp_path: Path) -> None:
    scene = slider(
        tmp_path, (sphere(0.1), sphere(0.1, (0.5, 0, 0))), (sphere(0.1, (1, 0, 0)), sphere(0.05))
    )
    assert scene.distance(at(scene, 0.4)) == pytest.approx(-0.05)
    pair = at(scene, 0.25)
    assert scene.distance(pair) == pytest.approx(0.1)
    assert scene.exact_distance(pair) == pytest.approx(0.1)
    assert not scene.touching(pair)


def test_depth_is_the_shortest_way_apart(tmp_path: Path) -> None:
    scene = slider(tmp_path, (box((1, 0.2, 1)),), (box((1, 0.2, 1)),))
    pair = at(scene, 0.5)
    assert scene.distance(pair) == pytest.approx(-0.2, abs=1e-6)
    witness = scene.witness(pair)
    assert abs(witness.normal[1]) == pytest.approx(1.0)


def u_shape(folder: Path) -> Path:
    """Return a mesh like a U that opens towards -x: three bars."""
    parts = [
        ((0.1, 0.5, 0.1), (0.2, 0, 0)),
        ((0.5, 0.1, 0.1), (0, 0.2, 0)),
        ((0.5, 0.1, 0.1), (0, -0.2, 0)),
    ]
    vertices, faces, count = [], [], 0
    for size, offset in parts:
        points, triangles = box_triangles(size)
        vertices.append(points + offset)
        faces.append(triangles + count)
        count += len(points)
    return write_stl(folder / "u.stl", np.concatenate(vertices), np.concatenate(faces))


def test_contact_is_decided_on_the_mesh_and_not_on_its_hull(tmp_path: Path) -> None:
    scene = slider(tmp_path, (mesh(u_shape(tmp_path)),), (box((0.1, 0.1, 0.1)),))
    inside = at(scene, 0.0)
    assert scene.distance(inside) < -0.05
    assert not scene.touching(inside)
    assert scene.exact_distance(inside) == pytest.approx(0.1, abs=1e-6)
    assert scene.touching(at(scene, 0.12))


def test_the_exact_slope_leads_to_contact(tmp_path: Path) -> None:
    scene = slider(tmp_path, (mesh(u_shape(tmp_path)),), (box((0.1, 0.02, 0.1)),))
    space = make_space(scene.hand, [0], real_limits(scene.hand))
    distance, slope = scene.exact_slope(at(scene, 0.05), space)
    assert distance == pytest.approx(0.05, abs=1e-6)
    assert slope[0] == pytest.approx(-2.0, abs=1e-6)  # the coordinate spans 2 m


@pytest.mark.parametrize("swapped", [False, True])
def test_a_shape_within_a_mesh_touches_it(tmp_path: Path, swapped: bool) -> None:
    ball = mesh(write_stl(tmp_path / "ball.stl", *sphere_triangles(0.3)))
    small = sphere(0.02)
    scene = slider(tmp_path, *((small,), (ball,)) if swapped else ((ball,), (small,)))
    assert scene.touching(at(scene, 0.0))
    assert scene.touching(at(scene, 0.2))
    assert not scene.touching(at(scene, 0.4))


def test_the_winding_number_tells_inside_from_outside() -> None:
    vertices, faces = sphere_triangles(1.0)
    assert winding_number(np.array([0.3, 0.2, 0.1]), vertices, faces) == pytest.approx(1.0)
    assert winding_number(np.array([1.3, 0.2, 0.1]), vertices, faces) == pytest.approx(0.0)


def test_links_of_one_body_are_no_pair(tmp_path: Path) -> None:
    model = Model().link("a", sphere(0.1)).joint("turn", "base", "a")
    model.link("b", sphere(0.1)).joint("hold", "a", "b", kind="fixed", xyz=(0.1, 0, 0))
    scene = Scene(model.finger("a", "a").finger("b", "b", base="a").load(tmp_path))
    assert scene.pair("a", "b") is None
    assert scene.tips == {}
