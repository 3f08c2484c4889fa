"""Gymnasium environment of a simulated hand, for any of the hands.

Importing this module registers ``rtee/Hand-v0``::

    import gymnasium, rtee.gym
    env = gymnasium.make("rtee/Hand-v0", hand="schunk_svh", task="lift")

The loop handles a policy's action as a stream's sample, with the same interpolation, limits and
safety checks as on the real hand.
"""

from __future__ import annotations

import logging
import math
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from rtee.commands import BeginStream, StreamSample
from rtee.drivers.mujoco.objects import MESHES
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.drivers.mujoco.surroundings import pose_vector
from rtee.errors import ConfigError, SimulationUnstable
from rtee.hand.validation import Invalid, validated
from rtee.objects.shape import parse_object
from rtee.sample import FloatArray
from rtee.trials.bench import bench
from rtee.trials.headless import HeadlessHand
from rtee.values import number

log = logging.getLogger(__name__)

RATE: Final = 30.0
"""Steps per second [Hz]: usual for policies learnt from cameras."""

_LOOP: Final = 120.0
"""Ticks of the loop per second [Hz]: four in each step. The loop reacts to a contact within 17 ms;
more ticks would make training slower."""

_STEPS: Final = 240
"""Steps of an episode before it is truncated: eight seconds."""

_BESIDE: Final = 0.003
"""Largest offset of the object from its nominal place along each axis [m]: the placement error of a
camera or a person."""

_LETS_GO: Final = 2.0
"""Time at which the support releases the object [s]: a hand can close slowly twice by then."""

_LIFTED: Final = 0.1
"""Height to which the carrier lifts the hand [m], in the time from 1 s to 3 s after the release."""

_LOST: Final = 0.06
"""Motion in the hand beyond which the object counts as lost [m]: more than a finger's breadth."""

_TURNED: Final = (0.3, 1.0)
"""Range of the angle by which to turn the object [rad]."""

_NEAR: Final = 0.1
"""Error of that angle below which the angle counts as reached [rad]."""


_FASTEST: Final = 100.0
"""Bound of the observed velocities [rad/s | m/s]: faster than any actuator."""

_STRONGEST: Final = 1000.0
"""Bound of the observed efforts and forces [N·m | N]: stronger than any hand."""

_FARTHEST: Final = 10.0
"""Bound of the object's observed coordinates [m]: it is long lost there."""


class Task(StrEnum):
    """What to do with the object."""

    HOLD = "hold"
    LIFT = "lift"
    REORIENT = "reorient"


