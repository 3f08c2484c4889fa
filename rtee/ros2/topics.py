"""The topics that a hand's node publishes: joints, transforms, openings, forces, goals, events."""

from __future__ import annotations

import math
import re
from collections.abc import AsyncIterator, Callable, Iterable
from typing import Any, TypeVar

import anyio
import numpy as np

from rtee.errors import ModelError
from rtee.hand.embedded_meshes import with_mesh_addresses
from rtee.hand.frames import JointFrames
from rtee.hand.meshes import resolve_mesh
from rtee.hand.model import Hand
from rtee.loop.measured import TIP_FORCE, tip_forces
from rtee.messages import EVENT, FEEDBACK, RESULT, JointStateEncoder, encode_string
from rtee.messages.layout import TransformsEncoder
from rtee.messages.state import State
from rtee.messages.touch import TOUCH_SENSORS, TouchEncoder, measured_at, sensors_fields
from rtee.ros2.endpoints import Publisher
from rtee.ros2.message import Message
from rtee.ros2.parameters import Parameter
from rtee.ros2.qos import LATCHED, Qos
from rtee.ros2.served_hand import Part, ServedHand
from rtee.touch import TouchState

T = TypeVar("T")

RATE = "rate"
"""Name of the parameter for the rate of published states."""

_TRANSFORMS = Qos(depth=100)
"""QoS of ``/tf``, that of tf2_ros."""


def ros_name(name: str) -> str:
    """Return a name that ROS 2 allows: letters, digits and underscores, with no digit first."""
    allowed = re.sub(r"\W", "_", name, flags=re.ASCII)
    return allowed if allowed[:1].isalpha() or allowed[:1] == "_" else f"_{allowed}"


def description(model: Hand, urdf: str) -> str:
    """Return the URDF of a running hand with absolute addresses of the meshes on this computer.

    Searches the model's folders for the meshes.
    """
    addresses = {}
    links = model.urdf.links.values()
    for shape in (each for link in links for each in (*link.visuals, *link.collisions)):
        if shape.kind == "mesh" and shape.mesh not in addresses:
            try:
                path = resolve_mesh(shape.mesh, model.urdf.path, model.package_dirs)
            except ModelError:
                continue  # the reader of the description may find it on its computer
            addresses[shape.mesh] = path.resolve().as_uri()
    return with_mesh_addresses(urdf, addresses)


class JointStates:
    """Encoder of ``sensor_msgs/msg/JointState`` for all moving joints of a hand.

    Velocities and efforts that are not measured are ``NaN``, as in joint_state_broadcaster; efforts
    are those of the actuators.
    """

    def __init__(self, model: Hand) -> None:
        self._transmission = model.transmission
        self._encoder = JointStateEncoder(model.joint_names)
        self._rows = np.array([model.joint_index(name) for name in model.actuator_names], np.intp)
        # Only the rows of actuators are written later; joints that follow others keep NaN.
        self._effort = np.full(len(model.joint_names), math.nan)

    def encode(self, state: State) -> bytes:
        """Return the CDR bytes of a state's message."""
        self._effort[self._rows] = state.effort
        velocity = self._transmission.velocities(state.position, state.velocity)
        return self._encoder.encode(state.wall_ns, state.joint_position, velocity, self._effort)


