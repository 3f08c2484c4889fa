"""A trial at one place: the hand comes to the object, grasps it, lifts it and shakes it."""

from __future__ import annotations

import math

import numpy as np

from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ActionError, SimulationUnstable
from rtee.trials.grasp_placement import Place
from rtee.trials.headless import HeadlessHand
from rtee.trials.holding import SLIP, TURN, reports_loss, turned
from rtee.trials.result import Trial, TrialResult
from rtee.trials.scenario import (
    ApproachStep,
    Grasp,
    Lift,
    Preshape,
    Shake,
    Step,
    TrialScene,
    Wait,
    Watch,
    mark,
    release,
)
from rtee.types import Goal, Intensity, Named

_SETTLE = 0.4
"""Time for the object to come to rest in the hand [s]."""

_LIFT = Lift(0.15, 2.0)
"""How far the hand lifts the object [m], and how long it holds it before it shakes it [s]; one that
slides falls within this time."""

_FALLEN = 0.06
"""An object that has moved farther in the hand has fallen [m]: more than a finger's breadth; one
that has moved by more than `SLIP` has slipped."""

_OUT_OF_REACH = 0.3
"""An object so far below the lowest point of hand and object is lost for certain [m]: fingers that
stretch reach no farther, the hand only goes up, and nothing lies below."""

_PUSHED = 0.05
"""Further displacement allowed for an object that closing fingers grasp [m]."""

_SHAKE = Shake(0.015, 2.0, 2)
"""Shaking along each axis: the acceleration is up to 2.4 m/s², a quarter of the weight, as of an
arm that stops."""


class _Gone(Exception):
    """The object has fallen too deep to come back to the hand."""


class TrialRun:
    """One trial at one place, in a `scene`."""

    def __init__(
        self,
        headless: HeadlessHand[Simulation],
        trial: Trial,
        place: Place,
        number: int = 1,
        watch: Watch | None = None,
        goal: Goal | None = None,
    ) -> None:
        """Prepare a trial; nothing moves yet.

        Args:
            headless: The hand, on an arm, with the object at its place.
            trial: The trial to run.
            place: The object's place in the hand.
            number: Number of places tried, including this one.
            watch: Called at the moments of the trial.
            goal: Grasps the object; by default the trial's action, to its intensity.
        """
        self.scene, self._trial, self._place = TrialScene(headless, watch), trial, place
        self._number = number
        self._what = Named(trial.action, trial.elements)
        self._goal = goal or Goal(self._what, Intensity(trial.intensity), goal_id=f"trial-{number}")
        self._gone_below = -math.inf

    def result(self) -> TrialResult:
        """Approach, grasp, lift, hold and shake; return how it ended."""
        scene = self.scene
        try:
            reason = scene.play(self._steps())
        except (ActionError, SimulationUnstable) as error:
            return self._ended(str(error))
        fingers = scene.headless.hand.fingers
        forces = zip(fingers, scene.forces.tolist(), strict=True)
        told = tuple((finger.name, round(force, 3)) for finger, force in forces)
        return self._ended(reason, scene.outcome, scene.slip, told)

    def held(self) -> bool:
        """Run the trial, but end as soon as it is certain whether the object is held."""
        self.scene.headless.before_tick(self._look_whether_gone)
        try:
            return self.result().held
        except _Gone:
            return False

    def _steps(self) -> tuple[Step, ...]:
        scene = self.scene
        before = Intensity(self._place.preshape)
        return (
            *((Preshape(Goal(self._what, before, goal_id="preshape")),) if before.share else ()),
            ApproachStep(scene.around.base_pose[:3, :3] @ self._place.approach_from),
            self._watch_height,
            Grasp(self._goal),
            Wait(_SETTLE),
            release,
            Wait(_SETTLE, "grasp"),
            mark,
            self._missed,
            _LIFT,
            _lifted,
            _SHAKE,
            Wait(_SETTLE),
            self._judge,
        )

    def _watch_height(self, scene: TrialScene) -> None:
        self._gone_below = scene.around.lowest - _OUT_OF_REACH

    def _missed(self, scene: TrialScene) -> str | None:
        moved = float(np.linalg.norm(scene.start - self._place.pose[:3, 3]))
        # A soft hand pushes the object as it closes, so the tolerance is larger than that of slip.
        if not scene.around.touching() or moved > _FALLEN + _PUSHED:
            scene.slip = moved
            return "it was not grasped"
        scene.watch_forces()
        return None

    def _judge(self, scene: TrialScene) -> str:
        reason = _fallen(scene, "shaken")
        turn = turned(self._trial.object, scene.orientation, scene.turn)
        if not reason and scene.slip > SLIP:
            reason = f"it slipped by {1e3 * scene.slip:.0f} mm"
        elif not reason and turn > TURN:
            reason = f"it turned by {math.degrees(turn):.0f} degrees"
        elif not reason and reports_loss(scene.said, scene.events):
            reason = "the hand says that it lost it"
        scene.tell("shake")
        return reason

    def _look_whether_gone(self, _: float) -> None:
        if self.scene.around.height < self._gone_below:
            raise _Gone

    def _ended(
        self,
        reason: str,
        outcome: str = "",
        slip: float = 0.0,
        forces: tuple[tuple[str, float], ...] = (),
    ) -> TrialResult:
        scene = self.scene
        x, y, z = (round(float(v), 5) for v in self._place.pose[:3, 3])
        return TrialResult(
            self._trial,
            not reason,
            reason,
            outcome,
            round(slip, 6),
            forces,
            round(scene.peak, 3),
            round(scene.duration, 3),
            self._number,
            (x, y, z),
        )


def _fallen(scene: TrialScene, when: str) -> str:
    """Return whether the object has fallen, and note how far it slipped."""
    scene.slip = scene.moved
    # A fallen object may still lean on a finger, and one that nothing touches may not be far yet.
    if scene.around.touching() and scene.slip <= _FALLEN:
        return ""
    return f"it fell while it was {when}"


def _lifted(scene: TrialScene) -> str:
    reason = _fallen(scene, "lifted")
    if reason:  # it ends here, and so do the pictures
        scene.tell("shake")
    return reason
