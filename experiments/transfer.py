"""Pick and place: grasp what stands on a table, carry it, set it down, let go, retreat."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Literal

import mujoco
import numpy as np
from msgspec import structs

from experiments.stance import Stance, find_stances
from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.contacts import TABLE_FRICTION, make_hard
from rtee.drivers.mujoco.objects import MESHES
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.surroundings import TABLE
from rtee.errors import SimulationUnstable
from rtee.hand.model import Hand
from rtee.loop.observer import Observer
from rtee.loop.planning import OPEN
from rtee.loop.settings import LoopSettings
from rtee.objects.shape import parse_object
from rtee.planning.objects import read_object
from rtee.planning.table import CLEAR
from rtee.sample import FloatArray
from rtee.trials.grasp_placement import fingers_of
from rtee.trials.headless import HeadlessHand
from rtee.trials.planned import PRESSED
from rtee.trials.scenario import ApproachStep, Grasp, Lift, Step, TrialScene, Wait, Watch, mark
from rtee.trials.variation import CHOOSING_FROM, Variation, draw
from rtee.types import Goal, Named

WAYS = np.array([[0.0, 0.0, -0.05], [0.0, 0.0, 0.14], [0.16, 0.1, 0.14], [0.24, 0.12, 0.0]])
"""The ways of the hand, which pictures of a transfer show ``(4, 3)`` [m]."""

CONTAINER_SIZE = (0.34, 0.34, 0.04)
"""Length, width and height of an open container [m]: an open hand fits between its walls."""

_WALL = 0.004
"""Thickness of its walls [m]: that of a plastic crate."""

MOMENTS = ("start", "approach", "grasp", "lift", "carry", "set down", "open", "retreat")
"""The moments of a transfer, in order."""

SLIDE = 0.01
"""How far the object may slide in the hand between lift and set-down [m]."""

LOST = 0.06
"""How far it may move in the hand before it counts as fallen [m]."""

OFF = 0.015
"""How far from its target it may stand [m]."""

TILT = math.radians(10.0)
"""How far it may lean [rad]."""

SPEED = 0.005
"""How fast it may still move [m/s]."""

_CHOOSING = 5
"""Tries with variation by which stances are compared: one that survives them all is taken."""

_NEAR = 0.003
"""The arm has learned enough when the object stands as near to its target [m]: a fifth of `OFF`."""

_LESSONS = 3
"""How often the arm learns from one stance: the second lesson corrects by a millimetre or two."""

_LOOKED_AT = 3
"""Places that are looked at for each one that is tried: in about a third the object is upright."""

_RAISE = 2e-3
"""By how much at a time the hand is raised until it clears the table [m]."""

_SETTLE = 0.4
"""How long the scene comes to rest after each movement [s]."""

_LIFT = 0.12
"""How far the object is lifted [m]: clear of the table and of the container's walls."""

_AWAY = 0.12
"""From how far the hand comes [m]: farther than fingers are long."""

_HOLD = 2.0
"""How long the object is held in the air [s]."""

_SLOW = 0.06
"""Speed at which the arm feels its way [m/s]."""

_STEP = 0.02
"""How long the arm goes between two looks whether it touches [s]: 1.2 mm."""

_DEEPER = 0.03
"""How far below its old height the object may be set down [m]: more than it may hang askew."""

_DROP = 0.03
"""From how high an object is dropped into a container [m]: fingers open below it."""

_FARTHER = 0.06
"""How far the hand comes on until it touches the object [m]: two variations of height and size."""


def add_container(spec: mujoco.MjSpec, height: float, middle: tuple[float, float]) -> None:
    """Add a container, open at the top, on a table.

    The table's top is at a height [m], the container's middle at x and y in the world [m].
    """
    half = 0.5 * np.array(CONTAINER_SIZE)
    thin = 0.5 * _WALL
    parts = [("floor", (half[0], half[1], thin), (0.0, 0.0, thin))]
    for sign, side in ((-1.0, "one"), (1.0, "other")):
        parts += [
            (f"x/{side}", (thin, half[1], half[2]), (sign * (half[0] - thin), 0.0, half[2])),
            (f"y/{side}", (half[0], thin, half[2]), (0.0, sign * (half[1] - thin), half[2])),
        ]
    origin = np.array([*middle, height])
    for name, size, offset in parts:
        geom = spec.worldbody.add_geom(
            name=f"{TABLE}/{name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=origin + offset,
            rgba=[0.45, 0.55, 0.68, 1.0],
        )
        make_hard(geom, TABLE_FRICTION)


