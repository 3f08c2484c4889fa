"""What wears: encoders, motors, the first answer; and how it is asked for."""

from __future__ import annotations

import statistics

import pytest

from rtee.buses.line_model import Wire
from rtee.buses.wear import IDEAL, Wear, WornSensor
from rtee.drivers.axis import Axis
from rtee.drivers.emulators import make_emulator
from rtee.errors import ConfigError

ASK = bytes.fromhex("09 03 07 D0 00 03 04 0E")


def worn(**wear: float) -> Axis:
    axis = Axis(lower=0.0, upper=100.0, max_velocity=50.0, time_constant=1e-3, resolution=1e-6)
    axis.enabled = True
    axis.wear_down(Wear(**wear))  # type: ignore[arg-type]
    return axis


def test_an_encoder_with_play_follows_late_on_the_way_back() -> None:
    sensor = WornSensor(backlash=2.0, offset=0.5)
    assert [sensor.read(q) for q in (10.0, 20.0, 19.5, 18.5, 17.0)] == [
        10.5,
        19.5,
        19.5,
        19.5,
        18.5,
    ]


def test_noise_has_its_deviation_and_is_the_same_in_every_run() -> None:
    first, second = ([WornSensor(noise=0.3).read(0.0) for _ in range(1)] for _ in range(2))
    assert first == second
    sensor = WornSensor(noise=0.3)
    assert statistics.stdev(sensor.read(1.0) for _ in range(2000)) == pytest.approx(0.3, rel=0.1)


def test_a_command_is_followed_after_the_lag_at_the_pace_and_a_stop_at_once() -> None:
    axis = worn(lag=0.1, pace=0.5)
    axis.target = 50.0
    axis.advance(0.09)
    assert axis.position == 0.0
    assert axis.moving
    assert not axis.blocked
    assert axis.effort == 0.0
    axis.advance(1.01)
    assert axis.position == pytest.approx(25.0, rel=0.02)  # 1 s at half of 50 a second
    axis.target = axis.position
    axis.advance(0.01)
    assert axis.velocity == 0.0
    assert not axis.moving


def test_a_stream_of_targets_is_followed_late_without_stopping() -> None:
    axis = worn(lag=0.1)
    for k in range(100):
        axis.target = 0.3 * k
        axis.advance(0.01)
        assert k < 15 or axis.velocity > 0.0
    assert axis.position == pytest.approx(0.3 * 90, abs=1.0)


def test_it_warms_up_while_it_waits() -> None:
    axis = worn(warmth=15.0)
    before = axis.temperature
    for _ in range(60):
        axis.advance(10.0)
    assert axis.temperature == pytest.approx(before + 15.0, abs=1.0)


@pytest.mark.parametrize("network", [False, True])
def test_the_first_answer_is_late_and_on_a_line_damaged(network: bool) -> None:
    gripper = make_emulator("robotiq_2f", {"port": "/dev/x", "emulator": {"wear": "worn"}})
    wire = Wire([gripper], timed=False, adapter=not network)
    wire.reset()
    answers = []
    for at in (1.0, 2.0):
        wire.receive(ASK, at)
        assert wire.step(at + 0.04) == [] or at > 1.0
        answers += wire.step(at + 0.06)
        answers = answers or []
    wire.receive(ASK, 3.0)
    answers += wire.step(3.0)
    assert answers[-1][0] == 9
    assert (answers[0][0] == 9) is network


def test_every_device_is_ideal_unless_it_is_asked_to_be_worn() -> None:
    plain = make_emulator("wsg50", {})
    assert plain.wear is IDEAL
    given = make_emulator("wsg50", {"emulator": {"wear": {"lag": 0.2}}})
    assert (given.wear.lag, given.wear.late) == (0.2, type(given).WEAR.late)


@pytest.mark.parametrize(
    ("wear", "text"),
    [
        ("rusty", "write worn, ideal, or the values that differ"),
        ({"lags": 0.1}, "did you mean 'lag'"),
        ({"lag": -1.0}, "wear 'lag'"),
        ({"pace": "slow"}, "wear 'pace'"),
    ],
)
def test_what_is_no_wear_is_refused(wear: object, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        make_emulator("wsg50", {"emulator": {"wear": wear}})
