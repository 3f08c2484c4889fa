"""Names of the topics in a recording and of the keys on the network.

In a recording a topic is ``/<hand>/<name>``, on the network a key is ``rtee/<hand>/<name>``; the
names and the types are the same in both.
"""

from __future__ import annotations

JOINT_STATES = "joint_states"
ACTUATOR_STATES = "actuator_states"
REFERENCE = "reference"
CHANNELS = "channels"
GOALS = "goals"
PLANS = "plans"
FEEDBACK = "feedback"
RESULTS = "results"
EVENTS = "events"
COMMANDS = "commands"
DEVICE_STATUS = "device_status"
LOOP_STATISTICS = "loop_statistics"
ROBOT_DESCRIPTION = "robot_description"

TYPES: dict[str, str] = {
    JOINT_STATES: "sensor_msgs/msg/JointState",
    ACTUATOR_STATES: "rtee_msgs/msg/ActuatorState",
    REFERENCE: "sensor_msgs/msg/JointState",
    CHANNELS: "rtee_msgs/msg/Channels",
    GOALS: "rtee_msgs/msg/Goal",
    PLANS: "rtee_msgs/msg/Plan",
    FEEDBACK: "rtee_msgs/msg/Feedback",
    RESULTS: "rtee_msgs/msg/Result",
    EVENTS: "rtee_msgs/msg/Event",
    COMMANDS: "rtee_msgs/msg/Command",
    DEVICE_STATUS: "rtee_msgs/msg/DeviceStatus",
    LOOP_STATISTICS: "rtee_msgs/msg/LoopStatistics",
    ROBOT_DESCRIPTION: "std_msgs/msg/String",
}
"""Name of a topic to the type of its messages."""

PUBLISHED = frozenset(
    {
        JOINT_STATES,
        REFERENCE,
        GOALS,
        FEEDBACK,
        RESULTS,
        EVENTS,
        DEVICE_STATUS,
        LOOP_STATISTICS,
    }
)
"""Topics that are also published on the network."""

PREFIX = "rtee"
"""First part of every key on the network."""


def log_topic(hand: str, name: str) -> str:
    """Return a topic's full name in a recording.

    The robot's description is ``/robot_description``, where viewers look for it, whatever the hand.
    """
    return f"/{name}" if name == ROBOT_DESCRIPTION else f"/{hand}/{name}"


def network_key(hand: str, name: str) -> str:
    """Return a key on the network; ``*`` as the hand stands for all."""
    return f"{PREFIX}/{hand}/{name}"
