"""Pick and place: grasp what stands on a table, carry it, set it down, let go, retreat."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Literal

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Action
from rtee.drivers.mujoco.objects import parse_object
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import CONTAINER_SIZE, approach, downward, make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.model import Hand
from rtee.log.recording import outcome_of
from rtee.loop.observer import LoopObserver
from rtee.loop.plan import OPEN
from rtee.loop.settings import LoopSettings
from rtee.sample import FloatArray
from rtee.trials.arm_motion import CarrierScript
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.stance import Stance
from rtee.trials.variation import Variation, draw
from rtee.types import Goal

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

_ENOUGH = 0.9
_NEAR = 0.003
_LESSONS = 3
_SETTLE = 0.4
_LIFT = 0.12
_AWAY = 0.12
_ALONG = 0.9
_TURNS = 3
_HOLD = 2.0
_SLOW = 0.06
_DEEPER = 0.03

Watch = Callable[[str, HeadlessHand[Simulation]], None]
"""Told at the moments of a transfer."""


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
    observers: Sequence[LoopObserver] = (),
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
        The first result that was placed, in 9 of 10 variations if there are any; else the one with
        the most variations survived, then the nearest to its target.

    Raises:
        UnknownAction: if there is no such action.
        ConfigError: if the object is none.
        ModelError: if the hand cannot be simulated.
    """
    action = library.find(transfer.action, transfer.elements)
    bench = _Bench(hand, library, settings, transfer, observers, watch, ticks)
    ways = stances or _stances(hand, action, settings, transfer)
    tried: list[TransferResult] = []
    for number, first in enumerate(islice(ways, transfer.places), 1):
        result = bench.taught(first, number) if teach else bench.run(first, number)
        if result.placed:
            result = bench.varied(result)
            if result.survived >= _ENOUGH * transfer.variations:
                return result
        tried.append(result)
    if not tried:
        return TransferResult(transfer, False, "the object fits nowhere between the fingers")
    return max(tried, key=lambda result: (result.placed, result.survived, -result.off))


class _Bench:
    """One transfer from any stance, with variations."""

    def __init__(
        self,
        hand: Hand,
        library: ActionLibrary,
        settings: LoopSettings,
        transfer: Transfer,
        observers: Sequence[LoopObserver],
        watch: Watch | None,
        ticks: int,
    ) -> None:
        self._hand, self._library, self._settings = hand, library, settings
        self._transfer, self._observers, self._watch = transfer, observers, watch
        self._shape = parse_object(transfer.object)
        self._ticks = ticks

    def taught(self, first: Stance, number: int) -> TransferResult:
        """Learn from how the object was held: turn the hand so that it is carried upright."""
        best = self.run(first, number)
        for _ in range(_LESSONS):
            stance = _learned(best)
            if stance is None:
                break
            result = self.run(stance, number)
            if (result.placed, -result.off) <= (best.placed, -best.off):
                break
            best = result
            if best.placed and best.off < _NEAR:
                break
        return best

    def varied(self, result: TransferResult) -> TransferResult:
        """Return a result with those of the variations."""
        if result.stance is None:
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
            options = options.model_copy(
                update={
                    "object_mass": transfer.mass * variation.mass,
                    "object_scale": variation.size,
                    "friction": variation.friction,
                }
            )
            place, mount = self._moved(place, mount, variation)
        lands = stance.place[:3, 3] if stance.lands is None else stance.lands
        x, y, _ = _turned(transfer.turn) @ mount @ lands + np.array([*transfer.by, 0.0])
        simulation = make_simulation(
            hand,
            options,
            hand.actuator_names,
            self._settings.period,
            place=place,
            mount=mount,
            container=(float(x), float(y)) if transfer.container else None,
        )
        # Before the first step: a varied object may be inside the hand at the end of the way.
        way = _AWAY * mount @ stance.way
        simulation.surroundings.jump(np.concatenate([-way, np.zeros(3)]))
        quiet = variation is not None
        headless = HeadlessHand(
            hand,
            self._library,
            self._settings,
            simulation,
            () if quiet else self._observers,
            ticks=self._ticks,
        )
        watch = None if quiet else self._watch
        run = _Run(headless, transfer, mount @ lands, way, watch)
        result = run.result()
        if not quiet:
            self._ticks = headless.ticks
        return replace(result, places=number, stance=stance, ticks=headless.ticks)

    def _moved(
        self, place: FloatArray, mount: FloatArray, variation: Variation
    ) -> tuple[FloatArray, FloatArray]:
        """Return the pose of a varied object in the hand, and the hand's turn.

        The object stands upright on a table of the same height whatever its size, so that a turn
        tilts the hand.
        """
        upright = mount @ place[:3, :3]
        place = variation.moved(place)
        mount = upright @ place[:3, :3].T
        frame = np.eye(4)
        frame[:3, :3] = upright
        grown = self._shape.lowest(frame) - self._shape.scaled(variation.size).lowest(frame)
        place[:3, 3] += mount.T @ np.array([0.0, 0.0, grown])
        return place, mount


