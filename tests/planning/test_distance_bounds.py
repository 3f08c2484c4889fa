"""Distances that planning does not measure, against all of them measured."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import coal
import numpy as np
import pytest

from rtee.hand.load import load_hand
from rtee.hand.tessellation import box, cylinder
from rtee.planning.distance_bounds import DistanceBounds
from rtee.planning.objects import GraspObject, hull_piece, read_object
from rtee.planning.postures import HandPose, HandPoses
from rtee.planning.scene import TOUCH, GraspScene
from rtee.sample import FloatArray

ROOT = Path(__file__).parents[2]
HAND = load_hand(ROOT / "config/leap_hand")


def _hammer() -> GraspObject:
    """A handle and a head: two pieces, side by side."""
    handle, head = cylinder(0.012, 0.16)[0], box((0.03, 0.03, 0.09))[0]
    turned = head[:, [2, 1, 0]] + np.array([0.0, 0.0, 0.09])
    return GraspObject("hammer", (hull_piece(handle), hull_piece(turned)), 0.3)


THINGS = {"sphere": read_object("sphere:0.03"), "hammer": _hammer()}


def _pose(draw: np.random.Generator) -> FloatArray:
    pose = np.eye(4)
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
    pose[:3, 3] = draw.uniform(-0.08, 0.08, 3)
    return pose


def _postures(draw: np.random.Generator, count: int) -> FloatArray:
    low = np.array([actuator.lower for actuator in HAND.actuators])
    high = np.array([actuator.upper for actuator in HAND.actuators])
    return low + (high - low) * draw.random((count, len(low)))


def _all(scene: GraspScene, at: HandPose, pose: FloatArray) -> FloatArray:
    """Return the distances of all shapes from the object, each pair measured."""
    pieces = range(len(scene.object.pieces))
    shapes = range(len(scene.geometry.shapes))
    return np.array([min(_distance(scene, s, p, at, pose) for p in pieces) for s in shapes])


def _distance(scene: GraspScene, shape: int, piece: int, at: HandPose, pose: FloatArray) -> float:
    here = coal.Transform3s(pose[:3, :3], pose[:3, 3])
    return scene.measured(shape, piece, at.where(shape), here)[0]


@pytest.mark.parametrize("obj", THINGS)
def test_gaps_are_never_wider_than_the_distance(obj: str) -> None:
    scene, draw = GraspScene(HAND, THINGS[obj]), np.random.default_rng(1)
    for u in _postures(draw, 20):
        at, pose = scene.posed(u), _pose(draw)
        gaps, normals = scene.gaps(at, pose)
        assert np.linalg.norm(normals, axis=2) == pytest.approx(np.ones(gaps.shape))
        for shape, piece in np.ndindex(*gaps.shape):
            assert gaps[shape, piece] <= _distance(scene, shape, piece, at, pose) + 1e-6


@pytest.mark.parametrize("obj", THINGS)
def test_what_touches_is_found_while_the_object_is_pushed_and_the_hand_closes(obj: str) -> None:
    scene, draw = GraspScene(HAND, THINGS[obj]), np.random.default_rng(2)
    touched = 0
    for begin, end in zip(_postures(draw, 12), _postures(draw, 12), strict=True):
        pose = _pose(draw)
        frames = scene.postures.frames(np.linspace(begin, end, 33))
        at = scene.postures.posed(frames[0])
        near = DistanceBounds(scene, [at], pose[None])
        for before, after in pairwise(frames[:9]):
            at = scene.postures.posed(after)
            near.closed(scene.postures.farthest_steps(np.stack([before, after]))[None])
            push = draw.normal(size=3) * 0.003
            pose[:3, 3] += push
            near.pushed(push[None])
            distances = _all(scene, at, pose)
            found = {touch.shape: touch for touch in near.touching(at)[0]}
            assert sorted(found) == np.flatnonzero(distances <= TOUCH).tolist()
            for shape, touch in found.items():
                assert touch.distance == pytest.approx(distances[shape], abs=1e-9)
            touched += len(found)
            assert near.least(at, 1.0)[0] == pytest.approx(float(distances.min()), abs=1e-9)
    assert touched > 50  # otherwise the poses are too far away to tell anything


def test_the_least_time_counts_how_fast_shapes_come() -> None:
    scene, draw = GraspScene(HAND, THINGS["sphere"]), np.random.default_rng(3)
    at, pose = scene.posed(np.array(HAND.rest)), np.eye(4)
    pose[:3, 3] = 0.0, 0.0, 0.3
    distances = _all(scene, at, pose)
    paces = draw.uniform(0.01, 0.1, len(distances))
    among = draw.random(len(distances)) < 0.5
    near = DistanceBounds(scene, [at], pose[None])
    paces, among = paces[None], among[None]
    (least,) = near.least(at, 1e3, paces=paces)
    assert least == pytest.approx(float((distances / paces[0]).min()))
    some = float((distances / paces[0])[among[0]].min())
    assert near.least(at, 1e3, paces=paces, among=among)[0] == pytest.approx(some)
    # What is farther than was asked for is not measured.
    assert near.least(at, 1e-3, paces=paces)[0] == 1e-3
    assert near.least(at, 1e3, below=1e2)[0] < 1e2
    until = near.least(at, 1e3, paces=paces, until=0.01)[0]
    assert until == pytest.approx(float(((distances - 0.01) / paces[0]).min()))


@pytest.mark.parametrize("obj", THINGS)
def test_several_hands_are_looked_at_as_each_alone(obj: str) -> None:
    scene, draw = GraspScene(HAND, THINGS[obj]), np.random.default_rng(5)
    begin, ends = _postures(draw, 1)[0], _postures(draw, 6)
    poses = np.array([_pose(draw) for _ in ends])
    at = scene.posed(begin)
    together, alone = (
        DistanceBounds(scene, [at] * len(poses), poses),
        [DistanceBounds(scene, [at], p[None]) for p in poses],
    )
    moved = HandPoses(scene.postures, scene.postures.frames(np.tile(begin, (len(ends), 1))))
    ways = [scene.postures.frames(np.linspace(begin, end, 9)) for end in ends]
    touched = 0
    for step in range(1, 9):
        rows = np.flatnonzero(draw.random(len(ends)) < 0.7)
        # Rows that are left out stay where they are, so only some hands and objects move.
        gone = np.array([scene.postures.farthest_steps(ways[row][: step + 1]) for row in rows])
        pushes = draw.normal(size=(len(rows), 3)) * 0.003
        together.closed(gone.reshape(-1, len(scene.geometry.shapes)) * step, rows)
        together.pushed(pushes, rows)
        moved.put(rows, np.array([ways[row][step] for row in rows]).reshape(-1, *ways[0][0].shape))
        for row, way, push in zip(rows.tolist(), gone * step, pushes, strict=True):
            alone[row].closed(way[None])
            alone[row].pushed(push[None])
        found, least = together.touching(moved), together.least(moved, 1.0)
        for row, near in enumerate(alone):
            here = moved.one(row)
            (touches,) = near.touching(here)
            assert [t.shape for t in found[row]] == [t.shape for t in touches]
            for one, other in zip(found[row], touches, strict=True):
                assert one.distance == pytest.approx(other.distance, abs=1e-9)
            assert least[row] == pytest.approx(near.least(here, 1.0)[0], abs=1e-9)
            touched += len(touches)
    assert touched > 10  # otherwise the poses are too far away to tell anything


@pytest.mark.parametrize("name", ["schunk_svh", "robotiq_3f", "heri_ii", "dagana", "robotiq_2f_85"])
def test_postures_are_those_of_the_kinematics(name: str) -> None:
    hand = load_hand(ROOT / "config" / name)
    scene, draw = GraspScene(hand, THINGS["sphere"]), np.random.default_rng(4)
    low = np.array([actuator.lower for actuator in hand.actuators])
    high = np.array([actuator.upper for actuator in hand.actuators])
    u = low + (high - low) * draw.random((5, len(low)))
    for row, frames in zip(u, scene.postures.frames(u), strict=True):
        poses, at = scene.geometry.kinematics.placements(row), scene.postures.posed(frames)
        for number, shape in enumerate(scene.geometry.shapes):
            there = shape.at(poses[shape.link])
            assert at.turns[number] == pytest.approx(there.getRotation(), abs=1e-9)
            assert at.places[number] == pytest.approx(there.getTranslation(), abs=1e-9)
