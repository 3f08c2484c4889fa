"""What a hand says of a grasp, beside what the contacts of the simulation say.

One try closes a hand by width and force, as `rtee grasp` does, on an object that somebody presents
to it and lets go of once two links have touched it. Everything is judged by the world alone: the
normal forces of MuJoCo's contacts, and where the object is two seconds later.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import mujoco
import numpy as np

from rtee.drivers.mujoco.objects import OBJECT
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import GoalRejected
from rtee.hand.model import Hand
from rtee.loop.measured import Measured
from rtee.loop.plan import Plan
from rtee.loop.planning import make_plan
from rtee.sample import FloatArray
from rtee.trials.bench import TrialBench
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.holding import SLIP, TURN, reports_loss, turned
from rtee.types import Around, Fingers, Force, Goal, Named, OnContact, Result, TipSpeed

RATE: Final = 500.0
"""Ticks per second [Hz]: a contact is answered within two."""

SETTLED: Final = 0.5
"""From this long after the result on, the force is judged [s]."""

WATCHED: Final = 2.0
"""For this long after the result, the object must stay in the hand [s]."""

_BESIDE: Final = 0.002
"""How far off the middle an object is along each axis at most [m]: as a person presents it."""

_PRESENTED: Final = 0.1
"""For this long an object is there before the goal begins [s]."""

_APART: Final = 0.1
"""For this long the fingers must have lost the object before they no longer press on it, or touch
it [s]: contacts chatter."""

_FRICTION: Final = (0.6, 1.0)
"""Range of the friction."""

_SLIPPERY: Final = 0.05
"""Friction of what slips out of the hand: that of ice."""

_HEAVY: Final = 4.0
"""Weight of what is too heavy, in forces asked: twice what two sides hold at a friction of 1."""

_LIGHT: Final = 0.2
"""Weight of other objects, in forces asked: a third of what two sides hold at 0.3."""

_UNASKED: Final = 10.0
"""Force that is thought of where none is asked for [N]."""

_GRAVITY: Final = 9.81
"""Acceleration of gravity [m/s²]."""

_MASS: Final = (0.01, 0.1)
"""Least and largest mass of such objects [kg]: a nut's and a cup's."""

_SOFT: Final = (0.02, 1.0), (0.1, 0.9, 0.006, 0.5, 2.0)
"""Time constant [s], damping ratio and impedance of the contact of a soft object: it yields by some
millimetres, as foam does."""

_DEPTH: Final = 0.03
"""Extents of a box across the closing [m]: those of a fingertip or two."""


class CaseObject(StrEnum):
    """The object; the value is what people read."""

    NONE = "none"
    BOX = "box"
    SPHERE = "sphere"
    CYLINDER = "cylinder"
    SOFT = "soft"
    HEAVY = "too heavy"
    SLIPPERY = "too slippery"

    @property
    def holds(self) -> bool:
        """Whether a hand that grasps it can keep it."""
        return self not in (CaseObject.NONE, CaseObject.HEAVY, CaseObject.SLIPPERY)


@dataclass(frozen=True, slots=True)
class Case:
    """One try.

    Attributes:
        thing: The object.
        width: Its width [m]; of nothing: the width that is asked for.
        force: The force asked for [N]; ``None``: none.
        speed: Closing speed of the opening [m/s]; ``None``: the hand's own choice.
        numb: Whether the hand feels with efforts alone, as most devices.
        seed: Seed of place and friction.
        on_contact: What the fingers do on contact, if anything is asked.
        elements: Fingers to use; empty: those of the hand's best action.
        action: An action to close by its posture instead, without a width or a force; ``force`` is
            then that for which the object is made.
    """

    thing: CaseObject
    width: float
    force: float | None
    speed: float | None = None
    numb: bool = False
    seed: int = 0
    on_contact: OnContact | None = None
    elements: tuple[str, ...] = ()
    action: str = ""


@dataclass(frozen=True, slots=True)
class Truth:
    """What a try came to; forces [N], lengths [m].

    Attributes:
        result: What the hand says.
        lost: Whether it has said afterwards that it lost the object.
        held: Whether the object is in the hand.
        pinched: Whether it is held by both sides, and does not lie beside the fingertips.
        peak: The largest force of a side until it is judged, its normal component alone.
        low: The least force between the tips from then on.
        high: The largest one.
        own: The largest force of fingers on one another.
        met: Distance of the meshes of the two sides when both had met the object, before the
            result; ``NaN``: not known.
        gap: The same distance when the force is judged.
    """

    result: Result
    lost: bool
    held: bool
    pinched: bool
    peak: float
    low: float
    high: float
    own: float
    met: float
    gap: float

    @property
    def said(self) -> bool:
        """Whether the hand says that it holds something, and has not taken it back."""
        return self.result.grasped and not self.lost

    @property
    def unknown(self) -> bool:
        """Whether the hand says that it cannot tell."""
        return self.result.unknown


class Unfit(GoalRejected):
    """The object fits nowhere between the fingers."""


def _shape(case: Case) -> str:
    """Return the object as on the command line; empty: none."""
    width = f"{case.width:.6f}"
    match case.thing:
        case CaseObject.NONE:
            return ""
        case CaseObject.SPHERE:
            return f"sphere:{0.5 * case.width:.6f}"
        case CaseObject.CYLINDER:
            return f"cylinder:{0.5 * case.width:.6f}x0.06"
        case _:
            # As wide along z, which may lie along the closing, too.
            return f"box:{width}x{_DEPTH}x{max(case.width, _DEPTH):.6f}"


def _mass(case: Case) -> float:
    """Return the mass of the object [kg]."""
    force = _UNASKED if case.force is None else case.force
    if case.thing is CaseObject.HEAVY:
        return _HEAVY * force / _GRAVITY
    if case.thing is CaseObject.SLIPPERY:
        return _HEAVY * _SLIPPERY * force / _GRAVITY
    least, most = _MASS
    return min(max(_LIGHT * force / _GRAVITY, least), most)


def _soften(simulation: Simulation) -> None:
    """Make the contacts of the object soft."""
    model = simulation.model
    body = model.body(OBJECT).id
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] == body:
            # The contact of the shape with the higher priority counts for both, friction included.
            model.geom_priority[geom] = 1
            model.geom_friction[geom, 0] = 1.0
            model.geom_solref[geom], model.geom_solimp[geom] = _SOFT


class NumbHand(HeadlessHand[Simulation]):
    """A hand that measures no forces at its fingers."""

    def _measured(self, position: FloatArray, effort: FloatArray, forces: FloatArray) -> Measured:
        return super()._measured(position, effort, np.full_like(forces, np.nan))


@dataclass(frozen=True, slots=True)
class Seen:
    """The forces in a grasp at one moment [N].

    Attributes:
        sides: The normal force of each side on the object: the sum over its fingers. That of a
            finger is the size of the sum of its links' normal forces as vectors: what counts is
            their component along the direction in which the finger presses.
        between: The force between the tips: the mean of both sides, since one of them also bears
            what the object weighs along the closing direction. Of tips from all around, the sum.
        blow: The larger of the sides; of tips from all around, their sum.
        own: The largest force of fingers on one another.
    """

    sides: tuple[float, float]
    between: float
    blow: float
    own: float


class Contacts:
    """The contacts of the fingers in a running simulation.

    Args:
        simulation: The simulation.
        hand: The hand.
        sides: Indices of the fingers on either side.
        around: Whether they close from all around.
    """

    def __init__(
        self,
        simulation: Simulation,
        hand: Hand,
        sides: tuple[Sequence[int], Sequence[int]],
        around: bool = False,
    ) -> None:
        model = simulation.model
        self._model, self._data = model, simulation.data
        thing = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, OBJECT)
        shared = [link for finger in hand.fingers for link in finger.links]
        finger_of = {
            model.body(LINK + link).id: number
            for number, finger in enumerate(hand.fingers)
            for link in finger.links
            if shared.count(link) == 1 or link == finger.tip
        }
        # By geom: asking MuJoCo at each tick takes longer than the contacts do.
        bodies = model.geom_bodyid.tolist()
        self._feels = [finger_of.get(body) for body in bodies]
        self._things = [body == thing for body in bodies]
        self._wrench = np.zeros(6)
        self._fingers = len(hand.fingers)
        self._sides, self._around = [list(side) for side in sides], around
        tips = [[hand.fingers[f].tip for f in side] for side in self._sides]
        self._tips = [
            [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
            for bodies in (
                {model.body(LINK + tip).id for tip in side if tip is not None} for side in tips
            )
        ]

    def seen(self) -> Seen:
        """Return the forces at this moment."""
        data = self._data
        if not data.ncon:
            return Seen((0.0, 0.0), 0.0, 0.0, 0.0)
        normal, own = np.zeros((self._fingers, 3)), 0.0
        contacts = data.contact
        pairs, places = contacts.geom.tolist(), contacts.efc_address.tolist()
        for number, ((one, other), place) in enumerate(zip(pairs, places, strict=True)):
            first, second = self._feels[one], self._feels[other]
            if place < 0 or first == second:
                continue
            if self._things[one] or self._things[other]:
                finger, towards = (first, 1.0) if self._things[other] else (second, -1.0)
                if finger is not None:
                    normal[finger] += towards * self._force(number) * contacts.frame[number, :3]
            elif first is not None and second is not None:
                own = max(own, self._force(number))
        each = np.linalg.norm(normal, axis=1)
        one_side, other_side = (float(each[side].sum()) for side in self._sides)
        both = one_side + other_side
        if self._around:
            return Seen((one_side, other_side), both, both, own)
        # While an object moves, one side may press more.
        return Seen((one_side, other_side), 0.5 * both, max(one_side, other_side), own)

    def _force(self, contact: int) -> float:
        """Return the normal force of a contact [N]."""
        mujoco.mj_contactForce(self._model, self._data, contact, self._wrench)
        return float(self._wrench[0])

    def gap(self) -> float:
        """Return the least distance of the tips of the two sides [m], by MuJoCo's own measure."""
        best, far = math.inf, 0.5
        for one in self._tips[0]:
            for other in self._tips[1]:
                best = min(
                    best, mujoco.mj_geomDistance(self._model, self._data, one, other, far, None)
                )
        return best if best < far else math.nan


