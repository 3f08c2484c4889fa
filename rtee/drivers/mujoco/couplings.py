"""The transmission in MuJoCo: joints that follow their actuator rigidly, or through springs.

A rigid coupling is an equality constraint. A joint on a spring is coupled by a tendon with
stiffness and damping, which pulls it to the position that its coupling prescribes. With a tendon of
the transmission, a further equality keeps the actuator at the weighted mean of its joints, so that
they share its effort: when one joint is stopped, the others move on, ahead of the actuator and
against the springs, which preserve the shape of the fingers. With linkages, there is such an
equality for each finger: joints of one finger give way to one another, but no finger gives way to
another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from rtee.drivers.mujoco.options import PASSIVE_STIFFNESS, SimOptions
from rtee.drivers.mujoco.servos import Servo
from rtee.errors import ModelError
from rtee.hand.config_schema import ActuatorDynamics, Following
from rtee.hand.inertia import PRISMATIC
from rtee.hand.model import Hand, JointRole
from rtee.hand.transmission import Coupling, sample
from rtee.hand.urdf import UrdfJoint
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, JointKind

DEGREE = 4
"""Degree of a joint equality's polynomial in MuJoCo."""

GIVE: Final = 0.4
"""How far a joint on a spring yields to its part of the full effort [rad]: enough to wrap objects,
and little enough to pinch without bending back."""

_LINEAR_GIVE = 0.01
"""Metres by which a prismatic joint yields where a rotary one yields by 1 rad."""

SAMPLES: Final = 201
"""Number of points at which a coupling is fitted, compared and tabulated: 200 equal steps."""

# Range that is fitted for an actuator without limits, to both sides [rad].
_CONTINUOUS_SPAN = math.pi

_SOLREF = [0.005, 1.0]
"""Time constant [s] and damping ratio of a rigid coupling."""

_SOLIMP = [0.95, 0.99, 0.001, 0.5, 2.0]
"""Impedance of a rigid coupling: hardly any play."""

_EXACT = 1e-6
"""Error of a polynomial [rad or m] below which it counts as the coupling itself."""

_LEAST_SLOPE = 1e-3
"""Least sum of shares times slopes, relative to the shares, for which effort is distributed: below
it the joints hardly move with the actuator and would get immense torques."""


def fit(coupling: Coupling, lower: float, upper: float) -> tuple[tuple[float, ...], float]:
    """Fit a polynomial to a coupling over an actuator's range [rad | m].

    Chebyshev nodes make the least-squares fit nearly minimax.

    Returns:
        Coefficients ``c₀ … c₄`` and the largest deviation [rad | m] on a dense grid.
    """
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    nodes = middle + half * np.cos(np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES)
    degree = 1 if coupling.linear else DEGREE
    values = np.array([coupling.value(float(u)) for u in nodes])
    # Fitted in a variable scaled to the range, which conditions it well; only the result is
    # converted to powers of u.
    polynomial = np.polynomial.Polynomial.fit(nodes, values, degree, domain=[lower, upper])
    grid = np.linspace(lower, upper, SAMPLES)
    truth = np.array([coupling.value(float(u)) for u in grid])
    error = float(np.abs(polynomial(grid) - truth).max())
    coefficients = np.zeros(DEGREE + 1)
    monomials = polynomial.convert().coef
    coefficients[: len(monomials)] = monomials
    return tuple(float(c) for c in coefficients), error


def motor_joint(hand: Hand, actuator: str) -> str:
    """Return the joint that an actuator's motor moves in the model.

    It is the actuator's own joint, unless that joint is on a spring: then it is one that the model
    adds.
    """
    known = hand.dynamics.get(actuator)
    apart = known is not None and actuator in (known.joints or ())
    return f"motor/{actuator}" if apart else actuator


def coupling_name(joint: str) -> str:
    """Return the name of the equality, or the tendon, that couples a joint to its actuator."""
    return f"coupling/{joint}"


def tendon_name(actuator: str, finger: str = "") -> str:
    """Return the name of the tendon, and the equality, that shares an actuator's effort.

    The joints of a finger share the effort; without a finger, all joints do.
    """
    return f"tendon/{actuator}/{finger}" if finger else f"tendon/{actuator}"


@dataclass(frozen=True, slots=True)
class Follower:
    """A joint that follows an actuator.

    Attributes:
        joint: Its name.
        coupling: How it follows.
        master: A joint on a spring that it follows instead, rigidly and linearly; or ``None``.
        elastic: Whether it follows by a spring.
    """

    joint: str
    actuator: ActuatorSpec
    coupling: Coupling
    master: str | None
    elastic: bool


