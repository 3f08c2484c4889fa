"""Messages of recordings and of the network: ROS 2 types encoded in CDR."""

from rtee.messages.convert import (
    COMMAND,
    DEVICE_STATUS,
    EVENT,
    FEEDBACK,
    LOOP_STATISTICS,
    RESULT,
    decode_string,
    encode_string,
)
from rtee.messages.goals import GOAL
from rtee.messages.layout import JointStateEncoder
from rtee.messages.schema import MessageType, message_type
from rtee.messages.topics import log_topic, network_key

__all__ = [
    "COMMAND",
    "DEVICE_STATUS",
    "EVENT",
    "FEEDBACK",
    "GOAL",
    "LOOP_STATISTICS",
    "RESULT",
    "JointStateEncoder",
    "MessageType",
    "decode_string",
    "encode_string",
    "log_topic",
    "message_type",
    "network_key",
]
