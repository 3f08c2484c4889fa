"""Place touch sensors on a hand."""

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
    """Return the number of taxels in a section of hand.yaml."""
    if section.grid is not None:
        return section.grid[0] * section.grid[1]
    return len(section.positions) or 1


def grid_points(grid: tuple[int, int], pitch: Sequence[float]) -> FloatArray:
    """Return the points ``(n, 3)`` [m] of a grid around the origin in the plane z = 0, row by row.

    Args:
        grid: Number of rows along x and of columns along y.
        pitch: Distance between rows and between columns [m].
    """
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * step for n, step in zip(grid, pitch, strict=True))
    points = np.zeros((grid[0] * grid[1], 3))
    points[:, 0], points[:, 1] = np.repeat(x, grid[1]), np.tile(y, grid[0])
    return points


def taxels_of(section: TouchSection) -> tuple[FloatArray, FloatArray]:
    """Return positions [m] and unit normals of taxels in their link's frame, ``(n, 3)`` each."""
    frame = origin(section.xyz, section.rpy)
    if section.grid is not None:
        points = grid_points(section.grid, section.pitch)
    else:
        points = np.array(section.positions or ((0.0, 0.0, 0.0),), dtype=np.float64)
    normals = np.tile((0.0, 0.0, 1.0), (len(points), 1))
    if section.normals:
        normals = np.array(section.normals, dtype=np.float64)
        # In hand.yaml, only their directions count.
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points @ frame[:3, :3].T + frame[:3, 3], normals @ frame[:3, :3].T


def finger_of(hand: Hand, link: str) -> str:
    """Return the finger of a link; empty if it belongs to none, such as the palm."""
    return finger_of_link(hand).get(link, "")


def on_hand(sensor: TouchSensor, hand: Hand) -> TouchSensor:
    """Return a sensor with its placement from the hand's hand.yaml.

    A placement in hand.yaml replaces that of the driver. With a scale in hand.yaml, the unit is the
    newton; the values must still be multiplied by `scale_of`.

    Raises:
        ValueError: if hand.yaml places another number of taxels, or the driver names a link that
            the hand does not have.
    """
    section = hand.touch.get(sensor.name)
    if section is not None and section.scale is not None:
        full = scale_of(sensor, hand) * sensor.full
        sensor = replace(sensor, unit=NEWTON, full=full)
    if section is None or section.link is None:
        if sensor.link and sensor.link not in hand.urdf.links:
            raise ValueError(
                f"'{sensor.name}' is on the link '{sensor.link}', which the hand does not have"
            )
        return replace(sensor, finger=sensor.finger or finger_of(hand, sensor.link))
    finger = finger_of(hand, section.link)
    count = taxel_count(section)
    if sensor.taxels > 1 and section.grid is None and not section.positions:
        # Only the link is known, not the positions of the taxels, so they cannot be drawn.
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
    """Return the factor from the values of a sensor, as its driver declares it, to newtons.

    It is 1 for a sensor that measures in newtons, such as a simulated or recorded one, and for one
    without a scale in hand.yaml.
    """
    section = hand.touch.get(sensor.name)
    if section is None or section.scale is None or sensor.unit == NEWTON:
        return 1.0
    return section.scale
