"""Definitions of the requests and replies on the network, in ROS 2's own notation."""

from __future__ import annotations

SERVICES: dict[str, str] = {
    "rtee_msgs/msg/Empty": """\
# A request without arguments.
bool unused
""",
    "rtee_msgs/msg/Reply": """\
# Whether a request was taken.
bool accepted                # it was
string error                 # name of the error, such as GoalRejected; empty when accepted
string reason                # why not, in one sentence
string text                  # what it made, such as a goal's identifier
""",
    "rtee_msgs/msg/GoalReference": """\
# A goal that is meant: to cancel it.
string goal_id               # empty: whichever runs
string client                # who asks
""",
    "rtee_msgs/msg/ClientRequest": """\
# A client asks for something: the lease, a stop, to open, to recover a device.
string client                # who asks
string what                  # acquire, release or the device's name; empty: all
""",
    "rtee_msgs/msg/StopReply": """\
# What the devices answered to a stop.
string[] device              # devices
bool[] confirmed             # whether each confirmed it
""",
    "rtee_msgs/msg/RecordRequest": """\
# A client starts, stops or marks the recording.
string client                # who asks
string what                  # start, stop or mark
string text                  # of the mark
""",
    "rtee_msgs/msg/NamedValues": """\
# Numbers by name: positions to jog to, gains of a device.
string client                # who asks
string source                # the device, where one is meant
string[] name                # actuators or gains
float64[] value              # positions [rad | m] or gains
float64 limit                # velocity limit [rad/s | m/s]; NaN: that of the hand
""",
    "rtee_msgs/msg/ActionFilter": """\
# Which actions are asked for; empty fields match all.
string kind                  # primitive, composed, timed or generic
string name                  # name of the action
string[] elements            # elements it is done with
""",
    "rtee_msgs/msg/Posture": """\
# Actuator positions with the mask of the involved ones.
string[] name                # actuators
float64[] position           # [rad | m]
string[] involved            # actuators that the action moves
""",
    "rtee_msgs/msg/ActionPart": """\
# An inner action of a composed or timed one.
string action                # name of the action
string[] elements            # elements, for a primitive
float64 scale                # of its set-points, from rest
string alias                 # its name within a timed action
float64 before               # margin before it starts [s]
float64 after                # margin after it is completed [s]
""",
    "rtee_msgs/msg/Evidence": """\
# What the extraction found at a posture of a pinch; frames: the hand's base.
float64 depth                # penetration of the tips [m]
float64 distance             # of the tips [m]
float64 frame_distance       # of the origins of the tips' links [m]; NaN: unknown
float64 contact_at           # intensity at which the tips first touch; NaN: unknown
float64[] point              # contact point [m], or empty
float64[] normal             # unit normal, or empty
bool clear                   # nothing else collides
bool path_clear              # nor on the straight way from rest
float64 clearance            # least distance from all else, 5 mm at most [m]; NaN: not clear
string[] colliding           # links that do collide, two per pair
string[] pair                # fingers of a multi-pinch that touch, two per pair
float64[] pair_depth         # depth of each pair [m]
float64[] angles             # between normal and line of closing, per tip [rad], or empty
bool force_closure           # a small ball at the contact is held
float64 friction             # coefficient assumed for that
""",
    "rtee_msgs/msg/Action": """\
# A grasping action of the hand.
string name                  # its name
string kind                  # primitive, composed, timed or generic
string[] elements            # fingers or actuator, for a primitive
string[] fingers             # fingers involved
string description           # one sentence
bool independent             # parts of a composed one share no actuator
bool stored                  # it stands in a file of the hand
rtee_msgs/Posture[] postures # ranked postures of a primitive; one otherwise; per part if timed
rtee_msgs/Evidence[] evidence # per posture of a primitive, or empty
rtee_msgs/ActionPart[] parts # inner actions of a composed or timed one
""",
    "rtee_msgs/msg/ActionList": """\
# Grasping actions.
rtee_msgs/Action[] actions
""",
    "rtee_msgs/msg/Combination": """\
# Elements a primitive can be done with.
string[] elements
""",
    "rtee_msgs/msg/PrimitiveGroup": """\
# All primitives of one name.
string name                  # Trig, MultiPinchTight_3 and so on
string[] selectable          # elements that occur
uint32 count                 # how many are selected at once
rtee_msgs/Combination[] combinations
""",
    "rtee_msgs/msg/PrimitiveGroups": """\
# All primitives, by name.
rtee_msgs/PrimitiveGroup[] groups
""",
    "rtee_msgs/msg/Names": """\
# A list of names.
string[] names
""",
    "rtee_msgs/msg/NewAction": """\
# A composed, timed or generic action to be made while the hand runs.
string client                # who asks
rtee_msgs/Action action      # the action; the hand works out the postures of what it is made of
bool store                   # also write it to the hand's folder
bool replace                 # replace an action of the same name
""",
    "rtee_msgs/msg/ActionName": """\
# An action that is meant: to find its partners, to remove, store or rename it.
string client                # who asks
string name                  # its name
string what                  # an element, or the new name
""",
    "rtee_msgs/msg/State": """\
# Everything that is measured of a hand and sent to it in one tick; NaN: not measured.
std_msgs/Header header
uint64 tick                  # number of the tick
float64 time                 # when it was due, CLOCK_MONOTONIC of the hand's computer [s]
string[] name                # actuators
float64[] position           # [rad | m]
float64[] velocity           # [rad/s | m/s]
float64[] effort             # [N.m | N]
float64[] current            # [A]
float64[] temperature        # [degC]
int8[] grasped               # the device's own word: 1 holding, 0 not, -1 none
bool[] fresh                 # measured since the last tick
float64[] reference_position # sent [rad | m]
float64[] reference_velocity # its velocity [rad/s | m/s]
float64[] reference_effort   # effort limit sent [N.m | N]; inf: the device's own
string[] joint               # all moving joints
float64[] joint_position     # [rad | m]
string[] channel             # further measured channels, device/channel
uint32[] channel_length      # values per channel
float64[] channel_value      # values of all channels, one channel after the other
""",
    "rtee_msgs/msg/StreamRequest": """\
# A client asks for states at a rate of its own.
string client                # who asks
float64 rate                 # wanted [Hz]
""",
    "rtee_msgs/msg/PostureRequest": """\
# A client asks for the hand's information at a posture; empty: at rest.
string[] name                # actuators
float64[] position           # [rad | m]
""",
    "rtee_msgs/msg/GraspRequest": """\
# A client asks which action suits an object.
string object                # box:WxDxH, cylinder:RxH, sphere:R, capsule:RxL [m]; a mesh's name
uint8[] mesh                 # content of its mesh file, 60 kB at most, or empty
string format                # suffix of that file, such as .stl
float64 mass                 # of the object [kg]
float64 friction             # coefficient of friction
float64 scale                # brings the mesh to metres
float64[] weight_axis        # where its weight pulls, in the hand's base frame; or empty
uint32 top                   # how many grasps are wanted
""",
    "rtee_msgs/msg/ActuatorInfo": """\
# An actuator as a grasp planner needs it.
string name
string kind                  # revolute, continuous or prismatic
float64 lower                # [rad | m]
float64 upper                # [rad | m]
float64 velocity             # limit [rad/s | m/s]
float64 acceleration         # limit [rad/s2 | m/s2]
float64 jerk                 # limit [rad/s3 | m/s3]
float64 effort               # limit [N.m | N]
float64 rest                 # in the rest posture [rad | m]
string[] fingers             # fingers whose tips it moves
""",
    "rtee_msgs/msg/FingerInfo": """\
# A finger as a grasp planner needs it.
string name
string base                  # first link
string tip                   # the fingertip's link
string[] links               # from base to end
string[] actuators           # that move the tip, nearest the palm first
float64[] tip_pose           # 4x4, row by row, in the hand's base frame, at the posture asked for
float64[] jacobian           # of the tip, 6 rows (linear, angular) by actuators, row by row
""",
    "rtee_msgs/msg/HandInfo": """\
# A hand as a grasp planner needs it.
string name
string base                  # root link
rtee_msgs/ActuatorInfo[] actuators
string[] joints              # moving joints
rtee_msgs/FingerInfo[] fingers
string[] posture_name        # actuators
float64[] posture            # at which poses and matrices hold [rad | m]
float64[] transmission       # d joints / d actuators there, joints by actuators, row by row
float64[] offset             # joint positions at the posture [rad | m]
string[] missing             # what could not be told, and why
string urdf                  # the model's text
""",
    "rtee_msgs/msg/Status": """\
# The loop and its devices.
string hand                  # the hand
string holder                # client that holds the hand, or empty
string goal_id               # goal that runs, or empty
string action                # its action
bool recording               # a recording is written
string recording_path        # to this file
string recording_trouble     # what it has lost and why, or empty
float64 grip_effort       # effort kept on what is held, as a fraction of the effort limit
rtee_msgs/LoopStatistics statistics
rtee_msgs/DeviceStatus[] devices
string profile               # how references move, and why if not as in hand.yaml
""",
}
"""Full name of a message to its definition."""
