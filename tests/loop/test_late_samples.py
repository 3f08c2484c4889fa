"""A busy computer: late ticks, gaps between measurements and late references are no contact."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from loop.hands import make_hand, make_library
from rtee.commands import SetActive
from rtee.hand.config_schema import StallSettings
from rtee.hand.model import Hand
from rtee.loop.controller import Controller
from rtee.loop.measured import Measured
from rtee.loop.planning import make_plan
from rtee.loop.settings import LoopSettings
from rtee.messages.goals import goal_of
from rtee.types import Event, OnContact, Result

INDEX, THUMB = 0, 2
NAN = math.nan
TICK = 0.002
LAG = 0.02
FRICTION = 0.05  # share of the effort limit
INERTIA = 3e-4  # effort as a share of the limit, per acceleration
FASTEST = 200.0  # acceleration of the motors
STIFFNESS = 20.0
STOP = {"": OnContact.STOP}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return make_hand(tmp_path_factory.mktemp("small"))


class Motor:
    """Follows its reference by a speed in proportion to its distance, up to a wall."""

    def __init__(self, limit: float, effort: float, wall: float) -> None:
        self.limit, self.full, self.wall = limit, effort, wall
        self.position = self.speed = self.effort = self.reference = 0.0

    def step(self) -> None:
        wanted = min(max((self.reference - self.position) / LAG, -self.limit), self.limit)
        gain = min(max((wanted - self.speed) / TICK, -FASTEST), FASTEST)
        self.speed += gain * TICK
        self.position += self.speed * TICK
        if self.position >= self.wall:
            self.position, self.speed = self.wall, 0.0
            self.effort = FRICTION * self.full + STIFFNESS * (self.reference - self.wall)
        else:
            moves = math.copysign(FRICTION, self.speed) if abs(self.speed) > 1e-4 else 0.0
            self.effort = (moves + INERTIA * gain) * self.full
        self.effort = min(max(self.effort, -self.full), self.full)


class Busy:
    """A hand whose device is asked at every n-th tick, and whose ticks and references are late.

    An answer is that of the exchange before, as on a wire.

    Args:
        hand: The hand.
        every: Ticks per exchange.
        walls: Where actuators are stopped, by index.

    Attributes:
        late: Times since the start of a goal at which nothing is scheduled, each with its duration;
            the device goes on meanwhile [s].
        held_up: The times within which references wait for the second one to reach the device [s].
    """

    def __init__(self, hand: Hand, every: int, walls: dict[int, float]) -> None:
        self.hand, self.every = hand, every
        self.settings = LoopSettings(rate=1.0 / TICK, stall=StallSettings(time=0.2, speed=0.03))
        self.controller = Controller(hand, self.settings)
        self.motors = [
            Motor(1.2 * a.velocity, a.effort, walls.get(i, math.inf))
            for i, a in enumerate(hand.actuators)
        ]
        self.late: Sequence[tuple[float, float]] = ()
        self.held_up = (0.0, 0.0)
        self.time = self.began = 0.0
        self.asked = -math.inf
        self.answer = self.known = self.read()
        self.sent: list[tuple[float, list[float]]] = []
        self.contacts: list[float] = []
        self.results: list[Result] = []
        self.controller.apply(SetActive(dict.fromkeys(hand.actuator_names, True)), 0.0)
        self.tick()

    def read(self) -> tuple[list[float], list[float]]:
        return [m.position for m in self.motors], [m.effort for m in self.motors]

    def turn(self) -> None:
        """Let one tick's time pass for the device."""
        self.time += TICK
        while self.sent and self.sent[0][0] <= self.time:
            for motor, reference in zip(self.motors, self.sent.pop(0)[1], strict=True):
                motor.reference = reference
        for motor in self.motors:
            motor.step()

    def tick(self) -> None:
        self.turn()
        while any(0.0 <= self.time - self.began - at < lasts for at, lasts in self.late):
            self.turn()
        fresh = self.time - self.asked >= self.every * TICK - 1e-9
        if fresh:
            self.known, self.answer, self.asked = self.answer, self.read(), self.time
            held, until = (self.began + at for at in self.held_up)
            due = until if held <= self.time < until else self.time
            self.sent.append((due, list(self.controller.reference_position)))
        n = len(self.motors)
        measured = Measured(*self.known, [NAN] * n, [fresh] * n, [-1] * n)
        self.controller.step(self.time, measured)
        for item in self.controller.outbox.items:
            if isinstance(item, Result):
                self.results.append(item)
            elif isinstance(item, Event) and item.kind == "contact":
                self.contacts.append(self.time)
        self.controller.outbox.items.clear()

    def do(self, action: str, *elements: str, **goal: object) -> Result:
        made = goal_of(action, elements, **goal)  # type: ignore[arg-type]
        self.began = self.time
        plan = make_plan(made, self.hand, make_library(self.hand), self.settings)
        self.controller.accept(plan, self.time)
        while not self.results:
            self.tick()
        self.late, self.held_up = (), (0.0, 0.0)
        return self.results.pop()

    def pinch(self, **goal: object) -> Result:
        return self.do("PinchTight", "index", "thumb", speed=0.5, **goal)


