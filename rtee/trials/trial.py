"""One trial: approach, grasp, lift, shake; and whether the object was held."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ActionError
from rtee.hand.model import Hand
from rtee.log.recording import outcome_of
from rtee.loop.observer import LoopObserver
from rtee.loop.settings import LoopSettings
from rtee.trials.arm_motion import CarrierScript
from rtee.trials.grasp_placement import Place, Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.result import Trial as Trial
from rtee.trials.result import TrialResult as TrialResult
from rtee.trials.variation import Variation, draw
from rtee.types import Goal

Watch = Callable[[str, HeadlessHand[Simulation]], None]
"""Told at the moments of a trial: ``start``, ``approach``, ``grasp``, ``lift``, ``shake``."""

Progress = Callable[[int, int], None]
"""Told how many of how many variations were tried."""

_ENOUGH = 0.9
"""Share of the variations that a place must survive for no other one to be tried."""

_SETTLE = 0.4
_LIFT = 0.15
_HOLD = 2.0
_FALLEN = 0.06
_AMPLITUDE = 0.015
_FREQUENCY = 2.0
_CYCLES = 2
_SHAKE_AXES = (0, 1, 2)


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
        The result at the first place where it was held, in 9 of 10 variations if there are any; or
        else at the one with the most variations survived, then with the least slip.

    Raises:
        UnknownAction: if there is no such action.
        ConfigError: if the object is none.
        ModelError: if the hand cannot be simulated.
    """
    action = library.find(trial.action, trial.elements)
    simulation = _simulation(hand, settings, trial)
    places = Places(simulation, hand, action).find(trial.places)
    if not places:
        return TrialResult(trial, False, "the object fits nowhere between the fingers")
    tried: list[TrialResult] = []
    ticks = 0
    for number, place in enumerate(places[skip:], skip + 1):
        simulation.reset()
        simulation.surroundings.place(simulation.surroundings.base_pose @ place.pose)
        headless = HeadlessHand(hand, library, settings, simulation, observers, ticks=ticks)
        result = _Run(headless, trial, place, number, watch).result()
        ticks = headless.ticks
        if result.held and trial.variations:
            survived = _survived(hand, library, settings, trial, place, progress)
            result = replace(result, survived=survived)
        if result.held and result.survived >= _ENOUGH * trial.variations:
            return result
        tried.append(result)
    return max(tried, key=lambda result: (result.held, result.survived, -result.slip))


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


def _survived(
    hand: Hand,
    library: ActionLibrary,
    settings: LoopSettings,
    trial: Trial,
    place: Place,
    progress: Progress | None,
) -> int:
    """Return in how many variations of a trial an object is held at a place."""
    count = 0
    for number in range(trial.variations):
        variation = draw(trial.seed, number)
        simulation = _simulation(hand, settings, trial, variation)
        around = simulation.surroundings
        moved = replace(place, pose=variation.moved(place.pose))
        around.place(around.base_pose @ moved.pose)
        headless = HeadlessHand(hand, library, settings, simulation)
        count += _Run(headless, trial, moved, number, None).result().held
        if progress is not None:
            progress(number + 1, trial.variations)
    return count


class _Run:
    """One trial at one place."""

    def __init__(
        self,
        headless: HeadlessHand[Simulation],
        trial: Trial,
        place: Place,
        number: int,
        watch: Watch | None,
    ) -> None:
        self._headless, self._trial, self._place = headless, trial, place
        self._number = number
        self._watch = watch
        self._around = headless.simulation.surroundings
        self._script = CarrierScript(headless)
        self._peak = 0.0
        self._began = headless.time - headless.period

    def result(self) -> TrialResult:
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
        around.remove_support()
        headless.wait(_SETTLE)
        self._tell("grasp")
        forces = tuple(
            (finger.name, round(float(force), 3))
            for finger, force in zip(
                headless.hand.fingers, headless.simulation.contact_forces, strict=True
            )
        )
        start = around.position_in_hand
        moved = float(np.linalg.norm(start - self._place.pose[:3, 3]))
        if not around.touching() or moved > _FALLEN + 0.05:
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
        self._script.jump(-way)
        self._tell("start")
        if np.any(way):
            self._script.go(np.zeros(3), 1.0)
            self._headless.wait(0.2)
        self._tell("approach")

    def _fallen(self, start: np.ndarray[tuple[int, ...], np.dtype[np.float64]], when: str) -> str:
        slip = float(np.linalg.norm(self._around.position_in_hand - start))
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
