"""The motor axis that the emulators move."""

from __future__ import annotations

import pytest

from rtee.drivers.axis import Axis, VirtualObject


def axis(position: float, target: float, obstacle: VirtualObject | None = None) -> Axis:
    made = Axis(position, lower=0.0, upper=255.0, max_effort=100.0, friction=10.0, resolution=0.3)
    made.enabled = True
    made.obstacle = obstacle
    made.target = target
    return made


@pytest.mark.parametrize("obstacle", [None, VirtualObject(180.0, 20.0)])
@pytest.mark.parametrize(("start", "target"), [(150.0, 20.0), (20.0, 150.0)])
def test_friction_is_never_against_the_motion_that_is_wanted(
    start: float, target: float, obstacle: VirtualObject | None
) -> None:
    """At the step of arrival, too, where target and position are the same already."""
    moved = axis(start, target, obstacle)
    while True:
        moved.advance(0.001)
        if moved.velocity == 0.0:
            break
        assert moved.effort * moved.velocity > 0.0
    assert moved.position == target
    assert moved.effort == 0.0


def test_a_motor_weaker_than_its_friction_pushes_in_vain() -> None:
    weak = axis(20.0, 150.0)
    weak.max_effort = 9.0
    weak.advance(1.0)
    assert (weak.position, weak.velocity, weak.effort) == (20.0, 0.0, 9.0)
    weak.max_effort = 10.0
    weak.advance(1.0)
    assert weak.position == 150.0


def test_what_is_squeezed_is_held_with_the_limit_of_the_effort() -> None:
    closed = axis(100.0, 255.0, VirtualObject(180.0, 20.0))
    closed.advance(1.0)
    assert closed.position == pytest.approx(185.0)
    assert closed.blocked
    assert closed.effort == 100.0


def test_what_a_screw_squeezed_stays_squeezed_with_less_effort() -> None:
    for locking, there in ((False, 182.5), (True, 185.0)):
        closed = axis(100.0, 255.0, VirtualObject(180.0, 20.0))
        closed.self_locking = locking
        closed.advance(1.0)
        closed.max_effort = 50.0
        closed.advance(1.0)
        assert closed.position == pytest.approx(there)
        assert closed.effort == 50.0
        closed.target = 20.0
        closed.advance(1.0)
        assert closed.position == 20.0
