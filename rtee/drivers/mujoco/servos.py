"""The motors: position servos with effort limits, friction and the inertia of motor and gear.

Values under ``dynamics`` in hand.yaml take precedence. The others are derived from the effort
limit, which every data sheet has, for a servo that reaches it at a small position error and follows
with a usual bandwidth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco

from rtee.drivers.mujoco.options import JOINT_DAMPING, JOINT_FRICTION, MISSING_EFFORT, SimOptions
from rtee.hand.config_schema import ActuatorDynamics
from rtee.hand.inertia import PRISMATIC, gain_of, inertia_of
from rtee.hand.model import Hand
from rtee.types import ActuatorSpec, JointKind

_LINEAR_EFFORT = 100.0
"""Factor of a missing effort limit in N for one in N·m: the force at a lever of 10 mm."""


@dataclass(frozen=True, slots=True)
class Servo:
    """A motor with its servo.

    Attributes:
        actuator: Name of the actuator.
        limit: Effort limit [N·m | N].
        kp: Position gain [N·m/rad | N/m].
        kd: Damping gain [N·m·s/rad | N·s/m]; ``None``: critical damping.
        ki: Integral gain [N·m/(rad·s) | N/(m·s)].
        armature: Inertia of motor and gear at the joint [kg·m² | kg].
        damping: Viscous friction [N·m·s/rad | N·s/m].
        friction: Dry friction [N·m | N].
        derived: Which of these are derived, by name.
    """

    actuator: str
    limit: float
    kp: float
    kd: float | None
    ki: float
    armature: float
    damping: float
    friction: float
    derived: tuple[str, ...]

    @property
    def note(self) -> str:
        """The derived values, in words; empty if there are none."""
        if not self.derived:
            return ""
        numbers = {"kp": self.kp, "armature": self.armature}
        numbers |= {"damping": self.damping, "dry friction": self.friction}
        words = [f"{n} {numbers[n]:.3g}" if n in numbers else n for n in self.derived]
        return f"actuator '{self.actuator}': {', '.join(words)} derived"


def servo_of(hand: Hand, actuator: ActuatorSpec, options: SimOptions) -> Servo:
    """Return the servo of an actuator, with known values and those derived from them."""
    known = hand.dynamics.get(actuator.name, ActuatorDynamics())
    slide = actuator.kind is JointKind.PRISMATIC
    unit = PRISMATIC if slide else 1.0
    derived = []
    limit = actuator.effort if math.isfinite(actuator.effort) else _assumed(actuator)
    kp = known.kp
    if kp is None:
        kp = gain_of(actuator, limit, options.stiffness)
        derived.append("kp")
    if known.kd is None:
        derived.append("critical damping")
    if known.armature is None:
        derived.append("armature")
    armature = inertia_of(actuator, limit, known, kp, options.bandwidth, options.armature)
    damping = known.damping
    if damping is None:
        damping = JOINT_DAMPING * unit
        derived.append("damping")
    friction = known.dry_friction
    if friction is None:
        friction = JOINT_FRICTION * limit
        derived.append("dry friction")
    return Servo(
        actuator.name, limit, kp, known.kd, known.ki or 0.0, armature, damping, friction,
        tuple(derived),
    )  # fmt: skip


def _assumed(actuator: ActuatorSpec) -> float:
    """Return the effort limit of an actuator for which the model states none [N·m | N]."""
    return MISSING_EFFORT * (_LINEAR_EFFORT if actuator.kind is JointKind.PRISMATIC else 1.0)


def effort_note(hand: Hand) -> list[str]:
    """Return a note on the actuators whose effort limit is assumed: forces follow from it."""
    lacking = [each for each in hand.actuators if not math.isfinite(each.effort)]
    if not lacking:
        return []
    limits = dict.fromkeys(
        f"{_assumed(each):g} {'N' if each.kind is JointKind.PRISMATIC else 'N·m'}"
        for each in lacking
    )
    several, are = len(lacking) > 1, "are" if len(limits) > 1 else "is"
    where = "hand.yaml" if hand.folder is None else hand.folder / "hand.yaml"
    return [
        f"no effort limit for actuator{'s' * several} {', '.join(each.name for each in lacking)}; "
        f"{' and '.join(limits)} {are} assumed, so grasp forces differ from those of the hand; "
        f"state {'each' if several else 'it'} under limits: in {where}, as "
        f"{lacking[0].name}: {{effort: …}}"
    ]


def add_motor(spec: mujoco.MjSpec, servo: Servo, joint: str) -> None:
    """Add the actuator by which a servo moves a joint of a model."""
    motor = spec.add_actuator(name=servo.actuator, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    if servo.kd is None:
        motor.set_to_position(kp=servo.kp, dampratio=1.0)
    else:
        motor.set_to_position(kp=servo.kp, kv=servo.kd)
    motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    motor.forcerange = [-servo.limit, servo.limit]
