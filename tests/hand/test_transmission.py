from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hand.models import GRIPPER, SRDF, line_of
from rtee.errors import ExpressionError, ModelError, UnknownJoint, UserError
from rtee.hand.load import load_hand
from rtee.hand.model import Hand, JointRole

Load = Callable[..., Hand]


def with_mimic(mimic: str, joint: str = "right", text: str = GRIPPER) -> str:
    """Return the gripper with a mimic tag in one of its joints."""
    return re.sub(rf'(<joint name="{joint}".*?)(\n  </joint>)', rf"\1{mimic}\2", text, flags=re.S)


def chain(*joints: str) -> str:
    """Return a robot that is a chain of revolute joints with the given contents."""
    links = "".join(f'<link name="l{i}"/>' for i in range(len(joints) + 1))
    body = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<limit lower="-1" upper="2" velocity="1" effort="1"/>{content}</joint>\n'
        for i, content in enumerate(joints)
    )
    return f'<robot name="chain">{links}\n{body}</robot>'


def test_multiplier_and_offset(load: Load) -> None:
    hand = load(with_mimic('<mimic joint="left" multiplier="-0.5" offset="0.2"/>'))
    assert hand.actuator_names == ("left",)
    assert hand.transmission.linear
    np.testing.assert_allclose(hand.transmission.joints(np.array([0.4])), [0.4, 0.0])
    np.testing.assert_allclose(hand.transmission.matrix, [[1.0], [-0.5]])
    np.testing.assert_allclose(hand.transmission.offset, [0.0, 0.2])
    assert [joint.role for joint in hand.joints] == [JointRole.ACTUATOR, JointRole.MIMIC]


def test_mimic_declared_before_its_master_and_chains_of_mimics(load: Load) -> None:
    text = chain(
        '<mimic joint="j1" multiplier="2" offset="1"/>',
        '<mimic joint="j3" multiplier="3" offset="-0.5"/>',
        '<mimic joint="j0" multiplier="0.5"/>',
        "",
    )
    hand = load(text, None)
    assert hand.actuator_names == ("j3",)
    u = 0.3
    j1 = 3 * u - 0.5
    j0 = 2 * j1 + 1
    np.testing.assert_allclose(hand.transmission.joints(np.array([u])), [j0, j1, 0.5 * j0, u])
    np.testing.assert_allclose(hand.transmission.jacobian(np.array([u])).ravel(), [6, 3, 3, 1])


def test_chain_of_non_linear_mimics(load: Load) -> None:
    text = chain(
        "",
        '<mimic joint="j0" nlFunPos="x^2"/>',
        '<mimic joint="j1" multiplier="2" offset="1"/>',
        '<mimic joint="j2" nlFunPos="sin(x)"/>',
    )
    transmission = load(text, None).transmission
    assert not transmission.linear
    u = np.array([0.7])
    expected = [0.7, 0.49, 1.98, np.sin(1.98)]
    slopes = [1, 1.4, 2.8, np.cos(1.98) * 2.8]
    np.testing.assert_allclose(transmission.joints(u), expected)
    np.testing.assert_allclose(transmission.jacobian(u).ravel(), slopes)


def bell(x: float, height: float, middle: float, width: float) -> float:
    return height * 2.71828 ** -(((x - middle) / width) ** 2)


HERI_CURVES: dict[str, Callable[[float], float]] = {
    "min(0.56, 0.08519*": lambda x: min(
        0.56,
        bell(x, 0.08519, 0.9172, 0.1817)
        + bell(x, 21500000000000, 32.2, 5.513)
        - bell(x, 714900, -17.93, 4.61)
        + bell(x, 0.2555, 0.7317, 1.105),
    ),
    "-0.1028*": lambda x: -0.1028 * x**4 + 0.4311 * x**3 - 0.6019 * x**2 + 0.9364 * x - 0.01132,
    "-0.06965*": lambda x: (
        -0.06965 * x**5 + 0.4258 * x**4 - 0.7659 * x**3 + 0.3528 * x**2 + 0.4078 * x + 0.007414
    ),
    "min(1.22, 0.3378*": lambda x: min(
        1.22, 0.3378 * x**4 - 1.179 * x**3 + 1.103 * x**2 + 0.7363 * x + 0.01468
    ),
    "-0.3366*": lambda x: -0.3366 * x**4 + 1.674 * x**3 - 2.506 * x**2 + 1.552 * x - 0.02812,
}


