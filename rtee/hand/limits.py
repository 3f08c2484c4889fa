"""Limits and rest positions of actuators: from the URDF, tightened by a configuration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rtee.errors import UserError
from rtee.hand.config import DEFAULTS, HandConfig
from rtee.hand.config_schema import ActuatorLimits, PositionRange
from rtee.hand.model import Joint, JointRole
from rtee.hand.srdf import Srdf
from rtee.hand.transmission import Transmission, sample
from rtee.hand.urdf import Urdf, UrdfJoint
from rtee.types import ActuatorSpec, JointKind, Mechanism

REST_STATES: Final = ("rest", "open", "home")
"""Names of SRDF group states for the rest posture; the first one found is used."""

ACCELERATION_TIME: Final = 0.1
"""Time in which an actuator reaches its velocity limit if no acceleration is configured [s]: quick,
yet gentle enough for the gears of small hands."""

JERK_TIME: Final = 0.05
"""Time in which it reaches its acceleration limit if no jerk is configured [s]: half of the above,
for smooth motions."""

# Assumed velocity limit by the kind of joint [rad/s | m/s]: slow enough to watch and to stop by
# hand.
_ASSUMED_VELOCITY: Final = {
    JointKind.REVOLUTE: 1.0,
    JointKind.CONTINUOUS: 1.0,
    JointKind.PRISMATIC: 0.1,
}

_MANY_TURNS: Final = 4.0 * math.pi
"""Range of a revolute joint that is likely meant in degrees [rad]: no finger turns twice."""

_LONG_WAY: Final = 1.0
"""Range of a prismatic joint that is likely meant in millimetres [m]: no jaw slides as far."""


@dataclass(frozen=True, slots=True)
class Overrides:
    """The part of a configuration that adds to the model.

    Attributes:
        config: What hand.yaml says, or the defaults for a hand without one.
        name: The hand's name; if ``None``, the robot's name in the URDF.
        package_dirs: Folders in which to look up mesh packages.
        passive: Joints without a motor, in addition to those of the SRDF.
        error: Makes the error for a value of the configuration, from its place and a message.
    """

    config: HandConfig
    name: str | None = None
    package_dirs: tuple[Path, ...] = ()
    passive: frozenset[str] = frozenset()
    error: Callable[[tuple[str | int, ...], str], UserError] | None = None

    def refusal(self, place: tuple[str | int, ...], what: str, urdf: Urdf) -> UserError:
        """Return the error for a configured value, with its line if it is in a file."""
        if self.error is not None:
            return self.error(place, what)
        return urdf.error(f"{'.'.join(map(str, place))}: {what}")


def rest_state(srdf: Srdf | None) -> tuple[str, dict[str, float]]:
    """Return the name and the joint positions of the SRDF's rest posture, if it has one."""
    for name in REST_STATES:
        states = [state for state in srdf.states if state.name.lower() == name] if srdf else []
        if states:
            # A group_state belongs to one group, so a hand's posture may be split into several.
            values = {joint: value for state in states for joint, value in state.values.items()}
            return states[0].name, values
    return "", {}


def clamped(value: float, lower: float, upper: float) -> float:
    """Return a value clamped into a range."""
    return min(max(value, lower), upper)


def actuator_spec(
    joint: UrdfJoint, urdf: Urdf, state: Mapping[str, float], overrides: Overrides
) -> tuple[ActuatorSpec, list[str]]:
    """Return an actuator's limits and rest position; ``state`` is the SRDF's rest [rad | m].

    Returns:
        The actuator, without its fingers, and a sentence for each assumption.

    Raises:
        UserError: if its limits are empty or wider than the URDF's, or it rests outside them.
    """
    reader = _LimitReader(joint, urdf, overrides)
    lower, upper = reader.range()
    velocity, effort = reader.tighter("velocity"), reader.tighter("effort")
    notes = []
    if velocity <= 0:
        # 0 means "not given" in a URDF; the limiter needs a number, and a small one is safe.
        velocity = _ASSUMED_VELOCITY[JointKind(joint.kind)]
    if joint.kind == "revolute" and upper - lower > _MANY_TURNS:
        notes.append(
            f"actuator '{joint.name}' goes from {lower:g} to {upper:g} rad, "
            f"{(upper - lower) / math.tau:.1f} turns; are its limits in degrees? URDFs have radians"
        )
    if joint.kind == "prismatic" and upper - lower > _LONG_WAY:
        notes.append(
            f"actuator '{joint.name}' goes from {lower:g} to {upper:g} m; are its limits in "
            "millimetres? URDFs have metres"
        )
    acceleration = reader.tighter("acceleration") or velocity / ACCELERATION_TIME
    rest = reader.rest(state, lower, upper)
    if rest is not None and rest != clamped(rest, lower, upper):
        notes.append(
            f"actuator '{joint.name}': the SRDF's rest position {rest:g} lies beyond the soft "
            f"limits {lower:g} … {upper:g}; it rests at {clamped(rest, lower, upper):g}"
        )
        rest = clamped(rest, lower, upper)
    if rest is None:
        rest = clamped(0.0, lower, upper)
        if rest:
            notes.append(
                f"actuator '{joint.name}' rests at {rest:g}: 0 lies outside its limits "
                f"{lower:g} … {upper:g}"
            )
    spec = ActuatorSpec(
        name=joint.name,
        kind=JointKind(joint.kind),
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
        jerk=reader.tighter("jerk") or acceleration / JERK_TIME,
        # 0 means "not given", as above; without a limit, only that of the device applies.
        effort=effort if effort > 0 else math.inf,
        rest=rest,
    )
    return spec, notes