class HandEnv(gymnasium.Env[dict[str, FloatArray], FloatArray]):  # type: ignore[misc]
    """A hand and an object between its fingertips.

    An action ``(n,)`` is the target of each actuator, from -1 at its lower limit to 1 at its upper
    limit. An observation has, for each actuator ``(n,)``, ``position`` [rad | m], ``velocity``
    [rad/s | m/s] and ``effort`` [N·m | N]; the ``tip_force`` on each finger [N]; the ``object``'s
    pose in the hand's base frame, position and unit quaternion (w, x, y, z) ``(7,)``; and the
    ``goal``, the angle by which to turn the object from its initial pose about the base frame's
    z axis [rad].

    The object weighs nothing until two links have touched it for a while, or two seconds have
    passed. The reward of a step is at most 1. It falls as the object moves in the hand; *lift* also
    rewards the object's height, and *reorient* an angle close to the goal. The episode terminates
    when the object is lost. ``info`` has ``success``.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": RATE}  # noqa: RUF012

    def __init__(
        self,
        hand: str | Path = "schunk_svh",
        task: Task | str = Task.HOLD,
        object: str = "sphere:0.03",  # noqa: A002 - as on the command line
        mass: float = 0.1,
        render_mode: str | None = None,
    ) -> None:
        """Build the simulation.

        Args:
            hand: The hand's name, or the path of its folder.
            task: What to do.
            object: The object, in the syntax of ``rtee run --object``.
            mass: Its mass [kg].
            render_mode: Must be ``None``.

        Raises:
            UserError: if the hand cannot be simulated, or there is no such task or object.
        """
        if task not in (*Task,):
            raise ConfigError(f"unknown task '{task}'; valid: {', '.join(Task)}")
        if render_mode is not None:
            raise ConfigError(
                f"this environment draws nothing: render_mode is {render_mode!r:.100}"
            )
        parse_object(object, MESHES)  # an empty text would be no object
        plain = number(mass)
        given = {"object": object, "object_mass": mass if plain is None else plain}
        try:
            options = validated(SimOptions, {**given, "support": "held", "carrier": "lift"})
        except Invalid as error:
            raise ConfigError(f"the mass of the object {error.sentence}") from None
        self.render_mode = render_mode
        self._task = Task(task)
        self._bench = bench(str(hand), _LOOP)
        self._model = self._bench.hand
        period = self._bench.settings.period
        self._simulation = make_simulation(self._model, options, self._model.actuator_names, period)
        for doubt in self._simulation.doubts:
            log.warning("%s: %s", self._model.name, doubt)
        self._start = self._simulation.surroundings.object_frame
        self._lower, self._upper = self._model.lower, self._model.upper
        if not np.isfinite([self._lower, self._upper]).all():
            endless = [
                a.name for a in self._model.actuators if not math.isfinite(a.upper - a.lower)
            ]
            raise ConfigError(f"actions need limits, and there are none for {', '.join(endless)}")
        n, span = len(self._model.actuators), self._upper - self._lower
        self._spaces: dict[str, Any] = {
            "position": Box(self._lower - span, self._upper + span, dtype=np.float64),
            "velocity": _within(n, _FASTEST),
            "effort": _within(n, _STRONGEST),
            "tip_force": Box(0.0, _STRONGEST, (len(self._model.fingers),), np.float64),
            "object": _within(7, _FARTHEST),
            "goal": _within(1, math.pi),
        }
        self.observation_space: Any = Dict(self._spaces)
        self.action_space = Box(-1.0, 1.0, (n,), np.float64)
        self._ticks = round(_LOOP / RATE)
        self._goal = 0.0
        self._headless: HeadlessHand[Simulation] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """Begin an episode: the hand at rest, the object slightly off its nominal place."""
        super().reset(seed=seed)
        simulation, bench = self._simulation, self._bench
        place = self._start.copy()
        place[:3, 3] += self.np_random.uniform(-_BESIDE, _BESIDE, 3)
        self._goal = 0.0
        if self._task is Task.REORIENT:
            self._goal = float(self.np_random.uniform(*_TURNED))
        simulation.surroundings.place(place)
        simulation.reset()
        headless = HeadlessHand(self._model, bench.library, bench.settings, simulation)
        headless.apply(BeginStream("policy", RATE, 4.0 / RATE))
        headless.before_tick(self._carry)
        self._headless = headless
        self._began = self._object()
        return self._observation(), {"success": False}

    def step(
        self, action: FloatArray
    ) -> tuple[dict[str, FloatArray], float, bool, bool, dict[str, Any]]:
        """Send targets, and advance by a thirtieth of a second.

        Raises:
            ConfigError: if the action is not ``(n,)`` finite numbers, or no episode has begun.
        """
        headless = self._headless
        if headless is None:
            raise ConfigError("call reset() to begin an episode")
        wrong = ConfigError(
            f"an action must be {len(self._lower)} finite numbers from -1 to 1, one per actuator"
        )
        try:
            given = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise wrong from None
        if given.shape != self.action_space.shape or not np.isfinite(given).all():
            raise wrong
        share = 0.5 + 0.5 * np.clip(given, -1.0, 1.0)
        targets = dict(
            zip(
                self._model.actuator_names,
                (self._lower + share * (self._upper - self._lower)).tolist(),
                strict=True,
            )
        )
        now = headless.time
        still = dict.fromkeys(targets, math.nan)
        headless.apply(StreamSample("policy", now, now, targets, {}, targets, still))
        try:
            for _ in range(self._ticks):
                headless.tick()
        except SimulationUnstable:
            return self._observation(), 0.0, True, False, {"success": False}
        reward, lost, success = self._judged()
        return self._observation(), reward, lost, False, {"success": success}

    def _carry(self, time: float) -> None:
        """Let go of the object when it is time, and lift the hand."""
        around = self._simulation.surroundings
        if time >= _LETS_GO:
            around.remove_support()
        if self._task is Task.LIFT:
            share = min(1.0, max(0.0, 0.5 * (time - _LETS_GO - 1.0)))
            height = _LIFTED * (3.0 - 2.0 * share) * share * share
            around.carry(np.array([0.0, 0.0, height, 0.0, 0.0, 0.0]))

    def _object(self) -> FloatArray:
        """Return the object's pose in the hand's base frame ``(4, 4)``."""
        around = self._simulation.surroundings
        return np.linalg.inv(around.base_pose) @ around.object_frame

    def _judged(self) -> tuple[float, bool, bool]:
        """Return the reward, whether the object is lost, and whether the task is done."""
        around, pose = self._simulation.surroundings, self._object()
        moved = float(np.linalg.norm(pose[:3, 3] - self._began[:3, 3]))
        held = max(0.0, 1.0 - moved / _LOST)
        borne = around.unsupported and moved < _LOST
        if self._task is Task.HOLD:
            return held, moved > _LOST, borne
        if self._task is Task.LIFT:
            risen = min(1.0, max(0.0, (around.height - float(self._start[2, 3])) / _LIFTED))
            return 0.5 * held + 0.5 * risen, moved > _LOST, borne and risen > 0.8
        turn = pose[:3, :3] @ self._began[:3, :3].T
        error = abs(math.atan2(turn[1, 0], turn[0, 0]) - self._goal)
        return held * math.exp(-error), moved > _LOST, borne and error < _NEAR

    def _observation(self) -> dict[str, FloatArray]:
        simulation = self._simulation
        seen = {
            "position": simulation.position,
            "velocity": simulation.velocity,
            "effort": simulation.effort,
            "tip_force": simulation.contact_forces,
            "object": pose_vector(self._object()),
            "goal": np.array([self._goal]),
        }
        spaces = self._spaces
        return {key: np.clip(seen[key], spaces[key].low, spaces[key].high) for key in seen}


def _within(size: int, most: float) -> Box:
    return Box(-most, most, (size,), np.float64)


gymnasium.register("rtee/Hand-v0", entry_point="rtee.gym:HandEnv", max_episode_steps=_STEPS)