def try_case(ready: TrialBench, case: Case) -> Truth:
    """Do one try.

    Args:
        ready: The hand; its settings must be for `RATE`.
        case: What to try.

    Raises:
        GoalRejected: if the hand cannot grasp such an object, or exert such a force.
        Unfit: if the object fits nowhere between the fingers.
        SimulationUnstable: if the equations blew up.
    """
    hand, library, settings = ready.hand, ready.library, ready.settings
    goal = Goal(
        Fingers(case.elements),
        Around(case.width),
        1.0 if case.speed is None else TipSpeed(case.speed),
        {} if case.force is None else Force(case.force),
        on_contact={} if case.on_contact is None else {"": case.on_contact},
    )
    if case.action:
        goal = Goal(Named(case.action, case.elements))
    plan = make_plan(goal, hand, library, settings)
    varied = np.random.default_rng(case.seed)
    friction = varied.uniform(*_FRICTION)
    beside = varied.uniform(-_BESIDE, _BESIDE, 3)
    options = SimOptions(
        object=_shape(case),
        object_mass=_mass(case),
        carrier="lift",  # so that the hand reaches down, and the object falls out of it
        friction=_SLIPPERY if case.thing is CaseObject.SLIPPERY else friction,
    )
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    around = simulation.surroundings
    if around.has_object:
        places = Places(simulation, hand, library.find(plan.action, plan.elements)).find(1)
        if not places:
            raise Unfit(f"{options.object} fits nowhere between the fingers of {plan.action}")
        pose = places[0].pose.copy()
        pose[:3, 3] += beside
        simulation.reset()
        if case.thing is CaseObject.SOFT:
            _soften(simulation)
        around.place(around.base_pose @ pose)
    return _Try(ready, case, goal, plan, simulation).run()