def test_the_curves_of_heri_have_the_values_of_their_formulas() -> None:
    hand = load_hand(Path(__file__).parents[2] / "config" / "heri_ii")
    transmission = hand.transmission
    random, h, compared = np.random.default_rng(1), 1e-6, 0
    for u in random.uniform(hand.lower, hand.upper, (50, len(hand.actuators))):
        q, slopes = transmission.joints(u), transmission.jacobian(u)
        for row, joint in enumerate(hand.joints):
            mimic, actuator = hand.urdf.joints[joint.name].mimic, transmission.moves(row)
            if mimic is None or mimic.expression is None or actuator is None:
                continue
            (curve,) = (f for begin, f in HERI_CURVES.items() if mimic.expression.startswith(begin))
            x = float(u[actuator])
            assert q[row] == pytest.approx(curve(x), rel=1e-12, abs=1e-12)
            quotient = (curve(x + h) - curve(x - h)) / (2 * h)
            assert slopes[row, actuator] == pytest.approx(quotient, rel=1e-4, abs=1e-4)
            compared += 1
    assert compared == 50 * 11


def test_passive_joints_stand_and_their_mimics_with_them(load: Load) -> None:
    text = chain("", "", '<mimic joint="j1" multiplier="3" offset="0.25"/>').replace(
        'name="j1" type="revolute"><parent link="l1"/><child link="l2"/><limit lower="-1"',
        'name="j1" type="revolute"><parent link="l1"/><child link="l2"/><limit lower="0.5"',
    )
    hand = load(text, '<robot name="chain"><passive_joint name="j1"/></robot>')
    assert [joint.role for joint in hand.joints] == ["actuator", "passive", "mimic"]
    for u in (0.0, 1.0):
        np.testing.assert_allclose(hand.transmission.joints(np.array([u])), [u, 0.5, 1.75])
    assert hand.transmission.moves(1) is None
    assert hand.transmission.moves(2) is None


def test_a_joint_both_mimic_and_passive_is_a_mimic(load: Load) -> None:
    srdf = SRDF.replace("</robot>", '<passive_joint name="right"/></robot>')
    hand = load(with_mimic('<mimic joint="left"/>'), srdf)
    assert hand.joints[1].role is JointRole.MIMIC
    assert "joint 'right' is both mimic and passive; it is taken as a mimic" in hand.notes


def test_a_joint_coupled_with_zero_is_moved_by_nothing(load: Load) -> None:
    hand = load(with_mimic('<mimic joint="left" multiplier="0"/>'))
    assert hand.finger("right_finger").actuators == ()
    assert hand.actuators[0].fingers == ("left_finger",)


@pytest.mark.parametrize(
    ("mimic", "error", "message"),
    [
        ('<mimic joint="lefd"/>', UnknownJoint, "unknown joint 'lefd'; did you mean 'left'?"),
        ('<mimic joint="right"/>', ModelError, "mimic loop: 'right' -> 'right'"),
        ('<mimic joint=""/>', ModelError, "<mimic> needs the attribute 'joint'"),
        ('<mimic joint="left" multiplier="nan"/>', ModelError, "is not a finite number"),
        (
            '<mimic joint="left" nlFunPos="x +"/>',
            ExpressionError,
            "nlFunPos of joint 'right': 'x +' ends where",
        ),
        (
            '<mimic joint="left" nlFunPos="1/(x-0.4)"/>',
            ExpressionError,
            "nlFunPos of joint 'right' has no finite value and slope at left = 0.4",
        ),
    ],
)
def test_bad_mimic(load: Load, mimic: str, error: type[UserError], message: str) -> None:
    text = with_mimic(f"\n    {mimic}")
    with pytest.raises(error, match=re.escape(message)) as caught:
        load(text)
    assert caught.value.line == line_of(text, "<mimic")
    assert caught.value.path is not None
    assert caught.value.path.name == "gripper.urdf"


