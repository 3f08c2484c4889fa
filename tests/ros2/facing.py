"""A kinematic hand with its node of ROS 2, and a node beside it as any other program has one."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import anyio
from remote.serving import Served, serving, until

from rtee.actions.library import ActionLibrary
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.model import Hand
from rtee.ros2 import Context, Node
from rtee.ros2.endpoints import Publisher
from rtee.ros2.keys import Kind
from rtee.ros2.qos import DEFAULT, Qos
from rtee.ros2.serving import Shown, serve


@dataclass
class Robot:
    """The other programs of a robot: a node of another session."""

    context: Context
    node: Node
    heard: dict[str, list[Any]] = field(default_factory=dict)

    async def listen(self, topic: str, kind: str, qos: Qos = DEFAULT) -> list[Any]:
        """Subscribe; return the list to which messages are appended, once there is one."""
        got: list[Any] = []
        self.node.subscription(topic, kind, got.append, qos)
        await until(lambda: bool(got))
        return got

    def hear(self, topic: str, kind: str) -> list[Any]:
        """Subscribe; return the list to which messages will be appended."""
        got: list[Any] = []
        self.node.subscription(topic, kind, got.append)
        return got

    async def talk(self, topic: str, kind: str) -> Publisher:
        """Return a publisher once somebody listens."""
        publisher = self.node.publisher(topic, kind)
        await until(lambda: publisher.heard)
        return publisher

    async def call(self, service: str, type_: str, /, **fields: Any) -> Any:
        """Call a service of the hand."""
        client = self.node.client(service, type_)
        try:
            await client.wait(300)
            return await client.call(client.type.request(**fields), 20.0)
        finally:
            self.node.discard(client)

    def names(self, kind: Kind) -> set[str]:
        """Return the names of what others than this node have of a kind in the graph."""
        mine = self.node.name
        found = [one for one in self.context.graph.entities() if one.node != mine]
        return {one.topic or one.node.full for one in found if one.kind is kind}

    async def sees(self, node: str, there: bool = True) -> None:
        """Wait until a node is in the graph, or has left it."""
        await self.context.graph.wait_until(lambda: (node in self.names(Kind.NODE)) is there)


@asynccontextmanager
async def robot(settings: Ros2Settings) -> AsyncIterator[Robot]:
    """Be the other programs of a robot."""
    async with Context.open(settings, {}) as context:
        yield Robot(context, context.node("planner"))


@asynccontextmanager
async def facing(*hands: Shown, environment: dict[str, str] | None = None) -> AsyncIterator[None]:
    """Show hands for as long as the context lasts."""
    async with anyio.create_task_group() as group:
        group.start_soon(serve, hands, environment or {})
        yield
        group.cancel_scope.cancel()


@asynccontextmanager
async def a_hand_in_ros(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings, **options: Any
) -> AsyncIterator[tuple[Served, Robot]]:
    """Run a hand, its node, and a robot that sees it."""
    shown = Shown(hand.name, settings, configured=hand)
    async with (
        serving(hand, library, **options) as served,
        facing(shown),
        robot(settings) as others,
    ):
        await others.sees(shown.node)
        yield served, others
