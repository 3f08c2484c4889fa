"""What stands in for finely meshed links while a search explores."""

from __future__ import annotations

import math
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest

from extract.models import Model, box
from rtee.extract import distance_queries
from rtee.extract.coarse_shapes import SLACK, coarse_shape, least_width, outer, simplified
from rtee.extract.scene import Scene
from rtee.extract.space import make_space, real_limits
from rtee.hand.geometry import HandGeometry, hull_of
from rtee.hand.halton import halton
from rtee.hand.load import load_model
from rtee.hand.model import Hand


@pytest.fixture(scope="module")
def leap(shared: Path) -> Hand:
    folder = shared / "more_hands" / "leap_right"
    return load_model(folder / "leap_right.urdf", folder / "leap_right.srdf")


def test_a_prism_has_no_more_sides_than_coal_takes(tmp_path: Path) -> None:
    disc = '<geometry><cylinder radius="5" length="0.05"/></geometry>'
    model = Model().link("disc", disc).link("tip", box((0.01, 0.01, 0.01)))
    model.joint("turn", "base", "disc").joint("bend", "disc", "tip").finger("finger", "tip")
    shape = HandGeometry(model.load(tmp_path)).shapes[0]
    coarse = coarse_shape(shape)
    assert isinstance(coarse.shape, coal.ConvexBase)
    inner = 5.0 * math.cos(math.pi / (coarse.shape.num_points // 2))
    assert 5.0 - inner == pytest.approx(coarse.slack, rel=1e-3)


@pytest.mark.parametrize("name", ["dagana", "heri_II", "robotiq_3f", "schunk"])
def test_a_convex_part_is_nowhere_narrower_than_its_least_width(name: str, shared: Path) -> None:
    folder = shared / "hands" / name
    hand = load_model(folder / f"{name}.urdf", folder / f"{name}.srdf")
    directions = np.random.default_rng(0).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for shape in HandGeometry(hand).shapes:
        width = least_width(shape, coarse_shape(shape).shape)
        assert width > 0.0
        assert np.ptp(shape.points @ directions.T, axis=0).min() > width


def test_a_draft_lies_within_its_hull_and_its_hull_within_the_slack(leap: Hand) -> None:
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    simplified = 0
    for shape in HandGeometry(leap).shapes:
        found = coarse_shape(shape)
        if found.slack == 0.0:
            assert found.shape is shape.convex
            continue
        simplified += 1
        assert found.slack <= SLACK
        assert found.shape.num_points < shape.convex.num_points / 10
        full = (np.array(shape.convex.points()) @ directions.T).max(axis=0)
        rough = (np.array(found.shape.points()) @ directions.T).max(axis=0)
        assert (rough <= full + 1e-12).all()
        assert (full <= rough + found.slack + 1e-12).all()
    assert simplified == 4


def test_a_draft_depends_neither_on_the_order_of_vertices_nor_on_a_mirror(leap: Hand) -> None:
    part = next(s.convex for s in HandGeometry(leap).shapes if coarse_shape(s).slack > 0.0)
    mirror = np.array([-1.0, 1.0, 1.0])
    other = hull_of(np.array(part.points())[::-1] * mirror)
    one, two = (np.array(simplified(p).shape.points()) for p in (part, other))
    assert sorted((one * mirror).tolist()) == sorted(two.tolist())


def test_distances_of_hulls_do_not_depend_on_earlier_ones(shared: Path) -> None:
    hand = load_model(shared / "hands/schunk/schunk.urdf", shared / "hands/schunk/schunk.srdf")

    def measured(postures: np.ndarray) -> list[float]:
        scene, distances = Scene(hand), list[float]()
        for posture in postures:
            scene.place(posture)
            distances = scene.distances(list(scene.tips.values()))
        return distances

    # At its last posture, Coal's default precision leaves 80 nm between the two.
    postures = np.random.default_rng(0).uniform(hand.lower, hand.upper, (33, len(hand.lower)))
    assert measured(postures) == pytest.approx(measured(postures[-1:]), abs=1e-12)


def test_a_couple_that_leads_hides_no_deeper_one(
    leap: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, fresh, random = Scene(leap), Scene(leap), np.random.default_rng(0)
    pairs, measured = list(scene.tips.values()), list[object]()

    def counted(model: object, data: object) -> int:
        measured.append(model)
        return int(pin.computeDistances(model, data))

    def deepest(u: np.ndarray) -> float:
        scene.place(u)
        return min(scene.distances(pairs))

    monkeypatch.setattr(distance_queries, "_measure", counted)
    asked = whole = 0
    for reach in (0.002, 0.005, 0.02, 0.05):
        u = min(random.uniform(leap.lower, leap.upper, (60, len(leap.rest))), key=deepest)
        assert deepest(u) < -0.003
        for _ in range(40):
            u = np.clip(u + random.uniform(-reach, reach, len(u)), leap.lower, leap.upper)
            # Far away, no couple leads: there, all of them are measured next.
            fresh.place(leap.rest)
            fresh.distances(pairs)
            fresh.place(u)
            expected = fresh.distances(pairs)
            scene.place(u)
            for pair, gap in zip(pairs, expected, strict=True):
                before = len(measured)
                assert scene.distance(pair) == pytest.approx(gap, abs=1e-12)
                if gap < 0.0:
                    asked, whole = asked + 1, whole + len(measured) - before
    assert asked > 100
    assert whole < 0.7 * asked


def test_a_known_distance_has_the_slope_of_its_posture(leap: Hand) -> None:
    scene = Scene(leap)
    pairs = list(scene.tips.values())
    space = make_space(leap, range(len(leap.rest)), real_limits(leap))
    here, there = np.random.default_rng(0).uniform(leap.lower, leap.upper, (2, len(leap.rest)))
    found = []
    for u in (here, there, here):
        scene.place(u)
        found.append([(scene.distance(pair), scene.derivative(pair, space)) for pair in pairs])
    for (gap, slope), (known, again), (other, _) in zip(found[0], found[2], found[1], strict=True):
        assert known == gap != other
        np.testing.assert_allclose(again, slope, atol=1e-9)


def test_distances_of_prisms_do_not_depend_on_the_order_of_links(tmp_path: Path) -> None:
    fingers = {
        "left": (
            0.0,
            (0, 0.6, 0.8),
            '<geometry><cylinder radius="0.01" length="0.04"/></geometry>',
        ),
        "right": (0.05, (0.6, 0.8, 0), box((0.02, 0.03, 0.04))),
    }
    found = []
    for order in (1, -1):
        model = Model(f"order_{order}")
        for name in [*fingers][::order]:
            x, axis, shape = fingers[name]
            rpy = (0.3 + 9 * x, 0.7 - 20 * x, 30 * x)
            model.link(name, shape).finger(name, name)
            model.joint(
                f"{name}_joint", "base", name, xyz=(x, 0, 0), rpy=rpy, axis=axis, limits=(-2, 2)
            )
        scene, distances = Scene(model.load(tmp_path)), []
        for posture in halton(2, 40):
            scene.place(posture[::order].copy())
            distances += scene.distances(list(scene.tips.values()))
        found.append(distances)
    assert min(found[0]) > 0.0
    # Coal's default precision leaves 0.4 µm between the two.
    assert found[0] == pytest.approx(found[1], abs=1e-12)


def test_distances_of_drafts_bound_those_of_the_full_convex_parts(leap: Hand) -> None:
    scene = Scene(leap)
    random = np.random.default_rng(0)
    for _ in range(50):
        scene.place(random.uniform(leap.lower, leap.upper))
        for pair in scene.tips.values():
            rough, least = scene.distance(pair), scene.at_least(pair)
            with scene.fine():
                full = scene.distance(pair)
            assert full == pytest.approx(scene.witness(pair).distance, abs=2e-6)
            assert full <= rough + 1e-6
            assert full >= least - 1e-6


def test_shapes_within_another_one_of_their_link_are_left_out(leap: Hand) -> None:
    shapes = HandGeometry(leap).shapes
    links = dict.fromkeys(shape.link for shape in shapes)
    for link in links:
        indices = [i for i, shape in enumerate(shapes) if shape.link == link]
        kept = outer(shapes, {i: coarse_shape(shapes[i]) for i in indices}, indices)
        assert kept
        for i in set(indices) - set(kept):
            at = coal.Transform3s(shapes[i].placement.rotation, shapes[i].placement.translation)
            within = [
                k
                for k in kept
                if coal.distance(
                    shapes[i].convex,
                    at,
                    shapes[k].convex,
                    coal.Transform3s(shapes[k].placement.rotation, shapes[k].placement.translation),
                    coal.DistanceRequest(),
                    coal.DistanceResult(),
                )
                < 0.0
            ]
            assert within
