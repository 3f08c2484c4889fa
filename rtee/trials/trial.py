"""One trial: approach, grasp, lift, shake; and whether the object was held."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import structs

from rtee.drivers.mujoco.model import Built
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import build_hand, make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ConfigError
from rtee.loop.observer import Observer
from rtee.planning.objects import read_object
from rtee.trials.bench import TrialBench
from rtee.trials.grasp_placement import Place, Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.result import CHOOSING
from rtee.trials.result import Trial as Trial
from rtee.trials.result import TrialResult as TrialResult
from rtee.trials.robust_places import misfit, robust_places
from rtee.trials.scenario import Watch
from rtee.trials.trial_run import TrialRun
from rtee.trials.variation import EXPLORING_FROM, Variation, choosing_draw, decided, draw

Progress = Callable[[int, int], None]
"""Receives the number of variations tried so far, and of all."""

_FIRST = 5
"""Tries with variation at each place, before places are compared."""

_SPARE = 1
"""Most losses in ten tries with which a place is taken at once: nine of ten should hold."""

_CONTENDERS = 2
"""Places that are moved and compared when places are chosen by more tries than usual: the five
tries that all places get may mistake the second best for the best."""

_CAREFUL_ROUNDS = 3
_STAYS = 0.002
"""For these: most moves of a place, and the move that is small enough to end them [m], a fifth of
the variation."""

_SCANNED_FROM = 40
"""Number of tries for choosing a place from which the best place is also moved along each axis, to
the middle of where the object is held: so many tell 18 of 20 from 14 of 20."""

_SCAN_STEP = 0.004
"""Distance of the places along an axis [m]: less than half the variation, so that neighbours differ
in few tries."""

_SCAN_STEPS = 3
"""Number of places tried to either side: a little farther than objects are varied."""

_FALLS_OFF = 0.25
"""If the share of tries held is this much lower than at the best place of the axis, no place
farther away is tried: the edge is there."""

_AMIDST = 0.85
"""A place is amid those where the object is held if it is held at this share of the places around
it, 12 of 14; then no other one is looked for."""

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
"""Number of moves of the best place to that middle: the second one corrects the first."""


def run_trial(
    ready: TrialBench,
    trial: Trial,
    *,
    observers: Sequence[Observer] = (),
    watch: Watch | None = None,
    skip: int = 0,
    progress: Progress | None = None,
) -> TrialResult:
    """Try an action on an object at one place after the other until one is held.

    Args:
        ready: The hand.
        trial: The trial to run.
        observers: Observers of every tick, as in the loop.
        watch: Called at the moments of the trial.
        skip: Places to leave out, because they are known to fail.
        progress: Called with how many variations of a place were tried, and of how many.

    Returns:
        The result at the first place where it was held. With variations, the place is chosen by
        other draws than those that count: the first that survives nine of ten, otherwise the best
        one, moved to the middle of where the object is held around it. With more draws than usual
        (``trial.choosing``), the two best are always moved, and compared; with 40 or more, the
        better one is moved along each axis, too, to the middle of where these draws are held.

    Raises:
        UnknownAction: if there is no such action.
        ConfigError: if the object is invalid, or no place is left.
        ModelError: if the hand cannot be simulated.
    """
    hand, library, settings = ready.hand, ready.library, ready.settings
    action = library.find(trial.action, trial.elements)
    # Built once: the variations differ only in the object and the friction.
    built = build_hand(hand, SimOptions())
    simulation = _simulation(ready, trial, built=built)
    obj = read_object(trial.object, trial.mass)
    unfit = misfit(library, action, obj, trial.variations)
    if unfit:
        return TrialResult(trial, False, unfit, fits=False)
    # Geometry ranks the places, since each one tried in dynamics takes a second.
    places = robust_places(simulation, library, action, obj, trial.places)
    if not places:
        return TrialResult(trial, False, "the object does not fit between the fingers")
    if skip >= len(places):
        raise ConfigError(
            f"there are {len(places)} places for the object, so that leaving out {skip} leaves none"
        )
    varied = _Varied(ready, trial, progress, built)
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
        elif varied.good(here, max(tried[:-1], key=lambda one: one.rank, default=None)):
            return varied.measured(here)
    ranked = sorted(tried, key=lambda here: here.rank, reverse=True)
    if not ranked[0].result.held:
        return ranked[0].result
    # The last trial left the hand lifted; places are moved out of contact with a hand at rest.
    simulation.reset()
    free = Places(simulation, hand, action)
    if trial.choosing > CHOOSING:
        best = _carefully(ranked[:_CONTENDERS], varied, free)
        if trial.choosing >= _SCANNED_FROM:
            best = _scanned(best, varied, free)
        return varied.measured(best)
    # None is good enough: only the best one is tried further.
    best = ranked[0]
    varied.choose(best, trial.choosing)
    # No move raises such a low rate to the required one.
    hopeless = decided(sum(best.held), len(best.held), trial.wanted)
    for round_ in range(0 if hopeless else _ROUNDS):
        here = varied.at(varied.shifted(best.place, round_)[0], free, best)
        varied.choose(here, trial.choosing, best)
        # A place that was moved may be worse: the tries that moved it are few.
        best = max(best, here, key=lambda here: here.rank)
        if best is not here or best.lost <= _SPARE:
            break
    return varied.measured(best)


def _carefully(contenders: list[_Tried], varied: _Varied, free: Places) -> _Tried:
    """Return the best of some places, each moved to the middle of the region that holds the object.

    A place on the edge of that region may survive all tries that choose it, so all are moved.
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
    # Lying well amid places that hold says more than how little the object slipped there.
    return max(found, key=lambda one: (*one.rank[:2], one.around))


