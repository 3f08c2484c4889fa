"""The action ``~/gripper_cmd``, as GripperCommand and as ParallelGripperCommand at once.

A position is the gap between the fingertips [m], and an effort the force between them [N]. If a
goal or a parameter names a joint, they are the position [rad | m] and effort [N·m | N] of the
joint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtee.actions.naming import normalise
from rtee.actions.types import Action, Timed, kind_of
from rtee.errors import ConfigError, GoalRejected, suggestion
from rtee.hand.config_schema import GripperUnit, Ros2Settings
from rtee.messages.goals import goal_of
from rtee.messages.state import State
from rtee.remote.openings import OpeningRange
from rtee.ros2.action_server import ActionServer, Offer
from rtee.ros2.hand_goals import ActionPart, HandJob
from rtee.ros2.message import Message
from rtee.ros2.parameters import Parameter
from rtee.ros2.served_hand import ServedHand
from rtee.ros2.trajectory import BEYOND
from rtee.types import ActuatorSpec, Feedback, Goal, Intensity, Named, Result

GRIPPER = "~/gripper_cmd"
"""Name of the action."""

JOINT, ACTION = "gripper.joint", "gripper.action"
"""Names of the parameters: the joint of the positions, and the action to close with."""

ALLOW_STALLING = "gripper.allow_stalling"
"""Name of the parameter that lets a goal succeed if it stalls on an object: ``allow_stalling`` of
ros2_control's gripper controllers, where it is off by default."""

GAP = "opening"
"""Name of the gap in ParallelGripperCommand, which gives each position a name."""

_STILL = 0.02
"""Share of its velocity limit below which an actuator counts as still: the hand's own default,
`rtee.hand.config_schema.StallSettings.speed`."""


