"""One trial: approach, grasp, lift, shake; and whether the object was held."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ActionError, ConfigError, SimulationUnstable
from rtee.hand.model import Hand
from rtee.log.recording import outcome_of
from rtee.loop.observer import LoopObserver
from rtee.loop.settings import LoopSettings
from rtee.trials.arm_motion import CarrierScript
from rtee.trials.grasp_placement import Place, Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.result import CHOOSING
from rtee.trials.result import Trial as Trial
from rtee.trials.result import TrialResult as TrialResult
from rtee.trials.robust_places import graspable, misfit, robust_places
from rtee.trials.variation import EXPLORING_FROM, Variation, choosing_draw, draw
from rtee.types import Goal

Watch = Callable[[str, HeadlessHand[Simulation]], None]
"""Told at the moments of a trial: ``start``, ``approach``, ``grasp``, ``lift``, ``shake``."""

Progress = Callable[[int, int], None]
"""Told how many of how many variations were tried."""

_FIRST = 5
"""Tries with variation at each place, before places are compared."""

_SPARE = 1
"""A place that loses no more of ten tries is taken at once: nine of ten are wanted."""

_CONTENDERS = 2
"""Places that are moved and compared when places are chosen by more tries than usual: the five
tries that all places get may mistake the second best for the best."""

_CAREFUL_ROUNDS = 3
_STAYS = 0.002
"""Then, a place is moved so often, until it stays within this [m], a fifth of the variation."""

_AMIDST = 0.85
"""A place is amid those where the object is held if it is held at this share of those around it,
12 of 14; no other one is looked for then."""

_AROUND = np.array(
    [
        *(0.012 * np.array(corner) for corner in itertools.product((-1.0, 1.0), repeat=3)),
        *(sign * 0.02 * axis for axis in np.eye(3) for sign in (-1.0, 1.0)),
    ]
)
"""Where an object is tried around the best place, to find the middle of where it is held [m]: the
corners of a cube and twice as far along each axis as objects are varied. Since the points are
balanced, the middle stays where it is when all of them are held."""

_ROUNDS = 2
"""How often the best place is moved to that middle: the second time finds what the first left."""

_SETTLE = 0.4
"""Time for the object to come to rest in the hand [s]."""

_LIFT = 0.15
"""How far the hand lifts the object [m], in a second: an arm's calm motion."""

_HOLD = 2.0
"""How long the object is held before it is shaken [s]; one that slides falls within this time."""

_FALLEN = 0.06
"""An object that has moved farther in the hand has fallen [m]: more than a finger's breadth."""

_PUSHED = 0.05
"""How much farther closing fingers may push an object that they grasp [m]."""

_AMPLITUDE = 0.015
_FREQUENCY = 2.0
_CYCLES = 2
"""Shaking along each axis: to either side [m], how fast [Hz], and how often. The acceleration is up
to 2.4 m/s², a quarter of the weight, as of an arm that stops."""


