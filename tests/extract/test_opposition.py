from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from extract.models import Model, box, sphere
from rtee.actions.types import Opposition, Primitive
from rtee.extract.extraction import extract
from rtee.extract.opposition import force_closure


def closing(angle: float, shape: str) -> Model:
    """Return two tips that slide towards each other, both ``angle`` off the line between them."""
    model = Model()
    for name, side in (("left", -1.0), ("right", 1.0)):
        model.link(name, shape)
        model.joint(
            f"{name}_slide",
            "base",
            name,
            kind="prismatic",
            xyz=(0.03 * side, 0, 0),
            axis=(-side * math.cos(angle), 0, math.sin(angle)),
            limits=(0, 0.028 / math.cos(angle)),
        )
        model.finger(name, name)
    return model


def pinch(model: Model, folder: Path) -> Primitive:
    return next(p for p in extract(model.load(folder)).primitives if p.name == "PinchTight")


def opposed(model: Model, folder: Path) -> Opposition:
    found = pinch(model, folder).evidence[0].opposition
    assert found is not None
    return found


def test_parallel_jaws_oppose_each_other(tmp_path: Path) -> None:
    found = opposed(closing(0.0, box((0.01, 0.02, 0.02))), tmp_path)
    np.testing.assert_allclose(found.angles, 0.0, atol=1e-6)
    assert found.force_closure
    assert found.friction == 0.5


@pytest.mark.parametrize(("angle", "holds"), [(0.35, True), (0.9, False)])
def test_a_ball_between_slanting_tips_holds_within_friction(
    angle: float, holds: bool, tmp_path: Path
) -> None:
    found = opposed(closing(angle, sphere(0.005)), tmp_path)
    np.testing.assert_allclose(found.angles, angle, atol=0.02)
    assert found.force_closure is holds


def test_a_jaw_that_stands_opposes_the_one_that_comes(tmp_path: Path) -> None:
    model = Model().link("wall", box((0.01, 0.1, 0.1))).joint("hold", "base", "wall", kind="fixed")
    model.link("jaw", box((0.01, 0.02, 0.02))).joint(
        "slide",
        "base",
        "jaw",
        kind="prismatic",
        xyz=(0.1, 0, 0),
        axis=(-1, 0, 0),
        limits=(0, 0.095),
    )
    found = opposed(model.finger("wall", "wall").finger("jaw", "jaw"), tmp_path)
    np.testing.assert_allclose(found.angles, 0.0, atol=1e-6)
    assert found.force_closure


def test_tips_that_come_from_the_same_side_do_not_hold_a_ball(tmp_path: Path) -> None:
    model = Model()
    for name, side in (("left", -1.0), ("right", 1.0)):
        model.link(name, sphere(0.01)).joint(
            f"{name}_slide",
            "base",
            name,
            kind="prismatic",
            xyz=(0.012 * side, 0, 0),
            axis=(-0.1 * side, 0, 1),
            limits=(0, 0.05),
        )
        model.finger(name, name)
    found = opposed(model, tmp_path)
    assert min(found.angles) > 1.4
    assert not found.force_closure


def test_force_closure_is_the_line_within_both_cones() -> None:
    centre = np.zeros(3)
    right, up = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert force_closure([right, -right], centre, 0.5)
    assert not force_closure([right, up], centre, 0.5)
    half = math.atan(0.5)
    for off, holds in ((0.99, True), (1.01, False)):
        turn = 2 * half * off
        leaning = np.array([-math.cos(turn), math.sin(turn), 0])
        assert force_closure([right, leaning], centre, 0.5) is holds
    assert not force_closure([right, right], centre, 0.5)
