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
STREAM_SAMPLES = "stream_samples"
DEVICE_STATUS = "device_status"
LOOP_STATISTICS = "loop_statistics"
OBJECT = "object"
ROBOT_DESCRIPTION = "robot_description"
URDF = "urdf"
TF = "tf"
TF_STATIC = "tf_static"
GRIP = "grip"
TOUCH = "touch"
TOUCH_SENSORS = "touch_sensors"
TICKS = "ticks"

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
    OBJECT: "rtee_msgs/msg/Object",
    ROBOT_DESCRIPTION: "std_msgs/msg/String",
    URDF: "std_msgs/msg/String",
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
    STREAM_SAMPLES: "rtee_msgs/msg/StreamSample",
    GRIP: "rtee_msgs/msg/Grip",
    TOUCH: "rtee_msgs/msg/Touch",
    TOUCH_SENSORS: "rtee_msgs/msg/TouchSensors",
    TICKS: "rtee_msgs/msg/Ticks",
}
"""Types of messages by name of the topic."""

FOR_VIEWERS = frozenset({URDF, TF, TF_STATIC})
"""Topics that follow from others and are recorded only for other software."""

DESCRIBING = frozenset({ROBOT_DESCRIPTION, OBJECT, TOUCH_SENSORS}) | FOR_VIEWERS
"""Topics that describe a hand and its surroundings, or their poses, for other programs."""

DIGESTED = frozenset({GOALS, PLANS, RESULTS, EVENTS, LOOP_STATISTICS})
"""Topics of which every recording holds a copy at its end, for a summary."""

LATCHED = frozenset({ROBOT_DESCRIPTION, URDF, TF_STATIC, OBJECT, TOUCH_SENSORS})
"""Topics whose last message stays valid until the next one and is kept for later subscribers."""

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
        TOUCH,
    }
)
"""Topics that are also published on the network."""

PREFIX = "rtee"
"""First part of every key on the network."""

# Viewers expect these names without the hand.
_FIXED = frozenset({ROBOT_DESCRIPTION, TF, TF_STATIC})


def log_topic(hand: str, name: str) -> str:
    """Return a topic's full name in a recording.

    The hand's name is left out of ``/robot_description``, ``/tf`` and ``/tf_static``, and of all
    topics of a hand without a name, as in recordings of other programs.
    """
    return f"/{name}" if name in _FIXED or not hand else f"/{hand}/{name}"


def network_key(hand: str, name: str) -> str:
    """Return the key of a topic on the network; the hand ``*`` matches all hands."""
    return f"{PREFIX}/{hand}/{name}"