class Topics(Part):
    """Publishes the states of a hand, its description, and the feedback and results of goals."""

    def __init__(self, served: ServedHand) -> None:
        self._served, node, model = served, served.node, served.model
        self._again = anyio.CancelScope()
        self._joint_states = JointStates(model)
        self._joints = node.publisher("joint_states", "sensor_msgs/msg/JointState")
        self._ros_end_effector = RosEndEffectorTopics(served)
        urdf = description(model, served.info.urdf)
        node.publisher("robot_description", "std_msgs/msg/String", LATCHED).publish(
            encode_string(urdf)
        )
        self._transforms = self._tf = None
        if served.settings.tf:
            self._transforms = JointFrames(model)
            self._moving = TransformsEncoder(*_ends(self._transforms.moving))
            self._tf = node.publisher("/tf", "tf2_msgs/msg/TFMessage", _TRANSFORMS)
            fixed = TransformsEncoder(*_ends(self._transforms.fixed))
            node.publisher("/tf_static", "tf2_msgs/msg/TFMessage", LATCHED).publish(
                fixed.encode(served.latest.wall_ns, *self._transforms.still)
            )
        number = "std_msgs/msg/Float64"
        self._opening = self._force = None
        if served.openings:
            self._opening = node.publisher("~/opening", number)
            self._force = node.publisher("~/force", number)
        self._number = served.message(number)
        self._tips: list[tuple[str, Publisher]] = []
        # Only hands that measure these forces have the topics.
        if any(name.endswith(f"/{TIP_FORCE}") for name in served.latest.channels):
            kind = "geometry_msgs/msg/WrenchStamped"
            self._tips = [
                (finger.tip or finger.base, node.publisher(f"~/tip_forces/{ros_name(name)}", kind))
                for name, finger in zip(model.finger_names, model.fingers, strict=True)
            ]
        self._control = ControllerStates(served)
        self._feedback = node.publisher("~/feedback", "rtee_msgs/msg/Feedback")
        self._results = node.publisher("~/results", "rtee_msgs/msg/Result")
        self._events = node.publisher("~/events", "rtee_msgs/msg/Event")
        self._touch = TouchTopics(served)

    def parameters(self) -> Iterable[Parameter]:
        """Return the parameter `RATE`."""
        yield Parameter(
            RATE,
            float(self._served.settings.rate),
            "Rate of joint_states and of the other topics of measurements [Hz]; the nearest rate"
            " that divides the loop's rate is used.",
            lower=1.0,
            upper=1000.0,
            change=lambda _: self._again.cancel(),
        )

    async def run(self) -> None:
        """Publish until the hand ends."""
        hand = self._served.hand
        async with anyio.create_task_group() as group:
            group.start_soon(self._relay, hand.feedback(), self._feedback, FEEDBACK.encode)
            group.start_soon(self._relay, hand.results(), self._results, RESULT.encode)
            group.start_soon(self._relay, hand.events(), self._events, EVENT.encode)
            group.start_soon(self._touch.run)
            while True:
                with anyio.CancelScope() as self._again:
                    # A changed rate is stored only after this scope was cancelled.
                    await anyio.lowlevel.checkpoint()
                    async for state in hand.states(self._served.number(RATE)):
                        self._served.latest = state
                        self.publish(state)

    @staticmethod
    async def _relay(
        messages: AsyncIterator[T], publisher: Publisher, encode: Callable[[T], bytes]
    ) -> None:
        async for message in messages:
            publisher.publish(encode(message))

    def publish(self, state: State) -> None:
        """Publish a state on the topics that have subscribers."""
        if self._joints.heard:
            self._joints.publish(self._joint_states.encode(state))
        self._ros_end_effector.publish(state, self._joint_states)
        if self._tf is not None and self._transforms is not None and self._tf.heard:
            where = self._transforms.at(state.joint_position)
            self._tf.publish(self._moving.encode(state.wall_ns, *where))
        for publisher, value in ((self._opening, state.opening), (self._force, state.force)):
            if publisher is not None and value is not None and publisher.heard:
                publisher.publish(self._number(data=value))
        if any(publisher.heard for _, publisher in self._tips):
            self._publish_forces(state)
        self._control.publish(state)

    def _publish_forces(self, state: State) -> None:
        forces = [v for name, v in state.channels.items() if name.endswith(f"/{TIP_FORCE}")]
        wrench: Any = self._served.message("geometry_msgs/msg/WrenchStamped")
        # All tips share a header, since a message is encoded before the next one changes it.
        message = wrench(header=self._served.header(state.wall_ns))
        for (frame, publisher), force in zip(self._tips, tip_forces(forces), strict=False):
            if not math.isnan(force):
                message.header.frame_id, message.wrench.force.z = frame, force
                publisher.publish(message)


