"""A trial at one place: the hand comes to the object, grasps it, lifts it and shakes it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ActionError, SimulationUnstable
from rtee.sample import FloatArray
from rtee.trials.arm_motion import CarrierScript
from rtee.trials.grasp_placement import Place
from rtee.trials.headless import HeadlessHand
from rtee.trials.holding import SLIP, TURN, said_lost, turned
from rtee.trials.result import Trial, TrialResult
from rtee.types import Goal, Intensity, Named

Watch = Callable[[str, HeadlessHand[Simulation]], None]
"""Told at the moments of a trial: ``start``, ``approach``, ``grasp``, ``lift``, ``shake``."""

_SETTLE = 0.4
"""Time for the object to come to rest in the hand [s]."""

_LIFT = 0.15
"""How far the hand lifts the object [m], in a second: an arm's calm motion."""

_HOLD = 2.0
"""How long the object is held before it is shaken [s]; one that slides falls within this time."""

_FALLEN = 0.06
"""An object that has moved farther in the hand has fallen [m]: more than a finger's breadth; one
that has moved by more than `SLIP` has slipped."""

_OUT_OF_REACH = 0.3
"""An object so far below the lowest point of hand and object is lost for certain [m]: fingers that
stretch reach no farther, the hand only goes up, and nothing lies below."""

_PUSHED = 0.05
"""How much farther closing fingers may push an object that they grasp [m]."""

_AMPLITUDE = 0.015
_FREQUENCY = 2.0
_CYCLES = 2
"""Shaking along each axis: to either side [m], how fast [Hz], and how often. The acceleration is up
to 2.4 m/s², a quarter of the weight, as of an arm that stops."""


class _Gone(Exception):
    """The object has fallen so deep that no way leads back to the hand."""


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
        self._gone_below = -math.inf
        # The tick with which the hand started belongs to the trial, too.
        self._began = headless.time - headless.period

    def result(self) -> TrialResult:
        """Approach, grasp, lift, hold and shake; return how it ended."""
        try:
            return self._done()
        except SimulationUnstable as error:
            return self._ended(str(error), "", outcome="")

    def held(self) -> bool:
        """Do the same, but end as soon as it is certain whether the object is held."""
        self._headless.before_tick(self._look_whether_gone)
        try:
            return self._done().held
        except (SimulationUnstable, _Gone):
            return False

    def _done(self) -> TrialResult:
        headless, around, trial = self._headless, self._around, self._trial
        self._approach()
        self._gone_below = around.lowest - _OUT_OF_REACH
        what, to = Named(trial.action, trial.elements), Intensity(trial.intensity)
        goal = Goal(what, to, goal_id=f"trial-{self._number}")
        try:
            said = headless.do(goal)
            outcome = said.outcome
        except ActionError as error:
            return self._ended("", str(error), outcome="")
        before = len(headless.events)
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
        start, orientation = around.position_in_hand, self._orientation()
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
        turn = turned(trial.object, orientation, self._orientation())
        if not reason and slip > SLIP:
            reason = f"it slipped by {1e3 * slip:.0f} mm"
        elif not reason and turn > TURN:
            reason = f"it turned by {math.degrees(turn):.0f} degrees"
        elif not reason and said_lost(said, headless.events[before:]):
            reason = "the hand says that it lost it"
        return self._ended(reason, "", outcome, slip, forces)

    def _orientation(self) -> FloatArray:
        """Return the object's orientation in the hand ``(3, 3)``."""
        around = self._around
        return np.asarray(around.base_pose[:3, :3].T @ around.object_frame[:3, :3])

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
        self._peak = max([self._peak, *self._headless.forces.tolist()])

    def _look_whether_gone(self, _: float) -> None:
        if self._around.height < self._gone_below:
            raise _Gone

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
