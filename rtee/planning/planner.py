"""Plan how a hand grasps an object with its actions: geometry and forces, no dynamics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee import values
from rtee.actions.naming import label
from rtee.actions.openings import MARGIN, Openings, OpeningTable
from rtee.actions.types import Action, PrimitiveKind, Timed, kind_of
from rtee.errors import ConfigError
from rtee.hand.frames import base_in_flange, flange_with
from rtee.hand.model import Hand
from rtee.objects.shape import Table, vector
from rtee.planning.approaches import GAP, PoseCandidate
from rtee.planning.closing import STEPS, ActionPath, Closure, HandClosing
from rtee.planning.distance_bounds import DistanceBounds
from rtee.planning.nearby import closed_nearby
from rtee.planning.objects import GraspObject
from rtee.planning.poses import Poses, orientations, outward
from rtee.planning.result import Contact, GraspPlan, Matrix, Ranking
from rtee.planning.scene import GraspScene
from rtee.planning.search import FoundGrasp, Search, search_together
from rtee.planning.springs import PressingForces, gains, pressing, scaled, sunk
from rtee.planning.table import Ground
from rtee.planning.wrench import EDGES, GRAVITY, balanced, load, quality, wrenches
from rtee.sample import BoolArray, FloatArray
from rtee.types import ActuatorSpec, JointKind

FRICTION: Final = 0.5
"""Default coefficient of friction: rubber has more on most materials, bare metal less."""

SAFETY: Final = 3.0
"""Load, in multiples of the weight, above which it does not limit a grasp: arms accelerate."""

_SAFETY_OF_FINGERS: Final = 20.0
"""The same factor for three or more fingers that take an object from a table. The load is that of
the best forces they could share; the forces of fingers that close on a standing object are far from
these. Of grasps that carry 3 to 6 times the weight, 1 of 54 held; of those that carry 6 to 20
times, 30 of 70; and beyond, 47 of 64."""

_PLACED: Final = 0.3
"""How much quality and place of the contacts count in a grasp with a force. Whether the fingers'
forces balance there tells more: with qualities from 0.01 to 0.14, grasps that carry the load and do
held in 93 of 94 tries."""

_SAFETY_OF_FORCE: Final = 10.0
"""Multiple of the weight that the force between fingertips carries, if the hand is strong enough:
with 3, fingers that meet an object askew lose it."""

_POSES: Final = 120
"""Poses of the object that are tried for a hand, shared by its actions."""

_FEWEST: Final = 3
"""Poses tried for each action at least."""

_ABOVE: Final = 3
"""Factor on this number above a table, since the table rules most poses out."""

_MOST: Final = 16
"""Poses tried for each action at most."""

_FINALISTS: Final = 2
"""Poses of an action whose quality and load are computed; one if there are many actions."""

_ENOUGH: Final = 3
"""Holding poses of an action after which no others are tried; or half of the requested number, if
that is more."""

_TOGETHER: Final = 64
"""Actions whose closing is computed together: the table of a path takes 0.3 MB."""

_JUDGED: Final = 12
"""Actions whose quality and load are computed: the most promising."""

_GOOD_QUALITY: Final = 0.05
"""Quality that counts half [N/N]: two soft fingers at friction 0.5 have 0.04, a wrap 0.1 to 0.3."""

_SHAKING: Final = 2.4
"""Acceleration of a carried object [m/s²]: an arm stops, and `rtee try` shakes it, 15 mm to either
side at 2 Hz."""

_SHAKEN: Final = _SHAKING * np.vstack([np.eye(3), -np.eye(3)])
"""Such accelerations along each axis, one at a time ``(6, 3)`` [m/s²]."""

_HALF_PLACE: Final = 5.1e-5
"""Scores are rounded to four places: one lower by no more than this may count as equal."""

_SQUEEZE: Final = {JointKind.PRISMATIC: 0.01}
"""How far set-points of sliding actuators go beyond the contact [m], so that they press."""

_SQUEEZE_ANGLE: Final = 0.3
"""The same for turning actuators [rad]: the full effort of an ordinary servo."""

_CLEAR: Final = 1e-3
"""Gap between the pre-shaped hand and the object [m]: the accuracy of models."""

_FAR: Final = 0.05
"""Largest clearance that is computed exactly [m]."""

_FORCE: Final = 0.6
"""Largest share of the strongest force between fingertips that is planned with. The rest keeps the
posture: at 0.9, a LinkerHand L10's index pushed its thumb back as soon as the table no longer
helped, at 0.6 and less never."""

_BALANCES: Final = (0.3, 0.6)
"""Shares of the fingers' pressing that must balance on the object: below the first, the table bears
most of it, and the object is pushed away once it is lifted; above the second, it stays."""

_SQUARE: Final = (0.42, 0.73)
"""Cosines between a finger's motion and the normal of its contact: 65 and 43 degrees, the angles at
which two tips reach the shares above. A finger that moves along a surface slides on it; then only
forces sideways, which no motor makes, could hold the object."""

_SINKS: Final = (2.5e-3, 5e-3)
"""Distances by which a force of the size of its weight moves an object in the hand [m]: up to the
first, half of the slip of an object that counts as held, it is safe; beyond the second, all of it,
it is not held."""

_MEETING: Final = 0.3
"""Share by which a grasp is worse if fingers of one side meet one another before the object: each
takes the other for the object, and waits."""

_PUSHED: Final = 0.015
"""Distance over which fingers push a standing object that halves the grasp's score [m]."""

