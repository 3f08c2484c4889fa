"""Pick and place: grasp what stands on a table, carry it, set it down, let go, retreat."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Action
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import approach, downward, make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.model import Hand
from rtee.log.recording import outcome_of
from rtee.loop.observer import LoopObserver
from rtee.loop.plan import OPEN
from rtee.loop.settings import LoopSettings
from rtee.trials.arm_motion import CarrierScript
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.types import FloatArray, Goal

MOMENTS = ("start", "approach", "grasp", "lift", "carry", "set down", "open", "retreat")
"""The moments of a transfer, in order."""

OFF = 0.05
"""How far from its target the object may stand [m]."""

TILT = math.radians(10.0)
"""How far it may lean [rad]."""

SPEED = 0.005
"""How fast it may still move [m/s]."""

_SETTLE = 0.4
_LIFT = 0.12
_AWAY = 0.12
_ALONG = 0.9
_TURNS = 3
_HOLD = 2.0
_LOST = 0.06
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
    """

    action: str
    elements: tuple[str, ...] = ()
    object: str = "cylinder:0.025x0.14"
    mass: float = 0.1
    by: tuple[float, float] = (0.15, 0.1)
    turn: float = 0.5
    reach: Literal["down", "level"] = "down"
    places: int = 6


@dataclass(frozen=True, slots=True)
class TransferResult:
    """How a transfer ended.

    Attributes:
        transfer: What was tried.
        placed: The object was held for two seconds in the air and stands at its target.
        reason: Why not; empty if it does.
        outcome: How the grasping action ended.
        slip: How far it moved in the hand while it was carried [m].
        off: How far from its target it stands in the plane [m].
        tilt: How far it leans from how it stood before [rad].
        speed: How fast it still moves [m/s].
        duration: Simulated time [s].
        places: How many places in the hand were tried.
    """

    transfer: Transfer
    placed: bool
    reason: str = ""
    outcome: str = ""
    slip: float = 0.0
    off: float = math.inf
    tilt: float = math.inf
    speed: float = math.inf
    duration: float = 0.0
    places: int = 0


def run_transfer(
    hand: Hand,
    library: ActionLibrary,
    settings: LoopSettings,
    transfer: Transfer,
    *,
    observers: Sequence[LoopObserver] = (),
    watch: Watch | None = None,
    skip: int = 0,
) -> TransferResult:
    """Pick an object up and place it elsewhere, from one place in the hand or another.

    Args:
        hand: The hand.
        library: Its actions.
        settings: Its loop's settings.
        transfer: What is tried.
        observers: Told of every tick, as in the loop.
        watch: Told of the moments of the transfer.
        skip: Places to leave out, because they are known to fail.

    Returns:
        The result with the first place that worked, or with the last one that was tried.

    Raises:
        UnknownAction: if there is no such action.
        ConfigError: if the object is none.
        ModelError: if the hand cannot be simulated.
    """
    action = library.find(transfer.action, transfer.elements)
    found = TransferResult(transfer, False, "the object fits nowhere between the fingers")
    ways = islice(_ways(hand, action, settings, transfer), transfer.places)
    ticks = 0
    for number, (place, mount) in enumerate(ways, 1):
        if number <= skip:
            continue
        options = SimOptions(
            object=transfer.object, object_mass=transfer.mass, support="table", carrier="arm"
        )
        simulation = make_simulation(
            hand, options, hand.actuator_names, settings.period, place=place, mount=mount
        )
        headless = HeadlessHand(hand, library, settings, simulation, observers, ticks=ticks)
        found = _Run(headless, transfer, mount @ approach(hand), number, watch).result()
        ticks = headless.ticks
        if found.placed:
            break
    return found


