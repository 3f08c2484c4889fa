"""A running simulation of one hand: steps it, reads it, commands it. No clock, no asyncio."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from rtee.drivers.mujoco.model import coupling_name, effort_limit
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK, rest_position
from rtee.drivers.mujoco.surroundings import Surroundings
from rtee.hand.model import Hand
from rtee.hand.transmission import Coupling
from rtee.types import BoolArray, FloatArray


class Simulation:
    """The hand in MuJoCo.

    Attributes:
        model: The compiled model.
        data: Its state.
        surroundings: The carrier, the object and what it lies on.
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
        self._all = np.array([model.joint(name).qposadr[0] for name in hand.actuator_names])
        specs = [hand.actuator(name) for name in actuators]
        self._period = period
        self._fastest: FloatArray = np.array([s.velocity for s in specs])
        self._fastest[~(self._fastest > 0.0)] = np.inf
        self._target: FloatArray = np.zeros(len(specs))
        self._speed = self._fastest.copy()
        self.effort_limit: FloatArray = np.array([effort_limit(s, options) for s in specs])
        self._gain = model.actuator_gainprm[self._motor, 0].copy()
        self._bias = model.actuator_biasprm[self._motor].copy()
        names = [finger.tip for finger in hand.fingers if finger.tip is not None]
        tips = list(dict.fromkeys(names))
        self._tips = len(tips)
        self._finger_rows = np.array(
            [-1 if f.tip is None else tips.index(f.tip) for f in hand.fingers], dtype=np.intp
        )
        self._row_of_geom = np.full(model.ngeom, -1, dtype=np.intp)
        for row, tip in enumerate(tips):
            self._row_of_geom[model.geom_bodyid == model.body(LINK + tip).id] = row
        self._curved = [
            (model.eq(coupling_name(joint.name)).id, self._address(hand, coupling), coupling)
            for joint, coupling in zip(hand.joints, hand.transmission.couplings, strict=True)
            if coupling.actuator is not None and not coupling.linear
        ]
        self._powered = True
        self.surroundings = Surroundings(model, self.data, options)
        self.reset()

    def _address(self, hand: Hand, coupling: Coupling) -> int:
        assert coupling.actuator is not None  # noqa: S101 - narrows the type
        return int(self.model.joint(hand.actuator_names[coupling.actuator]).qposadr[0])

    def reset(self) -> None:
        """Go back to the beginning: the hand at rest, everything else as modelled."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = rest_position(self.model, self._hand)
        names = self._hand.actuator_names
        self.data.ctrl[[self.model.actuator(n).id for n in names]] = self._hand.rest
        self._target = np.array(self.data.ctrl[self._motor])
        self._speed = self._fastest.copy()
        self.surroundings.reset()
        self._follow_curves()
        mujoco.mj_forward(self.model, self.data)

    def advance(self) -> None:
        """Step by one period."""
        self._follow_curves()
        step = self._speed * self._period
        reference = self.data.ctrl[self._motor]
        self.data.ctrl[self._motor] = reference + np.clip(self._target - reference, -step, step)
        mujoco.mj_step(self.model, self.data, nstep=self._substeps)
        self.surroundings.watch(self.time)

    def _follow_curves(self) -> None:
        """Couple joints that follow an actuator by a curve along its tangent here."""
        for equality, address, coupling in self._curved:
            u = float(self.data.qpos[address])
            value, slope = coupling.dual(u)
            self.model.eq_data[equality, :5] = (value - slope * u, slope, 0.0, 0.0, 0.0)

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
    def hand_position(self) -> FloatArray:
        """Positions of all actuators of the hand ``(n,)`` [rad | m], in the hand's order."""
        return np.asarray(self.data.qpos[self._all], dtype=np.float64)

    @property
    def joints(self) -> FloatArray:
        """Positions of all moving joints of the hand ``(m,)`` [rad | m], as simulated."""
        return np.asarray(self.data.qpos[self._joints], dtype=np.float64)

    @property
    def contact_forces(self) -> FloatArray:
        """Norm of the contact force on each fingertip ``(fingers,)`` [N]."""
        data = self.data
        forces = np.zeros((len(self._finger_rows), 3))
        if data.ncon:
            contact = data.contact
            rows = self._row_of_geom[contact.geom]
            first = contact.efc_address
            seen = np.flatnonzero((first >= 0) & (rows >= 0).any(axis=1))
            if len(seen):
                # The first three rows of an elliptic contact are its force in its own frame.
                own = data.efc_force[first[seen, None] + np.arange(3)]
                world = np.einsum("kij,ki->kj", contact.frame[seen].reshape(-1, 3, 3), own)
                tips = np.zeros((self._tips + 1, 3))  # the last one takes what is no fingertip
                np.subtract.at(tips, rows[seen, 0], world)
                np.add.at(tips, rows[seen, 1], world)
                tips[-1] = 0.0
                forces = tips[self._finger_rows]
        return np.asarray(np.sqrt((forces * forces).sum(axis=1)), dtype=np.float64)

    @property
    def object_pose(self) -> FloatArray | None:
        """Pose ``(7,)`` of the object in the world, if there is one; see `Surroundings.pose`."""
        return self.surroundings.pose if self.surroundings.has_object else None

    def command(
        self,
        position: FloatArray,
        max_effort: FloatArray,
        mask: BoolArray,
        max_velocity: FloatArray | None = None,
    ) -> None:
        """Set references and limits of the masked actuators.

        As in a real hand's own controller, the reference that counts moves to the given one no
        faster than the velocity limit.

        Args:
            position: References ``(n,)`` [rad | m].
            max_effort: Effort limits ``(n,)`` [N·m | N]; ``inf``: the actuator's own.
            mask: Which actuators are meant ``(n,)``.
            max_velocity: Velocity limits ``(n,)`` [rad/s | m/s]; the actuators' own unless given.
        """
        motors = self._motor[mask]
        self._target[mask] = position[mask]
        if max_velocity is not None:
            self._speed[mask] = np.minimum(self._fastest, np.maximum(max_velocity, 0.0))[mask]
        limit = np.minimum(self.effort_limit, np.maximum(max_effort, 0.0))[mask]
        self.model.actuator_forcerange[motors, 0] = -limit
        self.model.actuator_forcerange[motors, 1] = limit

    def hold(self) -> None:
        """Take the present positions for references."""
        self._target = self.position
        self.data.ctrl[self._motor] = self._target

    def power(self, on: bool) -> None:
        """Switch the position gains on or off; off leaves the joints limp."""
        self._powered = on
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
        self.power(self._powered)
