"""The proto3 messages of xbot2_zmq, built from their description at import; no protoc.

Only the fields that are known for certain are described; other fields of a server are skipped.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message

_FIELD = descriptor_pb2.FieldDescriptorProto
_PACKAGE = "rtee.xbot2"

_JOINT_STATE: tuple[tuple[str, int], ...] = (
    ("linkPos", 1), ("motPos", 2), ("linkVel", 3), ("motVel", 4), ("tor", 5), ("motorTemp", 6),
    ("driverTemp", 7), ("posRef", 8), ("velRef", 9), ("torRef", 10), ("k", 11), ("d", 12),
)  # fmt: skip
_JOINT_COMMAND: tuple[tuple[str, int], ...] = (
    ("posRef", 8), ("velRef", 9), ("torRef", 10), ("k", 11), ("d", 12),
)  # fmt: skip


class XBot2FrameError(ValueError):
    """Bytes that are not a message of xbot2_zmq."""


def _file() -> descriptor_pb2.FileDescriptorProto:
    made = descriptor_pb2.FileDescriptorProto(
        name="rtee/xbot2.proto", package=_PACKAGE, syntax="proto3"
    )

    def add(message: Any, name: str, number: int, kind: int, *, many: bool, of: str = "") -> None:
        field = message.field.add(name=name, number=number, type=kind)
        field.label = _FIELD.LABEL_REPEATED if many else _FIELD.LABEL_OPTIONAL
        if of:
            field.type_name = f".{_PACKAGE}.{of}"

    state = made.message_type.add(name="JointState")
    for name, number in _JOINT_STATE:
        add(state, name, number, _FIELD.TYPE_FLOAT, many=True)
    add(state, "jointNames", 16, _FIELD.TYPE_STRING, many=True)
    command = made.message_type.add(name="JointCommand")
    add(command, "name", 1, _FIELD.TYPE_STRING, many=True)
    for name, number in _JOINT_COMMAND:
        add(command, name, number, _FIELD.TYPE_FLOAT, many=True)
    add(command, "ctrl", 13, _FIELD.TYPE_UINT32, many=True)
    received = made.message_type.add(name="GenericRxMsg")
    add(received, "seq", 1, _FIELD.TYPE_INT32, many=False)
    add(received, "stamp", 2, _FIELD.TYPE_INT64, many=False)
    add(received, "js", 3, _FIELD.TYPE_MESSAGE, many=False, of="JointState")
    add(received, "cmd", 5, _FIELD.TYPE_MESSAGE, many=False, of="JointCommand")
    return made


_pool = descriptor_pool.DescriptorPool()
_pool.Add(_file())


def _message(name: str) -> type[Any]:
    found: type[Any] = message_factory.GetMessageClass(
        _pool.FindMessageTypeByName(f"{_PACKAGE}.{name}")
    )
    return found


JointCommand = _message("JointCommand")
"""Command of some joints; lists in the order of ``name``."""
GenericRxMsg = _message("GenericRxMsg")
"""The message that the server publishes."""


def read(kind: type[Any], data: bytes) -> Any:
    """Return the message in bytes; raises `XBot2FrameError`."""
    message: Message = kind()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise XBot2FrameError(f"this is no {kind.DESCRIPTOR.name}: {error}") from error
    return message