class RosEndEffectorTopics:
    """Publishes joints and references on the topics of ROS End-Effector.

    There, hardware nodes publish ``/ros_end_effector/joint_states``, and the executor publishes
    ``motor_reference_pos``, whose efforts are here the effort limits, or 0 for none.
    """

    def __init__(self, served: ServedHand) -> None:
        kind = "sensor_msgs/msg/JointState"
        self._served, self._kind = served, served.message(kind)
        self._joints = served.node.publisher("ros_end_effector/joint_states", kind)
        self._references = served.node.publisher("motor_reference_pos", kind)

    def publish(self, state: State, joints: JointStates) -> None:
        """Publish a state on the topics that have subscribers."""
        if self._joints.heard:
            self._joints.publish(joints.encode(state))
        if self._references.heard:
            effort = state.reference_effort
            message = self._kind(
                header=self._served.header(state.wall_ns),
                name=list(state.names),
                position=state.reference_position,
                velocity=state.reference_velocity,
                effort=np.where(np.isfinite(effort), effort, 0.0),
            )
            self._references.publish(message)


class TouchTopics:
    """Publishes ``~/touch`` at each reading, and ``~/touch_sensors`` for later subscribers, too."""

    def __init__(self, served: ServedHand) -> None:
        self._served = served
        self._encoder = TouchEncoder()
        self._touch = served.node.publisher("~/touch", "rtee_msgs/msg/Touch")
        self._sensors = served.node.publisher(
            "~/touch_sensors", "rtee_msgs/msg/TouchSensors", LATCHED
        )

    async def run(self) -> None:
        """Publish until the hand ends."""
        known: dict[str, TouchState] = {}
        async for state in self._served.hand.touch_states():
            before = known.get(state.device)
            known[state.device] = state
            now = self._served.latest
            # Compare by identity: the states of one device share their tuple of sensors.
            if before is None or before.sensors is not state.sensors:
                fields = sensors_fields(known.values(), now.wall_ns)
                self._sensors.publish(TOUCH_SENSORS.encode(fields))
            if self._touch.heard:
                wall = measured_at(now, state)
                self._touch.publish(self._encoder.encode(state, wall))


class ControllerStates:
    """Publishes ``~/controller_state`` as the joint_trajectory_controller of ros2_control does.

    The message holds the set-points of the actuators, their measured states, and the differences.
    """

    def __init__(self, served: ServedHand) -> None:
        kind = "control_msgs/msg/JointTrajectoryControllerState"
        self._served = served
        self._kind = served.message(kind)
        self._point = served.message("trajectory_msgs/msg/JointTrajectoryPoint")
        self._publisher = served.node.publisher("~/controller_state", kind)

    def publish(self, state: State) -> None:
        """Publish a state if anybody subscribes."""
        if self._publisher.heard:
            self._publisher.publish(self._message(state))

    def _message(self, state: State) -> Message:
        point = self._point
        reference = point(positions=state.reference_position, velocities=state.reference_velocity)
        return self._kind(
            header=self._served.header(state.wall_ns),
            joint_names=list(state.names),
            reference=reference,
            feedback=point(
                positions=state.position, velocities=state.velocity, effort=state.effort
            ),
            error=point(
                positions=state.reference_position - state.position,
                velocities=state.reference_velocity - state.velocity,
            ),
            output=reference,
            speed_scaling_factor=1.0,
        )


def _ends(frames: Iterable[tuple[str, str]]) -> tuple[list[str], list[str]]:
    """Return the parents and the children of pairs."""
    pairs = list(frames)
    return [parent for parent, _ in pairs], [child for _, child in pairs]
