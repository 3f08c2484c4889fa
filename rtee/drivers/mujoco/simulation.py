"""A running simulation of one hand: steps it, reads it, commands it. No clock, no asyncio."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from rtee.drivers.mujoco.model import LINK, effort_limit, rest_position
from rtee.drivers.mujoco.objects import OBJECT
from rtee.drivers.mujoco.options import SimOptions
from rtee.hand.model import Hand
from rtee.types import BoolArray, FloatArray


class Simulation:
    """The hand in MuJoCo.

    Attributes:
        model: The compiled model.
        data: Its state.
        actuators: Names of the actuators in the order of all arrays here.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        hand: Hand,
        options: SimOptions,
        actuators: Sequence[str],
        period: float,
    ) -> None:
        """Start at rest.

        Args:
            model: The compiled model.
            hand: The hand in it.
            options: How it is simulated.
            actuators: The actuators that are read and commanded, in order.
            period: Time one `advance` takes [s].
        """
        self.model = model
        self.data = mujoco.MjData(model)
        self.actuators = tuple(actuators)
        self._hand = hand
        self._substeps = max(1, math.ceil(period / options.timestep - 1e-9))
        model.opt.timestep = period / self._substeps
        self._motor = np.array([model.actuator(name).id for name in actuators])
        self._qpos = np.array([model.joint(name).qposadr[0] for name in actuators])
        self._qvel = np.array([model.joint(name).dofadr[0] for name in actuators])
        self._joints = np.array([model.joint(name).qposadr[0] for name in hand.joint_names])
        specs = [hand.actuator(name) for name in actuators]
        self.effort_limit: FloatArray = np.array([effort_limit(s, options) for s in specs])
        self._gain = model.actuator_gainprm[self._motor, 0].copy()
        self._bias = model.actuator_biasprm[self._motor].copy()
        self._finger_bodies = [
            -1 if finger.tip is None else int(model.body(LINK + finger.tip).id)
            for finger in hand.fingers
        ]
        self._force = np.zeros(6)
        self.reset()

    def reset(self) -> None:
        """Go back to the beginning: the hand at rest, everything else as modelled."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = rest_position(self.model, self._hand)
        names = self._hand.actuator_names
        self.data.ctrl[[self.model.actuator(n).id for n in names]] = self._hand.rest
        mujoco.mj_forward(self.model, self.data)

    def advance(self) -> None:
        """Step by one period."""
        mujoco.mj_step(self.model, self.data, nstep=self._substeps)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self.data.time)

    @property
    def position(self) -> FloatArray:
        """Actuator positions ``(n,)`` [rad | m]."""
        return np.asarray(self.data.qpos[self._qpos], dtype=np.float64)

    @property
    def velocity(self) -> FloatArray:
        """Actuator velocities ``(n,)`` [rad/s | m/s]."""
        return np.asarray(self.data.qvel[self._qvel], dtype=np.float64)

    @property
    def effort(self) -> FloatArray:
        """Actuator efforts ``(n,)`` [N·m | N]."""
        return np.asarray(self.data.actuator_force[self._motor], dtype=np.float64)

    @property
    def joints(self) -> FloatArray:
        """Positions of all moving joints of the hand ``(m,)`` [rad | m], as simulated."""
        return np.asarray(self.data.qpos[self._joints], dtype=np.float64)

    @property
    def contact_forces(self) -> FloatArray:
        """Norm of the contact force on each fingertip ``(fingers,)`` [N]."""
        forces = np.zeros((len(self._finger_bodies), 3))
        for index, contact in enumerate(self.data.contact):
            bodies = (
                self.model.geom_bodyid[contact.geom1],
                self.model.geom_bodyid[contact.geom2],
            )
            if bodies[0] not in self._finger_bodies and bodies[1] not in self._finger_bodies:
                continue
            mujoco.mj_contactForce(self.model, self.data, index, self._force)
            world = contact.frame.reshape(3, 3).T @ self._force[:3]
            for body, sign in zip(bodies, (-1.0, 1.0), strict=True):
                if body in self._finger_bodies:
                    forces[self._finger_bodies.index(body)] += sign * world
        return np.asarray(np.linalg.norm(forces, axis=1), dtype=np.float64)

    @property
    def object_pose(self) -> FloatArray | None:
        """Position and unit quaternion (w, x, y, z) of the object ``(7,)``, if there is one."""
        address = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, OBJECT)
        if address < 0:
            return None
        start = self.model.jnt_qposadr[address]
        return np.asarray(self.data.qpos[start : start + 7], dtype=np.float64).copy()

    def command(self, position: FloatArray, max_effort: FloatArray, mask: BoolArray) -> None:
        """Set references and effort limits of the masked actuators."""
        motors = self._motor[mask]
        self.data.ctrl[motors] = position[mask]
        limit = np.minimum(self.effort_limit, np.maximum(max_effort, 0.0))[mask]
        self.model.actuator_forcerange[motors, 0] = -limit
        self.model.actuator_forcerange[motors, 1] = limit

    def hold(self) -> None:
        """Take the present positions for references."""
        self.data.ctrl[self._motor] = self.position

    def power(self, on: bool) -> None:
        """Switch the position gains on or off; off leaves the joints limp."""
        self.model.actuator_gainprm[self._motor, 0] = self._gain if on else 0.0
        self.model.actuator_biasprm[self._motor] = self._bias if on else 0.0

    def set_gain(self, name: str, value: float) -> None:
        """Set one gain: ``kp.ACTUATOR`` [N·m/rad] or ``kd.ACTUATOR`` [N·m·s/rad].

        Raises:
            KeyError: if there is no such gain.
            ValueError: if the value is negative or not finite.
        """
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"gain '{name}' must be zero or more, not {value:g}")
        kind, _, actuator = name.partition(".")
        if kind not in ("kp", "kd") or actuator not in self.actuators:
            raise KeyError(name)
        index = self.actuators.index(actuator)
        if kind == "kp":
            self._gain[index] = value
            self._bias[index, 1] = -value
        else:
            self._bias[index, 2] = -value
        self.power(True)
