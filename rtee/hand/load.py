"""Loading a hand: from a URDF with or without an SRDF, or from its folder in ``config/``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from rtee.errors import ModelError, UnknownActuator
from rtee.hand.discovery import discover_fingers
from rtee.hand.fingers import Chain, check_srdf, fingers_of
from rtee.hand.model import Finger, Hand, Joint, JointRole
from rtee.hand.names import check_name, safe_name
from rtee.hand.srdf import Srdf, read_srdf
from rtee.hand.transmission import Transmission, make_transmission, sample
from rtee.hand.urdf import Urdf, UrdfJoint, read_urdf
from rtee.types import ActuatorSpec, JointKind, readonly

REST_STATES: Final = ("rest", "open", "home")
"""Names of SRDF group states taken for the rest posture, the first one found."""

ASSUMED_VELOCITY: Final = {JointKind.PRISMATIC: 0.1}
ASSUMED_ANGULAR_VELOCITY: Final = 1.0
ACCELERATION_TIME: Final = 0.1
"""Time in which an actuator reaches its velocity limit [s], where no acceleration is configured."""
JERK_TIME: Final = 0.05
"""Time in which it reaches its acceleration limit [s], where no jerk is configured."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of one actuator that tighten or complete the URDF's; ``None``: as in the URDF.

    Attributes:
        lower: Lower limit [rad | m].
        upper: Upper limit [rad | m].
        velocity: Velocity limit [rad/s | m/s].
        acceleration: Acceleration limit [rad/s² | m/s²].
        jerk: Jerk limit [rad/s³ | m/s³].
        effort: Effort limit [N·m | N].
    """

    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    acceleration: float | None = None
    jerk: float | None = None
    effort: float | None = None


@dataclass(frozen=True, slots=True)
class Overrides:
    """What a configuration adds to the model.

    Attributes:
        name: The hand's name; the robot's in the URDF if ``None``.
        title: Its name for people.
        package_dirs: Folders to look mesh packages up in.
        rest: Rest positions by actuator [rad | m].
        limits: Limits by actuator.
        default_limits: Limits for actuators that have none of their own there.
    """

    name: str | None = None
    title: str = ""
    package_dirs: tuple[Path, ...] = ()
    rest: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, Limits] = field(default_factory=dict)
    default_limits: Limits = field(default_factory=Limits)


def load_model(
    urdf: Path | str,
    srdf: Path | str | None = None,
    *,
    name: str | None = None,
    package_dirs: Sequence[Path | str] = (),
    rest: Mapping[str, float] | None = None,
) -> Hand:
    """Load a hand from its URDF.

    Args:
        urdf: The URDF.
        srdf: The SRDF that names the fingers; without one they are found from the tree.
        name: The hand's name; the robot's in the URDF unless given.
        package_dirs: Folders to look mesh packages up in.
        rest: Rest positions by actuator [rad | m]; they override the SRDF's and 0.

    Raises:
        ModelError: A file cannot be read or does not describe a hand.
        ConfigError: The name is not allowed.
    """
    overrides = Overrides(
        name=name, package_dirs=tuple(Path(p) for p in package_dirs), rest=dict(rest or {})
    )
    return build_hand(read_urdf(urdf), None if srdf is None else read_srdf(srdf), overrides)


def build_hand(urdf: Urdf, srdf: Srdf | None, overrides: Overrides) -> Hand:
    """Make a hand from what was read.

    Raises:
        ModelError: The files do not describe a hand.
        ConfigError: The name is not allowed.
    """
    notes = check_srdf(srdf, urdf) if srdf else []
    passive = {n for n in srdf.passive if urdf.joints[n].moving} if srdf else set()
    joints = tuple(_joint(joint, passive) for joint in urdf.joints.values() if joint.moving)
    driven = [urdf.joints[joint.name] for joint in joints if joint.role is JointRole.ACTUATOR]
    if not driven:
        raise ModelError(
            "no joint is an actuator: every moving joint is mimic or passive, or there is none",
            path=urdf.path,
        )
    _check_names([joint.name for joint in driven], overrides, urdf)
    state = _rest_state(srdf, notes)
    standing = {
        joint.name: _inside(state.get(joint.name, 0.0), joint.lower, joint.upper)
        for joint in joints
        if joint.role is JointRole.PASSIVE
    }
    transmission = make_transmission(urdf, [joint.name for joint in driven], standing)
    specs = [_actuator(joint, overrides, state, urdf, srdf, notes) for joint in driven]
    notes += _images(joints, specs, transmission)
    fingers = _fingers(urdf, srdf, joints, specs, transmission, notes)
    for i, spec in enumerate(specs):
        moved = tuple(f.name for f in fingers if f.tip and spec.name in f.actuators)
        specs[i] = replace(spec, fingers=moved)
    return Hand(
        name=check_name(overrides.name or safe_name(urdf.name), "hand"),
        base=urdf.root,
        joints=joints,
        actuators=tuple(specs),
        fingers=fingers,
        transmission=transmission,
        rest=readonly([spec.rest for spec in specs]),
        urdf=urdf,
        disabled_collisions=tuple((d.link1, d.link2, d.reason) for d in srdf.disabled)
        if srdf
        else (),
        notes=tuple(notes),
        package_dirs=overrides.package_dirs,
        description=overrides.title,
    )


def _check_names(actuators: list[str], overrides: Overrides, urdf: Urdf) -> None:
    for name in (*overrides.rest, *overrides.limits):
        if name not in actuators:
            raise UnknownActuator(name, actuators, path=urdf.path)


def _joint(joint: UrdfJoint, passive: set[str]) -> Joint:
    if joint.mimic is not None:
        role = JointRole.MIMIC
    else:
        role = JointRole.PASSIVE if joint.name in passive else JointRole.ACTUATOR
    return Joint(
        name=joint.name,
        kind=JointKind(joint.kind),
        role=role,
        parent=joint.parent,
        child=joint.child,
        lower=joint.lower,
        upper=joint.upper,
        line=joint.line,
    )


def _rest_state(srdf: Srdf | None, notes: list[str]) -> dict[str, float]:
    """Return the joint positions of the SRDF's rest posture, if it has one."""
    for name in REST_STATES:
        states = [state for state in srdf.states if state.name.lower() == name] if srdf else []
        if states:
            notes.append(f"the rest posture is the SRDF's group_state '{states[0].name}'")
            return {joint: value for state in states for joint, value in state.values.items()}
    return {}


