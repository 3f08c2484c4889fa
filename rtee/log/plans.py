"""Convert plans of goals, and the grips under way, to messages and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtee.drivers.capabilities import GripForce
from rtee.errors import MessageError
from rtee.loop.grip import Grip
from rtee.loop.plan import Leg, Plan
from rtee.messages.codec import Codec, header
from rtee.messages.schema import message_type
from rtee.types import Goal
from rtee.values import Value

_PLAN = message_type("rtee_msgs/msg/Plan")

_SIDES = -1
"""Separator, in a list of indices of fingers, between the first side and the others."""


@dataclass(frozen=True, slots=True)
class GripEstimate(Value):
    """Opening and force of the fingertips at a time.

    Attributes:
        time: CLOCK_MONOTONIC [s].
        action: Action of the goal.
        opening: Opening [m]; ``NaN``: not known.
        force: Force between the fingertips [N]; ``NaN``: not known.
        force_error: Its error [N].
        force_source: Its source, as in `rtee.types.Result`.
    """

    time: float
    action: str
    opening: float
    force: float
    force_error: float
    force_source: str


GRIP = Codec("rtee_msgs/msg/Grip", GripEstimate)
"""Openings and forces in CDR."""


def encode_plan(plan: Plan, actuators: Sequence[str], *, time: float, wall: int) -> bytes:
    """Return a ``rtee_msgs/Plan`` with the due time of the tick at which it took effect.

    This is by CLOCK_MONOTONIC [s], and ``wall`` the same time since 1970 [ns].
    """
    return _PLAN.encode(
        {
            "header": header(wall),
            "time": time,
            "goal_id": plan.goal_id,
            "action": plan.action,
            "timed": plan.timed,
            "timeout": plan.timeout,
            "effort_name": [actuators[index] for index in plan.effort],
            "effort": list(plan.effort.values()),
            "legs": [
                {
                    "name": leg.name,
                    "actuator": [actuators[index] for index in leg.targets],
                    "target": list(leg.targets.values()),
                    "before": leg.before,
                    "after": leg.after,
                }
                for leg in plan.legs
            ],
            "elements": list(plan.elements),
            "grip": [] if plan.grip is None else [_grip_fields(plan.grip, actuators)],
            "speed": plan.speed,
            "meets_name": [actuators[index] for index in plan.meets],
            "meets": list(plan.meets.values()),
        }
    )


def plan_of(fields: Mapping[str, Any], goal: Goal, actuators: Sequence[str]) -> Plan:
    """Return the plan of a goal in the fields of a decoded ``rtee_msgs/Plan``.

    Values taken over from the goal are recorded with the goal only.

    Raises `MessageError` if the plan names an actuator that the hand does not have.
    """

    def indexed(names: Sequence[str], values: Any) -> dict[int, float]:
        try:
            indices = [actuators.index(name) for name in names]
            # By name, since the order of actuators may change with the URDF.
            return dict(zip(indices, values.tolist(), strict=True))
        except ValueError as error:
            raise MessageError(f"a plan does not fit the hand: {error}") from None

    legs = tuple(
        Leg(leg["name"], indexed(leg["actuator"], leg["target"]), leg["before"], leg["after"])
        for leg in fields["legs"]
    )
    return Plan(
        goal_id=goal.goal_id,
        action=fields["action"],
        legs=legs,
        involved=frozenset(index for leg in legs for index in leg.targets),
        effort=indexed(fields["effort_name"], fields["effort"]),
        timeout=fields["timeout"],
        to=goal.to,
        speed=fields["speed"],
        force=goal.force,
        on_contact=goal.on_contact,
        timed=fields["timed"],
        elements=tuple(fields["elements"]),
        grip=_grip_of(fields["grip"][0], actuators) if fields["grip"] else None,
        meets=indexed(fields["meets_name"], fields["meets"]),
    )


def _grip_fields(grip: Grip, actuators: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/GripMap``."""
    sheet = grip.sheet
    table: list[float] = []
    if sheet is not None:
        rows = zip(sheet.position or (0.0,), sheet.weakest, sheet.strongest, strict=True)
        # One array: the efforts, 1 or 0 for positions, then rows of three numbers.
        table = [*sheet.effort, float(bool(sheet.position)), *(v for row in rows for v in row)]
    return {
        "actuator": [actuators[index] for index in grip.indices],
        "rest": list(grip.rest),
        "target": list(grip.target),
        "intensity": list(grip.intensity),
        "opening": list(grip.width),
        "lever": [value for row in grip.lever for value in row],
        "friction": list(grip.friction),
        "efficiency": list(grip.efficiency),
        "inertia": list(grip.inertia),
        "empty": grip.empty,
        "finger": [*grip.fingers, _SIDES, *grip.others],
        "around": grip.around,
        "sheet": table,
    }


def _grip_of(fields: Mapping[str, Any], actuators: Sequence[str]) -> Grip:
    """Return the grip in the fields of a ``rtee_msgs/GripMap``; raise `MessageError` if invalid."""
    try:
        indices = tuple(actuators.index(name) for name in fields["actuator"])
        rows, columns = len(fields["intensity"]), len(indices)
        # Messages have flat arrays only; the shape follows from the lengths of the others.
        lever = fields["lever"].reshape(rows, columns).tolist()
        fingers = fields["finger"].tolist()
        between = fingers.index(_SIDES)
        values = {
            name: tuple(fields[name].tolist())
            for name in ("rest", "target", "intensity", "friction", "efficiency")
        }
        sheet = _sheet(fields["sheet"].tolist())
    except (ValueError, IndexError) as error:
        raise MessageError(f"the grip of a plan does not fit the hand: {error}") from None
    return Grip(
        indices,
        values["rest"],
        values["target"],
        values["intensity"],
        tuple(fields["opening"].tolist()),
        tuple(tuple(row) for row in lever),
        values["friction"],
        values["efficiency"],
        tuple(fingers[:between]),
        tuple(fingers[between + 1 :]),
        fields["around"],
        sheet,
        tuple(fields["inertia"].tolist()) or (0.0,) * columns,  # none in older recordings
        fields["empty"],
    )


def _sheet(table: Sequence[float]) -> GripForce | None:
    if not table:
        return None
    (weak, strong, placed), rows = table[:3], table[3:]
    return GripForce(
        (weak, strong), tuple(rows[1::3]), tuple(rows[2::3]), tuple(rows[0::3]) if placed else ()
    )