@dataclass(frozen=True, slots=True)
class Transfer:
    """What is carried, how, and where to.

    Attributes:
        action: Name of the action that grasps.
        elements: Its elements.
        object: The object, as on the command line.
        mass: Its mass [kg].
        by: How far it is carried along the world's x and y [m].
        turn: How far it is turned about the vertical on the way [rad].
        reach: The hand comes from above (``down``), or from the side (``level``).
        places: How many places in the hand are tried at most.
        variations: How often it is tried with variations of the object, of its place and friction.
        seed: Seed of the variations.
        container: An open container is at its target, into which it is put. Then it may lie there
            as it likes.
        pressing: What presses harder than this is not placed [N]: the hand on table, container or,
            with other links than those of the action's fingers, on the object.
    """

    action: str
    elements: tuple[str, ...] = ()
    object: str = "cylinder:0.025x0.14"
    mass: float = 0.1
    by: tuple[float, float] = (0.15, 0.1)
    turn: float = 0.5
    reach: Literal["down", "level"] = "down"
    places: int = 6
    variations: int = 0
    seed: int = 0
    container: bool = False
    pressing: float = PRESSED


@dataclass(frozen=True, slots=True)
class TransferResult:
    """How a transfer ended.

    Attributes:
        transfer: What was tried.
        placed: The object was held for two seconds in the air, hardly slid, and stands at its
            target.
        reason: Why not; empty if it does.
        outcome: How the grasping action ended.
        shift: How far the fingers moved the object as they closed [m].
        slide: How far it slid in the hand between lift and set-down, at most [m].
        pressed: The largest force that `Transfer.pressing` limits [N].
        held_by: The fingers that touch the lifted object.
        off: How far from its target it stands in the plane [m].
        tilt: How far it leans from how it stood before [rad].
        speed: How fast it still moves [m/s].
        duration: Simulated time [s].
        places: How many places in the hand were tried.
        survived: In how many of the variations it was placed, too.
        stance: How the hand came to the object; nothing if it fits nowhere.
        held: Pose ``(4, 4)`` in the hand's base frame in which it was carried.
        lands: Where it was left ``(3,)`` [m], in the base frame of the hand that opens.
        varied: The results of the variations.
        ticks: Ticks since the recording's start.
    """

    transfer: Transfer
    placed: bool
    reason: str = ""
    outcome: str = ""
    shift: float = math.inf
    slide: float = math.inf
    pressed: float = 0.0
    held_by: tuple[str, ...] = ()
    off: float = math.inf
    tilt: float = math.inf
    speed: float = math.inf
    duration: float = 0.0
    places: int = 0
    survived: int = 0
    stance: Stance | None = field(default=None, compare=False)
    held: FloatArray | None = field(default=None, compare=False)
    lands: FloatArray | None = field(default=None, compare=False)
    varied: tuple[TransferResult, ...] = ()
    ticks: int = 0


def run_transfer(
    hand: Hand,
    library: ActionLibrary,
    settings: LoopSettings,
    transfer: Transfer,
    *,
    observers: Sequence[Observer] = (),
    watch: Watch | None = None,
    stances: Iterable[Stance] = (),
    teach: bool = True,
    ticks: int = 0,
) -> TransferResult:
    """Pick an object up and place it elsewhere, from one place in the hand or another.

    From each place the hand learns, as if a person taught the arm: how it has to be turned so that
    the object hangs upright in it, and where it leaves the object when it opens.

    Args:
        hand: The hand.
        library: Its actions.
        settings: Its loop's settings.
        transfer: What is tried.
        observers: Told of every tick, as in the loop.
        watch: Told of the moments of the transfer.
        stances: How the hand comes to the object; searched unless given.
        teach: Learn from each of them; switch it off for the stance of an earlier result.
        ticks: Ticks that went before, so that one recording may hold several transfers.

    Returns:
        The result from the first place where the object was placed. With variations, places are
        compared by other draws than those that count.

    Raises:
        UnknownAction: if there is no such action.
        ConfigError: if the object is none.
        ModelError: if the hand cannot be simulated.
    """
    bench = _Bench(hand, library, settings, transfer, observers, watch, ticks)
    ways = stances or bench.stances()
    tried: list[tuple[int, TransferResult]] = []
    for number, first in enumerate(islice(ways, transfer.places), 1):
        result = bench.taught(first, number) if teach else bench.run(first, number)
        survived = bench.compared(result)
        tried.append((survived, result))
        if result.placed and survived == bench.comparisons:
            break
    if not tried:
        return TransferResult(transfer, False, "the object does not fit between the fingers")
    # What was placed counts first; then how often it was placed with variations, then how near.
    _, best = max(tried, key=lambda pair: (pair[1].placed, pair[0], -pair[1].off))
    return bench.varied(best)


