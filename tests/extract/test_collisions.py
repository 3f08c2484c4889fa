from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from extract.models import Model, box, sphere
from rtee.extract.collisions import CollisionChecker, first_contact
from rtee.extract.evidence import Inspector
from rtee.extract.goals import TipEdge
from rtee.extract.motion import LinkDistanceBounds, MotionBounds
from rtee.extract.scene import Scene
from rtee.hand.load import load_hand


def gantry(*posts: str, length: float = 1.0) -> Model:
    """Return a ball that moves in the x-z plane, among posts that stand."""
    model = Model().link("posts", *posts).joint("stand", "base", "posts", kind="fixed")
    model.link("carriage").link("ball", sphere(0.01))
    model.joint("x", "base", "carriage", kind="prismatic", axis=(1, 0, 0), limits=(0, length))
    model.joint("z", "carriage", "ball", kind="prismatic", axis=(0, 0, 1), limits=(0, 1))
    return model.finger("ball", "ball")


def checker(inspector: Inspector) -> CollisionChecker:
    return inspector.collisions.checker(range(len(inspector.scene.hand.actuators)), [])


def pinching(*, gap: float, shoulder: float) -> Model:
    """Return two fingers that close on each other; one has a shoulder that comes near the other.

    The tips are ``gap`` apart at rest; the shoulders, on links of their own, by ``shoulder`` more.
    """
    model = Model()
    for name, side in (("left", -1), ("right", 1)):
        model.link(f"{name}_root", sphere(0.002, (0, 0, -0.2 - 0.1 * side)))
        model.joint(
            f"{name}_x",
            "base",
            f"{name}_root",
            kind="prismatic",
            axis=(-side, 0, 0),
            xyz=(side * (gap / 2 + 0.01), 0, 0),
            limits=(0, 0.05),
        )
        model.link(f"{name}_mid", sphere(0.01, (side * shoulder / 2, 0, -0.05)))
        model.joint(f"{name}_bend", f"{name}_root", f"{name}_mid", axis=(0, 1, 0))
        model.link(f"{name}_tip", sphere(0.01))
        model.joint(f"{name}_turn", f"{name}_mid", f"{name}_tip", axis=(0, 0, 1))
        model.finger(name, f"{name}_tip")
    return model


@pytest.mark.parametrize(
    ("shoulder", "blocked"), [(0.004, False), (0.0005, False), (-0.0005, False), (-0.003, True)]
)
def test_links_beside_the_tips_may_touch_with_them_but_not_before(
    shoulder: float, blocked: bool, tmp_path: Path
) -> None:
    inspector = Inspector.of(pinching(gap=0.02, shoulder=shoulder).load(tmp_path))
    hand, scene = inspector.scene.hand, inspector.scene
    tips = scene.tips["left_tip", "right_tip"]
    found = inspector.checker(hand.fingers, [TipEdge((0, 1), tips)])
    goal = hand.rest.copy()
    for name in ("left_x", "right_x"):
        goal[hand.actuator_index(name)] = 0.015
    assert found.at(goal) == []
    hit = found.blocked(goal)
    assert (hit is not None) is blocked
    if hit is not None:
        assert hit.pair.links == ("left_mid", "right_mid")
        assert hit.at < hit.until


def test_all_of_a_gripper_with_one_actuator_stands_still_at_the_contact(tmp_path: Path) -> None:
    model = Model().link("post", box((0.002, 0.2, 0.2), (0.03, 0.2, 0)))
    model.joint("stand", "base", "post", kind="fixed")
    arm = box((0.002, 0.02, 0.002), (0, 0.2, 0))
    follow = '<mimic joint="left" multiplier="1"/>'
    for name, side, mimic in (("left", -1, ""), ("right", 1, follow)):
        model.link(f"{name}_slide", arm if side < 0 else sphere(0.001, (0, -0.2, 0)))
        model.joint(
            name,
            "base",
            f"{name}_slide",
            kind="prismatic",
            axis=(-side, 0, 0),
            xyz=(0.02 * side, 0, 0),
            limits=(0, 0.06),
            mimic=mimic,
        )
        model.link(name, sphere(0.01)).joint(f"{name}_weld", f"{name}_slide", name, kind="fixed")
        model.finger(name, name)
    inspector = Inspector.of(model.load(tmp_path))
    hand, scene = inspector.scene.hand, inspector.scene
    checker = inspector.checker(hand.fingers, [TipEdge((0, 1), scene.tips["left", "right"])])
    assert checker.pairs == ()
    # The arm would reach the post only far behind the contact of the tips.
    assert checker.blocked(np.array([0.055])) is None