def run_trial(
    hand: Hand,
    library: ActionLibrary,
    settings: LoopSettings,
    trial: Trial,
    *,
    observers: Sequence[LoopObserver] = (),
    watch: Watch | None = None,
    skip: int = 0,
    progress: Progress | None = None,
) -> TrialResult:
    """Try an action on an object at one place after the other until one is held.

    Args:
        hand: The hand.
        library: Its actions.
        settings: Its loop's settings.
        trial: What is tried.
        observers: Told of every tick, as in the loop.
        watch: Told of the moments of the trial.
        skip: Places to leave out, because they are known to fail.
        progress: Called with how many variations of a place were tried, and of how many.

    Returns:
        The result at the first place where it was held. With variations, the place is chosen by
        other draws than those that count: the first that survives nine of ten, or else the best
        one, moved to the middle of where the object is held around it. With more draws than usual
        (``trial.choosing``), the two best are always moved, and compared.

    Raises:
        UnknownAction: if there is no such action.
        ConfigError: if the object is none, or no place is left.
        ModelError: if the hand cannot be simulated.
    """
    action = library.find(trial.action, trial.elements)
    simulation = _simulation(hand, settings, trial)
    thing = graspable(trial.object, trial.mass)
    unfit = misfit(library, action, thing, trial.variations)
    if unfit:
        return TrialResult(trial, False, unfit, fits=False)
    # Geometry ranks the places, since each one tried in dynamics takes a second.
    places = robust_places(simulation, library, action, thing, trial.places)
    if not places:
        return TrialResult(trial, False, "the object fits nowhere between the fingers")
    if skip >= len(places):
        raise ConfigError(
            f"there are {len(places)} places for the object, so that leaving out {skip} leaves none"
        )
    varied = _Varied(hand, library, settings, trial, progress)
    tried: list[_Tried] = []
    ticks = 0
    for number, place in enumerate(places[skip:], skip + 1):
        # One simulation serves all places, since only the object's pose differs.
        simulation.reset()
        simulation.surroundings.place(simulation.surroundings.base_pose @ place.pose)
        headless = HeadlessHand(hand, library, settings, simulation, observers, ticks=ticks)
        here = _Tried(place, TrialRun(headless, trial, place, number, watch).result())
        ticks = headless.ticks
        tried.append(here)
        if trial.choosing > CHOOSING:
            varied.choose(here, _FIRST)
        elif varied.good(here):
            return varied.measured(here)
    ranked = sorted(tried, key=lambda here: here.rank, reverse=True)
    if not ranked[0].result.held:
        return ranked[0].result
    free = Places(simulation, hand, action)
    if trial.choosing > CHOOSING:
        return varied.measured(_carefully(ranked[:_CONTENDERS], varied, free))
    # None is good enough: the best one is as far as the next tries go.
    best = ranked[0]
    varied.choose(best, trial.choosing)
    for round_ in range(_ROUNDS):
        here = varied.at(varied.shifted(best.place, round_)[0], free, best)
        varied.choose(here, trial.choosing)
        # A place that was moved may be worse: the tries that moved it are few.
        best = max(best, here, key=lambda here: here.rank)
        if best is not here or best.lost <= _SPARE:
            break
    return varied.measured(best)


def _carefully(contenders: list[_Tried], varied: _Varied, free: Places) -> _Tried:
    """Return the best of some places, each moved to the middle of where the object is held.

    A place on the edge of that may survive all tries that choose it, so all are moved.
    """
    found = []
    for best in contenders:
        if not best.result.held:
            continue
        here = best
        for round_ in range(_CAREFUL_ROUNDS):
            place, here.around = varied.shifted(here.place, round_)
            best = max(best, here, key=lambda one: (one.result.held, one.around))
            shift = np.linalg.norm(place.pose[:3, 3] - here.place.pose[:3, 3])
            # Moving on from a place that is no better would lead away from the best one.
            if best is not here or shift < _STAYS:
                break
            here = varied.at(place, free, here)
            if not here.result.held:
                break
        varied.choose(best, varied.choosing)
        found.append(best)
        if best.lost == 0 and best.around >= _AMIDST:
            break
    # How well it lies amid places that hold says more than how little the object slipped there.
    return max(found, key=lambda one: (*one.rank[:2], one.around))


