"""Messages of recordings and of the network: ROS 2 types encoded in CDR."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtee.messages.convert import COMMAND as COMMAND
    from rtee.messages.convert import DEVICE_STATUS as DEVICE_STATUS
    from rtee.messages.convert import EVENT as EVENT
    from rtee.messages.convert import FEEDBACK as FEEDBACK
    from rtee.messages.convert import LOOP_STATISTICS as LOOP_STATISTICS
    from rtee.messages.convert import RESULT as RESULT
    from rtee.messages.convert import encode_string as encode_string
    from rtee.messages.goals import GOAL as GOAL
    from rtee.messages.layout import JointStateEncoder as JointStateEncoder
    from rtee.messages.schema import MessageType as MessageType
    from rtee.messages.schema import message_type as message_type
    from rtee.messages.topics import log_topic as log_topic
    from rtee.messages.topics import network_key as network_key

_CONVERTED = ("COMMAND", "DEVICE_STATUS", "EVENT", "FEEDBACK", "LOOP_STATISTICS", "RESULT")
_HOME = {
    **dict.fromkeys((*_CONVERTED, "encode_string"), "convert"),
    "GOAL": "goals",
    "JointStateEncoder": "layout",
    **dict.fromkeys(("MessageType", "message_type"), "schema"),
    **dict.fromkeys(("log_topic", "network_key"), "topics"),
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    # Imported when first used: the chunks of a recording are checked without NumPy.
    if name in _HOME:
        return getattr(import_module(f"rtee.messages.{_HOME[name]}"), name)
    raise AttributeError(f"module 'rtee.messages' has no attribute '{name}'")
