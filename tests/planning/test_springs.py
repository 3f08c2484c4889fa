"""What fingers whose actuators are springs do to an object on which they press."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rtee.planning.result import Contact
from rtee.planning.springs import PressingForces, pressing, scaled, sunk
from rtee.planning.wrench import wrenches
from rtee.sample import FloatArray

WIDTH = 0.05  # of the object between two tips [m]
SPRING = 400.0  # of each tip along each axis [N/m]
CONTACT = 5e3  # of the contacts in series with it [N/m]
SERIES = SPRING * CONTACT / (SPRING + CONTACT)


@pytest.fixture
def contacts() -> list[Contact]:
    half = WIDTH / 2.0
    return [
        Contact("left", "left", (-half, 0.0, 0.0), (1.0, 0.0, 0.0)),
        Contact("right", "right", (half, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    ]


@pytest.fixture
def maps() -> FloatArray:
    """Three sliding actuators for each tip, along x, y and z."""
    found = np.zeros((2, 6, 3))
    found[0, :3], found[1, 3:] = np.eye(3), np.eye(3)
    return found


def pressed(
    contacts: list[Contact], maps: FloatArray, *way: float, friction: float = 0.5
) -> PressingForces:
    found = wrenches(contacts, friction, np.zeros(3), WIDTH)
    return pressing(found, maps, np.full(6, SPRING), np.array(way))


def test_tips_that_close_on_each_other_balance(contacts: list[Contact], maps: FloatArray) -> None:
    squarely = pressed(contacts, maps, 1e-3, 0.0, 0.0, -1e-3, 0.0, 0.0)
    assert squarely.share == pytest.approx(1.0, abs=1e-3)
    # Both springs are compressed by a millimetre.
    assert squarely.forces[0] == pytest.approx([0.4, 0.0, 0.0], abs=1e-3)
    assert squarely.forces[1] == pytest.approx([-0.4, 0.0, 0.0], abs=1e-3)


@pytest.mark.parametrize(("degrees", "share"), [(20.0, 0.88), (45.0, 0.56), (65.0, 0.29)])
def test_what_presses_on_the_table_does_not_balance(
    contacts: list[Contact], maps: FloatArray, degrees: float, share: float
) -> None:
    # Fixed, the object takes the part of both forces that friction passes on; free, none of it.
    down = -1e-3 * math.tan(math.radians(degrees))
    askew = pressed(contacts, maps, 1e-3, 0.0, down, -1e-3, 0.0, down)
    assert askew.share == pytest.approx(share, abs=0.01)
    assert askew.forces[:, 2] == pytest.approx([0.0, 0.0], abs=1e-3)


def test_fingers_of_one_side_do_not_balance(contacts: list[Contact], maps: FloatArray) -> None:
    beside = Contact("right", "right", (-WIDTH / 2.0, 0.01, 0.0), (1.0, 0.0, 0.0))
    one_side = pressed([contacts[0], beside], maps, 1e-3, 0.0, 0.0, 1e-3, 0.0, 0.0)
    assert one_side.share == pytest.approx(0.0, abs=1e-3)
    away = pressed(contacts, maps, -1e-3, 0.0, 0.0, 1e-3, 0.0, 0.0)
    assert away.share == 0.0


def sinks(contacts: list[Contact], maps: FloatArray, force: float) -> float:
    held = pressed(contacts, maps, 1e-3, 0.0, 0.0, -1e-3, 0.0, 0.0)
    arms = np.array([contact.point for contact in contacts])
    normals = np.array([contact.normal for contact in contacts])
    pressing_with = scaled(held, 2.0 * force)
    assert pressing_with.normal == pytest.approx([force, force])
    return sunk(pressing_with, maps, np.full(6, SPRING), arms, normals, 1.0)


def test_a_weight_sinks_by_the_yield_of_the_tips(contacts: list[Contact], maps: FloatArray) -> None:
    assert sinks(contacts, maps, 1.0) == pytest.approx(1.0 / (2.0 * SERIES), rel=1e-3)


def test_tips_that_press_too_hard_tilt_the_object(
    contacts: list[Contact], maps: FloatArray
) -> None:
    # Tilted by a small angle, it turns on if the force exceeds the stiffness times half the width.
    most = SERIES * WIDTH / 2.0
    assert math.isfinite(sinks(contacts, maps, 0.98 * most))
    assert sinks(contacts, maps, 1.02 * most) == math.inf


def test_a_single_contact_does_not_hold(contacts: list[Contact], maps: FloatArray) -> None:
    alone = PressingForces(1.0, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([1.0, 0.0]))
    arms = np.array([contact.point for contact in contacts])
    normals = np.array([contact.normal for contact in contacts])
    assert sunk(alone, maps, np.full(6, SPRING), arms, normals, 1.0) == math.inf
