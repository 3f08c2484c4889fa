from __future__ import annotations

from pathlib import Path

import numpy as np

from extract.models import Model, sphere
from rtee.extract.goals import MultiPinchGoal, TipEdge, linked, spanning_tree, spanning_trees
from rtee.extract.scene import Scene
from rtee.extract.space import make_space, real_limits


def test_the_spanning_tree_takes_the_shortest_edges() -> None:
    edges = [(0, 1), (1, 2), (0, 2), (2, 3)]
    assert sorted(spanning_tree(4, edges, [1.0, 5.0, 2.0, -1.0])) == [0, 2, 3]


def test_linked_needs_all_nodes() -> None:
    assert linked(3, [(0, 1), (1, 2)])
    assert not linked(4, [(0, 1), (1, 2), (0, 2)])


def test_all_spanning_trees_of_a_triangle() -> None:
    assert spanning_trees(3, [(0, 1), (1, 2), (0, 2)]) == [(0, 1), (0, 2), (1, 2)]


def row_of_balls(folder: Path, count: int) -> Scene:
    """Return balls that each slide along x; their coordinates are their places."""
    model = Model()
    for i in range(count):
        model.link(f"b{i}", sphere(0.1)).finger(f"b{i}", f"b{i}")
        model.joint(f"x{i}", "base", f"b{i}", kind="prismatic", axis=(1, 0, 0), limits=(0, 1))
    return Scene(model.load(folder))


def goal(scene: Scene, size: int) -> MultiPinchGoal:
    edges = [
        TipEdge((i, j), scene.tips[f"b{i}", f"b{j}"])
        for i in range(size)
        for j in range(i + 1, size)
    ]
    mine = {f"b{i}" for i in range(size)}
    bystanders = [pair for pair in scene.tips.values() if not set(pair.links) <= mine]
    return MultiPinchGoal(scene, size, edges, bystanders)


def test_exactly_the_wanted_tips_must_touch(tmp_path: Path) -> None:
    scene = row_of_balls(tmp_path, 4)
    three = goal(scene, 3)
    for places, touching in (
        ((0.1, 0.28, 0.46, 0.9), True),
        ((0.1, 0.28, 0.6, 0.9), False),
        ((0.1, 0.28, 0.46, 0.64), False),
    ):
        scene.place(np.array(places))
        assert three.touching() is touching


def test_the_value_pulls_lonely_tips_and_counts_depths(tmp_path: Path) -> None:
    scene = row_of_balls(tmp_path, 3)
    three = goal(scene, 3)
    scene.place(np.array([0.0, 0.15, 0.34]))
    linked_value = three.value()
    assert three.overlapping()
    assert abs(linked_value + 0.05 + 0.01) < 1e-6
    scene.place(np.array([0.0, 0.15, 0.5]))
    assert not three.overlapping()
    assert three.value() > linked_value


def test_the_slope_is_the_derivative_of_the_value(tmp_path: Path) -> None:
    scene = row_of_balls(tmp_path, 4)
    three = goal(scene, 3)
    space = make_space(scene.hand, range(4), real_limits(scene.hand))
    for y in np.random.default_rng(5).uniform(0, 0.5, (10, 4)):
        scene.place(space.posture(y))
        value, rise = three.slope(space)
        slope = rise()
        assert abs(value - three.value()) < 1e-12
        for i, direction in enumerate(np.eye(4)):
            values = []
            for step in (-1e-7, 1e-7):
                scene.place(space.posture(y + step * direction))
                values.append(three.value())
            assert abs((values[1] - values[0]) / 2e-7 - slope[i]) < 1e-4
