from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.actions.build import StepPlan, full_posture, generic, scaled, warnings_of
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference as Use
from rtee.actions.types import Composed
from rtee.errors import ActionError, ConfigError, UnknownAction, UnknownActuator
from rtee.hand.model import Hand

TRIG_INDEX = Use("Trig", ("index",))
PINCH = Use("PinchTight", ("index", "thumb"))


def test_scale_is_relative_to_the_rest_posture(library: ActionLibrary) -> None:
    made = library.compose("half", [Use("Trig", ("thumb",), 0.5)])
    assert made.posture.position["thumb_joint"] == pytest.approx(0.2 + 0.5 * (1.0 - 0.2))


def test_actuators_not_involved_stand_at_rest(library: ActionLibrary) -> None:
    posture = library.compose("one", [TRIG_INDEX]).posture
    assert posture.involved == ("index_joint",)
    assert posture.position == {
        "spread": 0.0,
        "index_joint": 1.0,
        "middle_joint": 0.0,
        "thumb_joint": 0.2,
    }


def test_shared_actuator_gets_the_mean_of_all_parts(library: ActionLibrary) -> None:
    three = [TRIG_INDEX, PINCH, Use("MultiPinchTight", ("index", "middle", "thumb"))]
    made = library.compose("mean", three)
    assert made.posture.position["index_joint"] == pytest.approx((1.0 + 0.5 + 0.5) / 3)
    assert made.posture.position["thumb_joint"] == pytest.approx(0.7)


def test_independent_refuses_shared_actuators(library: ActionLibrary) -> None:
    with pytest.raises(ActionError, match=r"'index_joint' twice: by Trig \(index\) and by Pinch"):
        library.compose("both", [TRIG_INDEX, PINCH], independent=True)
    assert library.compose("apart", [TRIG_INDEX, Use("point")], independent=True).independent


def test_scale_above_one_warns_and_clamps(library: ActionLibrary) -> None:
    made = library.compose("hard", [Use("Trig", ("index",), 1.5), Use("Trig", ("thumb",))])
    assert made.posture.position["index_joint"] == 1.2
    assert [w for w in warnings_of(made) if "1.5" in w and "Trig (index)" in w]
    assert warnings_of(library.find("schunkGrasp")) == []


@pytest.mark.parametrize("scale", [-0.1, math.nan, math.inf])
def test_bad_scale_is_refused(library: ActionLibrary, scale: float) -> None:
    with pytest.raises(ActionError, match="must be 0 or more"):
        library.compose("bad", [Use("Trig", ("index",), scale)])


@pytest.mark.parametrize(
    ("actuator", "value", "limit"),
    [("index_joint", 1.3, "upper limit 1.2 rad"), ("spread", -0.01, "lower limit 0 m")],
)
def test_value_outside_limits_names_the_limit(
    hand: Hand, actuator: str, value: float, limit: str
) -> None:
    with pytest.raises(ActionError, match=f"'{actuator}' is outside its {limit}"):
        generic(hand, "far", {actuator: value})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_value_that_is_not_finite_is_refused(hand: Hand, value: float) -> None:
    with pytest.raises(ActionError, match="finite"):
        generic(hand, "odd", {"spread": value})


def test_unknown_names_are_refused(library: ActionLibrary) -> None:
    with pytest.raises(UnknownActuator, match="did you mean 'index_joint'"):
        full_posture(library.hand, {"index_joimt": 0.0})
    with pytest.raises(UnknownAction, match="did you mean 'Trig'"):
        library.compose("bad", [Use("Trigg", ("index",))])
    with pytest.raises(ActionError, match="Trig does not exist with 'ring'"):
        library.compose("bad", [Use("Trig", ("ring",))])


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden", "a b"])
def test_bad_names_are_refused(hand: Hand, name: str) -> None:
    with pytest.raises(ConfigError, match="name"):
        generic(hand, name, {"spread": 0.0})


@pytest.mark.parametrize("name", ["trig", "pinch_tight", "MultiPinchTight_7", "--"])
def test_names_of_primitives_and_of_nothing_are_refused(hand: Hand, name: str) -> None:
    with pytest.raises(ActionError, match="name"):
        generic(hand, name, {"spread": 0.0})


def test_empty_actions_are_refused(library: ActionLibrary) -> None:
    with pytest.raises(ActionError, match="no parts"):
        library.compose("none", [])
    with pytest.raises(ActionError, match="no inner actions"):
        library.sequence("none", [])
    with pytest.raises(ActionError, match="at least one actuator"):
        generic(library.hand, "none", {})


def test_inner_names_of_a_timed_action_are_unique(library: ActionLibrary) -> None:
    twice = [StepPlan(TRIG_INDEX), StepPlan(TRIG_INDEX)]
    with pytest.raises(ActionError, match="two inner actions 'Trig_index'"):
        library.sequence("twice", twice)
    made = library.sequence("twice", [twice[0], StepPlan(TRIG_INDEX, alias="again")])
    assert [step.alias for step in made.steps] == ["Trig_index", "again"]


@pytest.mark.parametrize("margin", [-0.1, math.nan, math.inf, 1e6])
def test_bad_margins_are_refused(library: ActionLibrary, margin: float) -> None:
    with pytest.raises(ActionError, match="margin after"):
        library.sequence("bad", [StepPlan(TRIG_INDEX, after=margin)])


def test_timed_actions_do_not_nest(library: ActionLibrary) -> None:
    with pytest.raises(ActionError, match="cannot contain the timed action 'drill'"):
        library.compose("bad", [Use("drill")])
    with pytest.raises(ActionError, match="cannot contain the timed action 'drill'"):
        library.sequence("bad", [StepPlan(Use("drill"))])


def test_composed_of_composed(library: ActionLibrary) -> None:
    made = library.compose("more", [Use("schunkgrasp", (), 0.5), Use("point")])
    inner = library.find("schunkGrasp")
    assert isinstance(inner, Composed)
    assert made.posture.involved == ("index_joint", "middle_joint", "thumb_joint")
    assert made.posture.position["index_joint"] == pytest.approx(0.5)
    assert made.posture.position["thumb_joint"] == pytest.approx(
        0.2 + 0.5 * (inner.posture.position["thumb_joint"] - 0.2)
    )


@given(scale=st.floats(0.0, 5.0), target=st.floats(-0.5, 1.0))
def test_scaled_postures_stay_inside_the_limits(hand: Hand, scale: float, target: float) -> None:
    posture = scaled(hand, full_posture(hand, {"middle_joint": target}), scale)
    value = posture.position["middle_joint"]
    assert -0.5 <= value <= 1.0
    if scale <= 1.0:
        assert value == pytest.approx(scale * target)
