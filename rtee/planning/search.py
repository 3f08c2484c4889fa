"""Search for poses at which actions hold an object, for many actions at the same time.

The approach of the object and the closing of the hand are computed for many hands together, so
searches proceed in rounds: the next requests of all of them are answered at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from rtee.actions.openings import OpeningTable
from rtee.actions.types import Action
from rtee.planning.approaches import GAP, Approach, Found, PoseCandidate, bring_in
from rtee.planning.closing import Closure, HandClosing, close_all
from rtee.planning.distance_bounds import DistanceBounds
from rtee.planning.poses import Poses
from rtee.planning.scene import GraspScene
from rtee.planning.table import Ground
from rtee.sample import FloatArray

_SHARES: Final = (0.0, 0.1, 0.3, 1.0)
"""Shares of an approach at which a moved object must be free, closer together near its end."""

_LATE: Final = 0.005
"""How far the opening closes while half of a force is built up [m]: for half a second, at the
10 mm/s with which fingers meet an object. Fingers that would touch it later find it moved."""


@dataclass
class Search:
    """A search for poses of the object at which an action holds it.

    Attributes:
        action: The action.
        closing: Closes the hand by it.
        poses: Finds poses of the object; ``None`` if the action moves nothing.
        candidates: The poses that are left to try, and the approaches on which they depend.
        enough: Grasps after which no other poses are tried.
        grasps: The grasps found.
        ready: Poses to try next.
        tried: How many poses were tried.
        ground: The table to keep clear of, if there is one.
        blocked: Whether the ground ruled out a grasp.
        opening: Opening table of the action, if its sides can press with a force: then fingers wait
            for one another.
        meets: Intensity at which the empty hand may touch itself, by actuator of the action.
    """

    action: Action
    closing: HandClosing
    poses: Poses | None
    candidates: Iterator[Found]
    enough: int
    grasps: list[FoundGrasp] = field(default_factory=list)
    ready: list[PoseCandidate] = field(default_factory=list)
    tried: int = 0
    ground: Ground | None = None
    blocked: bool = False
    opening: OpeningTable | None = None
    meets: Mapping[str, float] = field(default_factory=dict)

    def by_force(self, width: float) -> bool:
        """Return whether an object of a width [m] is grasped with a force between the fingers."""
        opening = self.opening
        return opening is not None and opening.narrowest + opening.error < width < opening.widest

    def normal(self, force: float) -> float:
        """Return the sum of the normal forces of all fingers for a force between them [N].

        If the fingers close from two sides, each side presses with this force; if from all around,
        it is the sum.
        """
        around = self.opening is not None and self.opening.around
        return force if around else 2.0 * force

    def meet_first(self, closure: Closure) -> bool:
        """Return whether fingers may meet one another before they touch the object."""
        hand = self.closing.path.hand
        indices = [hand.actuator_index(name) for name in self.meets]
        return any(
            closure.blocked[i] and closure.shares[i] > at
            for i, at in zip(indices, self.meets.values(), strict=True)
        )

    def pressing(self, closure: Closure) -> Closure | None:
        """Return a closed hand with the contacts of the fingers that press with a force.

        They press once a finger of each side touches, whether these oppose each other or not.
        ``None``: no finger of some side touches.
        """
        if self.opening is None:
            return None
        hand, moving = self.closing.path.hand, self.closing.path.moving
        touching = {contact.finger for contact in closure.contacts}
        met: dict[str, float] = {}
        for finger in hand.fingers:
            own = [hand.actuator_index(name) for name in finger.actuators]
            stopped = [closure.shares[i] for i in own if closure.blocked[i] and moving[i]]
            if finger.name in touching:
                met[finger.name] = float(min(stopped, default=closure.first))
        sides = [[met[finger] for finger in side if finger in met] for side in self.opening.sides]
        if not all(sides):
            return None
        opening = self.opening
        rate = (opening.intensity[-1] - opening.intensity[0]) / (opening.widest - opening.narrowest)
        last = max(min(side) for side in sides) + _LATE * float(rate)
        # The palm, which belongs to no finger, is there from the beginning.
        there = tuple(c for c in closure.contacts if met.get(c.finger, 0.0) <= last)
        return replace(closure, contacts=there)

    def closing_on(self, candidate: PoseCandidate) -> HandClosing:
        """Return the closing of the hand for a pose at which the object stays."""
        return self.closing.waiting if self.by_force(candidate.width) else self.closing

    def next(self) -> Approach | list[PoseCandidate]:
        """Return the poses to try next, or the approach on which these depend.

        There are no more poses than needed, should the action hold the object at each of them.
        """
        # Collects as many poses as grasps are missing.
        while len(self.ready) < self.enough - len(self.grasps):
            found = next(self.candidates, None)
            if isinstance(found, Approach):
                return found
            if found is None:
                break
            self.ready.append(found)
        ready, self.ready = self.ready, []
        self.tried += len(ready)
        return ready

    @property
    def gaps(self) -> FloatArray:
        """How far apart the fingertips are along the path ``(steps + 1,)`` [m]."""
        return np.zeros(1) if self.poses is None else self.poses.gaps


@dataclass(frozen=True)
class FoundGrasp:
    """A hand closed on the object by an action, and the search that led to it.

    Attributes:
        search: The search that found it.
        candidate: Where the object was at first.
        closure: The closed hand.
        promise: A quick estimate of how good the grasp is; larger is better.
    """

    search: Search
    candidate: PoseCandidate
    closure: Closure
    promise: float

    @property
    def closing(self) -> HandClosing:
        """What closed the hand."""
        return self.search.closing_on(self.candidate)


def search_together(
    scene: GraspScene,
    searches: Sequence[Search],
    promise: Callable[[Search, Closure], float],
) -> None:
    """Search until each has enough grasps, or no pose is left to try.

    Args:
        scene: The hand and the object.
        searches: The searches; their grasps are filled in.
        promise: A quick estimate of how good a closed hand holds; larger is better.
    """
    while asked := _next(scene, searches):
        closings = [
            search.closing_on(candidate) if candidate.centred else search.closing
            for search, candidate in asked
        ]
        closures = close_all(
            [(closing, c.pose, c.start) for closing, (_, c) in zip(closings, asked, strict=True)]
        )
        for (search, candidate), closure in zip(asked, closures, strict=True):
            if closure is None:
                continue
            if search.by_force(candidate.width) and not candidate.centred:
                search.ready += _centred(scene, search.closing, candidate, closure)
                continue
            if search.by_force(candidate.width):
                closure = search.pressing(closure)
                if closure is None:
                    continue
            ground = search.ground
            if ground is not None and not ground.clears(search.closing, candidate, closure):
                search.blocked = True
                search.ready += ground.raised(search.closing, candidate, closure)
            else:
                search.grasps.append(
                    FoundGrasp(search, candidate, closure, promise(search, closure))
                )


def _centred(
    scene: GraspScene, closing: HandClosing, candidate: PoseCandidate, closure: Closure
) -> Iterator[PoseCandidate]:
    """Yield a candidate from which the fingers meet the object at about the same time.

    The fingers would push the object there.
    """
    pose, away = candidate.pose.copy(), candidate.approach_from
    push = closure.pose[:3, 3] - pose[:3, 3]
    unit = away / max(float(np.linalg.norm(away)), 1e-9)
    # Nothing was found to be free beyond the end of the approach.
    pose[:3, 3] += push - min(0.0, float(push @ unit)) * unit
    near = DistanceBounds(scene, [closing.table[candidate.start]], pose[None])
    for share in _SHARES:
        near.pushed((pose[:3, 3] + share * away - near.places[0])[None])
        if float(near.least(closing.table[candidate.start], GAP)[0]) < 0.5 * GAP:
            return
    yield replace(candidate, pose=pose, centred=True)


def _next(scene: GraspScene, searches: Sequence[Search]) -> list[tuple[Search, PoseCandidate]]:
    """Return the poses to try next, after finding the approaches that they need in one batch."""
    found: list[tuple[Search, PoseCandidate]] = []
    while searches:
        asking: list[Search] = []
        approaches: list[Approach] = []
        for search in searches:
            after = search.next()
            if isinstance(after, Approach):
                asking.append(search)
                approaches.append(after)
            else:
                found += [(search, candidate) for candidate in after]
        bring_in(scene, approaches)
        searches = asking
    return found
