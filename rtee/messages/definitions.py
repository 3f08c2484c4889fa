"""Definitions of the messages in the log and on the network, in ROS 2's own notation.

The text is the only source: schemas in recordings, encoders and decoders, the type store of
`rosbags` and the reference in the documentation are made from it. Units are SI; ``NaN`` means
"not measured" or "not given".
"""

from __future__ import annotations

from rtee.messages.services import SERVICES

DEFINITIONS: dict[str, str] = {
    "builtin_interfaces/msg/Time": """\
# Time since 1970-01-01 00:00 UTC.
int32 sec                    # whole seconds
uint32 nanosec               # and nanoseconds, 0 to 999999999
""",
    "std_msgs/msg/Header": """\
# When and in which frame.
builtin_interfaces/Time stamp
string frame_id
""",
    "std_msgs/msg/String": """\
# A text, such as the robot's URDF.
string data
""",
    "sensor_msgs/msg/JointState": """\
# Positions, velocities and efforts by joint.
std_msgs/Header header
string[] name
float64[] position           # [rad | m]
float64[] velocity           # [rad/s | m/s]
float64[] effort             # [N.m | N]
""",
    "geometry_msgs/msg/Vector3": """\
# A position or a direction.
float64 x                    # [m]
float64 y
float64 z
""",
    "geometry_msgs/msg/Quaternion": """\
# An orientation, as a unit quaternion.
float64 x
float64 y
float64 z
float64 w
""",
    "geometry_msgs/msg/Transform": """\
# Where one frame stands in another.
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
""",
    "geometry_msgs/msg/TransformStamped": """\
# Where a link's frame stands in its parent's; header.frame_id is the parent.
std_msgs/Header header
string child_frame_id        # the link
geometry_msgs/Transform transform
""",
    "tf2_msgs/msg/TFMessage": """\
# Transforms of several frames.
geometry_msgs/TransformStamped[] transforms
""",
    "rtee_msgs/msg/ActuatorState": """\
# What the actuators measured in a tick, as the executor was given it.
std_msgs/Header header
uint64 tick                  # number of the tick
float64 time                 # time given to the executor, CLOCK_MONOTONIC [s]
string[] name                # actuators
float64[] position           # [rad | m]
float64[] velocity           # [rad/s | m/s]
float64[] effort             # [N.m | N]
float64[] current            # [A]
float64[] temperature        # [degC]
int8[] grasped               # the device's own word: 1 holding, 0 not, -1 none
bool[] fresh                 # measured since the last tick; else it repeats an older one
""",
    "rtee_msgs/msg/Channels": """\
# Further measured channels, such as pressure.
std_msgs/Header header
uint64 tick                  # number of the tick
string[] name                # channels
uint32[] length              # values per channel
float64[] value              # values of all channels, one channel after the other
""",
    "rtee_msgs/msg/Goal": """\
# A grasping action to be executed.
std_msgs/Header header
float64 time                 # when the tick was due at which it took effect, CLOCK_MONOTONIC [s]
string goal_id               # its identifier
string client                # who asks
string action                # name of the action
string kind                  # primitive, composed, timed, generic, or empty: any
string[] elements            # fingers or actuator a primitive is done with
float64 intensity            # 0 (rest) to 1
string[] effort_name         # actuators with an effort limit of their own
float64[] effort             # those limits [N.m | N]
float64 tolerance            # error norm at which it counts as reached
float64 speed                # scale of the velocity limits, above 0 up to 1
float64 timeout              # longest time [s]; NaN: as configured
string stage                 # both, pre_grasp or grasp
""",
    "rtee_msgs/msg/Leg": """\
# One way to a set of set-points.
string name                  # inner action of a timed one, else empty
string[] actuator            # actuators that move
float64[] target             # where to [rad | m]
float64 before               # time to wait before [s]
float64 after                # time to wait after it is completed [s]
""",
    "rtee_msgs/msg/Plan": """\
# What a goal comes to.
std_msgs/Header header
float64 time                 # when the tick was due at which it took effect, CLOCK_MONOTONIC [s]
string goal_id               # the goal
string action                # name of the action, as the hand writes it
bool timed                   # the legs are inner actions
float64 timeout              # longest time [s]
string[] effort_name         # actuators with an effort limit of their own
float64[] effort             # those limits [N.m | N]
rtee_msgs/Leg[] legs         # what to do, one after the other
""",
    "rtee_msgs/msg/Feedback": """\
# How far a goal has come.
std_msgs/Header header
float64 time                 # CLOCK_MONOTONIC [s]
string goal_id               # the goal
float64 progress             # 0 to 1
string inner                 # inner action under way of a timed action, else empty
string[] inner_name          # inner actions of a timed action, in order
float64[] inner_progress     # progress of each, 0 to 1
""",
    "rtee_msgs/msg/Result": """\
# How a goal ended.
std_msgs/Header header
float64 time                 # CLOCK_MONOTONIC [s]
string goal_id               # the goal
string action                # name of the action
bool reached                 # the posture is within the tolerance
bool stalled                 # the hand stopped short of it
bool grasped                 # the hand holds something
string[] grasped_fingers     # the fingers that hold it
bool preempted               # a new goal replaced it
bool cancelled               # it was cancelled
bool timed_out               # it took too long
bool aborted                 # it could not go on
string reason                # why it was aborted
float64 error                # norm of the remaining error [rad | m]
float64 duration             # from acceptance to the end [s]
string[] position_name       # actuators
float64[] position           # measured at the end [rad | m]
""",
    "rtee_msgs/msg/Event": """\
# Something worth telling that is neither feedback nor a result.
std_msgs/Header header
float64 time                 # CLOCK_MONOTONIC [s]
string kind                  # grasp_lost, device_fault, stop, mark and the like
string source                # device, finger or client it concerns
string text                  # one sentence
string severity              # info, warning or error
""",
    "rtee_msgs/msg/Command": """\
# A call that steered the hand, other than a goal; with the goals it replays the hand.
std_msgs/Header header
uint64 tick                  # tick at which it took effect, before its set-points
float64 time                 # when that tick was due, CLOCK_MONOTONIC [s]
string kind                  # cancel, hold, freeze, jog, holding, active, accepts or fail
string text                  # goal (cancel), reason (hold, freeze, fail), velocity limit (jog)
string[] name                # actuators, or effort (holding)
float64[] value              # position [rad | m] (jog), fraction (holding), else 1 or 0
""",
    "rtee_msgs/msg/DeviceStatus": """\
# How a device is doing.
std_msgs/Header header
string name                  # the device
string driver                # its driver
string lifecycle             # unconfigured, inactive, active, fault or closed
string[] identity_name       # what it told about itself
string[] identity_value
float64 rate                 # measured rate of exchanges [Hz]
uint32 every                 # exchanged every n ticks
float64 age                  # of the newest measurement [s]
uint64 exchanges             # exchanges done
uint64 overruns              # exchanges that missed their deadline
uint64 errors                # exchanges that failed
uint64 reconnects            # times the link was re-established
string[] counter_name        # counters of the bus
int64[] counter_value
int64 fault_code             # the device's own code, 0 for none
string fault_name            # empty for none
bool recoverable             # recover may clear the fault
string hint                  # what the user can do
string message               # the last error in words
string[] gain                # gains that can be tuned while it runs
""",
    "rtee_msgs/msg/LoopStatistics": """\
# The loop's clock; times in seconds.
std_msgs/Header header
float64 rate                 # configured [Hz]
float64 measured_rate        # over the last window [Hz]
uint64 ticks                 # ticks done
uint64 missed                # ticks missed
float64 lateness_p50         # wake-up after the tick's due time, median [s]
float64 lateness_p99         # 99th percentile [s]
float64 lateness_p999        # 99.9th percentile [s]
float64 lateness_max         # worst [s]
float64 busy_p50             # work in a tick, median [s]
float64 busy_p99             # 99th percentile [s]
float64 busy_p999            # 99.9th percentile [s]
float64 busy_max             # worst [s]
uint64 dropped               # log records dropped
""",
    **SERVICES,
}
"""Full name of a message to its definition."""
