"""Simulate a goal before a hand executes it, to predict its grip, impacts and forces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK, rest_position
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ConfigError, GoalRejected
from rtee.hand.load import hand_folder, load_configured
from rtee.hand.model import Hand
from rtee.loop.planning import make_plan
from rtee.loop.settings import loop_settings
from rtee.remote.words import sentence
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.holding import SLIP
from rtee.trials.scenario import Grasp, Step, TrialScene, Wait, mark, release
from rtee.trials.tasks import RATE
from rtee.types import Goal, Result

_SETTLE: Final = 0.5
"""Time for the object to come to rest in the hand [s]."""

_WATCHED: Final = 1.5
"""Time for which the object must stay once its weight acts [s]: a sliding one falls sooner."""

_STRUCK: Final = 2.0
"""Force between links above which the hand collides with itself [N]: links that merely brush exert
less. Fingertips are exempt, since pinches bring them together."""

_HELD_BY: Final = 2
"""Number of links that must touch an object: one alone can only push it."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """Result of a goal in simulation.

    Attributes:
        result: How the goal ended.
        obj: The object, as on the command line; empty: none.
        held: Whether the object is in the hand afterwards.
        force: The largest force on a finger [N].
        struck: The largest force of the hand's links on one another, fingertips apart [N].
    """

    result: Result
    obj: str
    held: bool
    force: float
    struck: float

    @property
    def words(self) -> str:
        """Summary of the rehearsal, in one sentence."""
        object_ = f"; {self.obj} is {'held' if self.held else 'lost'}" if self.obj else ""
        return f"{sentence(self.result)}{object_}; at most {self.force:.1f} N on a finger"

    def refusal(self, force: float) -> str:
        """Return why the goal is not to be done, with a limit of the force [N]; empty if it may."""
        if self.result.aborted or self.result.timed_out:
            return "the goal fails"
        if self.obj and not self.held:
            return f"{self.obj} is lost"
        if self.struck > _STRUCK:
            return f"the hand strikes itself with {self.struck:.1f} N"
        if self.force > force:
            return f"it reaches {self.force:.1f} N, and a person allows {force:g} N"
        return ""


def rehearse(
    name: str, urdf: str, goal: Goal, obj: str, position: Mapping[str, float]
) -> Rehearsal:
    """Play a goal in MuJoCo, as fast as the computer can.

    Args:
        name: The hand, whose files are read here.
        urdf: The URDF of the running hand, which must be that of the files.
        goal: The goal.
        obj: Object to close on, as on the command line; empty: none.
        position: Where the actuators are [rad | m]; with an object, the hand starts at rest.

    Raises:
        UserError: if the files differ, or the hand cannot be simulated.
        ActionError: if the goal cannot be taken, or the object fits nowhere between the fingers.
        SimulationUnstable: if the equations blew up.
    """
    hand, config = load_configured(name)
    if hand.urdf.text != urdf:
        raise ConfigError(f"the files of '{name}' here are not those of the running hand")
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    settings = loop_settings(config, rate=RATE)
    plan = make_plan(goal, hand, library, settings)
    options = SimOptions(object=obj, carrier="lift" if obj else "fixed")
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    around = simulation.surroundings
    if obj:
        places = Places(simulation, hand, library.find(plan.action, plan.elements)).find(1)
        if not places:
            raise GoalRejected(f"{obj} does not fit between the fingers of {plan.action}")
        simulation.reset()
        around.place(around.base_pose @ places[0].pose)
    else:
        _stand(simulation, hand, position)
    scene = TrialScene(HeadlessHand(hand, library, settings, simulation))
    own, struck = _Own(simulation, hand), 0.0

    def watch(_: float) -> None:
        nonlocal struck
        struck = max(struck, own.force())

    scene.watch_forces()
    scene.headless.before_tick(watch)
    steps: list[Step] = [Grasp(goal), Wait(_SETTLE)]
    if obj:
        steps += [release, mark, Wait(_WATCHED)]
    scene.play(steps)
    held = bool(obj) and scene.moved <= SLIP and len(around.touching()) >= _HELD_BY
    return Rehearsal(scene.said, obj, held, scene.peak, struck)


def _stand(simulation: Simulation, hand: Hand, position: Mapping[str, float]) -> None:
    """Let the simulated hand start where the real one is."""
    where = np.array(
        [position.get(n, rest) for n, rest in zip(hand.actuator_names, hand.rest, strict=True)]
    )
    simulation.data.qpos[:] = rest_position(simulation.model, hand, where)
    simulation.hold()
    mujoco.mj_forward(simulation.model, simulation.data)


class _Own:
    """The force of a hand's links on one another."""

    def __init__(self, simulation: Simulation, hand: Hand) -> None:
        self._model, self._data = simulation.model, simulation.data
        names = [self._model.body(int(body)).name for body in self._model.geom_bodyid]
        self._links = [n.removeprefix(LINK) if n.startswith(LINK) else "" for n in names]
        self._tips = frozenset(hand.tip_links)

    def force(self) -> float:
        """Return the largest normal force of two links on one another, fingertips apart [N]."""
        largest, force = 0.0, np.zeros(6)
        for number in range(self._data.ncon):
            contact = self._data.contact[number]
            one, other = (self._links[geom] for geom in contact.geom)
            if contact.efc_address < 0 or not (one and other) or {one, other} <= self._tips:
                continue
            mujoco.mj_contactForce(self._model, self._data, number, force)
            largest = max(largest, float(force[0]))
        return largest
