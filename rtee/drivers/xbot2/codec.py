"""Messages over xbot2_zmq: states, commands, service requests, units. No I/O."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, Self

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from rtee.buses.parser import CodecError
from rtee.hand.yamlfile import yaml_reader

_FIELD = descriptor_pb2.FieldDescriptorProto
_PACKAGE = "rtee.xbot2"

_JOINT_STATE: tuple[tuple[str, int], ...] = (
    ("linkPos", 1), ("motPos", 2), ("linkVel", 3), ("motVel", 4), ("tor", 5), ("motorTemp", 6),
    ("driverTemp", 7), ("posRef", 8), ("velRef", 9), ("torRef", 10), ("k", 11), ("d", 12),
)  # fmt: skip
_JOINT_COMMAND: tuple[tuple[str, int], ...] = (
    ("posRef", 8), ("velRef", 9), ("torRef", 10), ("k", 11), ("d", 12),
)  # fmt: skip


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
    return message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"{_PACKAGE}.{name}"))


JointCommand = _message("JointCommand")
"""Command of some joints; lists in the order of ``name``."""
GenericRxMsg = _message("GenericRxMsg")
"""The message that the server publishes."""


def read(kind: type[Any], data: bytes) -> Any:
    """Decode a message from bytes; raises `CodecError`."""
    message: Message = kind()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise CodecError(f"this is not a {kind.DESCRIPTOR.name}: {error}") from error
    return message


STATE_PORT, SERVICE_PORT, COMMAND_PORT = 5556, 5557, 5558  # xbot2_zmq's default ports
_LONGEST = 1_000_000  # longest accepted answer [bytes]; a robot's joint names take a few thousand


class Control(IntFlag):
    """Bits that select which references of a joint apply."""

    POSITION = 1
    VELOCITY = 2
    EFFORT = 4
    STIFFNESS = 8
    DAMPING = 16


@dataclass(frozen=True, slots=True)
class State:
    """The joints' state as published.

    Attributes:
        sequence: Number of the message.
        names: The joints.
        position: Link positions.
        velocity: Velocities; ``NaN``: not published.
        effort: Efforts; ``NaN``: not published.
        temperature: Motor temperatures [°C]; ``NaN``: not published.
    """

    sequence: int
    names: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]
    temperature: tuple[float, ...]

    @classmethod
    def from_bytes(cls, data: bytes) -> Self | None:
        """Read a published message; ``None`` without a joint state; raises `CodecError`."""
        message = read(GenericRxMsg, data)
        if not message.HasField("js"):
            return None
        joints = message.js
        names = tuple(joints.jointNames)
        n = len(names)
        if not n or len(joints.linkPos) != n:
            raise CodecError(f"{len(joints.linkPos)} positions for {n} joints")
        velocity = _given(joints.motVel, n) or _given(joints.linkVel, n)
        return cls(
            message.seq,
            names,
            tuple(joints.linkPos),
            velocity or (math.nan,) * n,
            _given(joints.tor, n) or (math.nan,) * n,
            _given(joints.motorTemp, n) or (math.nan,) * n,
        )

    def to_bytes(self, reference: Sequence[float], stamp: int) -> bytes:
        """Return the message, with the fields that the server is known to fill."""
        message = GenericRxMsg(seq=self.sequence, stamp=stamp)
        message.js.jointNames.extend(self.names)
        message.js.linkPos.extend(self.position)
        message.js.posRef.extend(reference)
        message.js.motVel.extend(self.velocity)
        message.js.tor.extend(self.effort)
        return bytes(message.SerializeToString())


def _given(values: Sequence[float], n: int) -> tuple[float, ...]:
    # A list that the server does not fill is empty.
    return tuple(values) if len(values) == n else ()


@dataclass(frozen=True, slots=True)
class Command:
    """A command of some joints.

    Attributes:
        names: The joints.
        position: Position references.
        effort: Effort references.
        control: The references of each joint that apply.
    """

    names: tuple[str, ...]
    position: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()
    control: tuple[Control, ...] = ()

    def to_bytes(self) -> bytes:
        """Return the message without empty lists."""
        message = JointCommand(
            name=self.names,
            posRef=self.position,
            torRef=self.effort,
            ctrl=[int(c) for c in self.control],
        )
        return bytes(message.SerializeToString(deterministic=True))

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read a command; raises `CodecError`."""
        message = read(JointCommand, data)
        n = len(message.name)
        for values in (message.posRef, message.torRef, message.ctrl):
            if len(values) not in (0, n):
                raise CodecError(f"{len(values)} values for {n} joints")
        return cls(
            tuple(message.name),
            tuple(message.posRef),
            tuple(message.torRef),
            tuple(Control(c & 0x1F) for c in message.ctrl),
        )


def request(kind: str, **values: str | float | bool) -> bytes:
    """Return a service request."""
    return _yaml({"type": kind, **values})


def answer(success: bool, message: str = "", data: Any = None) -> bytes:
    """Return the answer to a service request."""
    return _yaml({"success": success, "message": message, "data": data})


def _yaml(value: Mapping[str, Any]) -> bytes:
    stream = io.StringIO()
    YAML(typ="safe", pure=True).dump(value, stream)
    return stream.getvalue().encode("utf-8")


def read_yaml(raw: bytes) -> Mapping[str, Any]:
    """Return a request or an answer; raises `CodecError`."""
    if len(raw) > _LONGEST:
        raise CodecError(f"{len(raw)} bytes are too many")
    try:
        found = yaml_reader().load(raw.decode("utf-8"))
    # Text from a network may be nested too deeply for the stack.
    except (YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise CodecError("this is not YAML") from error
    if not isinstance(found, dict):
        raise CodecError("this is not a mapping")
    return found


def joint_names(raw: bytes) -> tuple[str, ...]:
    """Return the joints in an answer to ``joint_names``; raises `CodecError`."""
    found = read_yaml(raw)
    data = found.get("data")
    if not found.get("success"):
        raise CodecError(f"refused: {found.get('message', '')}")
    if isinstance(data, str):
        data = data.replace(",", " ").split()
    if not isinstance(data, list) or not all(isinstance(name, str) for name in data):
        raise CodecError("the answer has no list of joints")
    return tuple(data)
