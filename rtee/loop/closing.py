"""Speeds at which fingers move around an object and meet it."""

from __future__ import annotations

import math
from typing import Final

from rtee.actions.openings import MARGIN
from rtee.errors import GoalRejected
from rtee.hand.model import Hand
from rtee.loop.grip import Grip
from rtee.loop.plan import Plan
from rtee.types import Around

_CONTACT_SPEED: Final = 0.01
"""Lowest closing speed of the opening for a goal with a force [m/s]: that of a touch, which crosses
the margin within a second."""

_SPEED_PER_FORCE: Final = 2e-3
"""Speed of the opening at which the fingers meet an object, per requested newton [m/s/N]. In MuJoCo
a 2F-85 hits with 0.38 N per mm/s, more than any other hand: the impact stays below the force."""

_AROUND_SPEED: Final = 0.15
"""Highest speed of the opening on the path around an object, for fingers with several actuators
[m/s]: servos with integral control overshoot by some 20 ms of motion, less than the margin."""

_BLOW: Final = 0.8
"""Share of the requested force that the impact of the closing fingers may reach: the force itself
is built up later."""

_MOST_BLOW: Final = 1.3
"""The same share on the path around the object, where fingers meet it only if it lies askew or deep
in the hand."""

_LEAST_BLOW: Final = 1.0
"""An impact of this size is always allowed, as is an excess of this size on the path around [N]."""

_STOPPING: Final = 0.0013
"""Time in which an object stops the moving mass of the fingers [s]: in MuJoCo, an EGU that closes
at 90 mm/s strikes with 140 N (1.5 ms), an SVH at 52 mm/s with 2.6 N (1.1 ms). Rubber pads take
longer, which softens the impact."""

_YIELDING: Final = 6.0
"""Multiple of the meeting speed at which bending fingers of unknown mass move around an object and
continue after meeting it: with less, light objects fall before a SoftHand presses; with more, a
3-Finger strikes harder with its middle links."""

_CHATTERING: Final = 2.0
"""The same multiple once most of the force is there: the faster the fingers, the harder they
chatter on a sliding object; with less, light objects slide out of a SoftHand."""

_DEPTH: Final = 1e-3
"""Depth of the references inside an object at which fingers with several actuators press with about
the force [m]: fingers and servos yield by this much or more."""

_NOTICED: Final = 0.9
"""A speed below this share of the requested one is reported: a smaller difference goes
unnoticed."""

_SLOWEST: Final = 0.002
"""Lowest closing speed by mass and lag [m/s]: crossing the margin then takes five seconds."""


def tip_speed_share(speed: float, hand: Hand, grip: Grip, at: float) -> float:
    """Return the share of the velocity limits at which the opening changes at a speed [m/s].

    The share is above 1 if the action cannot reach that speed at an intensity ``at``.
    """
    slope = grip.slope_at(at)  # of the opening [m per unit of intensity]
    # The slowest actuator sets the time; all arrive together.
    most = max(
        abs(target - rest) / hand.actuators[i].velocity
        for i, rest, target in zip(grip.indices, grip.rest, grip.target, strict=True)
    )
    return speed * most / slope


def checked_share(speed: float, hand: Hand, grip: Grip, at: float, name: str) -> float:
    """Return `tip_speed_share`, at most 1; raises `GoalRejected` if the action is slower."""
    share = tip_speed_share(speed, hand, grip, at)
    # Rounding must not refuse the very speed that the refusal suggests.
    if share > 1.0 + 1e-9:
        raise GoalRejected(
            f"{name} opens and closes at {1e3 * speed / share:.3g} mm/s at most there, "
            f"not {1e3 * speed:g} mm/s"
        )
    return min(share, 1.0)


