"""Put touch sensors where they are on a hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtee.hand.colours import finger_of_link
from rtee.hand.config_schema import TouchSection
from rtee.hand.frames import origin
from rtee.hand.model import Hand
from rtee.sample import FloatArray
from rtee.touch import NEWTON, TouchSensor


def taxel_count(section: TouchSection) -> int:
    """Return how many taxels a section of hand.yaml places."""
    if section.grid is not None:
        return section.grid[0] * section.grid[1]
    return len(section.positions) or 1


def grid_points(grid: tuple[int, int], pitch: Sequence[float]) -> FloatArray:
    """Return the points of a grid about the origin ``(n, 3)`` [m], row by row, in the plane z = 0.

    Args:
        grid: Rows along x, columns along y.
        pitch: Distance from row to row and from column to column [m].
    """
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * step for n, step in zip(grid, pitch, strict=True))
    points = np.zeros((grid[0] * grid[1], 3))
    points[:, 0], points[:, 1] = np.repeat(x, grid[1]), np.tile(y, grid[0])
    return points


def taxels_of(section: TouchSection) -> tuple[FloatArray, FloatArray]:
    """Return the positions of taxels in their link's frame, and normals, ``(n, 3)`` [m] each."""
    frame = origin(section.xyz, section.rpy)
    if section.grid is not None:
        points = grid_points(section.grid, section.pitch)
    else:
        points = np.array(section.positions or ((0.0, 0.0, 0.0),), dtype=np.float64)
    normals = np.tile((0.0, 0.0, 1.0), (len(points), 1))
    if section.normals:
        normals = np.array(section.normals, dtype=np.float64)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points @ frame[:3, :3].T + frame[:3, 3], normals @ frame[:3, :3].T


def finger_of(hand: Hand, link: str) -> str:
    """Return the finger that a link belongs to, as in pictures; empty: none, such as the palm."""
    return finger_of_link(hand).get(link, "")


def on_hand(sensor: TouchSensor, hand: Hand) -> TouchSensor:
    """Return a sensor as its driver declares it, completed from the hand and its hand.yaml.

    What hand.yaml says of its place goes before what the driver says. With a scale its unit is the
    newton; its values are still to be multiplied by that.

    Args:
        sensor: The sensor.
        hand: The hand that it is on.

    Raises:
        ValueError: if hand.yaml places another number of taxels, or the driver names a link that
            the hand does not have, with a message.
    """
    section = hand.touch.get(sensor.name)
    if section is not None and section.scale is not None:
        full = scale_of(sensor, hand) * sensor.full
        sensor = replace(sensor, unit=NEWTON, full=full)
    if section is None or section.link is None:
        if sensor.link and sensor.link not in hand.urdf.links:
            raise ValueError(f"'{sensor.name}' is on the link '{sensor.link}', which is unknown")
        return replace(sensor, finger=sensor.finger or finger_of(hand, sensor.link))
    finger = finger_of(hand, section.link)
    count = taxel_count(section)
    if sensor.taxels > 1 and section.grid is None and not section.positions:
        # The link alone is known: enough to feel with, not to draw.
        nowhere = np.zeros((0, 3))
        return replace(sensor, link=section.link, finger=finger, position=nowhere, normal=nowhere)
    if count != sensor.taxels:
        raise ValueError(f"'{sensor.name}' has {sensor.taxels} taxels, hand.yaml places {count}")
    position, normal = taxels_of(section)
    return replace(
        sensor,
        link=section.link,
        finger=finger,
        grid=section.grid or sensor.grid,
        position=position,
        normal=normal,
    )


def scale_of(sensor: TouchSensor, hand: Hand) -> float:
    """Return what the values of a sensor as its driver declares it are to be multiplied by.

    That is 1 for one that measures in newtons itself, as a simulated or recorded one does.
    """
    section = hand.touch.get(sensor.name)
    if section is None or section.scale is None or sensor.unit == NEWTON:
        return 1.0
    return section.scale