@dataclass(frozen=True, slots=True)
class GripCommand:
    """Command of a gripper.

    Attributes:
        joint: Name of the joint to move; empty: the gap between the fingertips.
        position: Target position [rad | m].
        effort: Largest effort of the joint [N·m | N], or force of the fingertips [N]; 0: as
            configured. Values above the hand's own limit count as that limit.
        speed: Speed [rad/s | m/s]; 0: as fast as the hand moves.
    """

    joint: str
    position: float
    effort: float = 0.0
    speed: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers; raises `GoalRejected` if one is out of range."""
        if not math.isfinite(self.position):
            raise GoalRejected(f"the position must be a finite number, not {self.position:g}")
        for what, value in (("effort", self.effort), ("velocity", self.speed)):
            if not 0.0 <= value < math.inf:
                raise GoalRejected(
                    f"the {what} must be 0 (as configured) or more, and finite, not {value:g}"
                )


class Gripper(ActionPart):
    """Offers the action ``~/gripper_cmd``.

    Raises `ConfigError` if the settings name an actuator that the hand does not have.
    """

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._joint = joint_of(served.settings, served.actuators)
        known, package = served.node.context.interfaces, "control_msgs/action"
        self._simple = known.action(f"{package}/GripperCommand")
        self._parallel = known.action(f"{package}/ParallelGripperCommand")
        self._joint_state = served.message("sensor_msgs/msg/JointState")
        self._server = ActionServer(
            served.node,
            GRIPPER,
            Offer(self._simple, self._accept_simple),
            Offer(self._parallel, self._accept_parallel),
        )

    def parameters(self) -> Iterable[Parameter]:
        """Return the parameters `JOINT`, `ACTION` and `ALLOW_STALLING`."""
        yield Parameter(
            JOINT,
            self._joint,
            f"The actuator whose position [rad | m] goals of {GRIPPER} give; empty: the gap between"
            " the fingertips [m].",
            change=self._check_joint,
        )
        yield Parameter(
            ACTION,
            "",
            f"The action that {GRIPPER} opens and closes with, and its elements, such as"
            " 'PinchTight index thumb'; empty: the hand's best one for the gap.",
        )
        yield Parameter(
            ALLOW_STALLING,
            True,
            f"Whether a goal of {GRIPPER} that stalls on an object succeeds; otherwise it is"
            " aborted, as by default in ros2_control.",
        )

    def _check_joint(self, name: str) -> None:
        if name:
            self._actuator(name)

    # --- commands

    async def _accept_simple(self, message: Any) -> HandJob:
        request = message.command
        command = GripCommand(self._configured_joint, request.position, request.max_effort)
        return await self._begin(command, lambda fields: self._simple.result(**fields), dict)

    async def _accept_parallel(self, message: Any) -> HandJob:
        request = message.command
        names = list(request.name)
        if len(request.position) != 1 or len(names) > 1:
            raise GoalRejected(
                "a gripper takes one position and at most one name, not"
                f" {len(request.position)} and {len(names)}"
            )
        if names in ([], [""]):
            joint = self._configured_joint
        else:
            # An actuator of that name takes precedence over the gap.
            joint = "" if names[0] == GAP and GAP not in self._served.actuators else names[0]
        command = GripCommand(
            joint,
            float(request.position[0]),
            _single(request.effort, "effort"),
            _single(request.velocity, "velocity"),
        )
        name = names or [joint or GAP]

        def state(fields: dict[str, Any]) -> Message:
            return self._joint_state(
                header=self._served.header(self._served.latest.wall_ns),
                name=name,
                position=[fields["position"]],
                effort=[fields["effort"]],
            )

        def ended(fields: dict[str, Any]) -> Message:
            return self._parallel.result(
                state=state(fields),
                stalled=fields["stalled"],
                reached_goal=fields["reached_goal"],
            )

        return await self._begin(command, ended, lambda fields: {"state": state(fields)})

    @property
    def _configured_joint(self) -> str:
        return str(self._served.parameters.values[JOINT])

    def _actuator(self, name: str) -> ActuatorSpec:
        """Return an actuator by name; raise `GoalRejected` if there is none."""
        names = self._served.actuators
        if name not in names:
            raise GoalRejected(f"there is no actuator '{name[:100]}'; {suggestion(name, names)}")
        return self._served.model.actuators[names.index(name)]

    # --- goals of the hand

    async def _begin(
        self,
        command: GripCommand,
        result: Callable[[dict[str, Any]], Message],
        feedback: Callable[[dict[str, Any]], dict[str, Any]],
    ) -> HandJob:
        hand = self._served.hand
        if command.joint:
            actuator = self._actuator(command.joint)
            goal = joint_goal(command, actuator, await hand.actions())
        else:
            self._check_unit(command.position)
            goal = self._gap_goal(command)
        running = await hand.start_goal(goal)
        return HandJob(
            running,
            lambda ended: result(self._ended(command.joint, ended)),
            lambda now: feedback(self._now(command.joint, now)),
            self._stalled,
        )

    def _stalled(self, result: Result) -> str:
        allowed = self._served.parameters.values[ALLOW_STALLING]
        return "" if allowed or not result.stalled else f"it stalled, and {ALLOW_STALLING} is off"

    def _check_unit(self, gap: float) -> None:
        """Raise `GoalRejected` for a joint position in place of an opening."""
        widest = max((known.widest for known in self._served.openings), default=math.inf)
        for actuator in self._served.model.actuators:
            if widest * (1.0 + BEYOND) < gap <= actuator.upper:
                raise GoalRejected(
                    f"{gap:g} m is beyond the widest opening, {1e3 * widest:.0f} mm; if it is"
                    f" the value of '{actuator.name}', as MoveIt sends it, write"
                    " 'ros2: {gripper: moveit}' in hand.yaml"
                )

    def _gap_goal(self, command: GripCommand) -> Goal:
        """Return the goal for a gap between the fingertips."""
        gap = command.position
        action, *elements = str(self._served.parameters.values[ACTION]).split() or [""]
        if not action and self._served.openings:
            # The hand's best action for a width opens wider than it, to get around an object. To
            # open as wide as possible, take the action that opens widest.
            widest = max(self._served.openings, key=lambda known: known.widest)
            if widest.widest <= gap <= widest.widest * (1.0 + BEYOND):
                gap, action, elements = widest.widest, widest.action, list(widest.elements)
        # As the hand does: the spelling and the order of the elements do not matter.
        wanted = normalise(action), sorted(elements)
        ranges = [
            known
            for known in self._served.openings
            if not action or (normalise(known.action), sorted(known.elements)) == wanted
        ]
        return goal_of(
            action,
            elements,
            opening=gap,
            force=at_most(command.effort, gap, ranges) or None,
            tip_speed=command.speed or None,
        )

    # --- feedback and results

    def _now(self, joint: str, _: Feedback) -> dict[str, Any]:
        """Return the fields of feedback."""
        position, effort = self._measured(joint)
        limits = [actuator.velocity for actuator in self._served.model.actuators]
        return {
            "position": position,
            "effort": effort,
            "stalled": is_stalled(self._served.latest, limits),
            "reached_goal": False,
        }

    def _ended(self, joint: str, result: Result) -> dict[str, Any]:
        """Return the fields of the result."""
        position, effort = self._measured(joint)
        # The hand's result holds the values at the end; the newest state here may be older.
        if joint:
            position = result.position.get(joint, position)
        else:
            position = position if result.opening is None else result.opening
            effort = effort if result.force is None else result.force
        return {
            "position": position,
            "effort": effort,
            "stalled": result.stalled,
            "reached_goal": result.reached,
        }

    def _measured(self, joint: str) -> tuple[float, float]:
        """Return the newest position [rad | m] and effort [N·m | N], of a joint or of the gap."""
        state = self._served.latest
        if not joint:
            opening, force = state.opening, state.force
            return math.nan if opening is None else opening, math.nan if force is None else force
        row = state.names.index(joint)
        return float(state.position[row]), float(state.effort[row])


def joint_of(settings: Ros2Settings, actuators: Sequence[str]) -> str:
    """Return the actuator whose position goals give; ``""``: they give the gap.

    Raises `ConfigError` if no actuator has the configured name, or several exist and none is named.
    """
    joint = settings.gripper_joint
    if joint and joint not in actuators:
        raise ConfigError(
            f"'gripper_joint' under 'ros2' in hand.yaml: there is no actuator '{joint}';"
            f" {suggestion(joint, actuators)}"
        )
    if joint or settings.gripper is GripperUnit.METRES:
        return joint
    if len(actuators) > 1:
        raise ConfigError(
            f"'gripper: moveit' under 'ros2' in hand.yaml: the hand has {len(actuators)} actuators;"
            " name the gripper's with 'gripper_joint', or have MoveIt use FollowJointTrajectory"
        )
    return actuators[0]


def is_stalled(state: State, limits: Sequence[float]) -> bool:
    """Return whether an object blocks the hand and no actuator moves.

    An actuator whose velocity is not measured counts as still. The limits are those of the
    velocities ``(n,)`` [rad/s | m/s].
    """
    moving = np.abs(state.velocity) > _STILL * np.asarray(limits)
    return bool(state.grasped.any()) and not bool(moving.any())


def at_most(effort: float, gap: float, ranges: Sequence[OpeningRange]) -> float:
    """Return the force of a goal for the ``max_effort`` of a command [N], needed at a gap [m].

    ROS 2's controllers take ``max_effort`` as an upper bound, and programs send one value to any
    gripper. So the result is this bound, or, if all of the actions are weaker at the gap, the force
    of the strongest.
    """
    strongest = max(
        (each.forces_at(gap)[1] for each in ranges if each.narrowest <= gap <= each.widest),
        default=0.0,
    )
    # If no force can be limited, pass the bound on: the hand refuses it with the reason.
    return min(effort, strongest) if strongest else effort


def joint_goal(command: GripCommand, actuator: ActuatorSpec, actions: Sequence[Action]) -> Goal:
    """Return the goal that moves an actuator to the position of a command.

    Its action is the one that moves the fewest other actuators, at the intensity of the position.
    Raises `GoalRejected` if no action reaches the position.
    """
    suitable: list[tuple[int, float, Action]] = []
    reached = [actuator.rest]
    for action in actions:
        # A timed action has no intensity that could stop it halfway.
        if isinstance(action, Timed) or actuator.name not in action.posture.involved:
            continue
        end = action.posture.position[actuator.name]
        reached.append(end)
        if end != actuator.rest:
            share = (command.position - actuator.rest) / (end - actuator.rest)
            if -BEYOND <= share <= 1.0 + BEYOND:
                suitable.append((len(action.posture.involved), min(max(share, 0.0), 1.0), action))
    if not suitable:
        raise GoalRejected(
            f"the hand's actions bring '{actuator.name}' from {min(reached):.4g} to"
            f" {max(reached):.4g}, not to {command.position:.4g}"
        )
    _, share, action = min(suitable, key=lambda each: each[:2])
    speed = command.speed / actuator.velocity
    return Goal(
        Named(action.name, tuple(action.elements), kind_of(action)),
        Intensity(share),
        min(speed, 1.0) if speed else 1.0,
        {actuator.name: min(command.effort, actuator.effort)} if command.effort else {},
    )


def _single(values: Sequence[float], what: str) -> float:
    """Return the value of a sequence of at most one; 0 for none."""
    if len(values) > 1:
        raise GoalRejected(f"a gripper takes one {what} or none, not {len(values)}")
    return float(values[0]) if len(values) else 0.0
