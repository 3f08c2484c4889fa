"""Streams of set-points: the way between samples, take-over and hand-back, what is dropped."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from msgspec import structs

from rtee.actions.library import ActionLibrary
from rtee.commands import (
    STREAM_ENDED,
    BeginStream,
    Cancel,
    Command,
    EndStream,
    Freeze,
    Hold,
    Jog,
    SetActive,
    StreamSample,
    StreamTargets,
)
from rtee.errors import GoalRejected
from rtee.hand.config_schema import ProfileKind, ProfileSettings, StreamSettings
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.loop.controller import Controller
from rtee.loop.measured import Measured
from rtee.loop.planning import make_plan
from rtee.loop.settings import LoopSettings
from rtee.loop.streams.intake import TimeBase
from rtee.loop.streams.targets import Targets
from rtee.types import Event, Goal, Named, Result

from .hands import running

PERIOD = 1e-3
"""Of the loop [s]."""

WITHOUT_SHRINKING = (Phase.explicit, Phase.reuse, Phase.generate)
"""An example takes a tenth of a second: to look for the smallest one would take minutes."""

CLOCK = -500.0
"""What the client's clock shows when the hand's shows 0 [s]."""


def sample(at: float, arrival: float, velocity: float = math.nan, **to: float) -> StreamSample:
    return StreamSample("s", at + CLOCK, arrival, to, {}, to, dict.fromkeys(to, velocity))


class Bench:
    """A controller whose actuators are where their references are."""

    def __init__(self, hand: Hand, profile: ProfileKind = ProfileKind.S_CURVE) -> None:
        self.settings = LoopSettings(profile=ProfileSettings(profile))
        self.controller = Controller(hand, self.settings)
        self.now = 0.0
        self.positions: list[list[float]] = []
        self.velocities: list[list[float]] = []
        self.events: list[Event] = []
        self.results: list[Result] = []
        self.limited = 0
        self.objects: dict[int, float] = {}
        self.apply(SetActive(dict.fromkeys(hand.actuator_names, True)))
        self.run(0.01)

    def apply(self, command: Command) -> None:
        self.controller.apply(command, self.now)

    def begin(
        self, rate: float = 50.0, deadline: float = 0.1, effort: dict[str, float] | None = None
    ) -> None:
        self.apply(BeginStream("s", rate, deadline, effort=effort or {}))

    def step(self) -> None:
        controller = self.controller
        here = list(controller.reference_position)
        effort = [0.0] * len(here)
        for i, most in self.objects.items():
            if here[i] > most:  # pressed with all that is allowed
                here[i], effort[i] = most, controller.reference_effort[i]
        nothing = [math.nan] * len(here)
        fresh, grasped = [True] * len(here), [-1] * len(here)
        controller.step(self.now, Measured(here, effort, nothing, fresh, grasped))
        self.positions.append(list(controller.reference_position))
        self.velocities.append(list(controller.reference_velocity))
        for item in controller.outbox.items:
            if isinstance(item, Event):
                self.events.append(item)
            elif isinstance(item, Result):
                self.results.append(item)
        controller.outbox.items.clear()
        self.now += PERIOD

    def run(self, seconds: float, samples: Iterable[StreamSample] = ()) -> None:
        """Tick, and take the samples when they arrive."""
        left = sorted(samples, key=lambda each: each.arrival)
        for _ in range(round(seconds / PERIOD)):
            while left and left[0].arrival <= self.now:
                self.apply(left.pop(0))
            self.step()

    def rest(self) -> None:
        """Tick until nothing moves any more, for 4 s at most."""
        for _ in range(4000):
            self.step()
            if not self.controller.moving:
                return
        raise AssertionError("the hand does not come to rest")

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]

    def check_limits(self, hand: Hand) -> None:
        """Check that no reference jumped: velocity and acceleration are within the limits."""
        position, velocity = np.array(self.positions), np.array(self.velocities)
        for i, spec in enumerate(hand.actuators):
            assert (position[:, i] >= spec.lower - 1e-9).all()
            assert (position[:, i] <= spec.upper + 1e-9).all()
            steps = np.diff(position[:, i]) / PERIOD
            assert np.abs(steps).max() <= spec.velocity * (1 + 1e-6)
            change = np.abs(np.diff(velocity[:, i])) / PERIOD
            assert change.max() <= spec.acceleration * (1 + 1e-5)


def wave(t: float, frequency: float = 0.5, amplitude: float = 0.3) -> float:
    return 0.7 + amplitude * math.sin(2.0 * math.pi * frequency * t)


def wavy(
    rate: float, seconds: float, start: float = 0.02, delay: float = 0.0
) -> list[StreamSample]:
    times = start + np.arange(round(seconds * rate)) / rate
    return [sample(t, t + delay, index_base=wave(t)) for t in times.tolist()]


def test_a_sine_comes_through_a_lag_later(hand: Hand) -> None:
    bench = Bench(hand)
    bench.begin()
    bench.run(6.0, wavy(50.0, 6.0))
    lag = bench.controller.stream.status().lag  # type: ignore[union-attr]
    assert 0.02 <= lag <= 0.029
    times = np.arange(len(bench.positions)) * PERIOD
    found = np.array(bench.positions)[:, 0]
    late = times > 2.0
    meant = np.array([wave(t - lag) for t in times[late].tolist()])
    assert np.abs(found[late] - meant).max() < 0.002 * 0.3
    bench.check_limits(hand)


def test_given_velocities_are_met(hand: Hand) -> None:
    """At 5 samples a period of the sine they make the difference."""
    errors = []
    for known in (True, False):
        bench = Bench(hand)
        bench.begin(5.0, 1.0)
        times = [0.02 + k / 5.0 for k in range(40)]
        slopes = [0.3 * math.pi * math.cos(math.pi * t) if known else math.nan for t in times]
        samples = [sample(t, t, v, index_base=wave(t)) for t, v in zip(times, slopes, strict=True)]
        bench.run(8.0, samples)
        lag = bench.controller.stream.status().lag  # type: ignore[union-attr]
        now = np.arange(len(bench.positions)) * PERIOD
        meant = np.array([wave(t - lag) for t in now.tolist()])
        errors.append(np.abs(np.array(bench.positions)[:, 0] - meant)[now > 4.0].max())
    assert errors[0] < 0.3 * errors[1]


@given(
    steps=st.lists(
        st.tuples(
            st.floats(0.0, 1.5),  # index_base
            st.floats(-0.5, 1.0),  # thumb_base
            st.floats(0.0, 0.06),  # delay [s]
            st.integers(0, 9),  # 0: lost
        ),
        min_size=2,
        max_size=40,
    ),
    rate=st.sampled_from([20.0, 50.0, 120.0]),
    profile=st.sampled_from([ProfileKind.S_CURVE, ProfileKind.STEP, ProfileKind.FILTER]),
    velocity=st.sampled_from([math.nan, 0.0, 2.0, -30.0]),
)
@settings(max_examples=25, deadline=None, phases=WITHOUT_SHRINKING)
def test_whatever_comes_no_reference_jumps(
    hand: Hand,
    steps: list[tuple[float, float, float, int]],
    rate: float,
    profile: ProfileKind,
    velocity: float,
) -> None:
    bench = Bench(hand, profile)
    bench.begin(rate, 0.12)
    start = bench.now
    times = [start + k / rate for k in range(len(steps))]
    samples = [
        sample(t, t + delay, velocity, index_base=index, thumb_base=thumb)
        for t, (index, thumb, delay, there) in zip(times, steps, strict=True)
        if there
    ]
    bench.run(len(steps) / rate + 0.05, samples)
    bench.apply(EndStream("s"))
    bench.rest()
    bench.check_limits(hand)
    # What is between the samples keeps near them: nothing swings far out.
    if samples:
        assert bench.positions[-1][1] == 0.0  # what no sample names does not move
        assert bench.positions[-1][3] == 0.0


@pytest.mark.parametrize("profile", [ProfileKind.JERK_LIMITED, ProfileKind.S_CURVE])
def test_a_stream_that_ends_fast_at_a_limit_leaves_the_hand_resting_on_it(
    hand: Hand, profile: ProfileKind
) -> None:
    """A limit that keeps limiting a hand at rest would be reported every second."""
    bench = Bench(hand, profile)
    bench.begin()
    times = np.arange(0.0, 1.0, 0.02).tolist()
    bench.run(1.0, [sample(t, t, index_base=1.5 * t) for t in times])
    bench.apply(EndStream("s"))
    bench.rest()
    assert "limited" in bench.kinds()  # it braked into the limit
    bench.events.clear()
    bench.run(3.0)
    assert bench.kinds() == []
    assert bench.positions[-1][0] == bench.controller._profile.position[0] == 1.5


@given(values=st.lists(st.floats(0.2, 1.2), min_size=3, max_size=30))
@settings(max_examples=30, deadline=None, phases=WITHOUT_SHRINKING)
def test_the_way_keeps_to_the_samples(hand: Hand, values: list[float]) -> None:
    """In time, with estimated velocities: no further out than a stop from full speed takes."""
    bench = Bench(hand)
    bench.begin()
    start = bench.now
    values = [min(values), *values]
    samples = [sample(start + k / 50, start + k / 50, index_base=v) for k, v in enumerate(values)]
    bench.run(len(values) / 50 + 0.02, samples)
    found = np.array(bench.positions)[:, 0]
    spec = hand.actuators[0]
    stop = spec.velocity**2 / (2.0 * spec.acceleration) + spec.velocity * 0.02
    assert found.max() <= max(values) + stop
    assert found.min() >= 0.0


@pytest.mark.parametrize("profile", [ProfileKind.S_CURVE, ProfileKind.FILTER, ProfileKind.STEP])
@pytest.mark.parametrize("how", ["goal", "jog", "hold", "end", "deadline"])
def test_taking_over_and_handing_back(
    hand: Hand, library: ActionLibrary, profile: ProfileKind, how: str
) -> None:
    bench = Bench(hand, profile)
    first = make_plan(Goal(Named("fist")), hand, library, bench.settings)
    bench.controller.accept(first, bench.now)
    bench.run(0.2)
    assert bench.controller.moving
    bench.begin()
    start = bench.now
    samples = [
        sample(start + k / 50, start + k / 50, index_base=wave(k / 50.0, 1.0)) for k in range(60)
    ]
    bench.run(1.0, samples)
    assert bench.results[0].preempted
    moving = bench.velocities[-1][0]
    assert abs(moving) > 0.3
    match how:
        case "goal":
            plan = make_plan(Goal(Named("Trig", ("index",))), hand, library, bench.settings)
            bench.controller.accept(plan, bench.now)
        case "jog":
            bench.apply(Jog({"index_base": 0.1}))
        case "hold":
            bench.apply(Hold("because"))
        case "end":
            bench.apply(EndStream("s"))
    bench.run(3.0)
    bench.check_limits(hand)
    assert bench.velocities[-1] == [0.0] * 4
    if how == "deadline":
        assert bench.kinds().count("stream_paused") == 1
        assert STREAM_ENDED not in bench.kinds()
        assert bench.controller.stream is not None
    else:
        assert bench.kinds().count(STREAM_ENDED) == 1
        assert bench.controller.stream is None
    if how == "goal":
        assert bench.results[1].reached
        assert bench.positions[-1][0] == pytest.approx(1.5, abs=0.01)
    if how == "jog":
        assert bench.positions[-1][0] == pytest.approx(0.1)


def test_a_pause_brakes_and_the_next_sample_goes_on(hand: Hand) -> None:
    bench = Bench(hand)
    bench.begin()
    start = bench.now
    ramp = [sample(start + k / 50, start + k / 50, index_base=0.02 * k) for k in range(25)]
    bench.run(2.0, ramp)
    rested = bench.positions[-1][0]
    # Braked within about a fifth of a second at 1 rad/s.
    assert 0.48 <= rested <= 0.62
    assert bench.kinds() == ["stream_paused"]
    bench.run(
        0.5, [sample(start + 2.0 + k / 50, start + 2.0 + k / 50, index_base=0.3) for k in range(20)]
    )
    assert bench.positions[-1][0] == pytest.approx(0.3, abs=1e-3)
    assert bench.controller.stream is not None
    assert bench.controller.stream.status().pauses == 2
    bench.check_limits(hand)


def test_silence_brakes_before_the_deadline(hand: Hand) -> None:
    bench = Bench(hand)
    bench.begin(deadline=10.0)
    start = bench.now
    ramp = [sample(start + k / 50, start + k / 50, index_base=0.02 * k) for k in range(25)]
    bench.run(1.0, ramp)
    # At 1 rad/s, two periods further and half of three in which it brakes.
    assert bench.positions[-1][0] == pytest.approx(0.48 + (2.0 + 1.5) / 50, abs=0.005)
    assert bench.velocities[-1][0] == pytest.approx(0.0, abs=1e-9)
    assert bench.kinds() == []
    bench.check_limits(hand)


def test_one_slow_actuator_delays_no_other(hand: Hand) -> None:
    """The slide needs half a second for its way, the index does not wait."""
    alone, both = Bench(hand), Bench(hand)
    for bench, more in ((alone, {}), (both, {"thumb_slide": 0.04})):
        bench.begin()
        start = bench.now
        bench.run(
            0.4,
            [
                sample(start + k / 50, start + k / 50, index_base=wave(k / 50), **more)
                for k in range(20)
            ],
        )
    assert [p[0] for p in alone.positions] == [p[0] for p in both.positions]
    assert 0.02 < both.positions[-1][3] < 0.04


def test_what_is_dropped_is_counted(hand: Hand) -> None:
    bench = Bench(hand)
    bench.begin()
    start = bench.now
    good = [sample(start + k / 50, start + k / 50, index_base=0.5) for k in range(50)]
    spikes = {10: 1.4, 30: 1.3}
    for k, value in spikes.items():
        good[k] = sample(start + k / 50, start + k / 50, index_base=value)
    again = [sample(start + 0.1, start + 0.105, index_base=0.9)]  # the stamp of good[5]
    older = [sample(start + 0.29, start + 0.305, index_base=0.9) for _ in range(2)]
    bench.run(1.0, [*good, *again, *older])
    found = bench.controller.stream.status()  # type: ignore[union-attr]
    assert (found.duplicates, found.out_of_order, found.outliers) == (1, 2, 2)
    assert found.samples == 48
    late = np.array(bench.positions)[500:, 0]
    assert np.abs(late - 0.5).max() < 1e-3


def test_a_step_that_is_meant_is_believed_at_its_second_sample(hand: Hand) -> None:
    bench = Bench(hand)
    bench.begin()
    start = bench.now
    values = [0.2] * 20 + [1.4] * 40
    samples = [sample(start + k / 50, start + k / 50, index_base=v) for k, v in enumerate(values)]
    bench.run(1.2, samples)
    assert bench.positions[-1][0] == pytest.approx(1.4, abs=1e-3)
    assert bench.controller.stream.status().outliers == 1  # type: ignore[union-attr]
    bench.check_limits(hand)


@given(
    jitter=st.lists(st.floats(0.0, 0.03), min_size=60, max_size=60),
    drift=st.floats(-2e-4, 2e-4),
    jump=st.sampled_from([0.0, 0.0, 3.0, -0.4]),
)
@settings(max_examples=25, deadline=None, phases=WITHOUT_SHRINKING)
def test_the_lag_is_bounded_whatever_the_clocks_do(
    hand: Hand, jitter: list[float], drift: float, jump: float
) -> None:
    bench = Bench(hand)
    bench.begin()
    start = bench.now
    samples = []
    for k, delay in enumerate(jitter):
        t = start + k / 50.0
        stamp = t * (1.0 + drift) + (jump if k > 30 else 0.0)
        samples.append(
            StreamSample(
                "s", stamp, t + delay, {}, {}, {"index_base": wave(t)}, {"index_base": math.nan}
            )
        )
    bench.run(1.3, samples)
    player = bench.controller.stream
    assert player is not None
    status = player.status()
    assert 0.0 < status.lag < 1.2 * max(1.0 / status.rate, 0.02) + 0.005 + 0.03
    bench.check_limits(hand)


def late(k: int, t: float, by: float) -> float:
    """The first sample comes late by so much: its stamp is that much older."""
    return t - by if k == 0 else t


def jumps(k: int, t: float, by: float) -> float:
    """The clock jumps in the middle of the stream."""
    return t + by if k >= 60 else t


def restarts(k: int, t: float, by: float) -> float:
    """The counter begins again at zero."""
    return t - 60 / 50.0 if k >= 60 else t + by


def wraps(k: int, t: float, by: float) -> float:
    """The counter wraps, again and again."""
    return math.fmod(t, by)


def glitch(k: int, t: float, by: float) -> float:
    """A single stamp is wrong."""
    return t + by if k == 60 else t


TROUBLES: list[tuple[Callable[[int, float, float], float], float]] = [
    *((late, by) for by in (0.3, 0.6, 3.0, 1e6)),
    *((jumps, by) for by in (0.3, 0.6, 5.0, 1e9, -0.05, -0.3, -0.9, -1.1, -5.0, -1e9)),
    *((restarts, by) for by in (0.5, 4.3e6)),
    *((wraps, by) for by in (1.0, 2.5)),
    *((glitch, by) for by in (0.7, 1e6, -0.1, -1e6)),
]


@pytest.mark.samples("*-0.6", "*--0.9", "*--5.0", "restarts-*", "*-1.0", "*-0.7", "*--1000000.0")
@pytest.mark.parametrize(("trouble", "by"), TROUBLES)
def test_a_stream_goes_on_whatever_its_clock_does(
    hand: Hand, trouble: Callable[[int, float, float], float], by: float
) -> None:
    """From 0.6 s on, a first sample that was late made all others count as in the future."""
    count, rate = 130, 50.0
    for seed in range(2):
        random = np.random.default_rng(seed)
        bench = Bench(hand)
        bench.begin(rate)
        base = TimeBase(rate, bench.now)
        samples, refused = [], 0
        arrival = start = bench.now
        for k in range(count):
            t = k / rate
            # In order, as over TCP, with a delay of some milliseconds.
            arrival = max(arrival, start + t + 0.002 + abs(random.normal(0.0, 0.004)))
            try:
                stamp = base.place(trouble(k, t, by), arrival)
            except GoalRejected:
                refused += 1
                continue
            to = {"index_base": wave(t)}
            samples.append(StreamSample("s", stamp, arrival, to, {}, to, {"index_base": math.nan}))
        bench.run(count / rate, samples)
        player = bench.controller.stream
        assert player is not None
        status = player.status()
        dropped = refused + status.out_of_order + status.duplicates
        events = 2 if trouble is wraps and by == 1.0 else 1
        assert dropped <= 6 * events, seed
        assert status.samples + dropped + status.outliers == count
        # The last samples are played: the lag is that of before.
        assert status.lag < 0.08
        # A small jump back is only forgotten after seconds; until then the way is extrapolated.
        close = 0.06 if trouble is jumps and -0.1 < by < 0.0 else 0.02
        assert bench.positions[-1][0] == pytest.approx(wave(count / rate - status.lag), abs=close)
        bench.check_limits(hand)


def test_stamps_that_do_not_agree_stay_refused() -> None:
    """Milliseconds taken for seconds, and stamps by chance, move nothing."""
    for wrong in (
        lambda k, _: 1000.0 * (100.0 + k / 50.0),
        lambda _, random: random.uniform(-1e6, 0.0),
        lambda *_: -77.0,
    ):
        random = np.random.default_rng(1)
        base = TimeBase(50.0, 0.0)
        for k in range(50):
            assert base.place(100.0 + k / 50.0, k / 50.0) == 100.0 + k / 50.0
        for k in range(50, 300):
            with pytest.raises(GoalRejected, match="take all stamps from one clock"):
                base.place(wrong(k, random), k / 50.0)


def test_what_a_network_held_back_does_not_change_the_time() -> None:
    """Ten samples of the past that arrive at once, after newer ones, are only out of order."""
    base = TimeBase(50.0, 0.0)
    for k in range(50):
        base.place(k / 50.0, k / 50.0)
    for k in range(35, 45):
        assert base.place(k / 50.0, 1.0 + (k - 35) * 1e-4) == k / 50.0
    assert base.place(51 / 50.0, 51 / 50.0) == 51 / 50.0


@pytest.mark.parametrize(
    "command",
    [Freeze("stopped"), SetActive({"index_base": False}), BeginStream("t", 10.0, 0.5), Hold()],
)
def test_what_ends_a_stream(hand: Hand, command: Command) -> None:
    bench = Bench(hand)
    bench.begin()
    bench.run(0.5, wavy(50.0, 0.5))
    bench.apply(command)
    bench.run(0.01)
    assert bench.kinds() == [STREAM_ENDED]
    assert bench.events[0].source == "s"
    assert bench.controller.ended_stream == "s"
    stays = bench.controller.stream
    assert stays is None or stays.name == "t"
    bench.apply(sample(1.0, bench.now, index_base=0.0))
    bench.run(0.5)
    assert bench.velocities[-1][0] == 0.0


def test_a_stream_presses_with_its_effort_and_then_with_that_of_holding(hand: Hand) -> None:
    bench = Bench(hand)
    own, grip = hand.actuators[0].effort, bench.controller.grip_effort
    limits = bench.controller.reference_effort
    bench.objects[0] = 0.5
    bench.begin(effort={"index_base": 0.9 * own})

    def closed(seconds: float, to: float) -> None:
        times = bench.now + np.arange(round(seconds * 50.0)) / 50.0
        bench.run(seconds, [sample(t, t, index_base=to) for t in times.tolist()])

    closed(1.0, 1.0)
    assert limits == pytest.approx([0.9 * own, *(a.effort for a in hand.actuators[1:])])
    closed(2.5, 1.0)  # blocked for longer than `grip_after`
    assert limits[0] == pytest.approx(grip * own)
    closed(1.0, 1.1)  # still inside of it
    assert limits[0] == pytest.approx(grip * own)
    closed(1.0, 0.2)
    assert limits[0] == pytest.approx(0.9 * own)
    bench.begin()  # the next stream has limits of its own: none
    closed(0.1, 0.3)
    assert limits[0] == pytest.approx(own)


def test_what_a_stream_holds_and_loses_is_told(hand: Hand) -> None:
    bench = Bench(hand)
    bench.objects[0] = 0.5
    bench.begin()
    times = bench.now + np.arange(100) / 50.0
    bench.run(2.0, [sample(t, t, index_base=1.0) for t in times.tolist()])
    assert not bench.controller.idle
    del bench.objects[0]
    times = bench.now + np.arange(50) / 50.0
    bench.run(1.0, [sample(t, t, index_base=1.0) for t in times.tolist()])
    assert bench.kinds() == ["grasp_lost"]
    assert "index" in bench.events[0].text


def test_a_hold_leaves_what_a_stream_grips_its_grip(hand: Hand) -> None:
    bench = Bench(hand)
    bench.objects[0] = 0.5
    bench.begin()
    times = bench.now + np.arange(100) / 50.0
    bench.run(2.0, [sample(t, t, index_base=0.8) for t in times.tolist()])
    bench.apply(Hold())
    bench.rest()
    assert bench.positions[-1][0] == pytest.approx(0.8, abs=1e-6)


def test_cancelling_a_goal_leaves_a_stream_alone(hand: Hand) -> None:
    bench = Bench(hand)
    bench.begin()
    bench.run(0.5, wavy(50.0, 0.5))
    bench.apply(Cancel())
    bench.run(0.01)
    assert bench.events == []


# --- what the names mean ---------------------------------------------------------------------

GEARED = """<robot name="geared">
  <link name="base"/>
  <joint name="drive" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1.2" velocity="3" effort="2"/></joint><link name="a"/>
  <joint name="half" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
    <mimic joint="drive" multiplier="-0.5" offset="0.1"/>
    <limit lower="-2" upper="2" velocity="3" effort="2"/></joint><link name="b"/>
  <joint name="square" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
    <mimic joint="drive" nlFunPos="x^2"/>
    <limit lower="-2" upper="2" velocity="3" effort="2"/></joint><link name="c"/>
  <joint name="hump" type="revolute"><parent link="c"/><child link="d"/><axis xyz="0 1 0"/>
    <mimic joint="drive" nlFunPos="x*(1-x)"/>
    <limit lower="-2" upper="2" velocity="3" effort="2"/></joint><link name="d"/>
  <joint name="free" type="revolute"><parent link="d"/><child link="e"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="3" effort="0"/></joint><link name="e"/>