def test_a_post_thinner_than_a_step_blocks_the_way(tmp_path: Path) -> None:
    inspector = Inspector.of(gantry(box((0.0001, 0.2, 0.2), (0.5, 0, 0))).load(tmp_path))
    blocked = checker(inspector).blocked(np.array([1.0, 0.0]))
    assert blocked is not None
    assert blocked.pair.links == ("posts", "ball")
    assert blocked.at == pytest.approx(0.489, abs=1e-3)  # 1 mm of clearance before it


def test_the_first_of_several_collisions_is_reported(tmp_path: Path) -> None:
    posts = [box((0.01, 0.2, 0.2), (x, 0, 0)) for x in (0.7, 0.3, 0.5)]
    inspector = Inspector.of(gantry(*posts).load(tmp_path))
    blocked = checker(inspector).blocked(np.array([1.0, 0.0]))
    assert blocked is not None
    assert blocked.at == pytest.approx(0.285, abs=1e-3)


def test_a_way_past_a_post_is_free_though_a_way_through_it_is_not(tmp_path: Path) -> None:
    inspector = Inspector.of(gantry(box((0.02, 0.2, 0.2), (0.5, 0, 0))).load(tmp_path))
    found = checker(inspector)
    assert found.blocked(np.array([1.0, 0.3])) is None
    assert found.blocked(np.array([1.0, 0.1])) is not None
    assert found.at(np.array([1.0, 0.1])) == []
    assert [pair.links for pair in found.at(np.array([0.5, 0.0]))] == [("posts", "ball")]


def test_a_long_way_is_checked_in_a_bounded_number_of_places(tmp_path: Path) -> None:
    rail = box((900, 0.2, 0.01), (450, 0, -0.016))  # a millimetre below the ball
    inspector = Inspector.of(gantry(rail, length=900).load(tmp_path))
    places: list[object] = []
    place = inspector.scene.place
    inspector.scene.place = lambda u: (places.append(u), place(u))[1]  # type: ignore[method-assign]
    assert checker(inspector).blocked(np.array([900.0, 0.0])) is None
    assert 1000 < len(places) < 5000


def test_what_slides_beyond_its_own_limits_is_seen_on_the_way(tmp_path: Path) -> None:
    # A ball at half a metre from the axis of the swing, by the offset of a mimic, meets a post.
    post = box((0.02, 0.2, 0.02), (0.5 * np.sin(1.5), 0, 0.5 * np.cos(1.5)))
    model = Model().link("posts", post).joint("stand", "base", "posts", kind="fixed")
    model.link("arm").link("knob").link("ball", sphere(0.01))
    model.joint("swing", "base", "arm", limits=(0, 3))
    model.joint("turn", "base", "knob", limits=(0, 0.1))
    follow = '<mimic joint="turn" offset="0.5"/>'
    up = {"kind": "prismatic", "axis": (0, 0, 1), "limits": (0, 0.01)}
    model.joint("out", "arm", "ball", mimic=follow, **up)  # type: ignore[arg-type]
    inspector = Inspector.of(model.finger("ball", "ball").load(tmp_path))
    hand = inspector.scene.hand
    goal = hand.rest.copy()
    goal[hand.actuator_index("swing")] = 3.0
    blocked = checker(inspector).blocked(goal)
    assert blocked is not None
    assert blocked.at == pytest.approx(0.48, abs=0.02)