def _scanned(best: _Tried, varied: _Varied, free: Places) -> _Tried:
    """Return a place moved, along each axis, to the middle of where the object is held.

    All places get the same tries. One that survives them all may lie on the edge of the region, and
    one that survives a few more than its neighbours may do so by chance. So each place is rated by
    the mean of itself and its neighbours, and of equally rated places, the middle one is taken.
    """
    for axis in np.eye(3):
        row = {0: best}
        for sign in (1, -1):
            for step in range(1, _SCAN_STEPS + 1):
                wanted = np.array(best.place.pose)
                wanted[:3, 3] += sign * step * _SCAN_STEP * axis
                here = varied.at(replace(best.place, pose=wanted), free, best)
                # The hand is in the way: the place was moved back to an earlier one.
                if np.abs(here.place.pose - wanted).max() > _SCAN_STEP / 2.0:
                    break
                row[sign * step] = here
                varied.choose(here, varied.choosing)
                if here.share < max(one.share for one in row.values()) - _FALLS_OFF:
                    break
        best = row[_middle({step: here.share for step, here in row.items()})]
    return best


def _middle(shares: dict[int, float]) -> int:
    """Return the place in a row whose share of held tries, and whose neighbours', is largest."""

    def mean(step: int) -> float:
        here = shares[step]
        # Beyond the last place nothing is known: the rate is assumed to go on falling, or to stay.
        before, after = (
            shares.get(step + side, min(here, 2.0 * here - shares.get(step - side, here)))
            for side in (-1, 1)
        )
        return round((before + here + after) / 3.0, 6)  # so that equal ones stay equal

    largest = max(mean(step) for step in shares)
    tied = sorted((step for step in shares if mean(step) == largest), key=abs)
    amid = sum(tied) / len(tied)
    # `min` returns the first of equals, which is nearer to the original place.
    return min(tied, key=lambda step: abs(step - amid))


