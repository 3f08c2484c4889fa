"""Parameters of a node: the six services that read, change and describe them, and their events."""

from __future__ import annotations

import contextlib
import inspect
import math
import time
import typing
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtee.errors import RteeError
from rtee.ros2.endpoints import fields_handler
from rtee.ros2.message import Message
from rtee.ros2.node import Node
from rtee.ros2.qos import PARAMETERS

Value = bool | int | float | str | bytes | list[bool] | list[int] | list[float] | list[str]
"""Types of a parameter's value."""

_KINDS: tuple[tuple[type, int, str], ...] = (
    # First, since a bool is an int in Python.
    (bool, 1, "bool"),
    (int, 2, "integer"),
    (float, 3, "double"),
    (str, 4, "string"),
)
_NOT_SET, _INTEGER, _DOUBLE, _DOUBLES, _BYTES = 0, 2, 3, 8, 5
_TO_ARRAY = 5
"""Offset of an array's kind from that of its elements."""

_FIELDS = (
    "",
    "bool_value",
    "integer_value",
    "double_value",
    "string_value",
    "byte_array_value",
    "bool_array_value",
    "integer_array_value",
    "double_array_value",
    "string_array_value",
)
_NAMES = ("not set", *(name for _, _, name in _KINDS), "byte_array", "bool_array")
_NAMES += ("integer_array", "double_array", "string_array")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of a node.

    Attributes:
        name: Name; dots separate groups.
        value: Value at the start, whose type never changes.
        description: Sentence about the parameter, with its unit.
        lower: Smallest value of a number, or of each number of an array; for an integer, both
            bounds or none.
        upper: Largest value.
        read_only: Whether the parameter cannot be changed.
        change: Called with a new value before it is stored; raises `RteeError` to refuse it; may
            return an awaitable.
    """

    name: str
    value: Value
    description: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    read_only: bool = False
    change: Callable[[Any], Awaitable[None] | None] | None = None

    @property
    def bounded(self) -> bool:
        """Whether the value has a bound."""
        return math.isfinite(self.lower) or math.isfinite(self.upper)

    @property
    def kind(self) -> int:
        """Number of the type in ``rcl_interfaces/msg/ParameterType``."""
        value = self.value
        if isinstance(value, bytes):
            return _BYTES
        # The elements of an empty list have no type; it counts as a list of doubles.
        sample = (value[0] if value else 0.0) if isinstance(value, list) else value
        kind = next(number for type_, number, _ in _KINDS if isinstance(sample, type_))
        return kind + _TO_ARRAY if isinstance(value, list) else kind

    def refusal(self, kind: int, value: Value) -> str:
        """Return why the parameter refuses a value of this type; ``""`` if it accepts the value."""
        if self.read_only:
            return f"parameter '{self.name}' cannot be set because it is read-only"
        if kind != self.kind:
            return (
                f"Wrong parameter type, parameter '{self.name}' is of type"
                f" '{_NAMES[self.kind]}', setting it to '{_NAMES[kind]}' is not allowed."
            )
        numbers = value if isinstance(value, list) else [value]
        for number in numbers:
            if self.bounded and isinstance(number, (int, float)) and not self._within(number):
                bounds = f"{self.lower:g} to {self.upper:g}"
                return f"Parameter '{self.name}' is {number:g}, outside {bounds}"
        return ""

    def _within(self, number: float) -> bool:
        return math.isfinite(number) and self.lower <= number <= self.upper


class Parameters:
    """The parameters of a node, with the services and the topic that ROS 2's tools use.

    Args:
        node: The node.
        declared: The parameters.
    """

    def __init__(self, node: Node, declared: Iterable[Parameter]) -> None:
        self._node = node
        self._declared = {parameter.name: parameter for parameter in declared}
        self._values: dict[str, Value] = {p.name: p.value for p in self._declared.values()}
        self._interfaces = interfaces = node.context.interfaces
        self._events = node.publisher(
            "/parameter_events", "rcl_interfaces/msg/ParameterEvent", PARAMETERS
        )
        for name, kind, handler in (
            ("get_parameters", "GetParameters", self._get),
            ("get_parameter_types", "GetParameterTypes", self._types),
            ("set_parameters", "SetParameters", self._set),
            ("set_parameters_atomically", "SetParametersAtomically", self._set_atomically),
            ("describe_parameters", "DescribeParameters", self._describe),
            ("list_parameters", "ListParameters", self._list),
        ):
            service = interfaces.service(f"rcl_interfaces/srv/{kind}")
            # One request at a time, so that all clients see the same order of changes.
            answer = fields_handler(service, handler)
            node.service(f"~/{name}", service, answer, PARAMETERS, at_once=1)
        self._publish("new_parameters", self._values)

    @property
    def values(self) -> Mapping[str, Value]:
        """The values, by name."""
        return self._values

    def update(self, values: Mapping[str, Value]) -> None:
        """Store values that the hand has changed, and publish those that differ."""
        changed = {name: value for name, value in values.items() if self._values[name] != value}
        if changed:
            self._values |= changed
            self._publish("changed_parameters", changed)

    def _message(self, name: str) -> Any:
        return self._interfaces.message(f"rcl_interfaces/msg/{name}")

    def _publish(self, field: str, values: Mapping[str, Value]) -> None:
        seconds, nanoseconds = divmod(time.time_ns(), 10**9)
        event = self._message("ParameterEvent")(node=self._node.name.full)
        event.stamp.sec, event.stamp.nanosec = seconds, nanoseconds
        parameter = self._message("Parameter")
        changes = [parameter(name=name, value=self._value(name, values)) for name in values]
        setattr(event, field, changes)
        self._events.publish(event)

    def _value(self, name: str, values: Mapping[str, Value]) -> Message:
        message = self._message("ParameterValue")()
        if name in values:
            message.type = self._declared[name].kind
            setattr(message, _FIELDS[message.type], values[name])
        return typing.cast("Message", message)

    async def _get(self, request: Any) -> dict[str, Any]:
        return {"values": [self._value(name, self._values) for name in request.names]}

    async def _types(self, request: Any) -> dict[str, Any]:
        declared = (self._declared.get(name) for name in request.names)
        return {"types": [_NOT_SET if known is None else known.kind for known in declared]}

    async def _describe(self, request: Any) -> dict[str, Any]:
        return {"descriptors": [self._descriptor(name) for name in request.names]}

    def _descriptor(self, name: str) -> Any:
        descriptor = self._message("ParameterDescriptor")(name=name)
        declared = self._declared.get(name)
        if declared is not None:
            descriptor.type, descriptor.read_only = declared.kind, declared.read_only
            descriptor.description = declared.description
            if declared.bounded:
                floating = declared.kind in {_DOUBLE, _DOUBLES}
                number = float if floating else int
                bounds = self._message("FloatingPointRange" if floating else "IntegerRange")(
                    from_value=number(declared.lower), to_value=number(declared.upper)
                )
                field = "floating_point_range" if floating else "integer_range"
                setattr(descriptor, field, [bounds])
        return descriptor

    async def _list(self, request: Any) -> dict[str, Any]:
        def wanted(name: str) -> bool:
            if not request.prefixes:
                return not request.depth or name.count(".") < request.depth
            return any(
                name == prefix
                or (
                    name.startswith(prefix + ".")
                    and (not request.depth or name[len(prefix) :].count(".") <= request.depth)
                )
                for prefix in request.prefixes
            )

        names = [name for name in sorted(self._declared) if wanted(name)]
        prefixes = sorted({name.rpartition(".")[0] for name in names if "." in name})
        return {"result": self._message("ListParametersResult")(names=names, prefixes=prefixes)}

    async def _set(self, request: Any) -> dict[str, Any]:
        return {"results": [await self._change([change]) for change in request.parameters]}

    async def _set_atomically(self, request: Any) -> dict[str, Any]:
        return {"result": await self._change(request.parameters)}

    async def _change(self, changes: Sequence[Any]) -> Message:
        """Change all of these parameters or none; return a ``SetParametersResult``."""
        result = self._message("SetParametersResult")
        wanted: dict[str, Value] = {}
        # Check all before changing any, so that a change rarely has to be undone.
        for each in changes:
            declared = self._declared.get(each.name)
            if declared is None:
                return _result(result, f"parameter '{each.name}' cannot be set: not declared")
            kind, value = _content(each.value, declared.kind)
            if refusal := declared.refusal(kind, value):
                return _result(result, refusal)
            wanted[each.name] = value
        before: dict[str, Value] = {}
        for name, value in wanted.items():
            try:
                await self._apply(name, value)
            except RteeError as error:
                for done, old in before.items():
                    # A hand that has ended refuses this, too; the client still gets its response.
                    with contextlib.suppress(RteeError):
                        await self._apply(done, old)
                return _result(result, str(error))
            before[name] = self._values[name]
        # One event for all, after the last one succeeded.
        self.update(wanted)
        return _result(result, "")

    async def _apply(self, name: str, value: Value) -> None:
        change = self._declared[name].change
        if change is not None:
            done = change(value)
            if inspect.isawaitable(done):
                await done


def _content(message: Any, wanted: int) -> tuple[int, Value]:
    """Return type and value of a ``ParameterValue``; an integer becomes a wanted double."""
    if not 0 < message.type < len(_FIELDS):
        return _NOT_SET, ""
    content: Any = getattr(message, _FIELDS[message.type])
    if (message.type, wanted) == (_INTEGER, _DOUBLE):
        return _DOUBLE, float(content)
    return message.type, content.tolist() if isinstance(content, np.ndarray) else content


def _result(result: Any, reason: str) -> Message:
    made: Message = result(successful=not reason, reason=reason)
    return made