class _Bench:
    """One transfer from any stance, with variations."""

    def __init__(
        self,
        hand: Hand,
        library: ActionLibrary,
        settings: LoopSettings,
        transfer: Transfer,
        observers: Sequence[Observer],
        watch: Watch | None,
        ticks: int,
    ) -> None:
        self._hand, self._library, self._settings = hand, library, settings
        self._transfer, self._observers, self._watch = transfer, observers, watch
        self._action = library.find(transfer.action, transfer.elements)
        self._shape = parse_object(transfer.object, MESHES)
        self._ticks = ticks

    def stances(self) -> Iterable[Stance]:
        """Search for stances."""
        transfer, hand = self._transfer, self._hand
        options = SimOptions(object=transfer.object, object_mass=transfer.mass, carrier="arm")
        return find_stances(
            make_simulation(hand, options, hand.actuator_names, self._settings.period),
            self._library,
            self._action,
            read_object(transfer.object, transfer.mass),
            transfer.reach,
            _LOOKED_AT * transfer.places,
        )

    def taught(self, first: Stance, number: int) -> TransferResult:
        """Learn from how the object was held: turn the hand so that it is carried upright."""
        best = self.run(first, number)
        for _ in range(_LESSONS):
            # An object that fell on the way teaches nothing.
            if best.stance is None or best.held is None or best.lands is None:
                break
            result = self.run(best.stance.learned(best.held, best.lands), number)
            if (result.placed, -result.off) <= (best.placed, -best.off):
                break
            best = result
            if best.placed and best.off < _NEAR:
                break
        return best

    @property
    def comparisons(self) -> int:
        """How many tries with variation compare places; none if no variations are wanted."""
        return _CHOOSING if self._transfer.variations else 0

    def compared(self, result: TransferResult) -> int:
        """Return in how many of these tries the object is placed, too."""
        if result.stance is None or not result.placed:
            return 0
        numbers = range(CHOOSING_FROM, CHOOSING_FROM + self.comparisons)
        draws = [draw(self._transfer.seed, number) for number in numbers]
        return sum(self.run(result.stance, result.places, each).placed for each in draws)

    def varied(self, result: TransferResult) -> TransferResult:
        """Return a result with those of the variations."""
        if result.stance is None or not result.placed:
            return result
        draws = [draw(self._transfer.seed, n) for n in range(self._transfer.variations)]
        tried = tuple(self.run(result.stance, result.places, variation) for variation in draws)
        return replace(result, survived=sum(each.placed for each in tried), varied=tried)

    def run(
        self, stance: Stance, number: int, variation: Variation | None = None
    ) -> TransferResult:
        """Do the transfer once; variations are neither recorded nor watched."""
        transfer, hand = self._transfer, self._hand
        options = SimOptions(
            object=transfer.object, object_mass=transfer.mass, support="table", carrier="arm"
        )
        place, mount = stance.place, stance.mount
        if variation is not None:
            options = structs.replace(options, **variation.options(transfer.mass))
            place, mount = stance.varied(variation, self._shape)
        lands = stance.place[:3, 3] if stance.lands is None else stance.lands
        # The container is where the hand leaves the object, turned and carried as it will be.
        x, y, _ = _turned(transfer.turn) @ mount @ lands + np.array([*transfer.by, 0.0])
        raised = mount.T @ np.array([0.0, 0.0, _RAISE])

        def furnish(spec: mujoco.MjSpec, height: float) -> None:
            if transfer.container:
                add_container(spec, height, (float(x), float(y)))

        while True:
            simulation = make_simulation(
                hand,
                options,
                hand.actuator_names,
                self._settings.period,
                place=place,
                mount=mount,
                furnish=furnish,
            )
            # An arm that knows its hand and the table keeps it above, tilted or not.
            simulation.surroundings.jump(np.array([0.0, 0.0, -CLEAR, 0.0, 0.0, 0.0]))
            if not simulation.surroundings.pressing():
                break
            place = place.copy()
            place[:3, 3] -= raised
        # Along the same line in the world, however the hand is tilted: a tilted one would begin or
        # end inside the table. Before the first step: a varied object may be inside the hand at the
        # end of the way.
        approach = _AWAY * stance.mount @ stance.approach
        simulation.surroundings.jump(np.concatenate([-approach, np.zeros(3)]))
        quiet = variation is not None
        headless = HeadlessHand(
            hand,
            self._library,
            self._settings,
            simulation,
            () if quiet else self._observers,
            ticks=self._ticks,
        )
        fingers = [hand.finger(name) for name in fingers_of(hand, self._action)]
        links = frozenset(link for finger in fingers for link in finger.body)
        scene = TrialScene(headless, None if quiet else self._watch)
        result = _Run(scene, transfer, links, mount @ lands, approach, stance.back).result()
        if not quiet:
            # Only what is recorded takes time of the recording.
            self._ticks = headless.ticks
        return replace(result, places=number, stance=stance, ticks=headless.ticks)


