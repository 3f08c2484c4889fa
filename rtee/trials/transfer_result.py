"""What is carried from one place to another, and how that ended; needs no simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from rtee.sample import FloatArray

if TYPE_CHECKING:
    from rtee.trials.stance import Stance


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
    pressing: float = math.inf


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