def two_arms(gap: float) -> Model:
    """Return two arms of two links each, side by side, ``gap`` apart."""
    model = Model()
    for name, y in (("a", 0.0), ("b", 0.02 + gap)):
        link = box((0.02, 0.02, 0.1), (0, 0, 0.05))
        model.link(f"{name}1", link).link(f"{name}2", link)
        model.joint(f"{name}_1", "base", f"{name}1", xyz=(0, y, 0))
        model.joint(f"{name}_2", f"{name}1", f"{name}2", xyz=(0, 0, 0.1))
        model.finger(name, f"{name}2")
    return model


def test_joined_links_and_links_touching_at_rest_are_not_checked(tmp_path: Path) -> None:
    collisions = Inspector.of(two_arms(0.0).load(tmp_path)).collisions
    assert set(collisions.at_rest) == {("a1", "b1"), ("a1", "b2"), ("a2", "b1"), ("a2", "b2")}
    assert collisions.checked == ()


def test_disabled_pairs_are_not_checked(tmp_path: Path) -> None:
    model = two_arms(0.005).disable("b2", "a1")
    checked = {pair.links for pair in Inspector.of(model.load(tmp_path)).collisions.checked}
    assert checked == {("a1", "b1"), ("a2", "b1"), ("a2", "b2")}


def test_only_pairs_that_move_are_watched(tmp_path: Path) -> None:
    inspector = Inspector.of(two_arms(0.005).load(tmp_path))
    hand = inspector.scene.hand
    found = inspector.collisions.checker([hand.actuator_index("a_2")], [frozenset(("a2", "b2"))])
    assert {pair.links for pair in found.pairs} == {("a2", "b1")}


@pytest.mark.parametrize("name", ["schunk_svh", "robotiq_3f", "heri_ii"])
def test_no_distance_changes_faster_than_the_bound_on_the_motion(name: str) -> None:
    scene = Scene(load_hand(name))
    motion = MotionBounds(scene)
    hand = scene.hand
    step = 1e-3
    for goal in np.random.default_rng(2).uniform(hand.lower, hand.upper, (4, len(hand.rest))):
        path = motion.path_to(goal)
        for pair in scene.tips.values():
            bound = motion.speed(pair, path)
            for t in (0.2, 0.5, 0.8):
                distances = []
                for s in (t, t + step):
                    scene.place(path.at(s))
                    distances.append(scene.distance(pair))
                assert abs(distances[1] - distances[0]) <= bound * step + 1e-6


@pytest.mark.parametrize("name", ["schunk_svh", "heri_ii"])
def test_what_is_known_of_distances_is_never_more_than_they_are(name: str) -> None:
    scene = Scene(load_hand(name))
    pairs = tuple(scene.pairs.values())
    known, hand = LinkDistanceBounds(MotionBounds(scene), pairs), scene.hand
    random = np.random.default_rng(3)
    u, told = hand.rest.copy(), 0
    for _ in range(30):
        u = np.clip(u + random.uniform(-0.1, 0.1, len(u)), hand.lower, hand.upper)
        scene.place(u)
        least = known.least(scene.joints)
        gaps = np.array([scene.distance(pair) for pair in pairs])
        assert (least <= gaps + 1e-6).all()
        told += int((least > 0.0).sum())
        some = np.flatnonzero(random.random(len(pairs)) < 0.5)
        known.learn(some, gaps[some].tolist(), scene.joints)
    assert told > 0


def test_first_contact_is_where_the_tips_begin_to_touch(tmp_path: Path) -> None:
    scene = Scene(gantry(box((0.1, 0.1, 0.1), (0.6, 0, 0))).load(tmp_path))
    motion = MotionBounds(scene)
    pair = scene.pairs["posts", "ball"]
    path = motion.path_to(np.array([0.8, 0.0]))
    at = first_contact(scene, pair, path, motion.speed(pair, path))
    assert at == pytest.approx(0.54 / 0.8, abs=1e-4)
    away = motion.path_to(np.array([0.2, 0.8]))
    assert first_contact(scene, pair, away, motion.speed(pair, away)) is None