class _Run:
    """One transfer with one object in one place."""

    def __init__(
        self,
        scene: TrialScene,
        transfer: Transfer,
        links: frozenset[str],
        expected: FloatArray,
        approach: FloatArray,
        back: float | None,
    ) -> None:
        """Prepare.

        Args:
            scene: The hand in the scene.
            transfer: What is done.
            links: The links that may press on the object.
            expected: Where it is to be left, from the hand's base, in the world ``(3,)`` [m].
            approach: How the hand comes, in the world ``(3,)`` [m].
            back: How far it goes back after it felt the object [m].
        """
        self._scene, self._transfer, self._links = scene, transfer, links
        self._expected, self._approach, self._back = expected, approach, back
        self._around = scene.around
        self._down: FloatArray = np.eye(4)
        self._held: FloatArray | None = None
        self._lands: FloatArray | None = None
        self._shift = math.inf
        self._slide = self._pressed = 0.0
        self._held_by: tuple[str, ...] = ()
        self._in_air = False
        self._ends = math.inf, math.inf, math.inf
        scene.headless.before_tick(self._note)

    def result(self) -> TransferResult:
        scene, transfer = self._scene, self._transfer
        ticks = scene.headless.ticks
        grasp = Goal(Named(transfer.action, transfer.elements), goal_id=f"grasp-{ticks}")
        steps: list[Step] = [
            ApproachStep(self._approach, self._feel),
            Grasp(grasp),
            Wait(_SETTLE, "grasp"),
            self._closed,
            mark,
            Lift(_LIFT, _HOLD),
            self._lifted,
            self._carry,
            Wait(_SETTLE, "carry"),
            self._carried,
            self._set_down,
            self._open,
            Wait(_SETTLE, "open"),
            self._retreat,
            # What was let go needs time to fall over, if it does.
            Wait(1.0, "retreat"),
            self._judge,
        ]
        try:
            reason = scene.play(steps)
        except SimulationUnstable as error:
            reason = str(error)
        off, tilt, speed = self._ends
        return TransferResult(
            transfer,
            not reason,
            reason,
            scene.outcome,
            self._shift,
            self._slide,
            round(self._pressed, 3),
            self._held_by,
            off,
            tilt,
            speed,
            scene.duration,
            held=self._held,
            lands=self._lands,
        )

    def _feel(self, scene: TrialScene) -> None:
        """Come on slowly until the hand touches the object, then go back."""
        if self._back is None:
            return
        approach = self._approach / np.linalg.norm(self._approach)
        come = 0.0
        while not self._around.touching() and come < _FARTHER:
            scene.go(scene.at[:3] + _SLOW * _STEP * approach, _STEP)
            come += _SLOW * _STEP
        scene.go(scene.at[:3] - self._back * approach, self._back / _SLOW)

    def _closed(self, scene: TrialScene) -> None:
        # A hand that felt for the object closes elsewhere than where the approach ended.
        closing = np.array(scene.base)
        closing[:3, 3] += self._approach
        closing[:3, 3] += scene.at[:3]
        place = (np.linalg.inv(closing) @ scene.before)[:3, 3]
        if self._around.touching():
            self._shift = float(np.linalg.norm(self._around.position_in_hand - place))
        self._in_air = True

    def _lifted(self, scene: TrialScene) -> str:
        touching = set(self._around.touching())
        fingers = scene.headless.hand.fingers
        self._held_by = tuple(f.name for f in fingers if touching & set(f.body))
        return "it fell while it was lifted" if self._lost() else ""

    def _carry(self, scene: TrialScene) -> None:
        goal = scene.at + np.array([*self._transfer.by, 0.0, 0.0, 0.0, self._transfer.turn])
        scene.to(goal, 2.0)

    def _carried(self, _: TrialScene) -> str:
        if self._lost():
            return "it fell while it was carried"
        around = self._around
        self._held = np.asarray(np.linalg.inv(around.base_pose) @ around.object_frame)
        return ""

    def _set_down(self, scene: TrialScene) -> None:
        """Go down slowly until the object stands; over a container's floor, a little back up."""
        height = scene.at[2]
        # As far as the contact, not to a height: the object may have slid in the hand.
        while not self._around.on_table and height - scene.at[2] < _LIFT + _DEEPER:
            if self._transfer.container and self._around.pressing() > 0.0:
                break
            scene.move(2, -_SLOW * _STEP, _STEP)
        # Fingers around an object would open into the floor.
        if self._transfer.container:
            scene.move(2, _DROP, 0.5)
        scene.headless.wait(_SETTLE)
        self._in_air = False
        # Before the hand retreats: `lands` is told in the frame of the hand that opens.
        self._down = self._around.base_pose
        scene.tell("set down")

    def _open(self, scene: TrialScene) -> None:
        scene.headless.do(Goal(Named(OPEN), goal_id=f"open-{scene.headless.ticks}"))

    def _retreat(self, scene: TrialScene) -> None:
        approach = _turned(self._transfer.turn) @ self._approach
        scene.go(scene.at[:3] - approach, 1.0)

    def _note(self, _: float) -> None:
        self._pressed = max(self._pressed, self._around.pressing(self._links))
        if self._in_air:  # between lift and set-down only
            self._slide = max(self._slide, self._scene.moved)

    def _lost(self) -> bool:
        # In the air it can touch the table only if it hangs far out of the hand.
        return not self._around.touching() or self._slide > LOST or self._around.on_table

    def _judge(self, scene: TrialScene) -> str:
        now, down = self._around.object_frame, self._down
        # Targets are told from where the way to the object ends.
        base = scene.base[:3, 3] + self._approach
        self._lands = down[:3, :3].T @ (now[:3, 3] - down[:3, 3])
        expected = np.array(scene.before)
        expected[:3, 3] = base + self._expected
        target = _moved(expected, base, self._transfer)
        speed = self._around.speed
        off = float(np.linalg.norm(now[:2, 3] - target[:2, 3]))
        up = target[:3, :3].T[:, 2]  # of the object, in its own frame
        # Rounding may bring a cosine beyond 1.
        tilt = float(np.arccos(np.clip((now[:3, :3] @ up)[2], -1.0, 1.0)))
        self._ends = off, tilt, speed
        inside = bool(
            (np.abs(now[:2, 3] - target[:2, 3]) < 0.5 * np.array(CONTAINER_SIZE[:2])).all()
        )
        if self._around.touching():
            # First: what is still held may stand well, but only by the hand.
            return "the hand did not let go of it"
        if self._pressed > self._transfer.pressing:
            return f"the hand pressed with {self._pressed:.0f} N what it should not"
        if self._transfer.container:
            return "" if inside else "it is not in the container"
        if self._slide > SLIDE:
            return f"it slid {self._slide * 1e3:.0f} mm in the hand"
        if tilt > TILT:
            return f"it leans by {math.degrees(tilt):.0f} degrees"
        if off > OFF:
            return f"it stands {off * 1e3:.0f} mm from its target"
        return f"it still moves at {speed * 1e3:.0f} mm/s" if speed > SPEED else ""


def _turned(angle: float) -> FloatArray:
    """Return the rotation ``(3, 3)`` about the vertical by an angle [rad]."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _moved(frame: FloatArray, base: FloatArray, transfer: Transfer) -> FloatArray:
    """Return a pose ``(4, 4)`` after the carrier's turn about the hand's base and its way."""
    turn = np.eye(4)
    turn[:3, :3] = _turned(transfer.turn)
    turn[:3, 3] = base - turn[:3, :3] @ base
    turn[:2, 3] += transfer.by
    moved: FloatArray = turn @ frame
    return moved