_MISSED: Final = 4
"""Exponent of the share of nearby places held: one miss in twelve costs 30 % of the score."""

JAWS: Final = 2
"""Fingers that oppose each other, with equal forces."""

_MOST_CONTACTS: Final = 32
"""Most contacts used; more only cost time."""


@dataclass(frozen=True)
class GraspTask:
    """The requirements of a grasp.

    Attributes:
        friction: Coefficient of friction between hand and object.
        weight_axis: Direction of the weight, a unit vector ``(3,)`` in the hand's base frame; with
            a table that has a normal, the weight acts against that instead.
    """

    friction: float
    weight_axis: FloatArray


class Planner:
    """Plans the grasps of one object by one hand.

    Attributes:
        scene: The hand and the object.
        task: The requirements of a grasp.
        too_wide: Whether no action that was tried opens as wide as the object.
        widest: The widest opening of these actions [m].
        narrowest: The object's least width there [m].
        out: The axis ``(3,)`` of the base frame along which the hand reaches out.
        turns: The turns ``(3, 3)`` of the object that look different.
        ground: The table on which it stands, if there is one.
    """

    def __init__(
        self,
        hand: Hand,
        obj: GraspObject,
        friction: float = FRICTION,
        weight_axis: Sequence[float] | None = None,
        table: Table | None = None,
        openings: Openings | None = None,
    ) -> None:
        """Read the geometry; see `plan_grasps`.

        With ``openings``, actions whose sides have motors of their own take an object from a table
        with a force.
        """
        if not 0.0 < (values.number(friction) or 0.0) <= 10.0:
            raise ConfigError(f"a friction must be above 0 and at most 10, not {friction!r:.100}")
        if not isinstance(table, Table | None):
            raise ConfigError(f"a table is a Table(…), not {table!r:.100}")
        self.hand, self.obj, self._openings = hand, obj, openings
        self.scene = GraspScene(hand, obj)
        self.out = outward(self.scene)
        axis = self.out
        if weight_axis is not None:
            axis = np.array(vector(weight_axis, "the weight axis"))
        if not np.linalg.norm(axis) > 0.0:
            raise ConfigError("the weight axis must be three finite numbers, not all of them 0")
        self.task = GraspTask(friction, axis / np.linalg.norm(axis))
        self.ground: Ground | None = None
        if table is not None:
            if table.up is not None and weight_axis is not None:
                raise ConfigError(
                    "a table's normal already gives the direction of the weight; give the normal "
                    "or a weight axis"
                )
            self.ground = Ground(self.scene, table, self.task.weight_axis)
        self._gains = gains(hand)
        self._firm = self.ground is not None and len(hand.fingers) > JAWS
        self.turns = orientations(obj, None if self.ground is None else self.ground.up)
        self.too_wide, self.widest, self.narrowest = True, 0.0, math.inf

    @property
    def no_opening(self) -> str:
        """Why nothing fits between the fingertips, whatever its size; empty if something may."""
        tips = [finger.name for finger in self.hand.fingers if finger.tip]
        if len(tips) > 1:
            return ""
        there = f"only one fingertip, that of '{tips[0]}'" if tips else "no fingertip"
        return (
            f"the hand has {there}, and so no opening; if a fixed part is opposite, make it a "
            "finger by a group in the SRDF"
        )

    def plan(self, actions: Iterable[Action]) -> tuple[list[GraspPlan], list[tuple[str, str]]]:
        """Return the grasps of actions, the best first, and why the others can't be used."""
        chosen = list(actions)
        several = 1 if self.ground is None else _ABOVE
        each = min(_MOST, several * max(_FEWEST, _POSES // max(1, len(chosen))))
        grasps, plans, rejected = [], [], []
        for action, found in zip(chosen, self._grasps(chosen, each), strict=True):
            if isinstance(found, str):
                rejected.append((label(action.name, action.elements), found))
            else:
                grasps.append(found)
        grasps.sort(key=lambda found: -found[0].promise)
        for number, found in enumerate(grasps):
            action = found[0].search.action
            plan: GraspPlan | str = f"{_JUDGED} others hold the object with more links"
            if number < _JUDGED:
                plan = self._best_of(found if len(grasps) <= _JUDGED else found[:1])
            if isinstance(plan, str):
                rejected.append((label(action.name, action.elements), plan))
            else:
                plans.append(plan)
        plans.sort(key=rank)
        return plans, rejected

    def ranking(
        self, plans: Sequence[GraspPlan], rejected: Sequence[tuple[str, str]] = ()
    ) -> Ranking:
        """Return the ranking of grasps, with the conditions of their planning."""
        x, y, z = (float(v) for v in self.task.weight_axis)
        unlimited = [a.name for a in self.hand.actuators if not math.isfinite(a.effort)]
        notes = [*self.obj.notes]
        if unlimited:
            notes.append(
                f"no effort limit is known for {', '.join(unlimited)}; they do not limit the load"
            )
        return Ranking(
            self.hand.name,
            self.obj.name,
            self.obj.mass,
            self.task.friction,
            (x, y, z),
            tuple(plans),
            tuple(rejected),
            tuple(notes),
            "" if self.hand.flange is None else self.hand.flange.frame,
        )

    def best(self, actions: Sequence[Action], most: int = _MOST) -> tuple[int, GraspPlan] | None:
        """Return the best grasp by one of several actions, and which one; ``None`` without any.

        For each, at most ``most`` poses of the object are tried.
        """
        best: tuple[int, GraspPlan] | None = None
        found = enumerate(self._grasps(actions, most))
        there = [(number, grasps) for number, grasps in found if not isinstance(grasps, str)]
        # The most promising first: a grasp that is certainly worse than the best so far ends soon.
        for number, grasps in sorted(there, key=lambda each: -each[1][0].promise):
            plan = self._best_of(grasps, best and best[1])
            if isinstance(plan, str):
                continue
            # Of equal grasps, the first one in the list wins, in whatever order they are judged.
            if best is None or (-plan.score, number) < (-best[1].score, best[0]):
                best = number, plan
        return best

    def _grasps(self, actions: Sequence[Action], most: int) -> list[list[FoundGrasp] | str]:
        """Return the most promising grasps by each action, or why there is none."""
        found: list[list[FoundGrasp] | str] = []
        for begin in range(0, len(actions), _TOGETHER):
            some = [self._search(action, most) for action in actions[begin : begin + _TOGETHER]]
            search_together(self.scene, some, self._hope)
            found += [self._found(search) for search in some]
        return found

    def _search(self, action: Action, most: int) -> Search:
        """Return the search for poses at which an action holds the object."""
        closing, poses = self.closing(action), None
        if closing.path.moving.any():
            poses = Poses(self.scene, closing, action, self.out, self.ground)
        candidates = iter(()) if poses is None else poses.search(self.turns, most)
        return Search(
            action,
            closing,
            poses,
            candidates,
            max(_ENOUGH, most // 2),
            ground=self.ground,
            opening=self._pressing(action),
            meets=self._meeting(action),
        )

    def _meeting(self, action: Action) -> Mapping[str, float]:
        found = None if self._openings is None else self._openings.meeting(action)
        return found or {}

    def sides_wait(self, action: Action) -> bool:
        """Return whether an action grasps with a force, where the first side to touch waits."""
        return self._pressing(action) is not None

    def _pressing(self, action: Action) -> OpeningTable | None:
        """Return the opening of an action, if each side has a motor of its own.

        Only then can one side wait for the other, and press with the same force.
        """
        # An object in the air may be wrapped: pushed into the palm, it is held as often as by a
        # force.
        if self.ground is None or self._openings is None:
            return None
        opening = self._openings.find(action)
        if opening is None:
            return None
        actuators = [self.hand.actuator(name) for name in opening.actuators]
        if not all(math.isfinite(actuator.effort) for actuator in actuators):
            return None
        moved = [set(actuator.fingers) for actuator in actuators]
        sides = [set(side) for side in opening.sides]
        return opening if all(_moved_alone(side, sides, moved) for side in sides) else None

    def _found(self, search: Search) -> list[FoundGrasp] | str:
        """Return the most promising grasps that a search has found, or why there is none."""
        if search.poses is None:
            return "it moves nothing"
        opening, narrowest = float(search.gaps.max()), search.poses.narrowest(self.turns)
        self.widest = max(self.widest, opening)
        self.narrowest = min(self.narrowest, narrowest)
        # Only if no pose was tried: an object too wide for the tips may still fit into the palm.
        if not search.tried and narrowest > opening - 2.0 * GAP:
            return f"it opens to {opening * 1e3:.0f} mm, the width is {narrowest * 1e3:.0f} mm"
        self.too_wide = False
        if not search.grasps and (search.blocked or search.poses.blocked):
            return "it meets the table as it comes or closes"
        if not search.tried:
            return "the object can't come between its fingers"
        search.grasps.sort(key=lambda grasp: -grasp.promise)
        return (
            search.grasps[: _FINALISTS + self._firm]
            or "its fingers do not oppose each other on the object"
        )

    def _best_of(
        self, grasps: Sequence[FoundGrasp], beat: GraspPlan | None = None
    ) -> GraspPlan | str:
        """Return the best of the grasps of an action, or why there is none."""
        best: GraspPlan | None = None
        least = 0.0 if beat is None else beat.score
        for grasp in grasps:
            judged = self._judged(grasp, least)
            if judged is not None and (best is None or rank(judged) < rank(best)):
                best, least = judged, max(least, judged.score)
        if best is None:
            return "it is no better than others"
        return best if best.load > 0.0 else "it can't carry the weight along this axis"

    def closing(self, action: Action) -> HandClosing:
        """Return what closes the hand by an action on the object."""
        return HandClosing(self.scene, ActionPath.of(self.hand, action), self.task.friction)

    def closed(self, action: Action, plan: GraspPlan) -> Closure | None:
        """Return the hand closed by an action at a plan's pose."""
        return self.closing(action).close(np.array(plan.pose), round(plan.preshape * STEPS))

    def promise(self, closure: Closure) -> float:
        """Return a quick estimate of how good a grasp is; larger is better."""
        contacts = closure.contacts
        # One contact of each link is enough for a quick estimate.
        by_link = {contact.link: contact for contact in contacts}
        found = self._wrenches(closure, list(by_link.values()))
        points = np.array([contact.point for contact in contacts])
        off = float(np.linalg.norm(points.mean(axis=0) - self._centre(closure)))
        links = len(by_link)
        return 4.0 * balanced(found) + min(links, 6) / 6.0 + (1.0 - min(1.0, off / self.obj.length))

    def _hope(self, search: Search, closure: Closure) -> float:
        """Return the sum of a grasp's promise and of how squarely its sides press."""
        maps = self.scene.torques(closure.u, closure.contacts)
        return self.promise(closure) + 2.0 * self._squareness(search, closure, maps)

    def _pressed(self, search: Search, closure: Closure) -> tuple[PressingForces, FloatArray]:
        """Return the forces of fingers that grasp with a force, and the maps of their contacts."""
        contacts = closure.contacts[:_MOST_CONTACTS]
        maps = self.scene.torques(closure.u, contacts)
        knots = search.closing.path.knots
        found = self._wrenches(closure, contacts)
        return pressing(found, maps, self._gains, knots[-1] - knots[0]), maps

    def _waited(self, grasp: FoundGrasp, force: float) -> float:
        """Return the factor by which a grasp with a force [N] is worse than its forces suggest.

        The forces of the fingers must balance once the table does not bear the difference, also if
        the object is slightly misplaced; and the fingers must be stiff enough.
        """
        search, closure = grasp.search, grasp.closure
        pressed, maps = self._pressed(search, closure)
        if not pressed.share:
            return 0.0
        contacts = closure.contacts[:_MOST_CONTACTS]
        arms = np.array([contact.point for contact in contacts]) - self._centre(closure)
        normals = np.array([contact.normal for contact in contacts])
        held = scaled(pressed, search.normal(force))
        weight = GRAVITY * self.obj.mass
        firm = 1.0 - _ramp(sunk(held, maps, self._gains, arms, normals, weight), _SINKS)
        if search.meet_first(closure):
            firm *= _MEETING
        stays = [self._stays(search, closure, pressed, maps)]
        for beside in closed_nearby(grasp.closing, grasp.candidate):
            found = None if beside is None else search.pressing(beside)
            stays.append(
                0.0 if found is None else self._stays(search, found, *self._pressed(search, found))
            )
        return firm * sum(stays) / len(stays)

    def _stays(
        self, search: Search, closure: Closure, pressed: PressingForces, maps: FloatArray
    ) -> float:
        """Return how surely an object stays where fingers press on it, 0 to 1.

        Their forces must balance, and no side may slide along it.
        """
        square = self._squareness(search, closure, maps)
        return min(_ramp(pressed.share, _BALANCES), _ramp(square, _SQUARE))

    def _squareness(self, search: Search, closure: Closure, maps: FloatArray) -> float:
        """Return the least cosine between a side's motion and the normal of its contact.

        Of each side, the finger that presses most squarely counts; 0 without an opening. The maps
        are those of the first contacts.
        """
        if search.opening is None:
            return 0.0
        knots, contacts = search.closing.path.knots, closure.contacts[: len(maps)]
        motions = np.einsum("kaj,a->kj", maps, knots[-1] - knots[0])
        normals = np.array([contact.normal for contact in contacts])
        sizes = np.maximum(np.linalg.norm(motions, axis=1), 1e-9)
        cosines = np.einsum("kj,kj->k", motions, normals) / sizes
        best = dict.fromkeys(search.opening.fingers, 0.0)
        for contact, cosine in zip(contacts, cosines.tolist(), strict=True):
            best[contact.finger] = max(best.get(contact.finger, 0.0), cosine)
        return min(max(best[finger] for finger in side) for side in search.opening.sides)

    def _centre(self, closure: Closure) -> FloatArray:
        return closure.pose[:3, :3] @ self.obj.centre + closure.pose[:3, 3]

    def _wrenches(self, closure: Closure, contacts: Sequence[Contact]) -> FloatArray:
        return wrenches(contacts, self.task.friction, self._centre(closure), self.obj.length)

    def _efforts(
        self, closure: Closure, contacts: Sequence[Contact], found: FloatArray
    ) -> FloatArray:
        """Return the efforts that wrenches need from the actuators, as shares of their limits."""
        limits = np.array([actuator.effort for actuator in self.hand.actuators])
        # An actuator without a known limit does not limit the load; the notes say so.
        limited: BoolArray = np.isfinite(limits)
        # Virtual work: the transposed Jacobian turns the forces at contacts into efforts.
        maps = self.scene.torques(closure.u, contacts)[:, limited] / limits[limited, None]
        maps = np.repeat(maps, EDGES + 2, axis=0)  # the number of wrenches of a contact
        efforts: FloatArray = np.einsum("kaj,kj->ka", maps, found[:, :3])
        return efforts

    def _judged(self, grasp: FoundGrasp, least: float) -> GraspPlan | None:
        """Evaluate a grasp; ``None`` if its score is certainly below ``least``.

        The load takes longest to compute, and can only lower the score.
        """
        action, closing, candidate = grasp.search.action, grasp.search.closing, grasp.candidate
        closure = grasp.closure
        contacts = closure.contacts[:_MOST_CONTACTS]
        found = self._wrenches(closure, contacts)
        points = np.array([contact.point for contact in contacts])
        off = float(np.linalg.norm(points.mean(axis=0) - self._centre(closure))) / self.obj.length
        # Scores are compared after rounding: half of the last place below counts as equal.
        wanted = least - _HALF_PLACE
        by_force = grasp.search.by_force(candidate.width)
        ball = quality(found, 0.0 if by_force else _least_quality(wanted, off))
        highest = _placed(ball, off)
        if by_force:
            highest = 1.0 - _PLACED * (1.0 - highest)
        if highest < wanted:
            return None
        safety = _SAFETY_OF_FINGERS if self._firm and not by_force else SAFETY
        efforts = self._efforts(closure, contacts, found)
        weights = np.zeros((1 + len(_SHAKEN), 6))
        top = (
            None
            if self.ground is None
            else self.ground.top(candidate.pose, candidate.approach_from)
        )
        down = self.task.weight_axis if top is None else -top.up
        weights[:, :3] = self.obj.mass * GRAVITY * down
        weights[1:, :3] += self.obj.mass * _SHAKEN
        held = load(found, efforts, weights, safety * wanted / highest) / safety
        strongest = self._strongest(grasp)
        if by_force:
            held = min(held, self._lifted(grasp.search.normal(_FORCE * strongest)) / safety)
        # A product: a grasp that carries nothing scores 0, however good it is otherwise.
        score = min(1.0, held) * highest
        if round(score, 4) < least:
            return None
        if by_force:
            score *= self._waited(grasp, _FORCE * strongest)
        elif self._firm:
            score *= _firmness(grasp)
        if round(score, 4) < least:
            return None
        times = load(found, efforts, weights[0])
        preshape, opening, clearance = self._before(grasp)
        most, needed = (_FORCE, _SAFETY_OF_FORCE) if by_force else (1.0, safety)
        effort = round(min(most, max(0.05, needed / times)) if times > 0.0 else most, 2)
        x, y, z = (float(v) for v in candidate.approach_from)
        kind = kind_of(action)
        plan = GraspPlan(
            action=action.name,
            elements=action.elements,
            kind=str(kind),
            parts=(),
            score=round(score, 4),
            intensity=1.0 if isinstance(action, Timed) else self._intensity(closing, closure),
            touch=round(closure.first, 3),
            preshape=preshape,
            opening=round(opening, 4),
            width=round(candidate.width, 4),
            effort=effort,
            force=round(effort * strongest, 2) if by_force else None,
            load=round(times, 2),
            quality=round(ball, 4),
            clearance=round(clearance, 4),
            pose=_rows(candidate.pose),
            held_pose=_rows(closure.pose),
            approach_from=(round(x, 4), round(y, 4), round(z, 4)),
            contacts=contacts,
            reasons=self._reasons(candidate, opening, contacts, times, ball, clearance),
            table=None if top is None else _rows(_inverse(candidate.pose) @ top.pose),
            overhang=0.0 if top is None else round(top.overhang, 4),
        )
        return self._mounted(plan, candidate.pose, candidate.approach_from, points)

    def _strongest(self, grasp: FoundGrasp) -> float:
        """Return the strongest force between the fingertips [N]; 0 without an opening."""
        opening = grasp.search.opening
        at = 0.0 if opening is None else opening.intensity_at(grasp.candidate.width)
        return 0.0 if opening is None else opening.strongest(self.hand, at)

    def _lifted(self, normal: float) -> float:
        """Return the load that friction carries, as a multiple of the shaken weight.

        Args:
            normal: Sum of the normal forces of all fingers [N].
        """
        return self.task.friction * normal / (self.obj.mass * (GRAVITY + _SHAKING))

    def _mounted(
        self, plan: GraspPlan, pose: FloatArray, approach_from: FloatArray, points: FloatArray
    ) -> GraspPlan:
        """Add the flange poses for an arm to a plan, if the hand's mounting is known."""
        flange = self.hand.flange
        if flange is None:
            return plan
        before = pose.copy()
        before[:3, 3] += approach_from
        x, y, z = (base_in_flange(flange) @ [*points.mean(axis=0), 1.0])[:3].round(5) + 0.0
        return dataclasses.replace(
            plan,
            flange_pose=_rows(flange_with(flange, _inverse(pose))),
            pre_flange_pose=_rows(flange_with(flange, _inverse(before))),
            tcp=(float(x), float(y), float(z)),
        )

    def _intensity(self, closing: HandClosing, closure: Closure) -> float:
        """Return how far the action goes so that all blocked actuators press."""
        moved = np.abs(closing.path.knots[-1] - closing.path.knots[0])
        # At least to where the contacts oppose each other, even if no actuator is blocked.
        wanted = [closure.first]
        for index in np.flatnonzero(closure.blocked).tolist():
            beyond = squeeze(self.hand.actuators[index]) / max(float(moved[index]), 1e-6)
            wanted.append(float(closure.shares[index]) + beyond)
        # Rounded up: rounded down, the set-points might no longer press.
        return min(1.0, math.ceil(100.0 * max(wanted)) / 100.0)

    def _before(self, grasp: FoundGrasp) -> tuple[float, float, float]:
        """Return pre-shape, opening and clearance before the hand closes.

        In the pre-shape, the hand is closed as far as it can be without coming near the object
        during the approach or at its end; above a table, it is closed as far as was found to clear
        the table.
        """
        gaps, closing, candidate = grasp.search.gaps, grasp.search.closing, grasp.candidate
        start = candidate.start
        # Places on its approach, closer to each other near its end, where the fingers are.
        places = [
            candidate.pose[:3, 3] + share * np.array(candidate.approach_from)
            for share in (0, 0.1, 0.3, 1)
        ]
        # A timed action always runs at intensity 1, so it has no pre-shape.
        found = self.ground is not None or isinstance(grasp.search.action, Timed)
        last = start if found else len(gaps) - 1
        steps = range(last, start - 1, -1)
        for step in steps:
            wide = gaps[step] >= candidate.width + MARGIN
            if step > start and not (wide and closing.grid[step] < grasp.closure.first):
                continue
            at, least = closing.table[step], math.inf
            near = DistanceBounds(self.scene, [at], candidate.pose[None])
            for place in places:
                near.pushed((place - near.places[0])[None])
                least = float(near.least(at, min(least, _FAR))[0])
                # Where a posture is ruled out, its other places do not matter.
                if step > start and least <= _CLEAR:
                    break
            # The last posture to try: there any clearance is reported.
            if step == start or least > _CLEAR:
                return float(closing.grid[step]), float(gaps[step] if step else gaps.max()), least
        return 0.0, float(gaps.max()), 0.0

    def _part(self, link: str) -> str:
        """Name a link that does not belong to one finger alone: the palm, or its own name."""
        return link if self.scene.geometry.kinematics.body(link) else "palm"

    def _reasons(
        self,
        candidate: PoseCandidate,
        opening: float,
        contacts: Sequence[Contact],
        times: float,
        ball: float,
        clearance: float,
    ) -> tuple[str, ...]:
        where: dict[str, int] = {}
        for contact in contacts:
            name = contact.finger or self._part(contact.link)
            where[name] = where.get(name, 0) + 1
        touched = ", ".join(f"{name} {count}" for name, count in where.items())
        carried = (
            f"carries {times:.1f} times the weight at full effort"
            if times >= 1.0
            else f"can't carry the weight: {times:.0%} of it at full effort"
        )
        room = f"width {candidate.width * 1e3:.0f} mm, {clearance * 1e3:.0f} mm clear"
        return (
            f"opens to {opening * 1e3:.0f} mm, {room}"
            if opening > candidate.width
            else f"wraps it from the palm's front, {room}",
            f"contacts: {touched}",
            f"{carried} with friction {self.task.friction:g}",
            f"resists every wrench up to {ball:.3f} N per newton of grip"
            if ball > 0.0
            else "does not resist every wrench",
        )


def squeeze(actuator: ActuatorSpec) -> float:
    """Return how far the set-point of an actuator goes beyond a contact to press [rad | m]."""
    return _SQUEEZE.get(actuator.kind, _SQUEEZE_ANGLE)


_ALONE: Final = frozenset({PrimitiveKind.TRIG, PrimitiveKind.TIP_FLEX, PrimitiveKind.FING_FLEX})
"""Primitives that bend one finger, whatever opposes it."""

_OPPOSED: Final = 0.05
"""Advantage in score above which one of these is better than an action of opposed fingers, whose
opening and force are known and can be set."""


def _inverse(pose: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(pose), np.float64)


def rank(plan: GraspPlan) -> tuple[float, str, tuple[str, ...]]:
    """Return the sort key of grasps: the best score first, then the name."""
    lead = 0.0 if plan.action in _ALONE else _OPPOSED
    return (-plan.score - lead, plan.action, plan.elements)


def _placed(ball: float, off: float) -> float:
    """Return the score of a grasp that carries enough, 0 to 1: how well its contacts are placed.

    It depends on the quality, and on the distance of the contacts' middle from the centre of mass,
    in lengths of the object.
    """
    # An object that is not held against every wrench turns or slides out when disturbed.
    closed = 0.2 if ball > 0.0 else 0.0
    return closed + 0.5 * ball / (ball + _GOOD_QUALITY) + 0.3 * (1.0 - min(1.0, off))


def _firmness(grasp: FoundGrasp) -> float:
    """Return the factor by which standing on a table makes a grasp worse than its forces suggest.

    Fingers that push the object far, or miss it when it is slightly misplaced, knock it over.
    """
    push = float(np.linalg.norm(grasp.closure.pose[:3, 3] - grasp.candidate.pose[:3, 3]))
    near = closed_nearby(grasp.closing, grasp.candidate)
    held = sum(closure is not None for closure in near) / len(near)
    return held**_MISSED / (1.0 + (push / _PUSHED) ** 2)


def _ramp(value: float, between: tuple[float, float]) -> float:
    """Return how far a value is between two others, from 0 to 1."""
    low, high = between
    return min(1.0, max(0.0, (value - low) / (high - low)))


def _moved_alone(side: set[str], sides: Sequence[set[str]], moved: Iterable[set[str]]) -> bool:
    """Return whether a motor moves fingers of one side only, given the fingers of each motor."""
    others = set[str]().union(*(other for other in sides if other is not side))
    return any(fingers & side and not fingers & others for fingers in moved)


def _least_quality(score: float, off: float) -> float:
    """Return the quality that a grasp needs for a score, if it carries enough; see `_placed`."""
    share = (score - 0.2 - 0.3 * (1.0 - min(1.0, off))) / 0.5
    if share <= 0.0:
        return 0.0
    return math.inf if share >= 1.0 else _GOOD_QUALITY * share / (1.0 - share)


def _rows(pose: FloatArray) -> Matrix:
    return tuple(tuple(round(float(value), 6) for value in row) for row in pose)