def test_mimic_of_a_fixed_joint(load: Load) -> None:
    fixed = GRIPPER.replace('name="left" type="revolute"', 'name="left" type="fixed"')
    text = fixed.replace(
        "</robot>",
        '<link name="x"/><joint name="j" type="continuous"><parent link="palm"/>'
        '<child link="x"/></joint></robot>',
    )
    with pytest.raises(ModelError, match="joint 'right' mimics 'left', which is fixed"):
        load(with_mimic('<mimic joint="left"/>', text=text))


def test_loop_of_mimics_names_the_loop(load: Load) -> None:
    text = chain("", '<mimic joint="j2"/>', '<mimic joint="j3"/>', '<mimic joint="j1"/>')
    with pytest.raises(ModelError, match=r"mimic loop: 'j1' -> 'j2' -> 'j3' -> 'j1'"):
        load(text, None)


def test_jacobian_equals_finite_differences(real_hand: Hand) -> None:
    transmission = real_hand.transmission
    h = 1e-6
    generator = np.random.default_rng(0)
    for _ in range(5):
        u = generator.uniform(real_hand.lower, real_hand.upper)
        jacobian = transmission.jacobian(u)
        assert jacobian.shape == transmission.matrix.shape
        for i in range(transmission.matrix.shape[1]):
            step = np.zeros_like(u)
            step[i] = h
            difference = transmission.joints(u + step) - transmission.joints(u - step)
            np.testing.assert_allclose(jacobian[:, i], difference / (2 * h), atol=1e-7)


def test_many_postures_at_once_equal_one_by_one(real_hand: Hand) -> None:
    transmission = real_hand.transmission
    u = np.random.default_rng(1).uniform(real_hand.lower, real_hand.upper, (7, len(real_hand.rest)))
    many = transmission.joints(u)
    assert many.shape == (7, transmission.n_joints)
    np.testing.assert_allclose(many, [transmission.joints(row) for row in u], atol=1e-12)
    if transmission.linear:
        np.testing.assert_allclose(many, u @ transmission.matrix.T + transmission.offset)


def test_long_chain_of_mimics(load: Load) -> None:
    joints = ["", *(f'<mimic joint="j{i}"/>' for i in range(290))]
    transmission = load(chain(*reversed(_renumbered(joints))), None).transmission
    assert transmission.matrix.shape[1] == 1
    assert all(len(coupling.stages) == 1 for coupling in transmission.couplings)


def _renumbered(joints: list[str]) -> list[str]:
    """Return a chain of mimics such that each follows the next one when reversed."""
    last = len(joints) - 1
    return [joints[0], *(f'<mimic joint="j{last - i}"/>' for i, _ in pairwise(range(last + 1)))]


def test_an_actuator_that_is_not_measured_leaves_the_joints_of_others_alone(
    real_hand: Hand,
) -> None:
    transmission = real_hand.transmission
    u = 0.4 * real_hand.lower + 0.6 * real_hand.upper
    rates = np.linspace(-1.0, 1.0, len(u))
    known = transmission.joints(u)
    moving = transmission.velocities(u, rates)
    np.testing.assert_allclose(moving, transmission.jacobian(u) @ rates, atol=1e-12)
    for lost in range(len(u)):
        holed, slowed = u.copy(), rates.copy()
        holed[lost] = slowed[lost] = np.nan
        follows = [coupling.actuator == lost for coupling in transmission.couplings]
        expected = np.where(follows, np.nan, known)
        np.testing.assert_array_equal(transmission.joints(holed), expected)
        np.testing.assert_array_equal(transmission.joints(np.stack([holed, u]))[0], expected)
        np.testing.assert_array_equal(
            transmission.velocities(holed, slowed), np.where(follows, np.nan, moving)
        )
        both = transmission.velocities(np.stack([holed, u]), np.stack([slowed, rates]))
        np.testing.assert_array_equal(both, [np.where(follows, np.nan, moving), moving])


def test_a_curve_of_a_joint_that_stands_where_it_is_undefined(load: Load) -> None:
    text = chain("", "", '<mimic joint="j0" nlFunPos="sqrt(x-0.5)"/>', "")
    with pytest.raises(ExpressionError, match="no finite value at the position"):
        load(text, '<robot name="chain"><passive_joint name="j0"/></robot>')
