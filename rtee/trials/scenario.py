"""A scenario in simulation: the steps of a hand with an object, and how they end."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rtee.drivers.mujoco.simulation import Simulation
from rtee.sample import FloatArray
from rtee.trials.headless import HeadlessHand
from rtee.types import Event, Goal, Result

Watch = Callable[[str, HeadlessHand[Simulation]], None]
"""Called at the moments of a scenario, such as ``start``, ``approach``, ``grasp`` and ``lift``."""


class TrialScene:
    """A hand with an object in simulation, and the findings of its steps so far.

    Attributes:
        headless: The hand.
        around: Its surroundings.
        at: Wanted pose of the carrier ``(6,)``: x, y, z [m], roll, pitch, yaw [rad].
        before: Pose ``(4, 4)`` of the object in the world where the hand's approach begins.
        base: Pose ``(4, 4)`` of the hand's base frame there.
        said: Result of the grasp; not set before it.
        outcome: The same in a word; empty before.
        start: Where the object was in the hand ``(3,)`` [m] when it was grasped.
        orientation: How it was turned there ``(3, 3)``.
        forces: The forces on the fingers then ``(fingers,)`` [N].
        peak: The largest force on a finger since `watch_forces` [N].
        slip: How far the object has moved in the hand since, when it was judged [m].
    """

    def __init__(self, headless: HeadlessHand[Simulation], watch: Watch | None = None) -> None:
        self.headless, self._watch = headless, watch
        self.around = headless.simulation.surroundings
        self.at: FloatArray = np.zeros(6)
        self.before = self.base = np.eye(4)
        self.said: Result
        self.outcome = ""
        self.start: FloatArray = np.zeros(3)
        self.orientation: FloatArray = np.eye(3)
        self.forces: FloatArray = np.zeros(len(headless.forces))
        self.peak = self.slip = 0.0
        self._before = 0
        # The tick with which the hand started belongs to the scenario, too.
        self._began = headless.time - headless.period

    def play(self, steps: Sequence[Step]) -> str:
        """Do one step after the other; return why the scenario ended early, empty if it did not.

        Raises:
            SimulationUnstable: if the equations blew up.
        """
        return next((reason for step in steps if (reason := step(self))), "")

    def tell(self, moment: str) -> None:
        """Report a moment to the watcher."""
        if self._watch is not None and moment:
            self._watch(moment, self.headless)

    def watch_forces(self) -> None:
        """Note the largest force on a finger from now on."""
        self.headless.before_tick(self._note_force)

    def _note_force(self, _: float) -> None:
        self.peak = max([self.peak, *self.headless.forces.tolist()])

    @property
    def duration(self) -> float:
        """Simulated time since the beginning [s]."""
        return self.headless.time - self._began

    @property
    def moved(self) -> float:
        """How far the object is from where it was in the hand when it was grasped [m]."""
        return float(np.linalg.norm(self.around.position_in_hand - self.start))

    @property
    def turn(self) -> FloatArray:
        """Orientation of the object in the hand ``(3, 3)``."""
        around = self.around
        return np.asarray(around.base_pose[:3, :3].T @ around.object_frame[:3, :3])

    @property
    def events(self) -> list[Event]:
        """Events of the hand since the grasp."""
        return self.headless.events[self._before :]

    def grasped(self, said: Result) -> None:
        """Record the result of the grasp."""
        self.said, self.outcome = said, said.outcome
        self._before = len(self.headless.events)

    def jump(self, position: FloatArray) -> None:
        """Put the carrier to a position ``(3,)`` [m], with all joints at rest, at once."""
        self.at[:3] = position
        self.around.jump(self.at)

    def go(self, position: FloatArray, duration: float) -> None:
        """Let the carrier go to a position ``(3,)`` [m] in a time [s]; velocity is continuous."""
        goal = self.at.copy()
        goal[:3] = position
        self.to(goal, duration)

    def move(self, axis: int, distance: float, duration: float) -> None:
        """Move along (0 to 2 [m]) or about (3 to 5 [rad]) one axis in a time [s]."""
        goal = self.at.copy()
        goal[axis] += distance
        self.to(goal, duration)

    def to(self, goal: FloatArray, duration: float) -> None:
        """Let the carrier go to a pose ``(6,)`` in a time [s], by a cubic of the time."""
        start, begin = self.at.copy(), self.headless.time
        while True:
            share = min(1.0, (self.headless.time - begin) / duration)
            self.carry(start + (3.0 - 2.0 * share) * share * share * (goal - start))
            if share >= 1.0:
                return
            self.headless.tick()

    def carry(self, pose: FloatArray) -> None:
        """Set the wanted pose of the carrier ``(6,)`` from the next tick on."""
        self.at = pose
        self.around.carry(pose)


Step = Callable[[TrialScene], str | None]
"""Does one step, and returns why the scenario ends with it; ``None`` to continue."""


@dataclass(frozen=True, slots=True)
class Wait:
    """Let simulated time pass [s], then report a moment if it has a name."""

    seconds: float
    moment: str = ""

    def __call__(self, scene: TrialScene) -> None:
        """Execute the step."""
        scene.headless.wait(self.seconds)
        scene.tell(self.moment)


@dataclass(frozen=True, slots=True)
class Preshape:
    """Execute a goal before the approach, half a metre above, where nothing is in the way."""

    goal: Goal

    def __call__(self, scene: TrialScene) -> None:
        """Execute the step."""
        scene.jump(np.array([0.0, 0.0, 0.5]))
        scene.headless.do(self.goal)


@dataclass(frozen=True, slots=True)
class ApproachStep:
    """Bring the hand to the object from an offset ``(3,)`` [m] in the world, slowly at the end.

    The hand moves, not the object, which waits where the hand will be. With a zero offset it is
    there already.
    """

    approach_from: FloatArray
    then: Callable[[TrialScene], None] = lambda _: None

    def __call__(self, scene: TrialScene) -> None:
        """Execute the step."""
        scene.jump(-self.approach_from)
        scene.before, scene.base = scene.around.object_frame, scene.around.base_pose
        scene.tell("start")
        if np.any(self.approach_from):
            scene.go(np.zeros(3), 1.0)
            self.then(scene)
            # The carrier's servos lag behind their references; the hand closes once they rest.
            scene.headless.wait(0.2)
        scene.tell("approach")


@dataclass(frozen=True, slots=True)
class Grasp:
    """Execute the goal that grasps the object; raises what `HeadlessHand.do` raises."""

    goal: Goal

    def __call__(self, scene: TrialScene) -> None:
        """Execute the step."""
        scene.grasped(scene.headless.do(self.goal))


def release(scene: TrialScene) -> None:
    """Let the object bear its own weight: if fewer than two links hold it, it must fall now."""
    scene.around.remove_support()


def mark(scene: TrialScene) -> None:
    """Record the object's pose in the hand, which it should keep from now on."""
    scene.start, scene.orientation = scene.around.position_in_hand, scene.turn
    scene.forces = scene.headless.forces