def mechanism(actuator: ActuatorSpec, urdf: Urdf) -> Mechanism:
    """Return what an actuator can do by the model, without the limits of hand.yaml."""
    joint = urdf.joints[actuator.name]
    # What the URDF does not give, hand.yaml completes instead of tightening it: the ends of a
    # continuous joint, and an effort of 0.
    limited = math.isfinite(joint.upper - joint.lower)
    lower, upper = (joint.lower, joint.upper) if limited else (actuator.lower, actuator.upper)
    return Mechanism(lower, upper, joint.effort or actuator.effort)


class _LimitReader:
    """Reads the values of one actuator; the configuration may only tighten the URDF's."""

    def __init__(self, joint: UrdfJoint, urdf: Urdf, overrides: Overrides) -> None:
        self.joint = joint
        self.urdf = urdf
        self.overrides = overrides
        self.usual = overrides.config.limits.get(DEFAULTS, ActuatorLimits())
        self.own = overrides.config.limits.get(joint.name, ActuatorLimits())

    def configured(self, key: str) -> Any:
        own, common = getattr(self.own, key), getattr(self.usual, key)
        return common if own is None else own

    def soft(self) -> tuple[float, float] | None:
        """Return the soft position limits if they hold [rad | m]."""
        hard = self.configured("range") is PositionRange.HARD
        return None if hard else self.joint.soft

    def range(self) -> tuple[float, float]:
        """Return the position limits [rad | m]."""
        joint = self.joint
        if joint.lower == joint.upper:
            what = f"empty limits: lower and upper are both {joint.lower:g}"
            remedy = 'give it the range of the real joint, or type="fixed"'
            raise self.urdf.error(f"actuator '{joint.name}' has {what}; {remedy}", joint.line)
        lower, upper = least, most = self.soft() or (joint.lower, joint.upper)
        for key in ("lower", "upper"):
            value: float | None = getattr(self.own, key)
            if value is None:
                continue
            if not least <= value <= most:
                soft = joint.lower <= value <= joint.upper
                raise self.error(
                    ("limits", joint.name, key),
                    f"{value:g} is outside the URDF's {'soft ' if soft else ''}limits "
                    f"{least:g} … {most:g}" + ("; `range: hard` takes the hard ones" * soft),
                )
            lower, upper = (value, upper) if key == "lower" else (lower, value)
        if lower >= upper:
            raise self.error(
                ("limits", joint.name),
                f"the lower limit {lower:g} is not below the upper limit {upper:g}",
            )
        return lower, upper

    def tighter(self, key: str) -> float:
        """Return the limit of a quantity; 0 if neither URDF nor configuration has one."""
        model: float = getattr(self.joint, key)
        own: float | None = getattr(self.own, key)
        # Only the value for this actuator is refused; a default for all is lowered.
        if own is not None and 0 < model < own:
            raise self.error(
                ("limits", self.joint.name, key),
                f"{own:g} is above the URDF's {key} limit {model:g}",
            )
        value: float | None = self.configured(key)
        if value is None:
            return model
        return min(value, model) if model > 0 else value

    def rest(self, state: Mapping[str, float], lower: float, upper: float) -> float | None:
        """Return the rest position given for the actuator, if there is one [rad | m].

        The SRDF's may lie between the soft and the hard limits.
        """
        name = self.joint.name
        configured = self.overrides.config.rest.get(name)
        value = state.get(name) if configured is None else configured
        if value is None or lower <= value <= upper:
            return value
        if configured is None and self.soft() and self.joint.lower <= value <= self.joint.upper:
            return value
        message = f"rest position {value:g} lies outside the limits {lower:g} … {upper:g}"
        # The SRDF is wrong, not hand.yaml, so the error names the model's file.
        if configured is None:
            raise self.urdf.error(f"actuator '{name}': the SRDF's {message}", self.joint.line)
        raise self.error(("rest", name), message)

    def error(self, location: tuple[str, ...], message: str) -> UserError:
        """Return an error with the place in the configuration, or else that of the joint."""
        if self.overrides.error is not None:
            return self.overrides.error(location, message)
        return self.urdf.error(f"actuator '{self.joint.name}': {message}", self.joint.line)


