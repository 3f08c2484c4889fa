"""Contact sensors are not zero at rest, are noisy, and drift."""

from __future__ import annotations

import numpy as np
import pytest

from rtee.drivers.tare import SensorTare

REST = np.array([1.31, 2.9, 1.2])


def test_noise_at_rest_is_no_contact_and_a_contact_has_its_force() -> None:
    noise = np.random.default_rng(3)
    tare, t = SensorTare(0.15), 0.0
    for _ in range(2000):
        t += 0.01
        assert not tare.above(REST + 0.03 * noise.standard_normal(3), t).any()
    felt = tare.above(REST + np.array([0.0, 1.5, 0.0]), t + 0.01)
    assert felt == pytest.approx([0.0, 1.5, 0.0], abs=0.02)


def test_a_long_contact_does_not_become_rest() -> None:
    tare = SensorTare(0.15)
    tare.above(REST, 0.0)
    for k in range(6_000):
        felt = tare.above(REST + 0.5, 0.1 * (k + 1))
    assert felt == pytest.approx([0.5] * 3)


def test_rest_values_follow_slow_drift() -> None:
    tare = SensorTare(0.15)
    for k in range(6_000):  # ten minutes, in which they rise by 1.2 N
        assert not tare.above(REST + 0.002 * 0.1 * k, 0.1 * k).any()
    assert tare.above(REST + 1.2 + 0.4, 600.0) == pytest.approx([0.4] * 3, abs=0.1)


def test_what_was_held_when_it_began_is_felt_after_it_was_let_go() -> None:
    tare = SensorTare(0.15)
    assert not tare.above(REST + 2.0, 0.0).any()
    for k in range(200):
        assert not tare.above(REST, 0.01 * (k + 1)).any()
    assert tare.above(REST + 1.0, 2.01) == pytest.approx([1.0] * 3, abs=0.16)


def test_a_sensor_that_measured_nothing_begins_later() -> None:
    tare = SensorTare(0.15)
    assert not tare.above(np.array([np.nan, 1.0, 1.0]), 0.0)[1:].any()
    assert not tare.above(np.array([5.0, 1.0, 1.0]), 0.01).any()
    felt = tare.above(np.array([np.nan, 2.0, 1.0]), 0.02)
    assert np.isnan(felt[0])
    assert felt[1:] == pytest.approx([1.0, 0.0])