class _Try:
    """One try, from the goal to the verdict."""

    def __init__(
        self, ready: TrialBench, case: Case, goal: Goal, plan: Plan, simulation: Simulation
    ) -> None:
        self._goal, self._simulation, self._shape = goal, simulation, _shape(case)
        grip = plan.grip
        sides = ((), ()) if grip is None else (grip.fingers, grip.others)
        around = grip is not None and grip.around
        self._contacts = Contacts(simulation, ready.hand, sides, around)
        self._around = simulation.surroundings
        kind = NumbHand if case.numb else HeadlessHand[Simulation]
        self._headless = kind(ready.hand, ready.library, ready.settings, simulation)
        self._forces: list[float] = []
        self._blow = self._own = 0.0
        self._met, self._pressed = math.nan, -math.inf
        self._headless.before_tick(self._watch)

    def _watch(self, now: float) -> None:
        seen = self._contacts.seen()
        self._forces.append(seen.between)
        self._blow, self._own = max(self._blow, seen.blow), max(self._own, seen.own)
        if min(seen.sides) > 0.0:
            if now - self._pressed > _APART:
                self._met = self._contacts.gap()
            self._pressed = now

    def run(self) -> Truth:
        """Grasp, wait, and judge."""
        headless, around = self._headless, self._around
        # What is presented may overlap a finger at first, and is pushed out: that is no blow.
        headless.wait(_PRESENTED)
        self._blow = 0.0
        result = headless.do(self._goal)
        met = self._met
        before = len(headless.events)  # what was lost on the way is not this grasp
        start = around.object_frame if around.has_object else np.eye(4)
        place = around.position_in_hand if around.has_object else np.zeros(3)
        headless.wait(SETTLED)
        until, blow = len(self._forces), self._blow
        if around.has_object:
            around.remove_support()
        gap = self._contacts.gap()
        headless.wait(WATCHED - SETTLED - _APART)
        touched = held = False
        for _ in range(round(_APART * RATE)):  # a ball may chatter between the fingers
            headless.tick()
            touched = touched or (around.has_object and len(around.touching()) > 1)
        if around.has_object:
            moved = float(np.linalg.norm(around.position_in_hand - place))
            turn = turned(self._shape, start, around.object_frame)
            held = moved <= SLIP and turn <= TURN and touched
        after = self._forces[until:] or [0.0]
        return Truth(
            result,
            reports_loss(result, headless.events[before:]),
            held,
            held and headless.time - self._pressed <= _APART,
            blow,
            min(after),
            max(after),
            self._own,
            met,
            gap,
        )