def _inside(value: float, lower: float, upper: float) -> float:
    return min(max(value, lower), upper)


def _actuator(
    joint: UrdfJoint,
    overrides: Overrides,
    state: Mapping[str, float],
    urdf: Urdf,
    srdf: Srdf | None,
    notes: list[str],
) -> ActuatorSpec:
    kind = JointKind(joint.kind)
    own, common = overrides.limits.get(joint.name, Limits()), overrides.default_limits
    lower, upper = _range(joint, own, urdf)
    velocity = _tighter(joint.velocity, own.velocity, common.velocity)
    if velocity <= 0:
        velocity = ASSUMED_VELOCITY.get(kind, ASSUMED_ANGULAR_VELOCITY)
        notes.append(f"actuator '{joint.name}' has no velocity limit; {velocity:g} is assumed")
    acceleration = own.acceleration or common.acceleration or velocity / ACCELERATION_TIME
    jerk = own.jerk or common.jerk or acceleration / JERK_TIME
    effort = _tighter(joint.effort, own.effort, common.effort)
    rest = overrides.rest.get(joint.name, state.get(joint.name))
    if rest is None:
        rest = _inside(0.0, lower, upper)
        if rest:
            notes.append(
                f"actuator '{joint.name}' rests at {rest:g}: 0 lies outside its limits "
                f"{lower:g} … {upper:g}"
            )
    elif not lower <= rest <= upper:
        from_state = joint.name not in overrides.rest
        raise ModelError(
            f"rest position {rest:g} of actuator '{joint.name}' lies outside its limits "
            f"{lower:g} … {upper:g}",
            path=srdf.path if from_state and srdf else urdf.path,
            line=None if from_state else joint.line,
        )
    return ActuatorSpec(
        name=joint.name,
        kind=kind,
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        effort=effort if effort > 0 else math.inf,
        rest=rest,
    )


