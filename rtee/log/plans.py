"""What goals come to, as messages, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rtee.errors import MessageError
from rtee.loop.plan import Leg, Plan
from rtee.messages.codec import header
from rtee.messages.schema import message_type
from rtee.types import Goal

_PLAN = message_type("rtee_msgs/msg/Plan")


def encode_plan(plan: Plan, actuators: Sequence[str], *, time: float, wall: int) -> bytes:
    """Return a ``rtee_msgs/Plan``.

    Args:
        plan: The plan.
        actuators: Names of the hand's actuators.
        time: When the tick was due at which it took effect, CLOCK_MONOTONIC [s].
        wall: The same since 1970 [ns].
    """
    return _PLAN.encode(
        {
            "header": header(wall),
            "time": time,
            "goal_id": plan.goal.goal_id,
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
        }
    )


def plan_of(fields: Mapping[str, Any], goal: Goal, actuators: Sequence[str]) -> Plan:
    """Return the plan in the fields of a decoded ``rtee_msgs/Plan``.

    Args:
        fields: The fields.
        goal: The goal it belongs to.
        actuators: Names of the hand's actuators.

    Raises:
        MessageError: if it names an actuator that the hand does not have.
    """

    def indexed(names: Sequence[str], values: Any) -> dict[int, float]:
        try:
            indices = [actuators.index(name) for name in names]
            return dict(zip(indices, values.tolist(), strict=True))
        except ValueError as error:
            raise MessageError(f"a plan does not fit the hand: {error}") from None

    legs = tuple(
        Leg(leg["name"], indexed(leg["actuator"], leg["target"]), leg["before"], leg["after"])
        for leg in fields["legs"]
    )
    return Plan(
        goal=goal,
        action=fields["action"],
        legs=legs,
        involved=frozenset(index for leg in legs for index in leg.targets),
        effort=indexed(fields["effort_name"], fields["effort"]),
        timeout=fields["timeout"],
        timed=fields["timed"],
    )