def _ways(
    hand: Hand, action: Action, settings: LoopSettings, transfer: Transfer
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Return poses ``(4, 4)`` of the upright object in the hand, and the hand's turn ``(3, 3)``.

    Only those into which the object comes along the hand's reach.
    """
    options = SimOptions(object=transfer.object, object_mass=transfer.mass, carrier="arm")
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    axis, down = approach(hand), downward(hand)
    for place in Places(simulation, hand, action).find(_TURNS * transfer.places):
        if float(place.way @ axis) <= 0.0:
            continue
        up = place.pose[:3, 2]
        if transfer.reach == "down" and abs(float(up @ axis)) > _ALONG:
            yield place.pose, down
        elif transfer.reach == "level" and abs(float(up @ axis)) < 1.0 - _ALONG:
            for upward in (up, -up):
                yield place.pose, np.stack([axis, np.cross(upward, axis), upward])


class _Run:
    """One transfer with one place in the hand."""

    def __init__(
        self,
        headless: HeadlessHand[Simulation],
        transfer: Transfer,
        way: FloatArray,
        number: int,
        watch: Watch | None,
    ) -> None:
        self._headless, self._transfer, self._number = headless, transfer, number
        self._way = _AWAY * way
        self._watch = watch
        self._around = headless.simulation.surroundings
        self._script = CarrierScript(headless)
        self._outcome = ""
        self._slip = 0.0
        self._began = headless.time - headless.period

    def result(self) -> TransferResult:
        headless, around, script = self._headless, self._around, self._script
        transfer = self._transfer
        before, base = around.object_frame, around.base_pose[:3, 3]
        script.jump(-self._way)
        self._tell("start")
        script.go(np.zeros(3), 1.0)
        headless.wait(0.2)
        self._tell("approach")
        grasp = Goal(transfer.action, transfer.elements, goal_id=f"grasp-{self._number}")
        self._outcome = outcome_of(headless.do(grasp))
        headless.wait(_SETTLE)
        self._tell("grasp")
        start = around.position_in_hand
        script.move(2, _LIFT, 1.0)
        headless.wait(_HOLD)
        self._tell("lift")
        if self._lost(start):
            return self._ended("it fell while it was lifted")
        goal = script.at + np.array([*transfer.by, 0.0, 0.0, 0.0, transfer.turn])
        script.to(goal, 2.0)
        headless.wait(_SETTLE)
        self._tell("carry")
        if self._lost(start):
            return self._ended("it fell while it was carried")
        self._set_down()
        self._tell("set down")
        headless.do(Goal(OPEN, goal_id=f"open-{self._number}"))
        headless.wait(_SETTLE)
        self._tell("open")
        way = _turned(transfer.turn) @ self._way
        script.go(script.at[:3] - way, 1.0)
        headless.wait(1.0)
        self._tell("retreat")
        return self._judge(_moved(before, base, transfer))

    def _set_down(self) -> None:
        """Go down slowly until the object stands."""
        script = self._script
        height = script.at[2]
        while not self._around.on_table and height - script.at[2] < _LIFT + _DEEPER:
            script.move(2, -_SLOW * 0.02, 0.02)
        self._headless.wait(_SETTLE)

    def _lost(self, start: FloatArray) -> bool:
        self._slip = float(np.linalg.norm(self._around.position_in_hand - start))
        return not self._around.touching() or self._slip > _LOST or self._around.on_table

    def _judge(self, target: FloatArray) -> TransferResult:
        now, speed = self._around.object_frame, self._around.speed
        off = float(np.linalg.norm(now[:2, 3] - target[:2, 3]))
        up = target[:3, :3].T[:, 2]  # of the object, in its own frame
        tilt = float(np.arccos(np.clip((now[:3, :3] @ up)[2], -1.0, 1.0)))
        reason = ""
        if self._around.touching():
            reason = "the hand did not let go of it"
        elif off > OFF:
            reason = f"it stands {off * 1e3:.0f} mm from its target"
        elif tilt > TILT:
            reason = f"it leans by {math.degrees(tilt):.0f} degrees"
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
            self._slip,
            off,
            tilt,
            speed,
            self._headless.time - self._began,
            self._number,
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