def _stances(
    hand: Hand, action: Action, settings: LoopSettings, transfer: Transfer
) -> Iterator[Stance]:
    """Return stances into which the upright object comes along the hand's reach."""
    options = SimOptions(object=transfer.object, object_mass=transfer.mass, carrier="arm")
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    axis, down = approach(hand), downward(hand)
    for place in Places(simulation, hand, action).find(_TURNS * transfer.places):
        if float(place.way @ axis) <= 0.0:
            continue
        up = place.pose[:3, 2]
        if transfer.reach == "down" and abs(float(up @ axis)) > _ALONG:
            yield Stance(place.pose, down, axis)
        elif transfer.reach == "level" and abs(float(up @ axis)) < 1.0 - _ALONG:
            for upward in (up, -up):
                yield Stance(place.pose, np.stack([axis, np.cross(upward, axis), upward]), axis)


def _learned(result: TransferResult) -> Stance | None:
    """Return the stance that carries the object upright and leaves it at its target."""
    if result.stance is None or result.held is None or result.lands is None:
        return None
    before = result.stance
    place = np.array(before.place)
    place[:3, :3] = result.held[:3, :3]
    mount: FloatArray = before.mount @ before.place[:3, :3] @ place[:3, :3].T
    way: FloatArray = mount.T @ before.mount @ before.way
    return Stance(place, mount, way, result.lands)