def standing_position(
    joint: UrdfJoint, urdf: Urdf, state: Mapping[str, float], overrides: Overrides
) -> float:
    """Return the position of a joint that no actuator moves [rad | m].

    Raises:
        UserError: if its configured rest position is outside its limits.
    """
    if joint.name in overrides.config.ignore or joint.name in overrides.config.rest:
        rest = _LimitReader(joint, urdf, overrides).rest(state, joint.lower, joint.upper)
        if rest is not None:
            return rest
    # Without a motor, springs and weight determine its position; rest is the best guess.
    return clamped(state.get(joint.name, 0.0), joint.lower, joint.upper)


def soft_notes(joints: Sequence[UrdfJoint], urdf: Urdf, overrides: Overrides) -> list[str]:
    """Return a note on the actuators whose soft limits hold."""
    soft = {joint.name: _LimitReader(joint, urdf, overrides).soft() for joint in joints}
    held = [
        f"'{joint.name}' {limits[0]:g} … {limits[1]:g} within {joint.lower:g} … {joint.upper:g}"
        for joint in joints
        if (limits := soft[joint.name]) is not None
    ]
    if not held:
        return []
    return [
        f"the soft limits of <safety_controller> hold: {', '.join(held)}; "
        "'limits: {defaults: {range: hard}}' in hand.yaml takes the hard ones"
    ]


def velocity_note(joints: Sequence[UrdfJoint], urdf: Urdf, overrides: Overrides) -> list[str]:
    """Return a note on the actuators whose velocity limit is assumed."""
    lacking = [j for j in joints if _LimitReader(j, urdf, overrides).tighter("velocity") <= 0]
    if not lacking:
        return []
    kinds = [JointKind(joint.kind) for joint in lacking]
    speeds = dict.fromkeys(
        f"{_ASSUMED_VELOCITY[kind]:g} {'m/s' if kind is JointKind.PRISMATIC else 'rad/s'}"
        for kind in kinds
    )
    assumed = " and ".join(speeds)
    more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
    return [
        f"no velocity limit for actuator '{lacking[0].name}'{more}; {assumed} is assumed, "
        "unless hand.yaml has limits:"
    ]


def rest_note(
    name: str, state: Mapping[str, float], actuators: Sequence[str], overrides: Overrides
) -> list[str]:
    """Return a note if the rest posture comes from the SRDF, at least in part."""
    taken = [actuator for actuator in actuators if actuator in state]
    own = [actuator for actuator in taken if actuator in overrides.config.rest]
    if not name or (own and len(own) == len(taken)):
        return []
    but = f", but for {', '.join(own)}, which the configuration sets" if own else ""
    return [f"the rest posture is the SRDF's group_state '{name}'{but}"]


def images_outside(
    joints: Sequence[Joint], specs: Sequence[ActuatorSpec], transmission: Transmission
) -> list[str]:
    """Return notes on mimic joints that exceed their limits when their actuator moves."""
    notes = []
    for joint, coupling in zip(joints, transmission.couplings, strict=True):
        if joint.role is not JointRole.MIMIC or coupling.actuator is None:
            continue
        spec = specs[coupling.actuator]
        image = [coupling.value(q) for q in sample(spec.lower, spec.upper)]
        # A thousandth of the range, the effect of rounded numbers in a URDF.
        slack = 1e-3 * (joint.upper - joint.lower)
        if min(image) < joint.lower - slack or max(image) > joint.upper + slack:
            notes.append(
                f"mimic joint '{joint.name}' moves {min(image):.4g} … {max(image):.4g}, outside "
                f"its own limits {joint.lower:.4g} … {joint.upper:.4g}; the actuator's limits count"
            )
    return notes