def practised(small: Hand, every: int, walls: dict[int, float] | None = None) -> Busy:
    """Return a hand that knows its free motion, and how often its device answers."""
    busy = Busy(small, every, {})
    for _ in range(2):
        assert busy.pinch().reached
        assert busy.do("open").reached
    for i, wall in (walls or {}).items():
        busy.motors[i].wall = wall
    return busy


@pytest.mark.samples("0.05-on_contact1", "0.15-on_contact0")
@pytest.mark.parametrize("on_contact", [{}, STOP])
@pytest.mark.parametrize("lasts", [0.05, 0.1, 0.15])
def test_a_slow_device_that_has_not_got_its_first_reference_is_no_stall(
    small: Hand, lasts: float, on_contact: dict[str, OnContact]
) -> None:
    """Its first measurements are older than the goal, and every late tick makes them older."""
    for at in (0.0, 0.02, 0.08):
        busy = practised(small, every=40)
        # Once, or again and again while the goal sets out.
        turns = 1 if lasts > 0.1 else 6
        busy.late = [(at + k * (lasts + 0.03), lasts) for k in range(turns)]
        result = busy.pinch(on_contact=on_contact)
        assert (result.outcome, result.touched) == ("reached", ()), (at, result.position)


@pytest.mark.parametrize("lasts", [0.06, 0.1, 0.15, 0.18])
def test_making_up_for_late_references_is_no_contact(small: Hand, lasts: float) -> None:
    """They come all at once, and to accelerate takes more effort than any motion before."""
    busy = practised(small, every=3)
    busy.held_up = (0.2, 0.2 + lasts)
    result = busy.pinch(on_contact=STOP)
    assert (result.outcome, result.touched) == ("reached", ()), result.position


@pytest.mark.parametrize("every", [1, 7])
def test_what_is_met_while_making_up_for_late_references_is_felt(small: Hand, every: int) -> None:
    busy = practised(small, every, {INDEX: 0.25, THUMB: 0.2})
    busy.held_up = (0.1, 0.3)
    result = busy.pinch(on_contact=STOP)
    assert set(result.touched) == {"index", "thumb"}
    assert result.position["index_base"] == pytest.approx(0.25)


def test_a_late_loop_does_not_hide_what_is_held(small: Hand) -> None:
    for at in (0.0, 0.05, 0.3, 0.5):
        busy = practised(small, 40, {INDEX: 0.6, THUMB: 0.5})
        busy.late = [(at + 0.18 * k, 0.15) for k in range(8)]
        result = busy.pinch()
        assert (result.outcome, set(result.grasped_fingers)) == ("held", {"index", "thumb"})
