"""The services of ROS End-Effector's ROS 2 packages, for programs that were written for it.

Names, fields and numbers are those of its package ``rosee_msg`` and of its node: services in the
namespace of the node, such as ``/grasping_actions_available``. Primitives have its names:
``pinchTight``, ``trig``, ``multiplePinchTight_3``.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from typing import Any

import numpy as np

from rtee.actions.naming import normalise
from rtee.actions.types import Action, ActionKind, Posture, Primitive, PrimitiveKind, Timed
from rtee.errors import ActionError, GoalRejected, LeaseHeld, RequestRejected, RteeError
from rtee.remote.client import RemoteHand
from rtee.ros2.action_server import ActionServer, Job, Offer, ServerGoal
from rtee.ros2.actions import ActionOutcome, GoalState
from rtee.ros2.endpoints import fields_handler
from rtee.ros2.hand_goals import ActionPart, HandJob
from rtee.ros2.message import Message
from rtee.ros2.node import Node
from rtee.ros2.served_hand import ServedHand
from rtee.ros2.types import Interfaces
from rtee.types import Feedback, Goal, Intensity, Named, Result

PRIMITIVES: dict[PrimitiveKind, str] = {
    PrimitiveKind.PINCH_TIGHT: "pinchTight",
    PrimitiveKind.PINCH_LOOSE: "pinchLoose",
    PrimitiveKind.MULTI_PINCH_TIGHT: "multiplePinchTight",
    PrimitiveKind.TRIG: "trig",
    PrimitiveKind.TIP_FLEX: "tipFlex",
    PrimitiveKind.FING_FLEX: "fingFlex",
    PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS: "singleJointMultipleTips",
}
"""Names of the kinds of primitives in ROS End-Effector, in the order of their numbers."""

_NUMBERS = {kind: number for number, kind in enumerate(PRIMITIVES)}
_NO_PRIMITIVE = len(PRIMITIVES)

_ACTIONS = {
    ActionKind.PRIMITIVE: 0,
    ActionKind.GENERIC: 1,
    ActionKind.COMPOSED: 2,
    ActionKind.TIMED: 3,
}
_ASKED = (
    {ActionKind.PRIMITIVE},
    {ActionKind.GENERIC, ActionKind.COMPOSED},
    {ActionKind.TIMED},
)
"""The kinds of actions by the number in a request for actions."""

_MSG, _SRV = "rosee_msg/msg", "rosee_msg/srv"


def name_there(action: Action) -> str:
    """Return the name of an action in ROS End-Effector."""
    if not isinstance(action, Primitive):
        return action.name
    name = PRIMITIVES[action.kind]
    return f"{name}_{action.tips}" if action.kind.counted else name


def name_here(name: str) -> str:
    """Return the name in rtee of an action of ROS End-Effector."""
    for kind, there in PRIMITIVES.items():
        begin, _, tips = name.partition("_")
        if normalise(begin) == normalise(there) and (tips.isdigit() or not tips):
            return f"{kind}_{tips}" if tips else str(kind)
    return name


class RosEndEffector:
    """Offers the services."""

    def __init__(self, node: Node, hand: RemoteHand) -> None:
        self._hand, self._interfaces = hand, node.context.interfaces
        offered: tuple[tuple[str, str, Callable[[Any], Awaitable[dict[str, Any]]]], ...] = (
            ("grasping_actions_available", "GraspingActionsAvailable", self._actions),
            (
                "primitives_aggregated_available",
                "GraspingPrimitiveAggregatedAvailable",
                self._aggregated,
            ),
            ("selectable_finger_pair_info", "SelectablePairInfo", self._partners),
            ("new_generic_grasping_action", "NewGenericGraspingActionSrv", self._new_generic),
            ("hand_info", "HandInfo", self._info),
        )
        for name, kind, handler in offered:
            service = self._interfaces.service(f"{_SRV}/{kind}")
            node.service(name, service, fields_handler(service, handler))

    async def _actions(self, request: Any) -> dict[str, Any]:
        if request.action_type >= len(_ASKED):
            return {}
        kinds = _ASKED[request.action_type]
        actions = [each for each in await self._hand.actions() if each.action_kind in kinds]
        if ActionKind.PRIMITIVE in kinds:
            actions = list[Action](_filtered(actions, request))
        elif request.action_name:
            actions = [each for each in actions if _same(each, request.action_name)]
        return {"grasping_actions": [_described(self._interfaces, action) for action in actions]}

    async def _aggregated(self, request: Any) -> dict[str, Any]:
        actions = await self._hand.actions(kind=ActionKind.PRIMITIVE)
        aggregated = self._interfaces.message(f"{_MSG}/GraspingPrimitiveAggregated")
        groups: dict[str, list[Primitive]] = {}
        for primitive in _filtered(actions, request):
            groups.setdefault(name_there(primitive), []).append(primitive)
        return {
            "primitives_aggregated": [
                aggregated(
                    action_name=name,
                    primitive_type=_NUMBERS[group[0].kind],
                    selectable_names=sorted(
                        {name for primitive in group for name in primitive.elements}
                    ),
                    max_selectable=len(group[0].elements),
                )
                for name, group in groups.items()
            ]
        }

    async def _partners(self, request: Any) -> dict[str, Any]:
        name, element = name_here(request.action_name), request.element_name
        try:
            return {"pair_elements": list(await self._hand.partners(name, element))}
        except RteeError:
            return {}  # as in ROS End-Effector, an unknown element has no partners

    async def _new_generic(self, request: Any) -> dict[str, Any]:
        wanted = request.new_action
        positions = wanted.action_motor_position
        if len(positions.name) != len(positions.position):
            return {"error_msg": "action_motor_position has more names than positions, or fewer"}
        mask = wanted.action_motor_count
        if len(mask.name) != len(mask.count):
            return {"error_msg": "action_motor_count has more names than counts, or fewer"}
        where = dict(zip(positions.name, positions.position.tolist(), strict=True))
        counts = dict(zip(mask.name, mask.count, strict=True))
        if unknown := set(counts) - set(where):
            return {"error_msg": f"action_motor_count has '{min(unknown)}' without a position"}
        # Without a mask, motors at 0 count as not involved.
        where = {
            name: value
            for name, value in where.items()
            if (counts.get(name, 0) if counts else value != 0.0)
        }
        try:
            await self._hand.add_generic(wanted.action_name, where, store=request.emit_yaml)
        except RteeError as error:
            return {"error_msg": str(error)}
        return {"accepted": True, "emitted": request.emit_yaml}

    async def _info(self, request: Any) -> dict[str, Any]:
        known = await self._hand.info()
        positions = request.motor_positions.tolist()
        if len(positions) == len(known.actuators):
            posture = dict(zip(known.actuator_names, positions, strict=True))
            known = await self._hand.info(posture)
        return {
            "fingers_names": [finger.name for finger in known.fingers],
            "motors_names": list(known.actuator_names),
            "transmission_matrix": self._matrix(known.transmission, ("joints", "motors")),
            "motors_stiffness": [actuator.stiffness for actuator in known.actuators],
            "tips_frictions": [finger.friction for finger in known.fingers],
            "motors_torque_limits": [actuator.effort for actuator in known.actuators],
        }

    def _matrix(self, values: Any, labels: tuple[str, str]) -> Message:
        """Return the message of a matrix, row by row."""
        package = "example_interfaces/msg"
        rows, columns = np.shape(values)
        dimension = self._interfaces.message(f"{package}/MultiArrayDimension")
        layout = self._interfaces.message(f"{package}/MultiArrayLayout")(
            dim=[
                dimension(label=labels[0], size=rows, stride=rows * columns),
                dimension(label=labels[1], size=columns, stride=columns),
            ]
        )
        made: Message = self._interfaces.message(f"{package}/Float32MultiArray")(
            layout=layout, data=np.ravel(values).astype(np.float32)
        )
        return made


def _same(action: Action, name: str) -> bool:
    return normalise(name) in (normalise(name_there(action)), normalise(action.name))


def _filtered(actions: Iterable[Action], request: Any) -> Iterable[Primitive]:
    """Yield the primitives that match a request; number 0 matches all kinds."""
    for action in actions:
        if not isinstance(action, Primitive):
            continue
        # As in ROS End-Effector, a kind takes precedence over the name.
        if request.primitive_type:
            wanted = _NUMBERS[action.kind] + 1 == request.primitive_type
        else:
            wanted = not request.action_name or _same(action, request.action_name)
        if wanted and set(request.elements_involved) in (set(), set(action.elements)):
            yield action


def _described(known: Interfaces, action: Action) -> Message:
    """Return a ``GraspingAction``."""
    primitive = isinstance(action, Primitive)
    postures = action.postures if isinstance(action, Primitive) else action.waypoints
    steps = action.steps if isinstance(action, Timed) else ()
    made: Message = known.message(f"{_MSG}/GraspingAction")(
        action_type=_ACTIONS[action.action_kind],
        primitive_type=_NUMBERS[action.kind] if isinstance(action, Primitive) else _NO_PRIMITIVE,
        action_name=name_there(action),
        elements_involved=list(action.elements if primitive else action.fingers),
        action_motor_count=_counted(known, postures),
        action_motor_positions=[
            known.message(f"{_MSG}/MotorPosition")(
                name=list(posture.position), position=list(posture.position.values())
            )
            for posture in postures
        ],
        inner_actions=[step.alias for step in steps] or [use.action for use in action.uses],
        before_time_margins=[step.before for step in steps],
        after_time_margins=[step.after for step in steps],
    )
    return made


def _counted(known: Interfaces, postures: Iterable[Posture]) -> Message:
    """Return 1 for each actuator that any of the postures moves, and 0 for the others."""
    counts: dict[str, int] = {}
    for posture in postures:
        for name in posture.position:
            counts[name] = max(counts.get(name, 0), int(name in posture.involved))
    made: Message = known.message(f"{_MSG}/JointsInvolvedCount")(
        name=list(counts), count=bytes(counts.values())
    )
    return made


COMMAND = "action_command"
"""Name of the action."""

_TOLERANCE = 0.01
"""Error norm of a goal that gives 0 [rad | m], the default of ROS End-Effector."""

_FULL = 100.0
"""Progress of a completed action in its feedback [%]; its goals have fractions instead."""


class ActionCommand(ActionPart):
    """Offers the action ``action_command``."""

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._type = served.node.context.interfaces.action("rosee_msg/action/ROSEECommand")
        self._server = ActionServer(served.node, COMMAND, Offer(self._type, self._accept))

    async def _accept(self, message: Any) -> Job:
        command = message.goal_action
        try:
            running = await self._served.hand.start_goal(goal_of(command))
        except (ActionError, RequestRejected, LeaseHeld) as error:
            # ROS End-Effector accepts every goal, and aborts what it cannot do.
            return _Aborted(self._type.result(completed_action=command), str(error))

        def ended(_: Result) -> Message:
            return self._type.result(completed_action=command)

        def now(feedback: Feedback) -> dict[str, Any]:
            return {
                "completation_percentage": _FULL * feedback.progress,
                "action_name_current": feedback.inner or command.action_name,
            }

        return HandJob(running, ended, now)


class _Aborted:
    """Job of a goal that is aborted at once."""

    def __init__(self, result: Message, reason: str) -> None:
        self._outcome = ActionOutcome(GoalState.ABORTED, result, reason)

    async def run(self, goal: ServerGoal) -> ActionOutcome:
        return self._outcome

    async def cancel(self) -> None:
        return


def goal_of(command: Any) -> Goal:
    """Return the goal in a ``rosee_msg/msg/ROSEEActionControl``.

    Its percentage is a fraction, 0 to 1, and is ignored for a timed action, as in ROS End-Effector.
    Commands for single motors are efforts [N·m | N], and 0 keeps the configured effort: ROS
    End-Effector passes them on as the efforts of its references. Raises `GoalRejected` if the type
    of the action is unknown, or the numbers of motor names and commands differ.
    """
    motors, commands = list(command.optional_motors_names), list(command.optional_motors_commands)
    if len(motors) != len(commands):
        raise GoalRejected(
            f"'optional_motors_commands' needs {len(motors)} numbers, one for each of"
            f" 'optional_motors_names', not {len(commands)}"
        )
    effort = {name: float(value) for name, value in zip(motors, commands, strict=True) if value}
    name, share = command.action_name, command.percentage
    if command.action_type == command.PRIMITIVE:
        items = tuple(command.selectable_items)
        what = Named(name_here(name), items, ActionKind.PRIMITIVE)
    # In ROS End-Effector, these two are the same.
    elif command.action_type in (command.GENERIC, command.COMPOSED):
        what = Named(name)
    elif command.action_type == command.TIMED:
        what, share = Named(name, kind=ActionKind.TIMED), 1.0
    else:
        raise GoalRejected(f"action_type {command.action_type} is unknown; it must be 0 to 3")
    to = Intensity(share, tolerance=command.error_norm or _TOLERANCE)
    return Goal(what, to, effort=effort)
