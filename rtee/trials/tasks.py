"""Tasks that require more than holding: an egg, a cup being filled, a part being tugged.

Each is tried in several ways to grasp, with reflexes and without, and with variations of place,
mass and friction. `rtee try --task` and ``benchmarks/reflexes.py`` run the same trials.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from rtee.drivers.mujoco.objects import OBJECT
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ConfigError, SimulationUnstable
from rtee.planning.objects import read_object
from rtee.trials.bench import TrialBench
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.scenario import During, Grasp, Step, TrialScene, Wait, mark, release
from rtee.types import Around, Force, Goal, Named, OnContact, TipSpeed

RATE: Final = 500.0
"""Ticks per second [Hz], as hands are simulated: a contact is answered within two."""

BREAKS: Final = 8.0
"""Force of a finger that breaks the egg [N]."""

FORCE: Final = 3.0
"""Default force with which an object is held [N]."""

MOST: Final = 7.0
"""Default force up to which slips raise it [N]: an egg bears it."""

_SPEED: Final = 0.02
"""Speed of the fingertips [m/s]: slow enough that the impact breaks no egg."""

_SETTLE: Final = 1.0
"""Time in which a grip settles, also after a disturbance [s]."""

_LOST: Final = 0.015
"""An object that has moved farther than this in the hand is lost [m]. It is less than a finger's
breadth, since an object that slides from the pads may come to rest at the fingers' roots."""

_BESIDE: Final = 0.003
"""Largest offset of the object from the middle along each axis [m]: as by a camera or a person."""

_MASS: Final = (0.8, 1.2)
"""Range of the factor of the mass."""

_FRICTION: Final = (0.6, 1.0)
"""Range of the friction."""

_WATER: Final = 0.5
"""Mass of the cup's filling [kg]: half a litre."""

_FILLING: Final = 5.0
"""Time within which it is filled [s]."""

_TUG: Final = 5.0
"""Force of the tug [N]."""

_TUGGED: Final = 0.5
"""Duration of the tug [s]."""

_RISING: Final = 0.1
"""Time within which the tug rises [s]: a tug, not a blow."""


class Task(StrEnum):
    """The task to do with the grasped object."""

    EGG = "egg"
    CUP = "cup"
    TUG = "tug"

    @property
    def mass(self) -> float:
        """Usual mass of the object [kg]: an egg's, an empty cup's and a light part's."""
        return 0.06 if self is Task.EGG else 0.05


class GraspMode(StrEnum):
    """Way of grasping the object; people read the value."""

    EFFORT = "hand's effort"
    FORCE = "force"
    REFLEXES = "force and reflexes"


class End(StrEnum):
    """Outcome of a task; people read the value."""

    HELD = "held"
    MISSED = "not grasped"
    STALLED = "stopped before a finger touched it"
    BROKEN = "broken"
    LOST = "lost"
    UNSTABLE = "simulation unstable"


@dataclass(frozen=True, slots=True)
class TaskTrial:
    """A task for an action and an object.

    Attributes:
        task: The task to do with the object.
        action: Name of the action.
        elements: Its elements.
        object: The object, as on the command line.
        mode: How it is grasped.
        width: Width of the object [m]; ``None``: its least extent.
        mass: Its mass [kg]; ``None``: the usual one of the task.
        force: Force to begin with [N]; not used with the hand's own effort.
        most: Force up to which a slip raises it [N]; used with reflexes.
        seed: Seed of the variations.
    """

    task: Task
    action: str
    elements: tuple[str, ...] = ()
    object: str = "sphere:0.03"
    mode: GraspMode = GraspMode.REFLEXES
    width: float | None = None
    mass: float | None = None
    force: float = FORCE
    most: float = MOST
    seed: int = 0

    def goal(self) -> Goal:
        """Return the goal that grasps the object."""
        width = self.width
        if width is None:
            width = read_object(self.object, self.mass or self.task.mass).extents[0]
        reflexes = self.mode is GraspMode.REFLEXES
        return Goal(
            Named(self.action, self.elements),
            Around(width),
            TipSpeed(_SPEED),
            {}
            if self.mode is GraspMode.EFFORT
            else Force(self.force, self.most if reflexes else None),
            {"": OnContact.SQUEEZE} if reflexes else {},
        )


@dataclass(frozen=True, slots=True)
class TaskResult:
    """Result of one variation of a task.

    Attributes:
        end: How it ended.
        peak: The largest force of a finger on the object [N].
    """

    end: End
    peak: float


