"""The one vocabulary of messages: ROS 2 types in CDR, in recordings and on the network alike."""

from rtee.messages.command import decode_command, encode_command
from rtee.messages.convert import (
    decode_device_status,
    decode_event,
    decode_feedback,
    decode_loop_statistics,
    decode_result,
    decode_string,
    encode_device_status,
    encode_event,
    encode_feedback,
    encode_loop_statistics,
    encode_result,
    encode_string,
)
from rtee.messages.goal import decode_goal, encode_goal
from rtee.messages.layout import JointStateEncoder
from rtee.messages.schema import MessageType, message_type
from rtee.messages.topics import log_topic, network_key

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
