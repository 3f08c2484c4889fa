"""Pinches of real hands, beside what is known of them."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from rtee.actions.types import Primitive
from rtee.extract.descent import descend
from rtee.extract.extraction import Extraction, extract
from rtee.extract.goals import GoalFunction, PinchGoal
from rtee.extract.scene import Scene
from rtee.extract.space import make_space, real_limits
from rtee.hand.load import load_model
from rtee.hand.model import Hand

PINCHES = {
    "heri_II": {("finger_2", "thumb"): 23.1},
    "qbhand": {("thumb", "index"): 18.2, ("thumb", "middle"): 2.9},
    "robotiq_2f_140": {("finger_1", "finger_2"): 0.2},
    "robotiq_3f": {
        ("finger_1", "finger_2"): 5.2,
        ("finger_1", "finger_middle"): 15.1,
        ("finger_2", "finger_middle"): 15.1,
    },
    "schunk": {
        ("index", "pinky"): 2.4,
        ("index", "ring"): 16.6,
        ("thumb", "index"): 17.9,
        ("middle", "pinky"): 16.7,
        ("middle", "ring"): 16.6,
        ("thumb", "middle"): 16.9,
        ("thumb", "pinky"): 14.3,
        ("thumb", "ring"): 18.6,
    },
    "test_ee": {},
    "test_ee_spread": {
        ("finger_1", "finger_2"): 116.3,
        ("finger_1", "finger_3"): 116.4,
        ("finger_2", "finger_3"): 122.5,
    },
    "two_finger": {("finger_1", "finger_2"): 100.0},
    "two_finger_mimic": {},
}
"""The deepest penetration known of each pair that can touch [mm], measured by others."""

SAMPLES = ("robotiq_*", "test_ee", "two_finger*")

LOOSE = {
    "heri_II": set(),
    "qbhand": {("index", "middle"), ("middle", "ring"), ("ring", "little")},
    "robotiq_2f_140": set(),
    "robotiq_3f": set(),
    "schunk": {("index", "middle"), ("ring", "pinky")},
    "test_ee": set(),
    "test_ee_spread": set(),
    "two_finger": set(),
    "two_finger_mimic": {("finger_1", "finger_2")},
}

TRIPLES = {
    "robotiq_3f": {("finger_1", "finger_2", "finger_middle")},
    "schunk": {
        ("thumb", "index", "ring"),
        ("thumb", "middle", "ring"),
        ("thumb", "middle", "pinky"),
    },
    "test_ee_spread": {("finger_1", "finger_2", "finger_3")},
}


def load(shared: Path, name: str) -> Hand:
    folder = shared / "hands" / name
    return load_model(folder / f"{name}.urdf", folder / f"{name}.srdf")


@functools.cache
def extracted(shared: Path, name: str) -> Extraction:
    return extract(load(shared, name), jobs=0)


def of_kind(shared: Path, name: str, kind: str) -> dict[tuple[str, ...], Primitive]:
    return {p.elements: p for p in extracted(shared, name).primitives if p.name == kind}


@pytest.mark.samples(*SAMPLES)
@pytest.mark.parametrize("name", PINCHES)
def test_exactly_the_pairs_that_can_touch_pinch(name: str, shared: Path) -> None:
    assert set(of_kind(shared, name, "PinchTight")) == set(PINCHES[name])


@pytest.mark.samples(*SAMPLES)
@pytest.mark.parametrize("name", PINCHES)
def test_pinches_reach_98_percent_of_the_deepest_known(name: str, shared: Path) -> None:
    for elements, pinch in of_kind(shared, name, "PinchTight").items():
        deepest = max(evidence.depth for evidence in pinch.evidence)
        # What is known is rounded to a tenth of a millimetre.
        assert deepest * 1000 >= 0.98 * PINCHES[name][elements] - 0.05


@pytest.mark.samples("robotiq_*", "test_ee", "two_finger*")
@pytest.mark.parametrize("name", LOOSE)
def test_loose_pinches_are_as_expected(name: str, shared: Path) -> None:
    assert set(of_kind(shared, name, "PinchLoose")) == LOOSE[name]


@pytest.mark.samples("robotiq_3f", "test_ee*")  # the SVH that ships has triples, too
@pytest.mark.parametrize("name", TRIPLES)
def test_known_triples_are_found(name: str, shared: Path) -> None:
    found = of_kind(shared, name, "MultiPinchTight_3")
    assert TRIPLES[name] <= set(found)
    for triple in found.values():
        for evidence in triple.evidence:
            linked = {name for first, second, _ in evidence.pairs for name in (first, second)}
            assert linked == set(triple.elements)
            assert evidence.depth == pytest.approx(sum(d for *_, d in evidence.pairs), abs=1e-8)


@pytest.mark.samples("robotiq_3f")
@pytest.mark.parametrize("name", ["robotiq_3f", "schunk"])
def test_stored_postures_touch_and_are_clear_as_their_evidence_says(
    name: str, shared: Path
) -> None:
    scene = Scene(load(shared, name))
    hand = scene.hand
    for elements, pinch in of_kind(shared, name, "PinchTight").items():
        first, second = (hand.finger(element) for element in elements)
        tips = scene.tips[str(first.tip), str(second.tip)]
        for posture, evidence in zip(pinch.postures, pinch.evidence, strict=True):
            u = np.array([posture.position[name] for name in hand.actuator_names])
            scene.place(u)
            assert scene.touching(tips)
            assert -scene.witness(tips).distance == pytest.approx(evidence.depth, abs=1e-8)
            involved = {*first.actuators, *second.actuators}
            assert set(posture.involved) == involved
            for spec in hand.actuators:
                if spec.name not in involved:
                    assert posture.position[spec.name] == spec.rest
            assert {frozenset(pair) for pair in evidence.colliding} == colliding(scene, elements)


def colliding(scene: Scene, elements: tuple[str, ...]) -> set[frozenset[str]]:
    """Return what else collides where the scene is placed, does not at rest, and may not there."""
    hand = scene.hand
    tips = frozenset(str(hand.finger(element).tip) for element in elements)
    parents = scene.kinematics.model.parents
    fingers = [set(hand.finger(element).links) for element in elements]
    own = [links.difference(*(o for o in fingers if o is not links)) for links in fingers]

    def until_contact(links: tuple[str, str]) -> bool:
        """Return whether links of two fingers hold each other as soon as the tips meet."""
        return all(mine & set(links) for mine in own)

    pairs = [
        pair
        for pair in scene.pairs.values()
        if not until_contact(pair.links)
        and parents[pair.bodies[0]] != pair.bodies[1]
        and parents[pair.bodies[1]] != pair.bodies[0]
        and frozenset(pair.links) != tips
    ]
    here = {frozenset(pair.links) for pair in pairs if scene.touching(pair)}
    scene.place(hand.rest)
    at_rest = {frozenset(pair.links) for pair in pairs if scene.touching(pair)}
    return here - at_rest


@pytest.mark.samples("robotiq_3f-*", "test_ee_spread-*")
@pytest.mark.parametrize(
    ("name", "elements"),
    [
        ("robotiq_3f", ("finger_1", "finger_2")),
        ("heri_II", ("finger_2", "thumb")),
        ("test_ee_spread", ("finger_2", "finger_3")),
        ("schunk", ("thumb", "index")),
        ("schunk", ("index", "pinky")),
    ],
)
def test_depth_is_at_least_98_percent_of_what_256_starts_find(
    name: str, elements: tuple[str, str], shared: Path
) -> None:
    hand = load(shared, name)
    scene = Scene(hand)
    first, second = (str(hand.finger(element).tip) for element in elements)
    tips = scene.tips[first, second]
    space = make_space(hand, sorted(tips.actuators), real_limits(hand))
    function = GoalFunction(scene, PinchGoal(scene, tips), space)
    starts = np.random.default_rng(11).uniform(size=(256, space.size))
    least = min(descend(function, y, evaluations=60).value for y in starts)
    found = of_kind(shared, name, "PinchTight")[elements]
    assert max(evidence.depth for evidence in found.evidence) >= 0.98 * -least


@pytest.mark.samples("robotiq_3f-*")
@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("name", ["robotiq_3f", "qbhand"])
def test_repetition_and_jobs_change_nothing(name: str, jobs: int, shared: Path) -> None:
    again = extract(load(shared, name), jobs=jobs).primitives
    assert again == extracted(shared, name).primitives  # one job per processor
