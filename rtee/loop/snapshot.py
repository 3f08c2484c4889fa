"""The state of a controller as data, from which another process can continue.

`capture` copies references only, quickly enough for a tick; `encode` turns them into JSON later, in
another thread. `restore` sets a new controller of the same hand and settings to exactly this state.
It creates only objects of the controller's own classes, and runs none of their code except the
checks of settings.
"""

from __future__ import annotations

import json
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from types import BuiltinMethodType, MappingProxyType, MethodType
from typing import Any, NamedTuple

import numpy as np

from rtee.errors import LogError
from rtee.hand.validation import Section
from rtee.loop.controller import Controller

_SCALARS = frozenset({type(None), bool, int, float, str})
_LISTS = {kind.__name__: kind for kind in (list, tuple, set, frozenset, deque)}
_MAPPINGS = {kind.__name__: kind for kind in (dict, MappingProxyType)}
_OURS = (
    "rtee.loop.",
    "rtee.types",
    "rtee.commands",
    "rtee.hand.",
    "rtee.objects.",
    "rtee.drivers.capabilities",
    "rtee.drivers.plausibility",
)
"""Modules of the classes of a controller's parts."""

_MOVED = {
    "rtee.loop.limiter": "rtee.loop.motion",
    "rtee.loop.profiles.phases": "rtee.loop.profiles.s_curve",
    "rtee.loop.reference_start": "rtee.loop.controller",
    "rtee.loop.streams.hold": "rtee.loop.streams.player",
    "rtee.loop.streams.playout": "rtee.loop.streams.player",
    "rtee.loop.thermal_model": "rtee.loop.thermal",
}
"""Modules that recorded states name, and where their classes are now."""


class Snapshot(NamedTuple):
    """A captured state: each object's parts by its `id`; the controller comes first.

    The snapshot keeps the objects alive, so that no new object can reuse an `id`.
    """

    nodes: Mapping[int, tuple[object, list[Any]]]
    given: Mapping[int, str]


def capture(controller: Controller) -> Snapshot:
    """Return the state between two ticks."""
    given = {id(controller.hand): "hand", id(controller.settings): "settings"}
    nodes: dict[int, tuple[object, list[Any]]] = {}
    waiting: list[Any] = [controller]
    while waiting:
        value = waiting.pop()
        if id(value) not in nodes:
            parts = [] if id(value) in given else _parts(value)
            nodes[id(value)] = value, parts
            waiting += [each for each in parts if type(each) not in _SCALARS]
    return Snapshot(nodes, given)


def _parts(value: Any) -> list[Any]:
    kind = type(value)
    if kind in (dict, MappingProxyType):
        return [*value.keys(), *value.values()]
    if kind in (list, tuple, set, frozenset, deque):
        return [*value]
    if kind in (MethodType, BuiltinMethodType):
        return [value.__self__]
    if kind is np.ndarray:
        return [value.dtype.str, value.tobytes().hex(), *value.shape]
    if kind.__module__.startswith(_OURS) and not isinstance(value, (Enum, type)):
        return [getattr(value, name) for name in _names(value)]
    return []


def _names(value: object) -> Iterator[str]:
    yield from getattr(value, "__dict__", ())
    for kind in type(value).__mro__:
        for name in kind.__dict__.get("__slots__", ()):
            if hasattr(value, name):
                yield name


def _fields(kind: type[Any], there: object) -> list[str]:
    """Return the names of a class's fields; ``there`` may be an object of the class."""
    if type(there) is kind:
        return [*_names(there)]
    if is_dataclass(kind):
        return [each.name for each in fields(kind)]
    return [name for each in kind.__mro__ for name in each.__dict__.get("__slots__", ())]