@dataclass(frozen=True, slots=True)
class Lift:
    """Lift the object by a distance [m] in a second, as an arm does calmly; hold it there [s]."""

    distance: float
    hold: float

    def __call__(self, scene: TrialScene) -> None:
        """Execute the step."""
        scene.move(2, self.distance, 1.0)
        scene.headless.wait(self.hold)
        scene.tell("lift")


@dataclass(frozen=True, slots=True)
class Shake:
    """Swing along x, then y, then z; each swells from rest and dies down to it.

    Attributes:
        amplitude: To either side [m].
        frequency: Swings per second [Hz].
        cycles: Swings along each axis.
    """

    amplitude: float
    frequency: float
    cycles: int

    def __call__(self, scene: TrialScene) -> None:
        """Execute the step."""
        middle, headless = scene.at.copy(), scene.headless
        frequency, cycles = self.frequency, self.cycles
        for axis in range(3):
            begin = headless.time
            while (elapsed := headless.time - begin) < cycles / frequency:
                pose = middle.copy()
                swell = math.sin(math.pi * elapsed * frequency / cycles)
                pose[axis] += self.amplitude * swell * math.sin(2.0 * math.pi * frequency * elapsed)
                scene.carry(pose)
                headless.tick()
        scene.carry(middle)


@dataclass(frozen=True, slots=True)
class During:
    """Let time pass [s]; call a function before each tick with the elapsed share of it.

    Then it settles [s]. It ends once the object has moved in the hand by a distance [m].
    """

    seconds: float
    act: Callable[[float], None]
    settle: float
    lost: float

    def __call__(self, scene: TrialScene) -> None:
        """Execute the step."""
        headless = scene.headless
        begin = headless.time
        # A lost object stays lost: the solver cannot handle a body that falls for seconds and
        # spins.
        while headless.time < begin + self.seconds and scene.moved < self.lost:
            self.act((headless.time - begin) / self.seconds)
            headless.tick()
        if scene.moved < self.lost:
            headless.wait(self.settle)
