"""Motions of the carrier in simulated time: smooth paths and shaking."""

from __future__ import annotations

import math

import numpy as np

from rtee.drivers.mujoco.simulation import Simulation
from rtee.sample import FloatArray
from rtee.trials.headless import HeadlessHand


class CarrierScript:
    """Moves the carrier of a simulated hand while its loop goes on.

    Attributes:
        at: Where the carrier has to be ``(6,)``: x, y, z [m], roll, pitch, yaw [rad].
    """

    def __init__(self, headless: HeadlessHand[Simulation]) -> None:
        self._headless = headless
        self.at: FloatArray = np.zeros(6)

    def jump(self, position: FloatArray) -> None:
        """Start at a position ``(3,)`` [m], with all joints at rest, without moving there."""
        self.at[:3] = position
        self._headless.simulation.surroundings.jump(self.at)

    def go(self, position: FloatArray, duration: float) -> None:
        """Go to a position ``(3,)`` [m] in a time [s]; velocity is continuous."""
        goal = self.at.copy()
        goal[:3] = position
        self.to(goal, duration)

    def move(self, axis: int, distance: float, duration: float) -> None:
        """Move along (0 to 2 [m]) or about (3 to 5 [rad]) one axis in a time [s]."""
        goal = self.at.copy()
        goal[axis] += distance
        self.to(goal, duration)

    def to(self, goal: FloatArray, duration: float) -> None:
        """Go to a pose ``(6,)`` in a time [s], by a cubic of the time."""
        start = self.at.copy()
        begin = self._headless.time
        while True:
            share = min(1.0, (self._headless.time - begin) / duration)
            self._set(start + (3.0 - 2.0 * share) * share * share * (goal - start))
            if share >= 1.0:
                return
            self._headless.tick()

    def shake(self, amplitude: float, frequency: float, cycles: int) -> None:
        """Swing along x, then y, then z; each swells from rest and dies down to it.

        Args:
            amplitude: To either side [m].
            frequency: Swings per second [Hz].
            cycles: Swings along each axis.
        """
        middle = self.at.copy()
        for axis in range(3):
            begin = self._headless.time
            while (elapsed := self._headless.time - begin) < cycles / frequency:
                pose = middle.copy()
                swell = math.sin(math.pi * elapsed * frequency / cycles)
                pose[axis] += amplitude * swell * math.sin(2.0 * math.pi * frequency * elapsed)
                self._set(pose)
                self._headless.tick()
        self._set(middle)

    def _set(self, pose: FloatArray) -> None:
        self.at = np.array(pose)
        self._headless.simulation.surroundings.carry(self.at)
