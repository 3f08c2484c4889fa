"""The ROS graph as people list it: nodes, topics, services and actions with their types."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from rtee.ros2.keys import Entity, Kind

_GOALS = "/_action/send_goal"
_PARTS = "/_action/"
_GOAL_TYPE = "_SendGoal"

_OFFERS = (Kind.PUBLISHER, Kind.SERVICE)
_TOPIC = (Kind.PUBLISHER, Kind.SUBSCRIPTION)


class Sort(StrEnum):
    """What is listed."""

    NODE = "node"
    TOPIC = "topic"
    SERVICE = "service"
    ACTION = "action"


@dataclass(frozen=True, slots=True)
class Listed:
    """A node, topic, service or action of the graph.

    Those of the same name whose type or hash differs are listed apart: they do not hear each other.

    Attributes:
        sort: What it is.
        name: Its fully qualified name.
        type: Full name of its type; empty for a node.
        type_hash: Hash of its type, of an action of the service that takes goals; empty for a node.
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
    """Return what is in the graph, by sort and name.

    Args:
        entities: The entities of the graph.
        parts: Also the topics and services that actions are made of.
    """
    nodes: set[str] = set()
    found: dict[tuple[Sort, str, str, str], tuple[set[str], set[str]]] = {}
    for one in entities:
        if one.kind is Kind.NODE:
            nodes.add(one.node.full)
            continue
        sort = Sort.TOPIC if one.kind in _TOPIC else Sort.SERVICE
        keys = [(sort, one.topic, one.type, one.type_hash)]
        if _PARTS in one.topic and not parts:
            keys = []
        # Of an action's five parts, one counts: it would be listed five times.
        if sort is Sort.SERVICE and one.topic.endswith(_GOALS):
            name, kind = one.topic.removesuffix(_GOALS), one.type.removesuffix(_GOAL_TYPE)
            keys.append((Sort.ACTION, name, kind, one.type_hash))
        for key in keys:
            offered, used = found.setdefault(key, (set(), set()))
            (offered if one.kind in _OFFERS else used).add(one.node.full)
    rows = [Listed(Sort.NODE, name) for name in nodes]
    rows += [Listed(*key, tuple(sorted(a)), tuple(sorted(b))) for key, (a, b) in found.items()]
    order = list(Sort)
    return sorted(rows, key=lambda row: (order.index(row.sort), row.name, row.type, row.type_hash))


def unheard(rows: Iterable[Listed]) -> list[str]:
    """Return a sentence for each node that uses what nobody offers, since type or hash differ.

    Args:
        rows: What is in the graph.
    """
    rows = list(rows)
    offered: dict[tuple[Sort, str], list[Listed]] = {}
    for row in rows:
        if row.offered:
            offered.setdefault((row.sort, row.name), []).append(row)
    said = []
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
        said.append(
            f"{users} {who} for the {row.sort} {row.name} {difference}: it hears nothing of"
            f" {', '.join(other.offered)}"
        )
    return said