def run_task(ready: TrialBench, trial: TaskTrial, number: int) -> TaskResult:
    """Do one variation of a task.

    Args:
        ready: The hand; its settings must be for `RATE`.
        trial: The task.
        number: Number of the variation, from 0; all hands and modes get the same ones.

    Raises:
        UnknownAction: if there is no such action.
        GoalRejected: if the hand cannot grasp the object like this.
        ConfigError: if the object is invalid or does not fit.
    """
    return play(trial, present(ready, trial, number))


def play(trial: TaskTrial, scene: TrialScene) -> TaskResult:
    """Grasp the presented object, do the task, and return how it ended."""
    # From the start: an egg may break at the first touch.
    scene.watch_forces()
    # Motion during the closing does not count as slip.
    grasp = Grasp(trial.goal()), Wait(_SETTLE), release, mark, Wait(_SETTLE), _missed
    disturbance = _disturbance(trial.task, scene.headless.simulation)
    try:
        end = End(scene.play((*grasp, *disturbance, _kept)) or End.HELD)
    except SimulationUnstable:
        return TaskResult(End.UNSTABLE, round(scene.peak, 3))
    # Independent of the other outcome: an egg may be broken and still be held.
    if trial.task is Task.EGG and scene.peak > BREAKS:
        end = End.BROKEN
    return TaskResult(end, round(scene.peak, 3))


def present(ready: TrialBench, trial: TaskTrial, number: int) -> TrialScene:
    """Return the hand, with the object of a variation where it is presented; see `run_task`."""
    hand, library, settings = ready.hand, ready.library, ready.settings
    # Neither hand nor mode is in the seed, so that all meet the same variations.
    varied = np.random.default_rng([number, trial.seed])
    mass = trial.task.mass if trial.mass is None else trial.mass
    options = SimOptions(
        object=trial.object,
        support="floating",  # let go when the hand reports that it holds it
        object_mass=mass * varied.uniform(*_MASS),
        friction=varied.uniform(*_FRICTION),
    )
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    places = Places(simulation, hand, library.find(trial.action, trial.elements)).find(1)
    if not places:
        raise ConfigError(f"{trial.object} does not fit between the fingers")
    simulation.reset()
    pose = places[0].pose.copy()
    pose[:3, 3] += varied.uniform(-_BESIDE, _BESIDE, 3)
    simulation.surroundings.place(simulation.surroundings.base_pose @ pose)
    return TrialScene(HeadlessHand(hand, library, settings, simulation))


def _missed(scene: TrialScene) -> str | None:
    said = scene.said
    # Told apart from a miss, since it has another remedy: a larger force.
    if said.stalled and not said.touched and not said.grasped:
        return End.STALLED
    return None if said.grasped and scene.moved < _LOST else End.MISSED


def _kept(scene: TrialScene) -> str | None:
    return None if scene.moved < _LOST else End.LOST


def _disturbance(task: Task, simulation: Simulation) -> tuple[Step, ...]:
    """Return the steps of the task with the grasped object."""
    if task is Task.CUP:
        return (During(_FILLING, filling(simulation), _SETTLE, _LOST),)
    if task is Task.EGG:
        return ()
    applied, body = simulation.data.xfrc_applied, simulation.model.body(OBJECT).id

    def pull(share: float) -> None:
        # Along the world's z axis, as the weight, whichever way the hand points.
        applied[body, 2] = -_TUG * min(share * _TUGGED / _RISING, 1.0)

    # MuJoCo keeps an applied force until it is taken away.
    return During(_TUGGED, pull, _SETTLE, _LOST), lambda _: applied[body].fill(0.0)


def filling(simulation: Simulation) -> Callable[[float], None]:
    """Return a function that fills a simulated object with a share (0 to 1) of the water."""
    model, body = simulation.model, simulation.model.body(OBJECT).id
    first = int(model.body_dofadr[body])
    dofs = slice(first, first + int(model.body_dofnum[body]))
    mass = float(model.body_mass[body])
    # MuJoCo works these out once: the last two scale its contacts, and the last but two stands for
    # the mass matrix of a free body. With the values of the empty cup it would fall too fast.
    grow = [(model.body_inertia, body), (model.dof_M0, dofs)]
    shrink = [(model.body_invweight0, body), (model.dof_invweight0, dofs)]
    empty = [(field, at, field[at].copy()) for field, at in (*grow, *shrink)]

    def fill(share: float) -> None:
        # The water is where the cup is: its inertia grows with the mass.
        factor = (mass + _WATER * share) / mass
        model.body_mass[body] = mass * factor
        for number, (field, at, value) in enumerate(empty):
            field[at] = value * factor if number < len(grow) else value / factor

    return fill
