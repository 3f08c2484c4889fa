"""Construct composed, timed and generic actions by the paper's rules.

A set-point is scaled from the rest posture: ``value = rest + scale * (set-point - rest)``. An
actuator that several parts of a composed action set gets the mean of their values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from rtee.actions.naming import label, normalise
from rtee.actions.types import (
    Action,
    ActionReference,
    Composed,
    CustomAction,
    Generic,
    Posture,
    PrimitiveKind,
    Step,
    Timed,
)
from rtee.errors import ActionError, UnknownActuator
from rtee.hand.model import Hand
from rtee.hand.names import check_name
from rtee.types import ActuatorSpec, JointKind, from_rest

Find = Callable[[str, tuple[str, ...]], Action]
"""Returns an action by name and elements."""

SLACK = 1e-6
"""Largest excess of a stored value over the limits that counts as rounding [rad | m]."""

MAX_MARGIN = 3600.0
"""Longest margin of an inner action [s]: an hour is surely a mistake of units."""


@dataclass(frozen=True, slots=True)
class StepPlan:
    """An inner action of a timed action, before it is looked up.

    Attributes:
        use: The inner action, or its text; see `ActionReference`.
        alias: Name within the timed action; empty: the action's own name.
        before: Margin before its start [s].
        after: Margin after its end [s].
    """

    use: ActionReference | str
    alias: str = ""
    before: float = 0.0
    after: float = 0.0


def plans_of(steps: Iterable[StepPlan]) -> tuple[StepPlan, ...]:
    """Return inner actions as they were given; raises `ActionError` for anything else."""
    plans = tuple(steps) if isinstance(steps, Iterable) else (steps,)
    if wrong := [each for each in plans if not isinstance(each, StepPlan)]:
        raise ActionError(
            "an inner action of a timed action must be a StepPlan, such as "
            f"StepPlan('trig:ring', before=0.5), not {wrong[0]!r:.100}"
        )
    return plans


def parts_of(parts: Iterable[ActionReference | str]) -> tuple[ActionReference, ...]:
    """Return the parts of a composed action; raises `ActionError` for anything but a list."""
    if isinstance(parts, str) or not isinstance(parts, Iterable):
        raise ActionError(
            "the parts of a composed action must be a list, such as ['trig:ring'], "
            f"not {parts!r:.100}"
        )
    return tuple(map(ActionReference.of, parts))


def full_posture(hand: Hand, involved: Mapping[str, float]) -> Posture:
    """Return a posture of involved positions [rad | m], with all other actuators at rest.

    Raises:
        UnknownActuator: if the hand has no such actuator.
        ActionError: if a value is not finite or outside the limits.
    """
    if not involved:
        raise ActionError("an action must involve at least one actuator")
    # Raises an error for an unknown name, which the mapping below would drop.
    for name in involved:
        hand.actuator_index(name)
    position = {
        spec.name: _inside(spec, involved[spec.name]) if spec.name in involved else rest
        for spec, rest in zip(hand.actuators, hand.rest.tolist(), strict=True)
    }
    return Posture(position, tuple(name for name in position if name in involved))


def _inside(spec: ActuatorSpec, value: float) -> float:
    if not math.isfinite(value):
        raise ActionError(f"the set-point of '{spec.name}' must be a finite number, not {value}")
    if value < spec.lower - SLACK or value > spec.upper + SLACK:
        unit = "m" if spec.kind is JointKind.PRISMATIC else "rad"
        side, limit = ("lower", spec.lower) if value < spec.lower else ("upper", spec.upper)
        raise ActionError(
            f"the set-point {value:g} {unit} of '{spec.name}' is outside its {side} limit "
            f"{limit:g} {unit}"
        )
    # A value outside by less than `SLACK` means the limit.
    return min(max(value, spec.lower), spec.upper)


def scaled(hand: Hand, posture: Posture, scale: float) -> Posture:
    """Return a posture scaled from rest and clamped to the limits."""
    position = dict(posture.position)
    for name in posture.involved:
        index = hand.actuator_index(name)
        spec, rest = hand.actuators[index], float(hand.rest[index])
        # At scale 1, rest + (set-point - rest) could differ in the last bit.
        value = position[name] if scale == 1.0 else from_rest(rest, position[name], scale)
        position[name] = min(max(value, spec.lower), spec.upper)
    return Posture(position, posture.involved)


def check_scale(scale: float, what: str) -> None:
    """Raise `ActionError` unless a scale is finite and not negative."""
    if not (math.isfinite(scale) and scale >= 0.0):
        raise ActionError(f"the scale of {what} is {scale:g}; it must be 0 or more")


def compose(
    hand: Hand,
    find: Find,
    name: str,
    parts: Sequence[ActionReference | str],
    *,
    independent: bool = False,
    description: str = "",
) -> Composed:
    """Combine actions into one.

    Args:
        hand: The hand.
        find: Function that returns a part by name and elements.
        name: Name of the new action.
        parts: The parts, or their texts; see `ActionReference`.
        independent: Refuse parts that set the same actuator.
        description: One sentence for people.

    Raises:
        UnknownAction: if there is no such part.
        ActionError: if a part cannot be used, or the name or a scale is invalid.
    """
    check_custom_name(name)
    uses = parts_of(parts)
    if not uses:
        raise ActionError(f"the composed action '{name}' has no parts")
    values: dict[str, list[float]] = {}
    setter: dict[str, str] = {}
    resolved: list[ActionReference] = []
    for part in uses:
        use, posture = _resolve(hand, find, part, f"the composed action '{name}'")
        resolved.append(use)
        for actuator in posture.involved:
            if independent and actuator in setter:
                raise ActionError(
                    f"the independent action '{name}' sets '{actuator}' twice: "
                    f"by {setter[actuator]} and by {label(use.action, use.elements)}"
                )
            setter[actuator] = label(use.action, use.elements)
            values.setdefault(actuator, []).append(posture.position[actuator])
    # With fsum, the order of the parts does not change the last digit.
    mean = {
        actuator: math.fsum(positions) / len(positions) for actuator, positions in values.items()
    }
    return Composed(name, tuple(resolved), full_posture(hand, mean), independent, description)


def sequence(
    hand: Hand, find: Find, name: str, steps: Sequence[StepPlan], *, description: str = ""
) -> Timed:
    """Put actions in sequence, with margins.

    ``find`` returns an inner action by name and elements.

    Raises:
        UnknownAction: if there is no such inner action.
        ActionError: if an inner action cannot be used, or a name, margin or scale is invalid.
    """
    check_custom_name(name)
    if not steps:
        raise ActionError(f"the timed action '{name}' has no inner actions")
    inner: list[Step] = []
    taken: set[str] = set()
    for plan in plans_of(steps):
        use, posture = _resolve(hand, find, plan.use, f"the timed action '{name}'")
        alias = plan.alias or "_".join((use.action, *use.elements))
        check_name(alias, "alias")
        if normalise(alias) in taken:
            raise ActionError(
                f"the timed action '{name}' has two inner actions '{alias}'; "
                "give one of them another name with 'alias'"
            )
        taken.add(normalise(alias))
        for side, margin in (("before", plan.before), ("after", plan.after)):
            if not 0.0 <= margin <= MAX_MARGIN:
                raise ActionError(
                    f"the margin {side} '{alias}' is {margin:g} s; "
                    f"it must be from 0 to {MAX_MARGIN:g} s"
                )
        inner.append(Step(use, alias, plan.before, plan.after, posture))
    return Timed(name, tuple(inner), description)


def generic(
    hand: Hand, name: str, set_points: Mapping[str, float], *, description: str = ""
) -> Generic:
    """Make an action of set-points [rad | m]; actuators without one are not involved.

    Raises:
        ActionError: if an actuator is unknown, a value outside its limits, or the name invalid.
    """
    check_custom_name(name)
    try:
        posture = full_posture(hand, set_points)
    except UnknownActuator as error:
        raise ActionError(f"the generic action '{name}': {error.message}") from None
    return Generic(name, posture, description)


def warnings_of(action: Action) -> list[str]:
    """Return sentences about scales above 1, which are allowed but may be a mistake."""
    return [
        f"'{action.name}' scales {label(use.action, use.elements)} by {use.scale:g}: "
        "above 1 it may pass the limits, where it is clamped"
        for use in action.uses
        if use.scale > 1.0
    ]


def rebuilt(hand: Hand, find: Find, action: CustomAction) -> CustomAction:
    """Return an action rebuilt from its parts, which may have changed."""
    match action:
        case Composed():
            return compose(
                hand,
                find,
                action.name,
                action.parts,
                independent=action.independent,
                description=action.description,
            )
        case Timed():
            plans = [StepPlan(s.use, s.alias, s.before, s.after) for s in action.steps]
            return sequence(hand, find, action.name, plans, description=action.description)
    return action


def _resolve(
    hand: Hand, find: Find, what: ActionReference | str, where: str
) -> tuple[ActionReference, Posture]:
    use = ActionReference.of(what)
    check_scale(use.scale, f"{label(use.action, use.elements)} in {where}")
    action = find(use.action, use.elements)
    # A timed action has no single posture to scale or average.
    if isinstance(action, Timed):
        raise ActionError(f"{where} cannot contain the timed action '{action.name}'")
    # In the action's own spelling, which files and users see.
    reference = ActionReference(action.name, action.elements, use.scale)
    return reference, scaled(hand, action.posture, use.scale)


_PRIMITIVE_NAMES = tuple(normalise(kind) for kind in PrimitiveKind)


def is_primitive_name(name: str) -> bool:
    """Return whether a name is, or may become, that of a primitive."""
    # With any count, since a later extraction may find primitives of other counts.
    return normalise(name).rstrip("0123456789") in _PRIMITIVE_NAMES


def check_custom_name(name: str) -> None:
    """Raise `UserError` unless a name is valid for a composed, timed or generic action."""
    check_name(name, "action")
    # Names are compared without underscores and hyphens, so these alone do not make a name.
    if not normalise(name):
        raise ActionError(f"the name '{name}' has no letter or digit")
    if is_primitive_name(name):
        raise ActionError(f"the name '{name}' is that of a primitive; choose another one")
