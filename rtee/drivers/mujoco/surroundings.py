"""The hand's surroundings while it runs: the carrier that moves it, the object, its support."""

from __future__ import annotations

import math
from collections.abc import Collection

import mujoco
import numpy as np

from rtee.drivers.mujoco.model import CARRIER
from rtee.drivers.mujoco.objects import OBJECT, TRIGGER
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.solids import turn_of
from rtee.hand.frames import homogeneous
from rtee.sample import FloatArray

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""The motions a carrier may have, in the order of its script's values."""

TABLE = "table"
"""Name of the table's geom, with which those of what stands on it begin."""

_STANDS_FOR = [50.0] * 3 + [10.0] * 3
"""Force and torque at which an arm yields [N, N·m]: a cobot's collaborative limit, and the same at
a lever of 200 mm."""

_YIELDS = 0.3
"""Share of the excess force to which the arm yields in one step: its servos follow within ms."""

_DRAG = 4.0  # on a held object [N·s/m]: at 50 mm/s it resists with 0.2 N, like a yielding hand
_TURN_DRAG = 0.01  # on its rotation [N·m·s/rad]: the same drag at a lever of 50 mm
_CONFIRM = 0.3  # a touch this long is a grasp and not a first impact [s]
_LINKS = 2  # this many links can hold an object between them; one can only push it


def pose_vector(pose: FloatArray) -> FloatArray:
    """Return a pose ``(4, 4)`` as position and unit quaternion (w, x, y, z) ``(7,)``."""
    vector = np.zeros(7)
    vector[:3] = pose[:3, 3]
    mujoco.mju_mat2Quat(vector[3:], np.ascontiguousarray(pose[:3, :3]).ravel())
    return vector