@dataclass
class _Tried:
    """A place, how the trial ended there, and which of the tries to choose it were held.

    Attributes:
        place: The place.
        result: How the trial ended there, without variation.
        held: Which of the tries to choose it were held.
        around: The share of the places around it where the object is held, as far as that is known.
    """

    place: Place
    result: TrialResult
    held: list[bool] = field(default_factory=list)
    around: float = 0.0

    @property
    def lost(self) -> int:
        """How many of these tries were lost."""
        return len(self.held) - sum(self.held)

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Larger is better."""
        share = sum(self.held) / len(self.held) if self.held else 0.0
        return self.result.held, share, -self.result.slip


def _simulation(
    hand: Hand, settings: LoopSettings, trial: Trial, variation: Variation | None = None
) -> Simulation:
    """Return the hand with the object of a trial, or with a variation of it."""
    options = SimOptions(
        object=trial.object,
        object_mass=trial.mass,
        friction=trial.friction,
        support="held",
        carrier="arm",
    )
    if variation is not None:
        friction = variation.friction if trial.friction is None else trial.friction
        changes = {
            "object_mass": trial.mass * variation.mass,
            "object_scale": variation.size,
            "friction": friction,
        }
        options = options.model_copy(update=changes)
    return make_simulation(hand, options, hand.actuator_names, settings.period)


class _Varied:
    """Tries the variations of a trial.

    Attributes:
        choosing: Tries by which a place is chosen.
    """

    def __init__(
        self,
        hand: Hand,
        library: ActionLibrary,
        settings: LoopSettings,
        trial: Trial,
        progress: Progress | None,
    ) -> None:
        self._hand, self._library, self._settings = hand, library, settings
        self._trial, self._progress = trial, progress
        self.choosing = trial.choosing

    def run(self, place: Place, variation: Variation | None = None) -> TrialRun:
        """Return the trial at a place, or a variation of it, ready to start."""
        # Size, mass and friction are compiled into the model, so each variation needs its own.
        simulation = _simulation(self._hand, self._settings, self._trial, variation)
        around = simulation.surroundings
        if variation is not None:
            place = replace(place, pose=variation.moved(place.pose))
        around.place(around.base_pose @ place.pose)
        headless = HeadlessHand(self._hand, self._library, self._settings, simulation)
        return TrialRun(headless, self._trial, place)

    def good(self, here: _Tried) -> bool:
        """Return whether a place is good enough for no other one to be tried."""
        self.choose(here, _FIRST)
        if not here.result.held or here.lost:
            return False
        self.choose(here, self.choosing)
        return here.lost <= _SPARE

    def choose(self, here: _Tried, count: int) -> None:
        """Try a place with variation until there are so many tries, to compare it with others."""
        # No more than are wanted afterwards: two variations are asked for to be quick.
        most = min(count, self._trial.variations) if here.result.held else 0
        for number in range(len(here.held), most):
            variation = choosing_draw(self._trial.seed, number)
            here.held.append(self.run(here.place, variation).result().held)

    def measured(self, here: _Tried) -> TrialResult:
        """Return the result at a place, with how many of the trial's variations are held there."""
        survived, count = 0, self._trial.variations
        for number in range(count):
            variation = draw(self._trial.seed, number)
            survived += self.run(here.place, variation).result().held
            if self._progress is not None:
                self._progress(number + 1, count)
        return replace(here.result, survived=survived)

    def at(self, place: Place, free: Places, origin: _Tried) -> _Tried:
        """Return how the trial ends at a place that another one was moved to.

        Args:
            place: The place; it is moved back until the open hand is clear of the object.
            free: Tells whether it is.
            origin: The other place.
        """
        place = replace(place, pose=free.freed(place))
        result = replace(self.run(place).result(), places=origin.result.places)
        return _Tried(place, result)

    def shifted(self, place: Place, round_: int) -> tuple[Place, float]:
        """Return a place amid those around one where an object is held, and the share of those.

        Args:
            place: The place.
            round_: How often a place was moved before; each round uses other draws.
        """
        # The place itself, where the object was held; the mean exists if no other one holds.
        held = [np.zeros(3)]
        for number, point in enumerate(_AROUND, EXPLORING_FROM + round_ * len(_AROUND)):
            x, y, z = (float(value) for value in point)
            variation = replace(draw(self._trial.seed, number), position=(x, y, z))
            if self.run(place, variation).result().held:
                held.append(point)
        pose = np.array(place.pose)
        pose[:3, 3] += np.mean(held, axis=0)
        # The share is of the places around, so the place itself does not count.
        return replace(place, pose=pose), (len(held) - 1) / len(_AROUND)


