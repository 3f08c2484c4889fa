"""Key expressions of topics and services, and liveliness tokens, which form the ROS graph."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from enum import StrEnum

from rtee.errors import ConfigError
from rtee.ros2.qos import Qos, parse_chunk

GRAPH = "@ros2_lv"
"""First chunk of all tokens."""

LONGEST_TOKEN = 2048
"""Longest token that is parsed [characters]: ROS limits each name to 255."""

# Without re.ASCII, \w would match letters and digits that ROS does not allow.
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_LONGEST_NAME = 255
"""Longest fully qualified name [characters], the limit of rmw."""


class Kind(StrEnum):
    """Kind of an entity of the graph, by its code in tokens."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class NodeName:
    """The name of a node.

    Attributes:
        name: Name without a namespace.
        namespace: Namespace with a leading slash; ``/`` for none.
    """

    name: str
    namespace: str = "/"

    @property
    def full(self) -> str:
        """The fully qualified name."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def resolve(self, name: str) -> str:
        """Return the fully qualified name of a topic or service.

        Args:
            name: ``/absolute``, ``relative`` to the namespace, or ``~/private`` to the node.

        Raises:
            ConfigError: if ROS 2 would refuse it.
        """
        if name == "~" or name.startswith("~/"):
            full = self.full + name[1:]
        elif name.startswith("/"):
            full = name
        else:
            full = f"{self.namespace.rstrip('/')}/{name}"
        return checked(full, f"'{name}'")


def checked(full: str, called: str) -> str:
    """Return a fully qualified name unchanged, or raise `ConfigError` if ROS 2 does not allow it.

    The error calls the name ``called``.
    """
    parts = full.removeprefix("/").split("/")
    if not full.startswith("/") or not all(map(_NAME.fullmatch, parts)):
        raise ConfigError(
            f"{called} is not a ROS 2 name: use letters, digits and underscores, separated by"
            " slashes, and begin no part with a digit"
        )
    if len(full) > _LONGEST_NAME:
        raise ConfigError(f"{called} is longer than {_LONGEST_NAME} characters")
    return full


def node_name(name: str, namespace: str = "") -> NodeName:
    """Return the name of a node; raise `ConfigError` if ROS 2 would refuse it."""
    namespace = "/" + namespace.strip("/")
    if namespace != "/":
        checked(namespace, f"the namespace '{namespace}'")
    full = NodeName(name, namespace)
    if "/" in name:
        raise ConfigError(f"the node's name '{name}' has a slash: give its namespace separately")
    checked(full.full, f"the node's name '{name}'")
    return full


def dds_type(name: str) -> str:
    """Return ``std_msgs::msg::dds_::String_`` for ``std_msgs/msg/String``."""
    package, kind, last = name.split("/")
    return f"{package}::{kind}::dds_::{last}_"


def ros_type(dds: str) -> str:
    """Return ``std_msgs/msg/String`` for ``std_msgs::msg::dds_::String_``; keep other texts."""
    parts = dds.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return dds
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def key_expression(domain: int, name: str, kind: str, type_hash: str) -> str:
    """Return the key expression of a topic or service with a type's full name and hash."""
    # Zenoh refuses keys with empty chunks, such as that before a leading slash.
    return f"{domain}/{name.strip('/')}/{dds_type(kind)}/{type_hash}"


def _mangled(name: str) -> str:
    # A slash would split the name into several chunks, and no chunk may be empty.
    return name.replace("/", "%") or "%"


def _demangled(chunk: str) -> str:
    return chunk.replace("%", "/")


@dataclass(frozen=True, slots=True)
class Entity:
    """A node, or a publisher, subscription, service or client of one, in the graph.

    Attributes:
        domain: The domain.
        session: Identifier of its Zenoh session.
        node_id: Number of its node.
        entity_id: Number of the entity; that of a node is its ``node_id``.
        kind: Kind of the entity.
        node: Name of its node.
        topic: Fully qualified name of the topic or service; empty for a node.
        type: Full name of the type; empty for a node.
        type_hash: Hash of the type; empty for a node.
        qos: Quality of service.
        enclave: Security enclave.
        more: Chunks that newer versions of rmw_zenoh append.
    """

    domain: str
    session: str
    node_id: str
    entity_id: str
    kind: Kind
    node: NodeName
    topic: str = ""
    type: str = ""
    type_hash: str = ""
    qos: Qos = field(default_factory=Qos)
    enclave: str = "/"
    more: tuple[str, ...] = ()

    @property
    def token(self) -> str:
        """The liveliness token of the entity."""
        names = map(_mangled, (self.enclave, self.node.namespace, self.node.name))
        ids = (self.domain, self.session, self.node_id, self.entity_id, self.kind.value)
        begin = "/".join((GRAPH, *ids, *names))
        if self.kind is Kind.NODE:
            return begin
        last = (_mangled(self.topic), dds_type(self.type), self.type_hash, self.qos.chunk)
        return "/".join((begin, *last, *self.more))


# Number of chunks of the token of a node, and of a publisher, subscription, service or client.
_NODE_CHUNKS = 9
_ENDPOINT_CHUNKS = 13


def parse_token(token: str) -> Entity | None:
    """Return the entity of a token, or ``None`` if the token is malformed.

    Accepts unknown chunks at the end and unknown numbers in the QoS, for newer versions.
    """
    if len(token) > LONGEST_TOKEN:
        return None
    chunks = token.split("/")
    if len(chunks) < _NODE_CHUNKS or chunks[0] != GRAPH or not all(chunks[:_NODE_CHUNKS]):
        return None
    try:
        kind = Kind(chunks[5])
    except ValueError:
        return None
    domain, session, node_id, entity_id = chunks[1:5]
    begin = Entity(
        domain,
        session,
        node_id,
        entity_id,
        kind,
        NodeName(_demangled(chunks[8]), _demangled(chunks[7])),
        enclave=_demangled(chunks[6]),
        more=tuple(chunks[_NODE_CHUNKS:]),
    )
    if kind is Kind.NODE:
        return begin
    if len(chunks) < _ENDPOINT_CHUNKS or not all(chunks[:_ENDPOINT_CHUNKS]):
        return None
    topic, dds, type_hash, qos = chunks[_NODE_CHUNKS:_ENDPOINT_CHUNKS]
    return replace(
        begin,
        topic=_demangled(topic),
        type=ros_type(dds),
        type_hash=type_hash,
        qos=parse_chunk(qos),
        more=tuple(chunks[_ENDPOINT_CHUNKS:]),
    )