def followers(hand: Hand) -> list[Follower]:
    """Return all joints that are coupled to an actuator, in the hand's order.

    An actuator's own joint is among them only if it is on a spring.
    """
    joints = []
    for joint, coupling in zip(hand.joints, hand.transmission.couplings, strict=True):
        if joint.role is JointRole.IGNORED or coupling.actuator is None:
            continue
        actuator = hand.actuators[coupling.actuator]
        elastic = hand.dynamics.get(actuator.name, ActuatorDynamics()).joints or ()
        if joint.name == actuator.name and joint.name not in elastic:
            continue
        mimic = hand.urdf.joints[joint.name].mimic
        linear = mimic is not None and mimic.expression is None
        master = mimic.of if mimic is not None and linear and mimic.of in elastic else None
        own = joint.name in elastic
        joints.append(Follower(joint.name, actuator, coupling, None if own else master, own))
    return joints


def on_spring(hand: Hand, joint: str) -> bool:
    """Return whether a joint follows its actuator by a spring."""
    return any(joint in (known.joints or ()) for known in hand.dynamics.values())


def reach(hand: Hand, joint: UrdfJoint) -> tuple[float, float]:
    """Return the limits of a joint [rad | m], widened to all positions that its coupling gives."""
    coupling = hand.transmission.couplings[hand.joint_index(joint.name)]
    if coupling.actuator is None:
        return joint.lower, joint.upper
    ends = [coupling.value(u) for u in sample(*span(hand.actuators[coupling.actuator]))]
    return min(joint.lower, *ends), max(joint.upper, *ends)


def add_couplings(
    spec: mujoco.MjSpec, hand: Hand, servos: Mapping[str, Servo], options: SimOptions
) -> list[str]:
    """Couple the joints of a model as the transmission does; returns the assumptions made."""
    notes: list[str] = []
    every = followers(hand)
    for follower in every:
        if follower.elastic:
            continue
        if follower.master is not None:
            mimic = hand.urdf.joints[follower.joint].mimic
            assert mimic is not None  # noqa: S101 - narrows the type
            line = (mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0)
            _add_equality(spec, follower.joint, follower.master, line)
            continue
        lower, upper = span(follower.actuator)
        data, error = fit(follower.coupling, lower, upper)
        motor = motor_joint(hand, follower.actuator.name)
        _add_equality(spec, follower.joint, motor, data)
        if error > _EXACT:
            notes.append(
                f"joint '{follower.joint}' follows '{follower.actuator.name}' by a curve; its "
                f"tangent is updated at every exchange (a single polynomial would be up to "
                f"{error:.2g} off)"
            )
    for actuator in hand.actuators:
        on_springs = [f for f in every if f.elastic and f.actuator.name == actuator.name]
        if on_springs:
            notes.append(_add_springs(spec, hand, on_springs, servos[actuator.name], options))
    return notes


def span(actuator: ActuatorSpec) -> tuple[float, float]:
    """Return the range of an actuator over which couplings are fitted [rad | m]."""
    lower = actuator.lower if math.isfinite(actuator.lower) else -_CONTINUOUS_SPAN
    upper = actuator.upper if math.isfinite(actuator.upper) else _CONTINUOUS_SPAN
    return lower, upper


def _add_equality(
    spec: mujoco.MjSpec, joint: str, master: str | None, data: tuple[float, ...]
) -> None:
    equality = spec.add_equality(
        name=coupling_name(joint),
        name1=joint,
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
    )
    if master is not None:
        equality.name2 = master
    equality.data[:5] = data
    equality.solref, equality.solimp = _SOLREF, _SOLIMP