class TrialRun:
    """One trial at one place."""

    def __init__(
        self,
        headless: HeadlessHand[Simulation],
        trial: Trial,
        place: Place,
        number: int = 1,
        watch: Watch | None = None,
    ) -> None:
        """Prepare a trial; nothing moves yet.

        Args:
            headless: The hand, on an arm, with the object at its place.
            trial: What is tried.
            place: The object's place in the hand.
            number: How many places were tried, with this one.
            watch: Told of the moments of the trial.
        """
        self._headless, self._trial, self._place = headless, trial, place
        self._number = number
        self._watch = watch
        self._around = headless.simulation.surroundings
        self._script = CarrierScript(headless)
        self._peak = 0.0
        # The tick with which the hand started belongs to the trial, too.
        self._began = headless.time - headless.period

    def result(self) -> TrialResult:
        """Approach, grasp, lift, hold and shake; return how it ended."""
        try:
            return self._done()
        except SimulationUnstable as error:
            return self._ended(str(error), "", outcome="")

    def _done(self) -> TrialResult:
        headless, around, trial = self._headless, self._around, self._trial
        self._approach()
        goal = Goal(
            trial.action,
            trial.elements,
            intensity=trial.intensity,
            goal_id=f"trial-{self._number}",
        )
        try:
            outcome = outcome_of(headless.do(goal))
        except ActionError as error:
            return self._ended("", str(error), outcome="")
        headless.wait(_SETTLE)
        # One that fewer than two links touch is still presented: it has to fall now.
        around.remove_support()
        headless.wait(_SETTLE)
        self._tell("grasp")
        forces = tuple(
            (finger.name, round(float(force), 3))
            for finger, force in zip(
                headless.hand.fingers, headless.simulation.contact_forces, strict=True
            )
        )
        # From here on the object should stay: how far closing moved it does not count as slip.
        start = around.position_in_hand
        moved = float(np.linalg.norm(start - self._place.pose[:3, 3]))
        # A soft hand pushes what it closes on, so that more is allowed here than of slip.
        if not around.touching() or moved > _FALLEN + _PUSHED:
            return self._ended("it was not grasped", "", outcome, moved, forces)
        headless.before_tick(self._note_force)
        self._script.move(2, _LIFT, 1.0)
        headless.wait(_HOLD)
        self._tell("lift")
        reason = self._fallen(start, "while it was lifted")
        if not reason:
            self._script.shake(_AMPLITUDE, _FREQUENCY, _CYCLES)
            headless.wait(_SETTLE)
            reason = self._fallen(start, "while it was shaken")
        self._tell("shake")
        slip = float(np.linalg.norm(around.position_in_hand - start))
        return self._ended(reason, "", outcome, slip, forces)

    def _approach(self) -> None:
        """Bring the hand to the object along the free way."""
        way = self._around.base_pose[:3, :3] @ self._place.way
        # The hand moves, not the object, which waits where the hand will be.
        self._script.jump(-way)
        self._tell("start")
        if np.any(way):
            self._script.go(np.zeros(3), 1.0)
            # The carrier's servos come behind their script; the hand closes at rest.
            self._headless.wait(0.2)
        self._tell("approach")

    def _fallen(self, start: np.ndarray[tuple[int, ...], np.dtype[np.float64]], when: str) -> str:
        slip = float(np.linalg.norm(self._around.position_in_hand - start))
        # What has fallen may still lean on a finger, and what nothing touches may not be far yet.
        if not self._around.touching() or slip > _FALLEN:
            return f"it fell {when}"
        return ""

    def _note_force(self, _: float) -> None:
        self._peak = max(self._peak, float(self._headless.simulation.contact_forces.max()))

    def _tell(self, moment: str) -> None:
        if self._watch is not None:
            self._watch(moment, self._headless)

    def _ended(
        self,
        reason: str,
        refused: str,
        outcome: str,
        slip: float = 0.0,
        forces: tuple[tuple[str, float], ...] = (),
    ) -> TrialResult:
        x, y, z = (round(float(v), 5) for v in self._place.pose[:3, 3])
        return TrialResult(
            self._trial,
            not reason and not refused,
            reason or refused,
            outcome,
            round(slip, 6),
            forces,
            round(self._peak, 3),
            round(self._headless.time - self._began, 3),
            self._number,
            (x, y, z),
        )