@dataclass
class _Tried:
    """A place, how the trial ended there, and which of the tries to choose it were held.

    Attributes:
        place: The place.
        result: How the trial ended there, without variation.
        held: Which of the tries to choose it were held.
        beaten: Whether it can no longer be the best, so that some of these tries were left out.
        around: The share of the places around it where the object is held, as far as that is known.
    """

    place: Place
    result: TrialResult
    held: list[bool] = field(default_factory=list)
    beaten: bool = False
    around: float = 0.0

    @property
    def lost(self) -> int:
        """Number of these tries that were lost."""
        return len(self.held) - sum(self.held)

    @property
    def share(self) -> float:
        """Share of these tries that was held; 0 before the first."""
        return sum(self.held) / len(self.held) if self.held else 0.0

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Larger is better."""
        return self.result.held and not self.beaten, self.share, -self.result.slip

    def may_beat(self, other: _Tried, count: int) -> bool:
        """Return whether it may rank above another one after the given number of tries."""
        most = count - self.lost
        return (self.result.held, most / count, -self.result.slip) > other.rank


def _simulation(
    ready: TrialBench,
    trial: Trial,
    variation: Variation | None = None,
    built: Built | None = None,
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
        changes = variation.options(trial.mass)
        if trial.friction is not None:  # values that the user gives do not vary
            del changes["friction"]
        options = structs.replace(options, **changes)
    hand, period = ready.hand, ready.settings.period
    return make_simulation(hand, options, hand.actuator_names, period, built=built)


class _Varied:
    """Tries the variations of a trial.

    Attributes:
        choosing: Tries by which a place is chosen.
    """

    def __init__(
        self,
        ready: TrialBench,
        trial: Trial,
        progress: Progress | None,
        built: Built | None = None,
    ) -> None:
        self._ready, self._built = ready, built
        self._trial, self._progress = trial, progress
        self.choosing = trial.choosing

    def run(self, place: Place, variation: Variation | None = None) -> TrialRun:
        """Return the trial at a place, or a variation of it, ready to start."""
        # Size, mass and friction are compiled into the model, so each variation needs its own.
        ready = self._ready
        simulation = _simulation(ready, self._trial, variation, self._built)
        around = simulation.surroundings
        if variation is not None:
            place = replace(place, pose=variation.moved(place.pose))
        around.place(around.base_pose @ place.pose)
        headless = HeadlessHand(ready.hand, ready.library, ready.settings, simulation)
        return TrialRun(headless, self._trial, place)

    def good(self, here: _Tried, best: _Tried | None) -> bool:
        """Return whether a place is good enough for no other one to be tried."""
        self.choose(here, _FIRST, best)
        if not here.result.held or here.lost:
            return False
        self.choose(here, self.choosing, best, until_good=True)
        return not here.beaten and here.lost <= _SPARE

    def choose(
        self,
        here: _Tried,
        count: int,
        best: _Tried | None = None,
        *,
        until_good: bool = False,
    ) -> None:
        """Try a place with variation until there are ``count`` tries, to compare it with others.

        It is tried no further once it cannot rank above ``best``, or, ``until_good``, once it is
        good enough whatever the others show.
        """
        # Whoever asks for two variations wants a quick answer, so no more are tried here. A scan
        # compares neighbouring places, for which so few would be meaningless.
        enough = count if count >= _SCANNED_FROM else self._trial.variations
        most = min(count, enough) if here.result.held else 0
        for number in range(len(here.held), most):
            if best is not None and not here.may_beat(best, most):
                here.beaten = True
                return
            if until_good and sum(here.held) >= most - _SPARE:
                return
            variation = choosing_draw(self._trial.seed, number)
            here.held.append(self.run(here.place, variation).held())

    def measured(self, here: _Tried) -> TrialResult:
        """Return the result at a place, with how many of the trial's variations were held there."""
        survived, count = 0, self._trial.variations
        for number in range(count):
            variation = draw(self._trial.seed, number)
            survived += self.run(here.place, variation).held()
            if self._progress is not None:
                self._progress(number + 1, count)
            if decided(survived, number + 1, self._trial.wanted):
                return replace(here.result, survived=survived, left=count - number - 1)
        return replace(here.result, survived=survived)

    def at(self, place: Place, free: Places, origin: _Tried) -> _Tried:
        """Return the result of the trial at a place that another one was moved to.

        The place is moved back until the open hand is clear of the object.
        """
        place = replace(place, pose=free.freed(place))
        result = replace(self.run(place).result(), places=origin.result.places)
        return _Tried(place, result)

    def shifted(self, place: Place, round_: int) -> tuple[Place, float]:
        """Return the mean of the places around one where the object is held, and their share.

        ``round_``: how often the place was moved before; each round uses other draws.
        """
        # The place itself holds, so the mean exists even if no place around it does.
        held = [np.zeros(3)]
        for number, point in enumerate(_AROUND, EXPLORING_FROM + round_ * len(_AROUND)):
            x, y, z = (float(value) for value in point)
            variation = replace(draw(self._trial.seed, number), position=(x, y, z))
            if self.run(place, variation).held():
                held.append(point)
        pose = np.array(place.pose)
        pose[:3, 3] += np.mean(held, axis=0)
        # The share is of the places around, so the place itself does not count.
        return replace(place, pose=pose), (len(held) - 1) / len(_AROUND)
