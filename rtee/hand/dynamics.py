"""Complete the configured dynamics of actuators, with the joints that follow them by springs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from fnmatch import fnmatchcase

from rtee.errors import UserError, suggestion
from rtee.hand.config_schema import ActuatorDynamics, Following
from rtee.hand.transmission import Transmission
from rtee.hand.urdf import Urdf


def make_dynamics(
    given: Mapping[str, ActuatorDynamics],
    defaults: ActuatorDynamics,
    actuators: Sequence[str],
    urdf: Urdf,
    transmission: Transmission,
    refuse: Callable[[tuple[str | int, ...], str], UserError],
) -> dict[str, ActuatorDynamics]:
    """Return the dynamics of every actuator, with the names of the joints on springs.

    Args:
        given: The configured dynamics of some actuators.
        defaults: The dynamics of all others, and for missing values of these.
        actuators: The hand's actuators, in order.
        urdf: Its URDF.
        transmission: Its transmission.
        refuse: Makes the error for a value of the configuration, from its place and a message.

    Raises:
        UserError: The configuration names an actuator or a joint that does not exist.
    """
    for name in given:
        if name not in actuators:
            raise refuse((name,), f"unknown actuator; {suggestion(name, actuators)}")
    moving = [name for name, joint in urdf.joints.items() if joint.moving]
    found: dict[str, ActuatorDynamics] = {}
    for index, name in enumerate(actuators):
        dynamics = _completed(given.get(name), defaults)
        follow = [joint for i, joint in enumerate(moving) if transmission.moves(i) == index]
        key, patterns = "joints", dynamics.joints
        if dynamics.shares is not None:
            key, patterns = "shares", tuple(dynamics.shares)
        chosen: dict[str, float] = {}
        if patterns is None:
            chosen = {
                joint: 1.0
                for joint in follow
                # An actuator's own joint without a shape below it is only a motor, without a
                # spring.
                if joint != name or _carries_shape(urdf, urdf.joints[joint].child)
            }
        for place, pattern in enumerate(patterns or ()):
            matching = [joint for joint in follow if fnmatchcase(joint, pattern)]
            if not matching:
                what = f"no joint that follows '{name}' is called '{pattern}'"
                at = place if key == "joints" else pattern
                raise refuse((name, key, at), f"{what}; {suggestion(pattern, follow)}")
            chosen |= dict.fromkeys(matching, (dynamics.shares or {}).get(pattern, 1.0))
        if dynamics.coupling in (None, Following.RIGID):
            chosen = {}
        # In the hand's order, independent of that of the patterns.
        chosen = {joint: chosen[joint] for joint in follow if joint in chosen}
        shares = chosen if dynamics.shares is not None else None
        found[name] = replace(dynamics, joints=tuple(chosen), shares=shares)
    return found


def _completed(own: ActuatorDynamics | None, defaults: ActuatorDynamics) -> ActuatorDynamics:
    """Return an actuator's dynamics with the defaults for missing values."""
    if own is None:
        return defaults
    missing = [field.name for field in fields(own) if getattr(own, field.name) is None]
    return replace(own, **{name: getattr(defaults, name) for name in missing})


def _carries_shape(urdf: Urdf, link: str) -> bool:
    """Return whether a link, or one below it, has collision geometry."""
    if urdf.links[link].collisions:
        return True
    return any(_carries_shape(urdf, joint.child) for joint in urdf.joints_below.get(link, ()))
