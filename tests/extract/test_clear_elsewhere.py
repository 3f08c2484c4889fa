"""A clear posture is sought in other places than near the deepest minima."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from extract.models import Model, box, sphere
from rtee.extract.canonical import canonical
from rtee.extract.clear_elsewhere import ClearElsewhere
from rtee.extract.collision_free import SearchBudget
from rtee.extract.evidence import Inspector
from rtee.extract.goals import GoalFunction, PinchGoal, TipEdge
from rtee.extract.multi import MultiSearch
from rtee.extract.pinch import pinch_search
from rtee.extract.ranking import Candidate
from rtee.extract.space import make_space, real_limits
from rtee.sample import FloatArray


@dataclass
class Wall:
    """A ball that a wall keeps from the deepest places in a slanted plate.

    Attributes:
        further: The searches for clear postures of ball and plate.
        at: Returns the posture with the ball at (x, z) [m].
    """

    further: ClearElsewhere
    at: Callable[[float, float], FloatArray]

    def deeper(self, *known: Candidate, postures: Sequence[FloatArray] = ()) -> list[Candidate]:
        """Return what is found if the deepest of the known postures is the only minimum."""
        minima = [self.further.function.space.coordinates(known[0].u)]
        return self.further.deeper(known, postures, minima)


@pytest.fixture
def wall(tmp_path: Path) -> Wall:
    model = Model().link("wall", box((0.02, 0.1, 0.02), (0.05, 0, 0.07)))
    model.joint("stand", "base", "wall", kind="fixed")
    plate = (
        '<origin xyz="0.12 0 0.05" rpy="0 -0.3 0"/><geometry><box size="0.02 0.1 0.4"/></geometry>'
    )
    model.link("plate", plate).joint("hold", "base", "plate", kind="fixed").finger("plate", "plate")
    model.link("carriage").link("ball", sphere(0.01)).finger("ball", "ball")
    model.joint("x", "base", "carriage", kind="prismatic", axis=(1, 0, 0), limits=(0, 0.1))
    model.joint("z", "carriage", "ball", kind="prismatic", axis=(0, 0, 1), limits=(0, 0.12))
    inspector = Inspector.of(model.load(tmp_path))
    scene, hand = inspector.scene, inspector.scene.hand
    tips = scene.tips["plate", "ball"]
    checker = inspector.checker(hand.fingers, [TipEdge((0, 1), tips)])
    space = make_space(hand, range(2), real_limits(hand))
    function = GoalFunction(scene, PinchGoal(scene, tips), space)

    def at(x: float, z: float) -> FloatArray:
        u = np.zeros(2)
        u[hand.actuator_index("x")], u[hand.actuator_index("z")] = x, z
        return u

    def measure(u: FloatArray) -> Candidate:
        return inspector.pinch(u, tips, checker)

    further = ClearElsewhere(function, inspector.motion, checker, measure, SearchBudget(), (4,))
    return Wall(further, at)


@pytest.fixture
def deepest(wall: Wall) -> Candidate:
    behind = wall.further.measure(wall.at(0.1, 0.12))
    assert behind.evidence.depth > 0.015
    assert not behind.usable
    return behind


def test_new_points_lead_to_what_no_minimum_leads_to(wall: Wall, deepest: Candidate) -> None:
    (found,) = wall.deeper(deepest)
    assert found.usable
    assert found.evidence.depth > 0.005


def test_the_search_goes_on_from_a_shallow_clear_posture(wall: Wall, deepest: Candidate) -> None:
    shallow = wall.further.measure(wall.at(0.1, 0.06))
    assert shallow.usable
    assert 0.0 < shallow.evidence.depth < 0.006
    (found,) = wall.deeper(deepest, shallow)
    assert found.evidence.depth > 0.008


def test_a_deep_posture_that_is_clear_as_it_is_takes_its_place(
    wall: Wall, deepest: Candidate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtee.extract.clear_elsewhere.clear_postures", lambda *a, **b: [])
    shallow, clear = wall.further.measure(wall.at(0.1, 0.06)), wall.at(0.1, 0.07)
    (found,) = wall.deeper(deepest, shallow, postures=[deepest.u, clear])
    assert (found.u == clear).all()


def test_nothing_is_sought_beyond_the_deepest_posture(wall: Wall, deepest: Candidate) -> None:
    (clear,) = wall.deeper(deepest)
    assert wall.deeper(clear, clear) == []


FINGERS = (
    ("f0", -0.1, (0.041, 0.034, 0.031)),
    ("f1", 1.62, (0.035, 0.03, 0.033)),
    ("f2", 3.05, (0.037, 0.04, 0.03)),
    ("f3", 4.85, (0.04, 0.036, 0.027)),
)
"""Names, angles around the palm [rad] and lengths of the phalanges [m]."""


def test_a_group_is_executed_clear_even_if_the_first_search_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtee.extract.multi.clear_postures", lambda *a, **b: [])
    palm = '<geometry><cylinder radius="0.042" length="0.02"/></geometry>'
    model = Model().link("palm", palm).joint("stand", "base", "palm", kind="fixed")
    for name, angle, lengths in FINGERS:
        parent = f"{name}_knuckle"
        place = (0.04 * math.cos(angle), 0.04 * math.sin(angle), 0.016)
        model.link(parent).joint(
            f"{name}_swing", "palm", parent,
            xyz=place, rpy=(0, 0, angle + math.pi), axis=(0, 0, 1), limits=(-0.7, 0.7),
        )  # fmt: skip
        place = (0.0, 0.0, 0.0)
        for i, length in enumerate(lengths):
            radius = 0.009 - 0.0009 * i
            bar = box((0.9 * radius, 2.6 * radius, 0.95 * length), (0, 0, length / 2))
            limits = (0.0, 1.6) if i else (-0.3, 1.4)
            model.link(f"{name}_{i}", bar)
            model.joint(f"{name}_bend_{i}", parent, f"{name}_{i}", xyz=place, limits=limits)
            parent, place = f"{name}_{i}", (0.0, 0.0, length)
        model.finger(name, parent, "palm")
    form = canonical(model.load(tmp_path))
    inspector = Inspector.of(form.hand, form.unit)
    pinches: dict[frozenset[str], FloatArray] = {}
    fingers = tuple(finger for finger in form.hand.fingers if finger.name != "f0")
    for one, other in combinations(fingers, 2):
        inspector.scene.forget()
        search = pinch_search(inspector, one, other, "depth")
        probe = search.probe() if search else None
        if probe is not None:
            pinches[frozenset((one.name, other.name))] = probe.explored
    found = MultiSearch(inspector, fingers, pinches).run()
    assert found is not None
    executed = found.candidates[0]
    assert executed.usable
    assert executed.evidence.depth > 0.9 * max(c.evidence.depth for c in found.candidates)