def leg_speed(plan: Plan, leg: int, hand: Hand) -> float:
    """Return the share of the velocity limits for a leg of a plan.

    Around an object, fingers with several actuators move more slowly, since any overshoot strikes
    the object. An impact on that path is no harder than a grasp allows. As they close on it, the
    force of the impact, before any reflex acts, comes from the inertia of the motors and grows with
    the speed: the smaller the requested force, the slower the fingers meet the object.
    """
    grip, force = plan.grip, plan.force
    if not isinstance(plan.to, Around) or force is None or grip is None:
        return plan.speed
    if leg + 1 == len(plan.legs):
        at = grip.intensity_at(plan.to.width)
        speed = meeting_speed(force.value, grip, at, plan.lag)
    else:
        at = grip.intensity_at(plan.to.width + MARGIN)
        speed = around_speed(force.value, grip, at)
    return min(plan.speed, tip_speed_share(speed, hand, grip, at))


def squeezing_speed(plan: Plan, hand: Hand) -> float:
    """Return the share of the velocity limits once most of the force has built up; 1: unchanged."""
    if plan.grip is None or not plan.grip.bends:
        return 1.0
    return min(_CHATTERING * leg_speed(plan, len(plan.legs) - 1, hand), 1.0)


def slowed(plan: Plan, hand: Hand) -> str:
    """Return a note that the fingers meet the object more slowly than requested, or empty."""
    grip, force = plan.grip, plan.force
    if grip is None or plan.width is None or force is None:
        return ""
    share = leg_speed(plan, len(plan.legs) - 1, hand)
    full = 1.0 / tip_speed_share(1.0, hand, grip, grip.intensity_at(plan.width))
    asked = full * plan.speed
    if plan.speed == 1.0:  # no speed was asked for, and such a force is met with this one
        asked = min(asked, _usual(force.value))
    if not share * full < _NOTICED * asked:
        return ""
    late = f" of fingers that lag {plan.lag:.2g} s behind" if plan.lag else ""
    return (
        f"the fingers meet the object at {1e3 * share * full:.3g} mm/s instead of "
        f"{1e3 * asked:.3g} mm/s: faster, the impact{late} may exceed the force"
    )


def around_speed(force: float, grip: Grip, at: float) -> float:
    """Return the largest speed of the opening on the path around an object [m/s].

    Args:
        force: The requested force [N].
        grip: The grip.
        at: Intensity at which the path ends.
    """
    most = math.inf if len(grip.squeezing(at)) < 2 else _AROUND_SPEED
    if math.isnan(grip.moving_mass(at)):
        return min(most, _YIELDING * meeting_speed(force, grip, at))
    blow = _BLOW * max(_MOST_BLOW * force, force + _LEAST_BLOW)
    return max(_SLOWEST, min(most, _struck(blow, grip, at)))


def _struck(blow: float, grip: Grip, at: float) -> float:
    """Return the opening speed at which the moving parts strike with a force [m/s].

    Stopping a mass ``m`` that moves with the opening within a time ``t`` takes ``m v / t``. The
    speed is infinite if the mass is not known.
    """
    mass = grip.moving_mass(at)
    return math.inf if mass != mass else blow * _STOPPING / mass


def _usual(force: float) -> float:
    """Return the closing speed at which a force is met, unless mass or lag demand less [m/s]."""
    return max(_CONTACT_SPEED, _SPEED_PER_FORCE * force)


def meeting_speed(force: float, grip: Grip, at: float, lag: float = 0.0) -> float:
    """Return the closing speed of the opening at which the impact does not exceed a force [m/s].

    It is proportional to the force, and lower where the mass that moves with the fingers is known
    and would strike with more than `_BLOW` of it, or where the references lead too deep into the
    object before the fingers react.

    Args:
        force: The requested force [N].
        grip: The grip.
        at: Intensity at which the fingers meet the object.
        lag: Time by which fingers that keep their posture follow their references [s]; 0: unknown.
    """
    by_mass = _struck(max(_BLOW * force, _LEAST_BLOW), grip, at)
    by_lag = _DEPTH * max(_MOST_BLOW, 1.0 + _LEAST_BLOW / force) / lag if lag else math.inf
    return max(_SLOWEST, min(by_mass, by_lag, _usual(force)))


def closing_time(to: Around, force: float, grip: Grip) -> float:
    """Return the additional time of a goal that closes slowly on its object [s]."""
    at = grip.intensity_at(to.width)
    # An object met on the way around is closed on from there.
    way = max(grip.width[0], to.width + MARGIN)
    return way / meeting_speed(force, grip, at) + way / around_speed(force, grip, at)
