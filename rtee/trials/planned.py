"""Try planned grasps in dynamics: the object at the plan's pose, with its weight's direction."""

from __future__ import annotations

import dataclasses
from typing import Final

import mujoco
import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.model import compiled
from rtee.drivers.mujoco.objects import add_body, add_hulls, add_object
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import add_carrier, add_table, build_hand
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.frames import homogeneous
from rtee.hand.model import Hand
from rtee.objects.shape import NUMBERS, ObjectShape
from rtee.planning.composition import DRAFT
from rtee.planning.objects import GraspObject
from rtee.planning.result import GraspCheck, GraspPlan, Ranking
from rtee.sample import FloatArray
from rtee.trials.bench import TrialBench
from rtee.trials.grasp_placement import Place
from rtee.trials.headless import HeadlessHand
from rtee.trials.result import Trial
from rtee.trials.trial_run import TrialRun
from rtee.trials.variation import Variation
from rtee.types import Around, Force, Goal, Intensity, Named

PRESSED: Final = 20.0
"""Force on the table above which the hand has hit it [N]: a cobot's arm yields at 50 N."""

_DOWN: Final = np.array([0.0, 0.0, -1.0])
"""Direction of the weight in the world."""


def check_plan(
    ready: TrialBench,
    obj: GraspObject,
    ranking: Ranking,
    plan: GraspPlan,
    variation: Variation | None = None,
) -> GraspCheck:
    """Try a planned grasp: approach, grasp, lift, hold and shake, as `rtee try` does.

    An object on a table lies there, and has its weight from the start. A variation moves and turns
    object and table, and has a friction of its own.

    Raises:
        UnknownAction: if the library does not have the action.
        ModelError: if the hand cannot be simulated.
    """
    hand, library, settings = ready.hand, ready.library, ready.settings
    name = plan.action or DRAFT
    if not plan.action:
        library = ActionLibrary(hand, (*library, library.compose(DRAFT, plan.parts)))
    # Within the trial, an action that is missing would count as a lost object.
    library.find(name, plan.elements)
    options = SimOptions(
        object_mass=obj.mass,
        friction=ranking.friction if variation is None else variation.friction,
        support="held" if plan.table is None else "table",
        carrier="arm",
    )
    pose = np.array(plan.pose)
    if variation is not None:
        pose = variation.moved(pose)
    table = None if plan.table is None else pose @ np.array(plan.table)
    down = np.array(ranking.weight_axis) if table is None else -table[:3, 2]
    simulation = _simulation(
        hand, options, obj, pose, down, settings.period, table, edge=plan.overhang > 0.0
    )
    trial = Trial(name, plan.elements, obj.name, plan.intensity, obj.mass)
    place = Place(pose, plan.touch, np.array(plan.approach_from), plan.preshape)
    # Before the first tick, the hand leaves for where its approach begins: where it will grasp, its
    # open fingers may overlap what stands a little beside its place, and would throw it.
    around = simulation.surroundings
    begin = -around.base_pose[:3, :3] @ place.approach_from
    around.jump(np.concatenate([begin, np.zeros(3)]))
    headless = HeadlessHand(hand, library, settings, simulation)
    pressed = 0.0

    def note(_: float) -> None:
        nonlocal pressed
        pressed = max(pressed, around.pressing())

    if table is not None:
        headless.before_tick(note)
    result = TrialRun(headless, trial, place, goal=_goal(plan, name)).result()
    reason = result.reason
    if not reason and pressed > PRESSED:
        reason = f"it pressed the table with {pressed:.0f} N"
    return GraspCheck(not reason, reason, result.slip, result.peak, round(pressed, 3))


def _goal(plan: GraspPlan, name: str) -> Goal:
    """Return the goal that grasps as planned, by an action of that name."""
    what = Named(name, plan.elements)
    if plan.force is None:
        return Goal(what, Intensity(plan.intensity))
    return Goal(what, Around(plan.width), effort=Force(plan.force))


def checked(ready: TrialBench, obj: GraspObject, ranking: Ranking, most: int) -> Ranking:
    """Return a ranking whose ``most`` best plans were tried in dynamics; successes come first.

    If none of these holds, the others are tried, too, until one does: geometry does not see how the
    fingers push the object while they close.
    """
    plans = list(ranking.plans)
    held = False
    for number, plan in enumerate(plans):
        if number >= most and held:
            break
        check = check_plan(ready, obj, ranking, plan)
        said = (
            f"held in dynamics, slip {check.slip * 1e3:.1f} mm"
            if check.held
            else f"lost in dynamics: {check.reason}"
        )
        held |= check.held
        plans[number] = dataclasses.replace(plan, check=check, reasons=(*plan.reasons, said))
    # Held ones first, then untried ones, then failed ones; stable, so otherwise as ranked.
    plans.sort(key=lambda plan: 1 if plan.check is None else 2 * (not plan.check.held))
    return dataclasses.replace(ranking, plans=tuple(plans))


def _simulation(
    hand: Hand,
    options: SimOptions,
    obj: GraspObject,
    place: FloatArray,
    weight_axis: FloatArray,
    period: float,
    table: FloatArray | None,
    *,
    edge: bool,
) -> Simulation:
    """Build a simulation of a carried hand that holds its weight axis down, with the object.

    Table and object have poses ``(4, 4)`` in the hand's base frame.
    """
    built = build_hand(hand, options)
    # Turning the hand instead of gravity leaves the world as a trial has it.
    turned = _turned(weight_axis)
    pose = homogeneous(turned, np.zeros(3))
    add_carrier(built.spec, turned, options)
    if table is not None:
        add_table(built.spec, pose @ table, edge=edge)
    _add_object(built.spec, obj, pose @ place)
    model = compiled(built.spec, hand)
    return Simulation(
        model,
        hand,
        options,
        hand.actuator_names,
        period,
        built.servos,
        (*built.notes, *built.following),
    )


def _turned(axis: FloatArray) -> FloatArray:
    """Return the shortest rotation ``(3, 3)`` that brings a unit vector downwards."""
    cosine = float(axis @ _DOWN)
    # Opposite vectors: any axis across them will do, and the formula would divide by 0.
    if cosine < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = np.cross(axis, _DOWN)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # Rodrigues' formula for the angle between two unit vectors, without the angle itself.
    rotation: FloatArray = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return rotation


def _add_object(spec: mujoco.MjSpec, obj: GraspObject, pose: FloatArray) -> None:
    """Add an object as it was planned for: the mass shared by the volumes of its pieces."""
    first = obj.pieces[0]
    if first.kind in NUMBERS:
        add_object(spec, ObjectShape(first.kind, first.size), mass=obj.mass, pose=pose)
        return
    volumes = np.array([piece.shape.computeVolume() for piece in obj.pieces])
    points = [piece.points for piece in obj.pieces]
    add_hulls(spec, add_body(spec, pose), points, obj.mass * volumes / volumes.sum())
