"""Lists of the ROS graph for people: nodes, topics, services and actions with their types."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from rtee.ros2.keys import Entity, Kind

# Endings of the services and topics that make up an action, and of the type of its goals' service.
_GOALS = "/_action/send_goal"
_PARTS = "/_action/"
_GOAL_TYPE = "_SendGoal"

_OFFERS = (Kind.PUBLISHER, Kind.SERVICE)
_TOPIC = (Kind.PUBLISHER, Kind.SUBSCRIPTION)


class Sort(StrEnum):
    """Kind of a row of a list."""

    NODE = "node"
    TOPIC = "topic"
    SERVICE = "service"
    ACTION = "action"


@dataclass(frozen=True, slots=True)
class Listed:
    """A node, topic, service or action of the graph; a node has no type.

    Entities of the same name with another type or hash are listed separately, since they do not
    exchange messages.

    Attributes:
        type_hash: Hash of the type, for an action that of its ``send_goal``.
        offered: Nodes that publish the topic, or offer the service or action.
        used: Nodes that subscribe to the topic, or are clients.
    """

    sort: Sort
    name: str
    type: str = ""
    type_hash: str = ""
    offered: tuple[str, ...] = ()
    used: tuple[str, ...] = ()


def listed(entities: Iterable[Entity], *, parts: bool = False) -> list[Listed]:
    """Return the rows of a list of the graph, ordered by sort and name.

    With ``parts``, lists the topics and services of actions, too.
    """
    nodes: set[str] = set()
    offers: dict[tuple[Sort, str, str, str], tuple[set[str], set[str]]] = {}
    for entity in entities:
        if entity.kind is Kind.NODE:
            nodes.add(entity.node.full)
            continue
        sort = Sort.TOPIC if entity.kind in _TOPIC else Sort.SERVICE
        keys = [(sort, entity.topic, entity.type, entity.type_hash)]
        if _PARTS in entity.topic and not parts:
            keys = []
        # One of its five parts represents an action, which would otherwise be listed five times.
        if sort is Sort.SERVICE and entity.topic.endswith(_GOALS):
            name, kind = entity.topic.removesuffix(_GOALS), entity.type.removesuffix(_GOAL_TYPE)
            keys.append((Sort.ACTION, name, kind, entity.type_hash))
        for key in keys:
            offered, used = offers.setdefault(key, (set(), set()))
            (offered if entity.kind in _OFFERS else used).add(entity.node.full)
    rows = [Listed(Sort.NODE, name) for name in nodes]
    rows += [Listed(*key, tuple(sorted(a)), tuple(sorted(b))) for key, (a, b) in offers.items()]
    order = list(Sort)
    return sorted(rows, key=lambda row: (order.index(row.sort), row.name, row.type, row.type_hash))


def unheard(rows: Iterable[Listed]) -> list[str]:
    """Return a sentence for each topic, service or action used with a type that no node offers."""
    rows = list(rows)
    offered: dict[tuple[Sort, str], list[Listed]] = {}
    for row in rows:
        if row.offered:
            offered.setdefault((row.sort, row.name), []).append(row)
    sentences = []
    for row in rows:
        others = offered.get((row.sort, row.name), [])
        if row.offered or not row.used or not others:
            continue
        users, other = ", ".join(row.used), others[0]
        who = "asks" if len(row.used) == 1 else "ask"
        if row.type == other.type:
            difference = f"with another hash ({row.type_hash}, not {other.type_hash})"
        else:
            difference = f"as {row.type}, not {other.type}"
        sentences.append(
            f"{users} {who} for the {row.sort} {row.name} {difference}: nothing arrives from"
            f" {', '.join(other.offered)}"
        )
    return sentences
