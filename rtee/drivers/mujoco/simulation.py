"""A running simulation of one hand: steps it, reads it, commands it. No clock, no asyncio."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from rtee.drivers.mujoco.couplings import motor_joint
from rtee.drivers.mujoco.finger_forces import FingerForces
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import rest_position
from rtee.drivers.mujoco.scene_channels import SceneChannels, describe
from rtee.drivers.mujoco.servos import Servo, effort_note
from rtee.drivers.mujoco.sheet_forces import SheetForces
from rtee.drivers.mujoco.surroundings import Surroundings
from rtee.drivers.mujoco.tangents import JointCouplings
from rtee.drivers.mujoco.taxels import Taxels
from rtee.errors import SimulationUnstable
from rtee.hand.model import Hand
from rtee.sample import BoolArray, FloatArray

log = logging.getLogger(__name__)


class Simulation:
    """The hand in MuJoCo.

    Attributes:
        model: The compiled model.
        data: Its state.
        surroundings: The carrier, the object and what it lies on.
        actuators: Names of the actuators in the order of all arrays here.
        effort_limit: Their effort limits ``(n,)`` [N·m | N].
        notes: Assumptions about the hand, one sentence each.
        doubts: Assumptions on which all forces depend, which are not among the notes.
        object_description: Shape and colour of the object, if there is one.
        taxels: The touch sensors.

    Args:
        period: Simulated time of one `advance` [s].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        hand: Hand,
        options: SimOptions,
        actuators: Sequence[str],
        period: float,
        servos: Mapping[str, Servo],
        notes: Sequence[str] = (),
    ) -> None:
        # Otherwise MuJoCo writes its warnings to a file in the current folder.
        mujoco.set_mju_user_warning(log.warning)
        self.model = model
        self.notes = tuple(notes)
        self.doubts = tuple(effort_note(hand))
        self.data = mujoco.MjData(model)
        # Views of the state, kept because MuJoCo makes a new one at each access.
        self._positions: FloatArray = self.data.qpos
        self._control: FloatArray = self.data.ctrl
        self._efforts: FloatArray = self.data.actuator_force
        self.actuators = tuple(actuators)
        self._hand = hand
        # The step is shortened so that a whole number of steps makes one period exactly; the small
        # number keeps rounding from adding a step.
        self._substeps = max(1, math.ceil(period / model.opt.timestep - 1e-9))
        model.opt.timestep = period / self._substeps
        self._motor = np.array([model.actuator(name).id for name in actuators])
        moved = {name: model.joint(motor_joint(hand, name)) for name in hand.actuator_names}
        self._qpos = np.array([moved[name].qposadr[0] for name in actuators])
        self._qvel = np.array([moved[name].dofadr[0] for name in actuators])
        self._joints = np.array([model.joint(name).qposadr[0] for name in hand.joint_names])
        self._all = np.array([joint.qposadr[0] for joint in moved.values()])
        specs = [hand.actuator(name) for name in actuators]
        self._period = period
        self._fastest: FloatArray = np.array([s.velocity for s in specs])
        # URDFs without a velocity limit say 0.
        self._fastest[~(self._fastest > 0.0)] = np.inf
        self._target: FloatArray = np.zeros(len(specs))
        self._speed = self._fastest.copy()
        self.effort_limit: FloatArray = np.array([servos[name].limit for name in actuators])
        # Copies, since switching the power off overwrites the model's own gains.
        self._gain = model.actuator_gainprm[self._motor, 0].copy()
        self._bias = model.actuator_biasprm[self._motor].copy()
        self._integral: FloatArray = np.array([servos[name].ki for name in actuators])
        self._integrates = bool(self._integral.any())
        self._forces = FingerForces(model, hand)
        self.taxels = Taxels(model, hand, options)
        self._couplings = JointCouplings(model, hand)
        self._sheet = SheetForces(hand, model, list(actuators))
        self._powered = True
        self.surroundings = Surroundings(model, self.data, options)
        self._scene_channels = SceneChannels(model, self.data, hand, self.surroundings, options)
        # After all parts have looked the model up, since each of them is reset.
        self.reset()
        self.object_description = describe(model, self.data, options)

    def reset(self) -> None:
        """Go back to the beginning: the hand at rest, everything else as modelled.

        Only gains that were set stay as they are.
        """
        mujoco.mj_resetData(self.model, self.data)
        # Integrals and effort limits are kept in the model, which a reset of the data leaves alone.
        self.power(True)
        # No reference has these limits, so the first one is written.
        self._limited = b"", b""
        self.model.actuator_forcerange[self._motor, 0] = -self.effort_limit
        self.model.actuator_forcerange[self._motor, 1] = self.effort_limit
        self.data.qpos[:] = rest_position(self.model, self._hand)
        names = self._hand.actuator_names
        self.data.ctrl[[self.model.actuator(n).id for n in names]] = self._hand.rest
        self._target = np.array(self.data.ctrl[self._motor])
        self._speed = self._fastest.copy()
        self.surroundings.reset()
        self._couplings.renew(self.data.qpos)
        # Poses and forces can then be read before the first step.
        mujoco.mj_forward(self.model, self.data)

    def advance(self) -> None:
        """Step by one period.

        Raises:
            SimulationUnstable: if MuJoCo has reset its state, as it does once a value is not finite
                or exceeds all bounds.
        """
        # Before the step: the tangents belong to the positions from which it starts.
        self._couplings.renew(self._positions)
        references, targets = self._control.take(self._motor).tolist(), self._target.tolist()
        if references != targets:
            self._follow(references, targets)
        if self._integrates:
            self._integrate()
        before = self.data.time
        mujoco.mj_step(self.model, self.data, nstep=self._substeps)
        # After a reset, time starts at 0 again; there is no other immediate sign of it.
        if self.data.time < before + 0.5 * self._period:
            raise SimulationUnstable
        self.surroundings.watch(self.time)

    def _follow(self, references: list[float], targets: list[float]) -> None:
        """Move the effective references towards the given ones."""
        positions = self._positions.take(self._qpos).tolist()
        steps = (self._speed * self._period).tolist()
        # Plain numbers: for so few, at every exchange, numpy takes several times as long.
        for index, (reference, position, target, step) in enumerate(
            zip(references, positions, targets, steps, strict=True)
        ):
            # A reference that has run ahead into an object turns back from the actuator's position.
            # It does not travel back to it first, so the actuator reverses as fast as a real servo.
            start = position if (reference - position) * (target - position) < 0.0 else reference
            way = target - start
            # Written so that NaN stays NaN.
            references[index] = start + (step if way > step else -step if way < -step else way)
        self._control[self._motor] = references

    def _integrate(self) -> None:
        """Integrate the position errors; the sum stays within the effort limits."""
        motors = self._motor
        error = self.data.ctrl[motors] - self.data.qpos[self._qpos]
        limit = self.model.actuator_forcerange[motors, 1]
        step = np.where(self._powered, self._integral * error * self._period, 0.0)
        self._bias[:, 0] = np.clip(self._bias[:, 0] + step, -limit, limit)
        self.model.actuator_biasprm[motors, 0] = np.where(self._powered, self._bias[:, 0], 0.0)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self.data.time)

    @property
    def position(self) -> FloatArray:
        """Actuator positions ``(n,)`` [rad | m]."""
        return self._positions.take(self._qpos)

    @property
    def velocity(self) -> FloatArray:
        """Actuator velocities ``(n,)`` [rad/s | m/s]."""
        return np.asarray(self.data.qvel[self._qvel], dtype=np.float64)

    @property
    def effort(self) -> FloatArray:
        """Actuator efforts ``(n,)`` [N·m | N]."""
        return self._efforts.take(self._motor)

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
        """Contact force on each finger ``(fingers,)`` [N]; see `FingerForces`."""
        return self._forces.read(self.data)

    @property
    def scene_channels(self) -> dict[str, FloatArray]:
        """The object, the hand's pose and the contacts, as channels; see `SceneChannels`."""
        return self._scene_channels.read()

    @property
    def gains(self) -> dict[str, float]:
        """The present gains; see `set_gain`."""
        gains = {}
        for index, name in enumerate(self.actuators):
            gains[f"kp.{name}"] = float(self._gain[index])
            gains[f"ki.{name}"] = float(self._integral[index])
            gains[f"kd.{name}"] = -float(self._bias[index, 2])
        return gains

    def command(
        self,
        position: FloatArray,
        max_effort: FloatArray,
        mask: BoolArray,
        max_velocity: FloatArray | None = None,
    ) -> None:
        """Set references and limits of the masked actuators.

        As in a real hand's own controller, the effective reference moves to the given one no
        faster than the velocity limit.

        Args:
            position: References ``(n,)`` [rad | m].
            max_effort: Effort limits ``(n,)`` [N·m | N]; ``inf``: the actuator's own.
            mask: Which actuators to command ``(n,)``.
            max_velocity: Velocity limits ``(n,)`` [rad/s | m/s]; by default the actuators' own.
        """
        np.copyto(self._target, position, where=mask)
        if max_velocity is not None:
            self._speed[mask] = np.minimum(self._fastest, np.maximum(max_velocity, 0.0))[mask]
        # Limits rarely change from one exchange to the next.
        limited = max_effort.tobytes(), mask.tobytes()
        if limited != self._limited or self._sheet:
            self._limited = limited
            own = self.effort_limit
            if self._sheet:
                own = self._sheet.lower(own, self.data.qpos[self._qpos])
            limit = np.minimum(own, np.maximum(max_effort, 0.0))[mask]
            motors = self._motor[mask]
            self.model.actuator_forcerange[motors, 0] = -limit
            self.model.actuator_forcerange[motors, 1] = limit

    def hold(self) -> None:
        """Make the present positions the references."""
        self._target = self.position
        # The rate-limited reference, too; otherwise the actuators would finish their old motion.
        self.data.ctrl[self._motor] = self._target

    def power(self, on: bool) -> None:
        """Switch the position gains on or off; off leaves the joints limp."""
        self._powered = on
        self._bias[:, 0] = 0.0  # the integrals start from 0
        self._write_gains()

    def _write_gains(self) -> None:
        on = 1.0 if self._powered else 0.0
        self.model.actuator_gainprm[self._motor, 0] = on * self._gain
        self.model.actuator_biasprm[self._motor] = on * self._bias

    def set_gain(self, name: str, value: float) -> None:
        """Set a gain: ``kp.ACTUATOR`` [N·m/rad], ``ki.…`` [N·m/(rad·s)] or ``kd.…`` [N·m·s/rad].

        Raises `KeyError` for an unknown name, `ValueError` for a negative or infinite value.
        """
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"gain '{name}' must be 0 or more, not {value:g}")
        kind, _, actuator = name.partition(".")
        if kind not in ("kp", "ki", "kd") or actuator not in self.actuators:
            raise KeyError(name)
        index = self.actuators.index(actuator)
        if kind == "kp":
            self._gain[index] = value
            self._bias[index, 1] = -value
        elif kind == "kd":
            self._bias[index, 2] = -value
        else:
            self._integral[index] = value
            self._integrates = bool(self._integral.any())
            self._bias[index, 0] = 0.0
        self._write_gains()