def add_locks(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Hold the ignored joints where they are."""
    for joint, coupling in zip(hand.joints, hand.transmission.couplings, strict=True):
        if joint.role is JointRole.IGNORED:
            _add_equality(spec, joint.name, None, (coupling.value(0.0), 0.0, 0.0, 0.0, 0.0))


def shares_of(known: ActuatorDynamics, of: Sequence[int] = ()) -> FloatArray | None:
    """Return the ratios of the joints' torques in hand.yaml ``(k,)``; ``None`` if it has none.

    ``of`` has the indices of the joints among those that ``known`` lists; by default all.
    """
    if known.shares is None:
        return None
    weights = np.array(list(known.shares.values()))
    return weights[list(of)] if of else weights


def distributed(slopes: FloatArray, weights: FloatArray | None) -> FloatArray | None:
    """Return the torque at each joint ``(k,)`` per unit of the actuator's torque; no work is lost.

    Unless hand.yaml gives their ratios as weights ``(k,)``, the torques are proportional to the
    joints' slopes, as with pulleys whose radii are proportional to the slopes. The result is
    ``None`` if the joints do not move with the actuator.
    """
    # Not numpy.linalg.norm, which takes longer than all the rest for so few numbers.
    if weights is None:
        weights, total = slopes, float(slopes @ slopes)
        size = math.sqrt(total)
    else:
        total, size = float(weights @ slopes), math.sqrt(weights @ weights)
    if abs(total) < _LEAST_SLOPE * size:
        return None
    return weights / total


def tendons_of(
    hand: Hand, actuator: str, joints: Sequence[str], known: ActuatorDynamics
) -> list[tuple[str, list[int]]]:
    """Return the tendons of an actuator, each with the indices of its joints in ``joints``."""
    if known.coupling is Following.TENDON:
        return [(tendon_name(actuator), list(range(len(joints))))]
    if known.coupling is not Following.LINKAGE:
        return []
    found: dict[str, list[int]] = {}
    for number, joint in enumerate(joints):
        child = hand.urdf.joints[joint].child
        # A joint that belongs to no finger has a linkage of its own.
        finger = next((f.name for f in hand.fingers if child in f.links), joint)
        found.setdefault(finger, []).append(number)
    return [(tendon_name(actuator, finger), numbers) for finger, numbers in found.items()]


def _mean_slope(follower: Follower) -> float:
    lower, upper = span(follower.actuator)
    value = follower.coupling.value
    return (value(upper) - value(lower)) / (upper - lower)


def _add_springs(
    spec: mujoco.MjSpec, hand: Hand, group: list[Follower], servo: Servo, options: SimOptions
) -> str:
    """Couple joints to their actuator by springs, and by its tendon where it has one."""
    known = hand.dynamics[servo.actuator]
    motor = motor_joint(hand, servo.actuator)
    slopes = np.array([_mean_slope(follower) for follower in group])
    shares = distributed(slopes, shares_of(known))
    if shares is None:
        raise _moves_nothing(hand, servo.actuator)
    for follower, slope, share in zip(group, slopes, shares, strict=True):
        slide = hand.joints[hand.joint_index(follower.joint)].kind is JointKind.PRISMATIC
        give = known.give or GIVE * (_LINEAR_GIVE if slide else 1.0)
        # With a tendon a joint gets its share of the effort; without one it alone gets all of it,
        # by the leverage of its slope.
        alone = 1.0 / (slope or math.inf) if known.coupling is Following.SPRING else share
        unit = PRISMATIC if slide else 1.0
        stiffness = max(abs(alone) * servo.limit / give, PASSIVE_STIFFNESS * unit)
        inertia = options.armature * unit
        tendon = spec.add_tendon(name=coupling_name(follower.joint))
        tendon.wrap_joint(follower.joint, 1.0)
        tendon.wrap_joint(motor, -slope)
        tendon.stiffness = [stiffness, 0.0, 0.0]
        # Critical damping: the fingers must not swing when an object is let go.
        tendon.damping = [2.0 * math.sqrt(stiffness * inertia), 0.0, 0.0]
        rest = follower.coupling.value(follower.actuator.rest) - slope * follower.actuator.rest
        tendon.springlength = [rest, rest]
    shared = tendons_of(hand, servo.actuator, [f.joint for f in group], known)
    for name, numbers in shared:
        own = distributed(slopes[numbers], shares_of(known, numbers))
        if own is None:
            raise _moves_nothing(hand, servo.actuator)
        tendon = spec.add_tendon(name=name)
        for number, share in zip(numbers, own, strict=True):
            tendon.wrap_joint(group[number].joint, share)
        tendon.wrap_joint(motor, -1.0)
        equality = spec.add_equality(
            name=name, name1=name, type=mujoco.mjtEq.mjEQ_TENDON, objtype=mujoco.mjtObj.mjOBJ_TENDON
        )
        equality.solref, equality.solimp = _SOLREF, _SOLIMP
    how = {
        Following.TENDON: ", and a tendon shares its effort among them",
        Following.LINKAGE: ", and each finger shares its effort among its own",
    }.get(known.coupling or Following.SPRING, "")
    return f"'{servo.actuator}' moves {len(group)} joint(s) by springs{how}" + (
        "" if known.give else f"; they yield by {GIVE:g} rad to their part of the full effort"
    )


def _moves_nothing(hand: Hand, actuator: str) -> ModelError:
    return ModelError(
        f"actuator '{actuator}' moves no joint with its shares in hand.yaml; the sum of "
        "each share times the slope of its joint must not be zero",
        path=hand.urdf.path,
    )