def encode(snapshot: Snapshot) -> list[Any]:
    """Return a state as lists for JSON, one per object; raises `TypeError` for an unknown class."""
    places = {key: place for place, key in enumerate(snapshot.nodes)}

    def part(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        return value if type(value) in _SCALARS else [places[id(value)]]

    return [
        _node(value, [part(each) for each in parts], snapshot.given.get(key))
        for key, (value, parts) in snapshot.nodes.items()
    ]


def _node(value: Any, parts: list[Any], given: str | None) -> list[Any]:
    kind = type(value)
    if given is not None:
        return ["given", given]
    if kind.__name__ in _LISTS or kind.__name__ in _MAPPINGS or kind is np.ndarray:
        return [kind.__name__, *parts]
    if kind in (MethodType, BuiltinMethodType):
        return ["method", *parts, value.__name__]
    name = f"{kind.__module__}:{kind.__qualname__}"
    if isinstance(value, Enum):
        return ["enum", name, value.value]
    if kind.__module__.startswith("rtee.") and not kind.__module__.startswith(_OURS):
        raise TypeError(f"{name} is not known as a part of a controller")
    if not kind.__module__.startswith(_OURS):
        return ["other"]
    return ["object", name, dict(zip(_names(value), parts, strict=True))]


def restore(controller: Controller, nodes: list[Any]) -> tuple[str, ...]:
    """Set the state of a new controller.

    Returns:
        Fields that the lists lack, or that only they have, as ``class.field``: another version
        wrote them. A field that they lack keeps the value with which a new controller begins, if
        that has such an object; else it stays unset.

    Raises:
        LogError: if the lists do not describe a state.
    """
    restoring = _Restoring(controller, nodes)
    try:
        restoring.value([0], controller)
        controller.restored()
    except (AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, AttributeError) and restoring.differing:
            raise LogError(differs(restoring.differing)) from None
        raise LogError(f"contains an invalid state of the controller: {error}") from None
    return tuple(restoring.differing)


def differs(names: Iterable[str]) -> str:
    """Return the sentence about the fields in which a recorded state differs from a present one."""
    return (
        "begins with the controller state of another version of rtee, which differs in "
        f"{', '.join(names)}: recompute it with that version, or together with the files before "
        "it, from the loop's start on (--series)"
    )


class _Restoring:
    def __init__(self, controller: Controller, nodes: list[Any]) -> None:
        self._given = {"hand": controller.hand, "settings": controller.settings}
        # A controller's callbacks are set at its construction. A file that was tampered with must
        # not make it call anything else.
        own = (value for value, _ in capture(controller).nodes.values())
        self._wired = {
            (type(each.__self__), each.__name__)
            for each in own
            if isinstance(each, (MethodType, BuiltinMethodType))
        }
        self._nodes = nodes
        self._made: dict[int, Any] = {}
        self.differing: dict[str, None] = {}  # as an ordered set

    def value(self, part: Any, there: Any) -> Any:
        """Return a part; ``there`` is its counterpart in a new controller."""
        if not isinstance(part, list):
            return part
        (place,) = part
        if place not in self._made:
            self._make(place, there)
        return self._made[place]

    def _make(self, place: int, there: Any) -> None:
        kind, *parts = self._nodes[place]
        made: Any = there  # for objects of other libraries, the new controller's own are kept
        if kind == "object" and issubclass(its := _class(parts[0]), Section):
            made = its(**{name: self.value(part, None) for name, part in parts[1].items()})
        elif kind == "object":
            made = self._made[place] = there if type(there) is its else object.__new__(its)
            strange = [name for name in _fields(its, there) if name not in parts[1]]
            for name, part in parts[1].items():
                value = self.value(part, getattr(made, name, None))
                try:
                    object.__setattr__(made, name, value)
                except AttributeError:  # a field that the class no longer has
                    strange.append(name)
            self.differing |= dict.fromkeys(f"{its.__name__}.{name}" for name in strange)
        elif kind == "list":
            made = self._made[place] = []
            made += [self.value(part, None) for part in parts]
        elif kind in _LISTS:
            made = _LISTS[kind](self.value(part, None) for part in parts)
        elif kind in _MAPPINGS:
            values = [self.value(part, None) for part in parts]
            half = len(values) // 2
            made = _MAPPINGS[kind](dict(zip(values[:half], values[half:], strict=True)))
        elif kind == "ndarray":
            made = np.frombuffer(bytes.fromhex(parts[1]), parts[0]).reshape(parts[2:]).copy()
        elif kind == "method":
            owner = self.value(parts[0], getattr(there, "__self__", None))
            if (type(owner), parts[1]) not in self._wired:
                raise ValueError(f"{parts[1]} is not a callback of a controller")
            made = getattr(owner, parts[1])
        elif kind == "enum":
            made = _class(parts[0])(parts[1])
        elif kind == "given":
            made = self._given[parts[0]]
        self._made[place] = made


def _class(name: str) -> type[Any]:
    module, _, inside = name.partition(":")
    module = _MOVED.get(module, module)
    found: Any = sys.modules[module] if module.startswith(_OURS) else None
    for each in inside.split("."):
        found = vars(found)[each]
    if not isinstance(found, type) or found.__module__ != module:
        raise ValueError(f"{name} is not a class of the controller")
    return found


def to_bytes(snapshot: Snapshot, **more: object) -> bytes:
    """Return a state as JSON with further values."""
    return json.dumps({**more, "nodes": encode(snapshot)}).encode()
