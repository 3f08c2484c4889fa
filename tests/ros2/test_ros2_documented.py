"""The table of a hand's interfaces in the documentation, beside those in the graph."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from msgspec import structs
from remote.serving import until

from rtee.actions.library import ActionLibrary
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.ros2.hand_services import service_name
from rtee.ros2.keys import Entity, Kind
from rtee.ros2.qos import DEFAULT, LATCHED, PARAMETERS, Qos
from rtee.ros2.types import ServiceType, TopicType, interfaces

from .facing import a_hand_in_ros

pytestmark = pytest.mark.anyio

ROWS = {Kind.PUBLISHER: "out", Kind.SUBSCRIPTION: "in", Kind.SERVICE: "service"}
QOS = {
    DEFAULT: "reliable, 10",
    LATCHED: "reliable, transient local, 1",
    PARAMETERS: "reliable, 1000",
    Qos(depth=100): "reliable, 100",
}
ELSEWHERE = {"~/opening", "~/force", "~/tip_forces/FINGER"}
"""What the hand of these tests has not: no openings, and no forces at the fingertips."""

SEND = "/_action/send_goal"
"""What the service of an action that takes goals is called."""

Row = tuple[str, str, str, str, str]


def row_of(entity: Entity) -> Row:
    """Return what the documentation says of an entity."""
    name = re.sub(r"^~/do/.*", "~/do/ACTION", entity.topic.replace("/small/", "~/"))
    short = entity.type_hash.removeprefix("RIHS01_")[:8]
    if name.endswith(SEND):
        kind = entity.type.removesuffix("_SendGoal")
        return "action", name.removesuffix(SEND), kind, QOS[entity.qos], short
    return ROWS[entity.kind], name, entity.type, QOS[entity.qos], short


def documented(text: str) -> set[Row]:
    """Return the rows of the table."""
    found = re.findall(
        r"^\| (out|in|service|action) \| `(.+?)` \| `(.+?)` \| (.+?) \| `(\w+)` \|", text, re.M
    )
    return set(found)


async def test_the_table_of_interfaces(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, repository: Path
) -> None:
    table = documented((repository / "docs" / "how-to" / "ros2.md").read_text())
    async with a_hand_in_ros(hand, library, structs.replace(settings, tf=True)) as (_, robot):
        mine = robot.node.name

        def in_graph() -> set[Row]:
            found = [e for e in robot.context.graph.entities() if e.node != mine]
            parts = [e for e in found if "/_action/" in e.topic and not e.topic.endswith(SEND)]
            return {row_of(e) for e in found if e.kind in ROWS and e not in parts}

        # The graph tells of one after the other; a row that is wrong is said at once.
        names = {name for _, name, *_ in table}
        await until(lambda: names - {name for _, name, *_ in in_graph()} <= ELSEWHERE)
        assert sorted(in_graph() - table) == []
        assert {name for _, name, *_ in table - in_graph()} == ELSEWHERE
    for kind, _, type_, _, short in table:
        known = interfaces("jazzy")
        made: TopicType | ServiceType
        if kind == "action":
            made = known.action(type_).send_goal
        else:
            made = known.service(type_) if kind == "service" else known.topic(type_)
        assert made.hash.startswith(f"RIHS01_{short}")


def test_the_services_of_actions_in_the_examples_exist(repository: Path) -> None:
    folder = repository / "config" / "schunk_svh"
    library = ActionLibrary.load(load_hand(folder), folder / "actions")
    page = (repository / "docs" / "how-to" / "ros2.md").read_text()
    named = set(re.findall(r"/schunk_svh/do/(\w+)", page))
    assert named
    assert named <= {service_name(action) for action in library}
