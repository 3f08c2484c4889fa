"""The approach of a carried hand to an object that stands on a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Action
from rtee.drivers.mujoco.scene import approach, downward
from rtee.drivers.mujoco.simulation import Simulation
from rtee.objects.shape import ObjectShape
from rtee.planning.objects import GraspObject
from rtee.sample import FloatArray
from rtee.trials.robust_places import robust_places
from rtee.trials.variation import Variation

_ALONG = 0.9
"""An object is along the hand's reach, or across it, if its axis is within 26 degrees of that: the
cosine, or its complement to 1."""

_ALIKE = 0.012
"""Outlines that differ by less are one [m]: less than what places are apart by."""

_TURNS = tuple(
    np.stack([x, np.cross(z, x), z], axis=1)
    for z in (*np.eye(3)[::-1], *-np.eye(3))
    for x in (*np.eye(3), *-np.eye(3))
    if x @ z == 0.0
)
"""The 24 turns of a cube ``(3, 3)``, that by nothing first."""


@dataclass(frozen=True, slots=True)
class Stance:
    """The approach of the hand to the object that stands on the table.

    Attributes:
        place: Pose ``(4, 4)`` in the hand's base frame where the object would be after the approach
            if nothing touched it; the palm pushes one that would be inside it.
        mount: How the hand is turned in the world ``(3, 3)``.
        approach: The unit vector ``(3,)`` in the base frame along which the hand comes.
        lands: Where the object is left ``(3,)`` [m], in the base frame of the hand that opens; at
            its place unless given.
        back: How far the hand goes back [m] after it came on until it felt the object; unless given
            it stays where the approach ends.
    """

    place: FloatArray
    mount: FloatArray
    approach: FloatArray
    lands: FloatArray | None = None
    back: float | None = None

    def learned(self, held: FloatArray, lands: FloatArray) -> Stance:
        """Return the stance that carries the object upright and leaves it at its target.

        Args:
            held: Pose ``(4, 4)`` in the hand's base frame in which it was carried from this stance.
            lands: Where it was left ``(3,)`` [m], in the base frame of the hand that opens.
        """
        place = np.array(self.place)
        place[:3, :3] = held[:3, :3]
        # The object stands in the world as before, so that it is the hand that turns.
        mount: FloatArray = self.mount @ self.place[:3, :3] @ place[:3, :3].T
        # The hand comes along the same line in the world.
        approach: FloatArray = mount.T @ self.mount @ self.approach
        return Stance(place, mount, approach, lands, self.back)

    def varied(self, variation: Variation, shape: ObjectShape) -> tuple[FloatArray, FloatArray]:
        """Return where a varied object is in the hand ``(4, 4)``, and the hand's turn ``(3, 3)``.

        The object stands upright on a table of the same height whatever its size, so that a turn
        tilts the hand.
        """
        upright = self.mount @ self.place[:3, :3]
        place = variation.moved(self.place)
        mount: FloatArray = upright @ place[:3, :3].T
        frame = np.eye(4)
        frame[:3, :3] = upright
        # Scaled about its origin, a larger object would reach into the table.
        grown = shape.lowest(frame) - shape.scaled(variation.size).lowest(frame)
        place[:3, 3] += mount.T @ np.array([0.0, 0.0, grown])
        return place, mount


def standing(position: FloatArray, up: FloatArray, approach: FloatArray) -> Stance:
    """Return the stance in which an upright object is somewhere in the hand.

    Args:
        position: Where it is in the hand's base frame ``(3,)`` [m].
        up: Its upward axis ``(3,)`` in the base frame.
        approach: About where the hand moves ``(3,)`` in the base frame as it comes; only what is
            horizontal of it counts.
    """
    up = up / np.linalg.norm(up)
    along = approach - (approach @ up) * up
    along = along / np.linalg.norm(along)
    place = np.eye(4)
    place[:3, :3] = np.stack([along, np.cross(up, along), up], axis=1)
    place[:3, 3] = position
    return Stance(place, np.array(place[:3, :3].T), along)


def find_stances(
    simulation: Simulation,
    library: ActionLibrary,
    action: Action,
    thing: GraspObject,
    reach: Literal["down", "level"],
    most: int,
) -> Iterator[Stance]:
    """Return stances into which the upright object comes along the hand's reach.

    Args:
        simulation: The hand with its object and carrier.
        library: The hand's actions.
        action: What is to grasp the object.
        thing: The object.
        reach: The hand comes from above (``down``), or from the side (``level``).
        most: How many places of the object in the hand are looked at; fewer of them are upright.
    """
    hand = library.hand
    axis, down = approach(hand), downward(hand)
    least, largest = (_ALONG, 1.0) if reach == "down" else (0.0, 1.0 - _ALONG)
    for place in robust_places(simulation, library, action, thing, most):
        if float(place.approach_from @ axis) <= 0.0:
            continue
        alike = _alike(place.pose, thing)
        pose = next((p for p in alike if least <= abs(p[:3, 2] @ axis) <= largest), None)
        if pose is None:
            continue
        if reach == "down":
            yield Stance(pose, down, axis)
        else:
            # From the side, the hand may come with either side up.
            for up in (pose[:3, 2], -pose[:3, 2]):
                yield Stance(pose, np.stack([axis, np.cross(up, axis), up]), axis)


def _alike(pose: FloatArray, thing: GraspObject) -> Iterator[FloatArray]:
    """Return a pose ``(4, 4)`` and those in which the turned object has about the same outline.

    Places are told apart by outlines, so the object of a place may be any of these.
    """
    middle, _ = thing.box
    axes = np.concatenate([np.eye(3), -np.eye(3)])

    def outline(turn: FloatArray) -> FloatArray:
        local = axes @ turn
        return np.asarray(thing.support(local) - local @ middle)

    for turn in _TURNS:
        turned = np.array(pose)
        turned[:3, :3] = pose[:3, :3] @ turn
        turned[:3, 3] += pose[:3, :3] @ middle - turned[:3, :3] @ middle
        if np.abs(outline(turned[:3, :3]) - outline(pose[:3, :3])).max() < _ALIKE:
            yield turned