class _Run:
    """One transfer with one object in one place."""

    def __init__(
        self,
        headless: HeadlessHand[Simulation],
        transfer: Transfer,
        expected: FloatArray,
        way: FloatArray,
        watch: Watch | None,
    ) -> None:
        """Prepare.

        Args:
            headless: The hand in the scene.
            transfer: What is done.
            expected: Where it is to be left, from the hand's base, in the world ``(3,)`` [m].
            way: How the hand comes, in the world ``(3,)`` [m].
            watch: Told of the moments.
        """
        self._headless, self._transfer = headless, transfer
        self._expected, self._way = expected, way
        self._watch = watch
        self._around = headless.simulation.surroundings
        self._script = CarrierScript(headless)
        self._outcome = ""
        self._held: FloatArray | None = None
        self._lands: FloatArray | None = None
        self._shift = math.inf
        self._slide = 0.0
        self._start: FloatArray | None = None
        self._began = headless.time - headless.period
        headless.before_tick(self._note_slide)

    def result(self) -> TransferResult:
        headless, around, script = self._headless, self._around, self._script
        transfer = self._transfer
        script.jump(-self._way)
        before, base = around.object_frame, around.base_pose
        base[:3, 3] += self._way
        self._tell("start")
        script.go(np.zeros(3), 1.0)
        headless.wait(0.2)
        self._tell("approach")
        grasp = Goal(transfer.action, transfer.elements, goal_id=f"grasp-{headless.ticks}")
        self._outcome = outcome_of(headless.do(grasp))
        headless.wait(_SETTLE)
        self._tell("grasp")
        place = (np.linalg.inv(base) @ before)[:3, 3]
        if around.touching():
            self._shift = float(np.linalg.norm(around.position_in_hand - place))
        self._start = around.position_in_hand
        script.move(2, _LIFT, 1.0)
        headless.wait(_HOLD)
        self._tell("lift")
        if self._lost():
            return self._ended("it fell while it was lifted")
        goal = script.at + np.array([*transfer.by, 0.0, 0.0, 0.0, transfer.turn])
        script.to(goal, 2.0)
        headless.wait(_SETTLE)
        self._tell("carry")
        if self._lost():
            return self._ended("it fell while it was carried")
        self._held = np.asarray(np.linalg.inv(around.base_pose) @ around.object_frame)
        self._set_down()
        self._start = None
        down = around.base_pose
        self._tell("set down")
        headless.do(Goal(OPEN, goal_id=f"open-{headless.ticks}"))
        headless.wait(_SETTLE)
        self._tell("open")
        way = _turned(transfer.turn) @ self._way
        script.go(script.at[:3] - way, 1.0)
        headless.wait(1.0)
        self._tell("retreat")
        expected = np.array(before)
        expected[:3, 3] = base[:3, 3] + self._expected
        self._lands = down[:3, :3].T @ (around.object_frame[:3, 3] - down[:3, 3])
        return self._judge(_moved(expected, base[:3, 3], transfer))

    def _set_down(self) -> None:
        """Go down slowly until the object stands."""
        script = self._script
        height = script.at[2]
        while not self._around.on_table and height - script.at[2] < _LIFT + _DEEPER:
            script.move(2, -_SLOW * 0.02, 0.02)
        self._headless.wait(_SETTLE)

    def _note_slide(self, _: float) -> None:
        if self._start is not None:
            now = self._around.position_in_hand
            self._slide = max(self._slide, float(np.linalg.norm(now - self._start)))

    def _lost(self) -> bool:
        return not self._around.touching() or self._slide > LOST or self._around.on_table

    def _judge(self, target: FloatArray) -> TransferResult:
        now, speed = self._around.object_frame, self._around.speed
        off = float(np.linalg.norm(now[:2, 3] - target[:2, 3]))
        up = target[:3, :3].T[:, 2]  # of the object, in its own frame
        tilt = float(np.arccos(np.clip((now[:3, :3] @ up)[2], -1.0, 1.0)))
        reason = ""
        inside = bool(
            (np.abs(now[:2, 3] - target[:2, 3]) < 0.5 * np.array(CONTAINER_SIZE[:2])).all()
        )
        if self._around.touching():
            reason = "the hand did not let go of it"
        elif self._transfer.container:
            reason = "" if inside else "it is not in the container"
        elif self._slide > SLIDE:
            reason = f"it slid {self._slide * 1e3:.0f} mm in the hand"
        elif tilt > TILT:
            reason = f"it leans by {math.degrees(tilt):.0f} degrees"
        elif off > OFF:
            reason = f"it stands {off * 1e3:.0f} mm from its target"
        elif speed > SPEED:
            reason = f"it still moves at {speed * 1e3:.0f} mm/s"
        return self._ended(reason, off, tilt, speed)

    def _ended(
        self,
        reason: str,
        off: float = math.inf,
        tilt: float = math.inf,
        speed: float = math.inf,
    ) -> TransferResult:
        return TransferResult(
            self._transfer,
            not reason,
            reason,
            self._outcome,
            self._shift,
            self._slide,
            off,
            tilt,
            speed,
            self._headless.time - self._began,
            held=self._held,
            lands=self._lands,
        )

    def _tell(self, moment: str) -> None:
        if self._watch is not None:
            self._watch(moment, self._headless)


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
