"""Results of planning: ranked grasps with their reasons, as data without geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from rtee.actions.naming import label
from rtee.actions.types import ActionReference
from rtee.hand.validation import validated
from rtee.values import Value

Point = tuple[float, float, float]
Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class Contact(Value):
    """Contact of a hand with an object, in the hand's base frame.

    Attributes:
        link: The link that touches.
        finger: Its finger; empty for the palm and for links of linkages.
        point: Its position ``(3,)`` [m].
        normal: Unit normal ``(3,)`` into the object.
    """

    link: str
    finger: str
    point: Point
    normal: Point


@dataclass(frozen=True, slots=True)
class GraspCheck(Value):
    """Result of a grasp in the simulation.

    Attributes:
        held: Whether the object was lifted, held and shaken and is still in the hand.
        reason: Why not, in words; empty if it was held.
        slip: How far the object moved in the hand from the grasp to the end [m].
        peak: The largest contact force on a finger while it was lifted and shaken [N].
        pressed: The largest force of the hand on the table [N]; 0 without one.
    """

    held: bool
    reason: str
    slip: float
    peak: float
    pressed: float = 0.0


@dataclass(frozen=True, slots=True)
class GraspPlan(Value):
    """A grasp: an action, how to do it, and why.

    Attributes:
        action: Name of the action; empty for one that was composed for the object and has no name.
        elements: Its elements, for a primitive.
        kind: ``primitive``, ``composed``, ``timed`` or ``generic``.
        parts: Its parts, if it was composed for the object.
        score: From 0 to 1; ranks the plans. With a table, the share of such grasps that held
            in simulation.
        intensity: How far the action goes, 0 to 1, so that it presses.
        touch: Intensity at which the links oppose each other on the object.
        preshape: Intensity to which the hand closes before the approach.
        opening: How far apart the fingertips are then [m].
        width: The object's width between the fingers [m].
        effort: Share of the effort limits that carries three times the weight, at most 1; 20 times
            where three fingers or more take the object from a table.
        load: Largest load at full effort, as a multiple of the object's weight.
        quality: Radius of the largest ball of wrenches that is resisted, per newton of normal
            force (Ferrari and Canny).
        clearance: Least distance between hand and object before it closes [m].
        pose: Pose of the object ``(4, 4)`` in the hand's base frame before the hand closes, row by
            row [m].
        held_pose: The same after it has closed: the fingers may push the object.
        approach_from: Start of the object's approach, relative to the hand ``(3,)`` [m].
        contacts: Contacts of the hand with the object; with a force, those of the fingers that
            touch in time to press.
        reasons: Why it has its rank, one sentence each.
        check: Result in the simulation, if it was tried there.
        flange_pose: Pose of the arm's flange ``(4, 4)`` in the object's frame before the hand
            closes, row by row [m]; ``None`` if hand.yaml has no ``flange``.
        pre_flange_pose: Pose of the flange before the approach, likewise.
        tcp: The middle of the contacts ``(3,)`` in the flange's frame [m], likewise.
        table: Pose of the table's top ``(4, 4)`` in the object's frame, row by row [m], z up; its
            origin is below the object, or on the edge over which this stands out, along x.
            ``None`` without a table.
        overhang: How far it has to stand out over that edge [m].
        force: Force between the fingertips with which the hand takes an object of that width from
            a table [N]: the side that touches first waits for the other. ``None``: the hand closes
            to the intensity.
    """

    action: str
    elements: tuple[str, ...]
    kind: str
    parts: tuple[ActionReference, ...]
    score: float
    intensity: float
    touch: float
    preshape: float
    opening: float
    width: float
    effort: float
    load: float
    quality: float
    clearance: float
    pose: Matrix
    held_pose: Matrix
    approach_from: Point
    contacts: tuple[Contact, ...]
    reasons: tuple[str, ...]
    check: GraspCheck | None = None
    flange_pose: Matrix | None = None
    pre_flange_pose: Matrix | None = None
    tcp: Point | None = None
    table: Matrix | None = None
    overhang: float = 0.0
    force: float | None = None

    @property
    def label(self) -> str:
        """Name in a sentence; without a name, ``Trig:index*0.6 + Trig:thumb``."""
        if self.action:
            return label(self.action, self.elements)
        return " + ".join(written(part) for part in self.parts)

    @property
    def carries(self) -> bool:
        """Whether it carries the object's weight at full effort."""
        return self.load >= 1.0

    @property
    def fingers(self) -> tuple[str, ...]:
        """The fingers that touch, each once."""
        return tuple(dict.fromkeys(c.finger for c in self.contacts if c.finger))


@dataclass(frozen=True, slots=True)
class Ranking(Value):
    """The grasps of an object by a hand, the best first.

    Attributes:
        hand: The hand's name.
        object: The object, as on the command line.
        mass: Its mass [kg].
        friction: Coefficient of friction.
        weight_axis: Direction of its weight, a unit vector in the hand's base frame; with a table
            that has a normal, the weight acts against z of each plan's `table` instead.
        plans: The grasps, one for each action that can hold the object.
        rejected: The other actions, with the reasons.
        notes: Assumptions, one sentence each.
        flange: The frame of the arm's flange; empty if hand.yaml has none.
    """

    hand: str
    object: str
    mass: float
    friction: float
    weight_axis: Point
    plans: tuple[GraspPlan, ...]
    rejected: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    flange: str = ""


def written(part: ActionReference) -> str:
    """Return a part as `rtee compose` reads it: ``Trig:index*0.6``."""
    elements = f":{','.join(part.elements)}" if part.elements else ""
    scale = f"*{part.scale:g}" if part.scale != 1.0 else ""
    return f"{part.action}{elements}{scale}"


def to_document(ranking: Ranking) -> dict[str, Any]:
    """Return a ranking as plain data, ready for JSON."""
    return asdict(ranking)


def from_document(document: Mapping[str, Any]) -> Ranking:
    """Return a ranking from plain data.

    Raises:
        Invalid: if it is not a ranking; the error names all mistakes.
    """
    return validated(Ranking, document)