class Surroundings:
    """The carrier, the object and its support.

    An object that is *held* is weightless and moves against a drag, as if a yielding hand presented
    it; it is let go when two links have touched it for a while, or by `remove_support`.

    Attributes:
        has_object: Whether there is an object.
        unsupported: Whether the object bears its own weight.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, options: SimOptions) -> None:
        self._model, self._data = model, data
        self._support = options.support
        self._carrier = int(model.body(CARRIER).id)
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, OBJECT)
        self.has_object = joint >= 0
        self.unsupported = not self.has_object or options.support == "table"
        self._ground = [g for g in range(model.ngeom) if model.geom(g).name.startswith(TABLE)]
        self._motors = [
            mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, f"{CARRIER}/{axis}")
            for axis in AXES
        ]
        self._wanted = [0.0] * len(AXES)
        self._yielded = [0.0] * len(AXES)
        self._axes = [
            (axis, int(model.jnt_dofadr[model.actuator_trnid[motor, 0]]), motor)
            for axis, motor in enumerate(self._motors)
            if motor >= 0
        ]
        self._dofs = np.array([dof for _, dof, _ in self._axes], dtype=int)
        # Views of the state, kept because MuJoCo makes a new one at each access.
        self._pushing, self._control = data.qfrc_constraint, data.ctrl
        self._touched = 0.0
        self._last = 0.0
        if self.has_object:
            self._body = int(model.body(OBJECT).id)
            self._qpos = int(model.jnt_qposadr[joint])
            self._dof = int(model.jnt_dofadr[joint])
            self._start = np.array(model.qpos0[self._qpos : self._qpos + 7])
            self._parts = [
                body for body in range(model.nbody) if model.body_rootid[body] == self._body
            ]
            self._is_part = np.isin(model.geom_bodyid, self._parts).tolist()
            names = [model.body(int(body)).name for body in model.geom_bodyid]
            # The link of each geom; empty if it does not belong to the hand.
            self._link = [
                name.removeprefix(LINK) if name.startswith(LINK) else "" for name in names
            ]
        trigger = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, TRIGGER)
        self._trigger = int(model.jnt_qposadr[trigger]) if trigger >= 0 else -1

    def reset(self) -> None:
        """Put the object where it began and hold it again."""
        self._touched = self._last = 0.0
        self._yielded, self._wanted = [0.0] * len(AXES), [0.0] * len(AXES)
        if self.has_object:
            self._data.qpos[self._qpos : self._qpos + 7] = self._start
            self._hold(self._support != "table")

    def place(self, pose: FloatArray) -> None:
        """Put the object at a pose ``(4, 4)`` in the world, to which `reset` returns it."""
        self._start = pose_vector(pose)
        self._data.qpos[self._qpos : self._qpos + 7] = self._start
        self._data.qvel[self._dof : self._dof + 6] = 0.0

    def remove_support(self) -> None:
        """Let go of the object: from now on it bears its own weight."""
        if self.has_object and not self.unsupported:
            self._hold(False)

    def _hold(self, on: bool) -> None:
        self.unsupported = not on
        drag = [_DRAG] * 3 + [_TURN_DRAG] * 3 if on else 0.0
        self._model.dof_damping[self._dof : self._dof + 6] = drag
        # MuJoCo compensates the weight of each body separately, so of the trigger, too.
        self._model.body_gravcomp[self._parts] = 1.0 if on else 0.0

    def watch(self, time: float) -> None:
        """Let go of a held object that two links have touched for a while; simulated time [s].

        Also let the arm yield to forces on the hand.
        """
        self._yield_to_force()
        elapsed, self._last = time - self._last, time
        if self.unsupported or self._support == "floating":
            return
        self._touched = self._touched + elapsed if len(self.touching()) >= _LINKS else 0.0
        if self._touched >= _CONFIRM:
            self.remove_support()

    def _yield_to_force(self) -> None:
        """Let the carrier's set-points yield to a force that is too large, and return after it."""
        # The forces of contacts along the axes; forces inside the hand cancel out.
        forces = self._pushing.take(self._dofs).tolist()
        for (axis, _, motor), force in zip(self._axes, forces, strict=True):
            most, gave = _STANDS_FOR[axis], self._yielded[axis]
            if not gave and -most <= force <= most:
                continue
            # Below the limit, its unused part drives the arm back to where it came from.
            over = force - math.copysign(most, force if abs(force) > most else gave)
            step = _YIELDS * over / float(self._model.actuator_gainprm[motor, 0])
            after = gave + step
            # It returns to its set-point, and no farther.
            self._yielded[axis] = after if abs(force) > most or after * gave > 0.0 else 0.0
            self._control[motor] = self._wanted[axis] + self._yielded[axis]

    @property
    def on_table(self) -> bool:
        """Whether the object touches the table, or a container on it."""
        if not self._ground or not self.has_object:
            return False
        geoms = self._data.contact.geom
        ground = np.isin(geoms, self._ground)
        parts = np.isin(self._model.geom_bodyid[geoms], self._parts)
        return bool((ground[:, ::-1] & parts).any())

    def pressing(self, holding: Collection[str] | None = None) -> float:
        """Return the largest force of the hand on anything it should not touch [N].

        Args:
            holding: The links that may touch the object; all unless given. None may touch the table
                or the container.
        """
        if not self.has_object or not len(self._data.contact.geom):
            return 0.0
        forces: dict[tuple[str, bool], float] = {}
        for number, geoms in enumerate(self._data.contact.geom.tolist()):
            for one, other in (geoms, geoms[::-1]):
                link, on_object = self._link[one], self._is_part[other]
                wrong = other in self._ground or (
                    on_object and holding is not None and link not in holding
                )
                # Contacts that are only within the margin have no force.
                row = int(self._data.contact.efc_address[number])
                if link and wrong and row >= 0:
                    key = link, on_object
                    forces[key] = forces.get(key, 0.0) + float(self._data.efc_force[row])
        return max(forces.values(), default=0.0)

    @property
    def speed(self) -> float:
        """Speed of the object's origin [m/s]."""
        return float(np.linalg.norm(self._data.qvel[self._dof : self._dof + 3]))

    @property
    def object_frame(self) -> FloatArray:
        """Pose ``(4, 4)`` of the object in the world."""
        return homogeneous(turn_of(self.pose[3:]), self.pose[:3])

    def touching(self) -> tuple[str, ...]:
        """Return the names of the links that touch the object, sorted."""
        if not self.has_object:
            return ()
        return tuple(sorted({self._link[geom] for geom, _ in self._met(self._data)}))

    def _met(self, data: mujoco.MjData) -> list[tuple[int, int]]:
        """Return the geom of the hand and the number of each of its contacts with the object."""
        is_part, link = self._is_part, self._link
        touching = []
        for number, (one, other) in enumerate(data.contact.geom.tolist()):
            if is_part[one] and link[other]:
                touching.append((other, number))
            elif is_part[other] and link[one]:
                touching.append((one, number))
        return touching

    def depth_at(self, data: mujoco.MjData, pose: FloatArray) -> float:
        """Return how deep links would reach into the object at a pose ``(4, 4)`` in the world [m].

        The depth is 0 if no link touches the object. ``data`` is a state of the hand, changed by
        this call; the running state stays as it is.
        """
        data.qpos[self._qpos : self._qpos + 7] = pose_vector(pose)
        # Only what contacts need: a full `mj_forward` takes longer.
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_collision(self._model, data)
        met = self._met(data)
        if not met:
            return 0.0
        # Contacts begin at the surface, which is a skin outside of the shape that MuJoCo knows.
        contact = data.contact
        deep = contact.includemargin - contact.dist
        return max(0.0, *(float(deep[number]) for _, number in met))

    @property
    def pose(self) -> FloatArray:
        """Position and unit quaternion (w, x, y, z) of the object in the world ``(7,)``."""
        return np.array(self._data.qpos[self._qpos : self._qpos + 7], dtype=np.float64)

    @property
    def height(self) -> float:
        """Height of the object's origin in the world [m]."""
        return float(self._data.qpos.item(self._qpos + 2))

    @property
    def lowest(self) -> float:
        """A lower bound of the heights that hand and object reach in the world [m]."""
        return float((self._data.geom_xpos[:, 2] - self._model.geom_rbound).min())

    @property
    def position_in_hand(self) -> FloatArray:
        """Position of the object's origin in the hand's base frame ``(3,)`` [m]."""
        turn = self._data.xmat[self._carrier].reshape(3, 3)
        return np.asarray(turn.T @ (self.pose[:3] - self._data.xpos[self._carrier]))

    @property
    def base_pose(self) -> FloatArray:
        """Pose of the hand's base frame in the world ``(4, 4)``."""
        pose = np.eye(4)
        pose[:3, :3] = self._data.xmat[self._carrier].reshape(3, 3)
        pose[:3, 3] = self._data.xpos[self._carrier]
        return pose

    @property
    def trigger(self) -> float:
        """How far the object's trigger is pressed [m]; 0 when it has none."""
        return 0.0 if self._trigger < 0 else float(self._data.qpos[self._trigger])

    def carry(self, pose: FloatArray) -> None:
        """Set the carrier's target ``(6,)``: x, y, z [m], roll, pitch, yaw [rad] from the start.

        Motions that the carrier does not have are ignored.
        """
        self._wanted = pose.tolist()
        for axis, _, motor in self._axes:
            self._control[motor] = self._wanted[axis] + self._yielded[axis]

    def jump(self, pose: FloatArray) -> None:
        """Put the carrier where `carry` would send it, at once and at rest."""
        self.carry(pose)
        for axis, value in zip(AXES, pose, strict=True):
            joint = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_JOINT, f"{CARRIER}/{axis}")
            if joint >= 0:
                self._data.qpos[self._model.jnt_qposadr[joint]] = value
                self._data.qvel[self._model.jnt_dofadr[joint]] = 0.0
        mujoco.mj_forward(self._model, self._data)
