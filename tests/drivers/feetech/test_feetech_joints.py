"""Two servos that bend and tilt a finger: angles, velocities and efforts both ways."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.drivers.feetech.options import (
    Curve,
    Differential,
    DifferentialOptions,
    FeetechOptions,
    Joints,
)
from rtee.errors import ConfigError
from rtee.hand.validation import validated
from rtee.running.run import RunOptions, prepare
from rtee.testing import Session, actuator
from rtee.types import DeviceSpec
from tests.drivers.feetech.test_feetech_contract import CASE, DIFFERENTIAL, PAIRED

PLAIN = Differential(validated(DifferentialOptions, {"pairs": DIFFERENTIAL["pairs"]}))


@pytest.fixture(scope="module")
def amazing(repository: Path) -> DeviceSpec:
    prepared = prepare(str(repository / "config" / "amazing_hand"), RunOptions(driver="devices"))
    return prepared.devices[0].spec


def finger(spec: DeviceSpec, name: str, first: float, second: float) -> tuple[float, float]:
    """Return flexion and tilt of a finger at the angles of its servos [degrees]."""
    joints = Joints(spec, validated(FeetechOptions, dict(spec.options)))
    angles = np.zeros(len(spec.actuators))
    angles[joints.names.index(f"{name}_1")] = math.radians(first)
    angles[joints.names.index(f"{name}_2")] = math.radians(second)
    positions = joints.positions(angles)
    places = {a.name: i for i, a in enumerate(spec.actuators)}
    return positions[places[f"{name}_flexion"]], positions[places[f"{name}_tilt"]]


def test_a_curve_is_prolonged_and_inverted() -> None:
    curve = Curve([(0.0, 1.0), (1.0, 3.0), (2.0, 4.0)])
    assert [curve.at(x) for x in (-1.0, 0.5, 1.5, 4.0)] == [
        (-1.0, 2.0), (2.0, 2.0), (3.5, 1.0), (6.0, 1.0),
    ]  # fmt: skip
    assert [curve.inverse(y) for y in (-1.0, 2.0, 3.5, 6.0)] == [-1.0, 0.5, 1.5, 4.0]


def test_sum_and_difference_make_tilt_and_flexion() -> None:
    assert PLAIN.joints(0.5, -0.5) == pytest.approx((0.5, 0.0))
    assert PLAIN.joints(0.3, 0.3) == pytest.approx((0.0, 0.3))
    assert PLAIN.servos(0.4, 0.1) == pytest.approx((0.5, -0.3))
    assert PLAIN.jacobian(0.0, 0.0).tolist() == [[1.0, 1.0], [-1.0, 1.0]]


def test_a_tilt_gives_way_to_the_flexion() -> None:
    quarter = math.pi / 2.0
    assert PLAIN.servos(1.2, 0.9) == pytest.approx((quarter, -1.2 + (quarter - 1.2)))
    assert PLAIN.servos(1.2, -0.9) == pytest.approx((1.2 - (quarter - 1.2), -quarter))
    # A flexion that the servos do not reach ends at their limit, and leaves no tilt.
    assert PLAIN.servos(2.0, 0.5) == pytest.approx((quarter, -quarter))


@given(st.floats(0.0, 1.15), st.floats(-0.14, 0.14))
def test_positions_come_back(flexion: float, tilt: float) -> None:
    one = Differential(validated(DifferentialOptions, DIFFERENTIAL))
    servos = one.servos(flexion, tilt)
    assert max(abs(angle) for angle in servos) <= one.limit + 1e-9
    reached = one.joints(*servos)
    assert reached[0] == pytest.approx(flexion, abs=1e-9)
    if max(abs(angle) for angle in servos) < one.limit - 1e-9:
        assert reached[1] == pytest.approx(tilt, abs=1e-9)
    else:  # a servo is at its limit: the tilt gives way to the flexion
        assert abs(reached[1]) <= abs(tilt) + 1e-9


@given(st.floats(-0.6, 1.2), st.floats(-0.3, 0.3))
def test_the_derivative_is_that_of_the_map(bent: float, lean: float) -> None:
    one = Differential(validated(DifferentialOptions, DIFFERENTIAL))
    angles = np.array([bent + lean, lean - bent])
    step = 1e-7
    # Points of the curves have a slope on either side.
    points = [x for name in ("flexion", "tilt_share") for x, _ in DIFFERENTIAL[name]]  # type: ignore[misc]
    if any(abs(bent - x) < 1e-5 for x in points):
        return
    by_servo = np.array(
        [
            (np.array(one.joints(*(angles + d))) - np.array(one.joints(*(angles - d)))) / (2 * step)
            for d in np.eye(2) * step
        ]
    ).T
    assert one.jacobian(*angles.tolist()) @ by_servo == pytest.approx(np.eye(2), abs=1e-5)


# --- the AmazingHand -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("half", "proximal"),
    [(-45, -39.5), (-35, -30.2), (0, 0.0), (30, 20.6), (60, 35.9), (80, 42.2), (90, 43.7)],
)
def test_the_flexion_of_a_finger_is_that_of_its_linkage(
    amazing: DeviceSpec, half: float, proximal: float
) -> None:
    flexion, tilt = finger(amazing, "index", half, -half)
    assert math.degrees(flexion) - 30.2 == pytest.approx(proximal, abs=0.01)
    assert tilt == 0.0


@pytest.mark.parametrize(
    ("half", "bent", "tilt"),
    [
        (10, 0, 5.9), (20, 0, 11.7), (30, 0, 17.3), (40, 0, 22.5), (-40, 0, -22.5),
        (40, -30, 19.6), (40, 30, 18.8), (40, 60, 10.9),
    ],
)  # fmt: skip
def test_the_tilt_of_a_finger_shrinks_where_it_is_bent(
    amazing: DeviceSpec, half: float, bent: float, tilt: float
) -> None:
    _, found = finger(amazing, "ring", half + bent, half - bent)
    assert math.degrees(found) == pytest.approx(tilt, abs=0.02)


@pytest.mark.parametrize(
    ("pose", "positions"),
    [
        # The hand's own programs: (-35, 35) and (90, -90) degrees; they cut fractions off.
        ([0.0, 0.0] * 4, [391.5, 630.5]),
        ([0.0, 1.2898] * 4, [818.2, 203.8]),
    ],
)
def test_open_and_closed_are_those_of_its_programs(
    amazing: DeviceSpec, pose: list[float], positions: list[float]
) -> None:
    joints = Joints(amazing, validated(FeetechOptions, dict(amazing.options)))
    angles = joints.servos(np.array(pose))
    counts = {
        name: 511 + angle / math.radians(300.0) * 1024
        for name, angle in zip(joints.names, angles.tolist(), strict=True)
    }
    for name in ("index", "middle", "ring", "thumb"):
        assert [counts[f"{name}_1"], counts[f"{name}_2"]] == pytest.approx(positions, abs=0.1)


def test_every_corner_of_its_limits_can_be_reached(amazing: DeviceSpec) -> None:
    joints = Joints(amazing, validated(FeetechOptions, dict(amazing.options)))
    for flexion in (0, 1):
        for side in (0, 1):
            pose = np.array(
                [
                    (a.lower, a.upper)[flexion if a.name.endswith("flexion") else side]
                    for a in amazing.actuators
                ]
            )
            angles = joints.servos(pose)
            assert joints.limit_warnings(pose, angles) == ()
            assert joints.positions(angles) == pytest.approx(pose, abs=1e-9)


def test_its_fingertips_are_where_they_were_published(
    amazing: DeviceSpec, repository: Path
) -> None:
    from rtee.hand.kinematics import Kinematics

    hand = prepare(str(repository / "config" / "amazing_hand"), RunOptions()).hand
    kinematics = Kinematics(hand)
    # Half of the servos' difference [degrees], and x and z of the index finger's tip [mm].
    table = [(-35, -12.0, 189.2), (0, 44.1, 164.1), (40, 62.7, 118.0), (80, 58.6, 92.0)]
    for half, x, z in table:
        pose = np.array(hand.rest)
        pose[hand.actuator_index("index_flexion")] = finger(amazing, "index", half, -half)[0]
        place = kinematics.link_pose("index_distal", pose) @ np.array([0.0, 0.0, 0.0351, 1.0])
        assert place[[0, 2]] * 1e3 == pytest.approx([x, z], abs=1.3)
    pose = np.array(hand.rest)
    pose[hand.actuator_index("thumb_flexion")] = finger(amazing, "thumb", 0, 0)[0]
    place = kinematics.link_pose("thumb_distal", pose) @ np.array([0.0, 0.0, 0.0351, 1.0])
    assert place[:3] * 1e3 == pytest.approx([86.1, 44.2, 85.3], abs=1.3)


# --- options ---------------------------------------------------------------------------------


SERVOS = {
    f"{name}_{k}": {"id": 2 * i + k} for i, name in enumerate(("index", "middle")) for k in (1, 2)
}


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"differential": {**DIFFERENTIAL, "matrix": [[1, 1], [2, 2]]}}, "cannot be inverted"),
        ({"differential": {**DIFFERENTIAL, "flexion": [[0, 0], [0, 1]]}}, "flexion' must increase"),
        ({"differential": {**DIFFERENTIAL, "tilt": [[0, 1], [1, 0]]}}, "'tilt' must increase"),
        ({"differential": {**DIFFERENTIAL, "tilt": [[0, 1]]}}, "at least 2 items"),
        ({"differential": {**DIFFERENTIAL, "tilt_share": [[0, 1], [1, 0]]}}, "above 0"),
        ({"differential": {**DIFFERENTIAL, "limit": 0}}, "greater than 0"),
        ({"differential": None}, "must name the device's actuators"),
        ({"family": "abc"}, "'scs', 'sts', 'sms' or 'hls'"),
        ({"baudrate": 9600}, "baudrate must be one of 1000000"),
        ({"servos": {"index_1": {"id": 1}}}, "servo 'index_2', which 'servos' does not name"),
        ({"servos": {**SERVOS, "index_1": {"id": 2}}}, "two servos have the same id"),
        ({"servos": {**SERVOS, "index_1": {"id": 254}}}, "less than or equal to 253"),
        ({"servos": {**SERVOS, "index_1": {"id": 1, "zero": 1024}}}, "from 0 to 1023, not 1024"),
        ({"servos": {**SERVOS, "more": {"id": 9}}}, "do not match: more"),
        ({"torque": 1.5}, "less than or equal to 1"),
    ],
)  # fmt: skip
def test_options_that_cannot_be_are_told(changes: dict[str, Any], problem: str) -> None:
    made = {"family": "scs", "servos": SERVOS, "differential": DIFFERENTIAL, **changes}
    case = replace(CASE, actuators=PAIRED, options=made)
    with pytest.raises(ConfigError, match=problem):
        Session(case)


def test_a_servo_in_two_pairs_is_told() -> None:
    pairs = {
        "a": {"servos": ["s1", "s2"], "actuators": ["f", "t"]},
        "b": {"servos": ["s1", "s3"], "actuators": ["g", "u"]},
    }
    servos = {f"s{i}": {"id": i} for i in (1, 2, 3)}
    made = {"family": "scs", "servos": servos, "differential": {"pairs": pairs}}
    with pytest.raises(ConfigError, match="servo 's1' is in two pairs"):
        Session(replace(CASE, actuators=(actuator("f", 0.0, 1.0),), options=made))
