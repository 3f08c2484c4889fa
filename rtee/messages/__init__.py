"""Messages of recordings and of the network: ROS 2 types encoded in CDR."""

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

encode_goal = GOAL.encode
"""Encode a goal in CDR."""
decode_goal = GOAL.decode
"""Return a goal from CDR; raises `MessageError` if the message holds none."""
encode_feedback = FEEDBACK.encode
"""Encode feedback in CDR."""
decode_feedback = FEEDBACK.decode
"""Return feedback from CDR; raises `MessageError` if the message holds none."""
encode_result = RESULT.encode
"""Encode a result in CDR."""
decode_result = RESULT.decode
"""Return a result from CDR; raises `MessageError` if the message holds none."""
encode_event = EVENT.encode
"""Encode an event in CDR."""
decode_event = EVENT.decode
"""Return an event from CDR; raises `MessageError` if the message holds none."""
encode_command = COMMAND.encode
"""Encode a command in CDR."""
decode_command = COMMAND.decode
"""Return a command from CDR; raises `MessageError` if the message holds none."""
encode_device_status = DEVICE_STATUS.encode
"""Encode a device's status in CDR."""
decode_device_status = DEVICE_STATUS.decode
"""Return a device's status from CDR; raises `MessageError` if the message holds none."""
encode_loop_statistics = LOOP_STATISTICS.encode
"""Encode the loop's statistics in CDR."""
decode_loop_statistics = LOOP_STATISTICS.decode
"""Return the loop's statistics from CDR; raises `MessageError` if the message holds none."""

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