</robot>"""


@pytest.fixture(scope="module")
def geared(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    path = tmp_path_factory.mktemp("geared") / "geared.urdf"
    path.write_text(GEARED)
    return load_model(path, None, name="geared", actuators=["drive"])


def resolved(
    hand: Hand,
    library: ActionLibrary,
    values: dict[str, float],
    velocity: dict[str, float] = {},  # noqa: B006
) -> tuple[dict[int, float], dict[int, float]]:
    return Targets(tuple(values), hand, library).resolve(values, velocity)


def test_joints_are_inverted_through_the_transmission(geared: Hand) -> None:
    library = ActionLibrary(geared, ())
    assert resolved(geared, library, {"half": -0.2})[0][0] == pytest.approx(0.6)
    positions, rates = resolved(geared, library, {"square": 0.25}, {"square": 1.0})
    assert positions[0] == pytest.approx(0.5)
    assert rates[0] == pytest.approx(1.0)
    # Two joints of one actuator that agree are one target.
    assert resolved(geared, library, {"half": -0.2, "square": 0.36})[0][0] == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"half": -0.2, "square": 0.04}, "need different positions of 'drive'"),
        ({"hump": 0.1}, "several positions of 'drive'"),
        ({"free": 0.1}, "no actuator moves the joint 'free'"),
        ({"drive": 45.0}, "are these degrees"),
        ({"half": 20.0}, "are these degrees"),
        ({"drive": math.nan}, "finite"),
        ({"nose": 0.1}, "neither an actuator nor a joint nor an action"),
    ],
)
def test_joint_targets_that_cannot_be_meant(
    geared: Hand, values: dict[str, float], said: str
) -> None:
    with pytest.raises(GoalRejected, match=said):
        resolved(geared, ActionLibrary(geared, ()), values)


def test_a_blend_adds_the_ways_from_rest(hand: Hand, library: ActionLibrary) -> None:
    blend = {"PinchTight index thumb": 0.5, "trig thumb": 0.25}
    positions, rates = resolved(hand, library, blend, dict.fromkeys(blend, 1.0))
    assert positions == pytest.approx({0: 0.5, 2: 0.65})
    assert rates == pytest.approx({0: 1.0, 2: 1.8})
    # A glove overshoots a little.
    assert resolved(hand, library, {"Trig thumb": 1.004}) == resolved(
        hand, library, {"Trig thumb": 1.0}
    )
    assert resolved(hand, library, {"Trig thumb": -0.01}) == resolved(
        hand, library, {"Trig thumb": 0.0}
    )
    full = resolved(hand, library, dict.fromkeys(blend, 1.0))[0]
    assert full[2] == 1.0  # clamped into the limits
    # With an actuator that none of the actions moves.
    assert resolved(hand, library, {**blend, "index_tip": 0.3})[0][1] == 0.3


@pytest.mark.parametrize(
    ("values", "velocity", "said"),
    [
        ({"Trig index": 1.6}, {}, "must be 0 to 1"),
        ({"Trig index": -0.6}, {}, "must be 0 to 1"),
        ({"Trig index": 40.0}, {}, "must be 0 to 1"),
        ({"Trig index": 0.2, "index_base": 0.1}, {}, "given twice"),
        ({"drill": 0.5}, {}, "timed"),
        ({"Trig nose": 0.5}, {}, "Trig"),
        ({"": 0.5}, {}, "is not an action"),
        ({"thumb_slide": 20.0}, {}, "are these millimetres"),
        ({"index_base": 0.2}, {"index_base": math.inf}, "finite"),
        ({"index_base": 0.2}, {"index_base": 500.0}, "far beyond its limit"),
        ({"index_base": 0.2}, {"index_tip": 1.0}, "no position"),
    ],
)
def test_targets_that_cannot_be_meant(
    hand: Hand,
    library: ActionLibrary,
    values: dict[str, float],
    velocity: dict[str, float],
    said: str,
) -> None:
    with pytest.raises(GoalRejected, match=said):
        resolved(hand, library, values, velocity)


# --- in a hand's loop ------------------------------------------------------------------------


@pytest.mark.anyio
class TestIntake:
    async def test_samples_move_the_hand(self, hand: Hand) -> None:
        async with running(hand) as rig:
            streams = rig.loop.streams
            streams.begin("s", 50.0)
            for k in range(60):
                streams.sample(StreamTargets("s", 7.0 + k / 50, {"fist": k / 60}))
                await rig.run(0.02)
            assert rig.driver.plants[0].position > 1.3
            record = rig.loop.snapshot()
            lag, jitter = record.channels["stream/lag"]
            assert 0.02 <= lag <= 0.03
            assert jitter < 0.002
            status = streams.status()
            assert (status.stream, status.samples, status.refused) == ("s", 60, 0)
            streams.end("s")
            await rig.run(0.3)
            assert streams.stream == ""
            assert "stream/lag" not in rig.loop.snapshot().channels
            assert STREAM_ENDED in rig.watcher.kinds()

    @pytest.mark.parametrize(
        ("rate", "deadline", "said"),
        [
            (10_000.0, None, "up to 500"),
            (0.0, None, "up to 500"),
            (math.nan, None, "up to 500"),
            (50.0, 0.0, "deadline"),
            (50.0, math.inf, "deadline"),
            (5.0, None, "would pause after every sample"),
        ],
    )
    async def test_streams_that_cannot_be(
        self, hand: Hand, rate: float, deadline: float | None, said: str
    ) -> None:
        async with running(hand) as rig:
            with pytest.raises(GoalRejected, match=said):
                rig.loop.streams.begin("s", rate, deadline)
            assert rig.loop.streams.stream == ""

    @pytest.mark.parametrize(
        ("stamp", "said"),
        [
            (math.nan, "a time in seconds"),
            (math.inf, "a time in seconds"),
            (1e9, "ahead of those before"),
            (-1e9, "before the newest one"),
        ],
    )
    async def test_stamps_that_cannot_be(self, hand: Hand, stamp: float, said: str) -> None:
        async with running(hand) as rig:
            streams = rig.loop.streams
            streams.begin("s", 50.0)
            streams.sample(StreamTargets("s", 100.0, {"index_base": 0.0}))
            await rig.run(0.02)
            with pytest.raises(GoalRejected, match=said):
                streams.sample(StreamTargets("s", stamp, {"index_base": 1.0}))
            await rig.run(0.3)
            assert rig.driver.plants[0].position == 0.0
            assert streams.status().refused == 1

    async def test_a_flood_is_thinned_and_counted(self, hand: Hand) -> None:
        async with running(hand) as rig:
            streams = rig.loop.streams
            streams.begin("s", 50.0)
            admitted = 0
            for k in range(3000):  # at 10 kHz
                admitted += streams.admit()
                if k % 10 == 0:
                    await rig.run(0.001)
            assert 20 <= admitted <= 20 + 0.3 * 1.5 * 50 + 1
            assert streams.status().thinned in (0, 3000 - admitted)

    async def test_the_deadline_of_hand_yaml(self, hand: Hand) -> None:

        chosen = structs.replace(LoopSettings(), stream=StreamSettings(deadline=0.3, max_lag=0.05))
        async with running(hand, chosen) as rig:
            rig.loop.streams.begin("s", 5.0)
            begun = None
            await rig.run(0.01)
            for record in rig.watcher.commands:
                begun = record.command if isinstance(record.command, BeginStream) else begun
            assert begun == BeginStream("s", 5.0, 0.3, 0.05)

    async def test_a_device_that_is_not_active_refuses(self, hand: Hand) -> None:
        async with running(hand) as rig:
            await rig.loop.disable()
            await rig.run(0.05)
            rig.loop.streams.begin("s", 50.0)
            with pytest.raises(GoalRejected, match="is inactive"):
                rig.loop.streams.sample(StreamTargets("s", 1.0, {"index_base": 0.5}))


@pytest.mark.anyio
async def test_stamps_nearer_than_clocks_resolve_are_one(hand: Hand) -> None:
    async with running(hand, LoopSettings(rate=100)) as rig:
        streams = rig.loop.streams
        streams.begin("s", 50.0)
        await rig.run(0.02)
        streams.sample(StreamTargets("s", 0.0, {"index_base": 0.0}))
        await rig.run(0.01)
        # The slope between them is not finite; it ended the loop once both had been played.
        streams.sample(StreamTargets("s", 1e-200, {"index_base": 0.0}))
        await rig.run(0.3)
        assert rig.loop.snapshot() is not None
