"""The one vocabulary of messages: ROS 2 types in CDR, in recordings and on the network alike."""

from rtee.messages.convert import (
    COMMAND,
    DEVICE_STATUS,
    EVENT,
    FEEDBACK,
    GOAL,
    LOOP_STATISTICS,
    RESULT,
    decode_string,
    encode_string,
)
from rtee.messages.layout import JointStateEncoder
from rtee.messages.schema import MessageType, message_type
from rtee.messages.topics import log_topic, network_key

encode_goal, decode_goal = GOAL.encode, GOAL.decode
encode_feedback, decode_feedback = FEEDBACK.encode, FEEDBACK.decode
encode_result, decode_result = RESULT.encode, RESULT.decode
encode_event, decode_event = EVENT.encode, EVENT.decode
encode_command, decode_command = COMMAND.encode, COMMAND.decode
encode_device_status, decode_device_status = DEVICE_STATUS.encode, DEVICE_STATUS.decode
encode_loop_statistics, decode_loop_statistics = LOOP_STATISTICS.encode, LOOP_STATISTICS.decode

__all__ = [
    "JointStateEncoder",
    "MessageType",
    "decode_command",
    "decode_device_status",
    "decode_event",
    "decode_feedback",
    "decode_goal",
    "decode_loop_statistics",
    "decode_result",
    "decode_string",
    "encode_command",
    "encode_device_status",
    "encode_event",
    "encode_feedback",
    "encode_goal",
    "encode_loop_statistics",
    "encode_result",
    "encode_string",
    "log_topic",
    "message_type",
    "network_key",
]