def _range(joint: UrdfJoint, own: Limits, urdf: Urdf) -> tuple[float, float]:
    """Return the position limits; the configuration may only tighten the URDF's."""
    if joint.lower == joint.upper:
        raise ModelError(
            f"actuator '{joint.name}' has empty limits: lower and upper are both {joint.lower:g}",
            path=urdf.path,
            line=joint.line,
        )
    lower = joint.lower if own.lower is None else max(own.lower, joint.lower)
    upper = joint.upper if own.upper is None else min(own.upper, joint.upper)
    if lower >= upper:
        raise ModelError(
            f"actuator '{joint.name}' has empty limits: {lower:g} … {upper:g}",
            path=urdf.path,
            line=joint.line,
        )
    return lower, upper


def _tighter(model: float, *configured: float | None) -> float:
    """Return the first configured limit, not above the model's where that has one."""
    value = next((v for v in configured if v is not None), None)
    if value is None:
        return model
    return min(value, model) if model > 0 else value


def _images(
    joints: tuple[Joint, ...], specs: Sequence[ActuatorSpec], transmission: Transmission
) -> list[str]:
    """Note the mimic joints that their actuator drives outside their own limits."""
    notes = []
    for joint, coupling in zip(joints, transmission.couplings, strict=True):
        if joint.role is not JointRole.MIMIC or coupling.actuator is None:
            continue
        if joint.kind is JointKind.CONTINUOUS:
            continue
        spec = specs[coupling.actuator]
        image = [coupling.value(q) for q in sample(spec.lower, spec.upper)]
        slack = 1e-3 * (joint.upper - joint.lower)
        if min(image) < joint.lower - slack or max(image) > joint.upper + slack:
            notes.append(
                f"mimic joint '{joint.name}' moves {min(image):.4g} … {max(image):.4g}, outside "
                f"its own limits {joint.lower:.4g} … {joint.upper:.4g}; the actuator's limits count"
            )
    return notes


def _fingers(
    urdf: Urdf,
    srdf: Srdf | None,
    joints: tuple[Joint, ...],
    specs: Sequence[ActuatorSpec],
    transmission: Transmission,
    notes: list[str],
) -> tuple[Finger, ...]:
    chains = fingers_of(srdf, urdf) if srdf else ()
    mover = {joint.name: transmission.moves(i) for i, joint in enumerate(joints)}
    if not chains:
        moved = frozenset(name for name, actuator in mover.items() if actuator is not None)
        chains = discover_fingers(urdf, moved)
        found = "no SRDF was given" if srdf is None else "the SRDF names no finger"
        notes.append(f"{found}; the fingers were found from the tree")
    _check_chains(chains, urdf, srdf)
    tips = {chain.name: chain.tip(urdf) for chain in chains}
    for chain in chains:
        if tips[chain.name] is None:
            notes.append(f"finger '{chain.name}' has no collision geometry: no pinches for it")
    names = [spec.name for spec in specs]
    moving = {
        chain.name: _movers(urdf, tips[chain.name] or chain.links[-1], mover, names)
        for chain in chains
    }
    return tuple(
        Finger(
            name=chain.name,
            base=chain.links[0],
            tip=tips[chain.name],
            links=chain.links,
            actuators=moving[chain.name],
            own=tuple(
                actuator
                for actuator in moving[chain.name]
                if not any(actuator in moving[c.name] for c in chains if c.name != chain.name)
            ),
            reason=chain.reason,
        )
        for chain in chains
    )


def _check_chains(chains: Sequence[Chain], urdf: Urdf, srdf: Srdf | None) -> None:
    path = urdf.path if srdf is None else srdf.path
    tips: dict[str, str] = {}
    for chain in chains:
        check_name(chain.name, "finger", path, chain.line or None)
        tip = chain.tip(urdf)
        if tip is not None and tips.setdefault(tip, chain.name) != chain.name:
            raise ModelError(
                f"fingers '{tips[tip]}' and '{chain.name}' have the same fingertip '{tip}'",
                path=path,
                line=chain.line or None,
            )


def _movers(
    urdf: Urdf, tip: str, mover: Mapping[str, int | None], names: Sequence[str]
) -> tuple[str, ...]:
    """Return the actuators that move a link, nearest the root first.

    An actuator stands where its own joint stands on the way to the link, or else where the first
    joint that follows it does.
    """
    place: dict[str, int] = {}
    for position, joint in enumerate(urdf.path_to(tip)):
        index = mover.get(joint.name)
        if index is None:
            continue
        actuator = names[index]
        if actuator == joint.name:
            place[actuator] = position
        else:
            place.setdefault(actuator, position)
    return tuple(sorted(place, key=lambda name: place[name]))
