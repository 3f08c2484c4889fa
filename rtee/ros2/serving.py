"""Service that shows running hands as nodes of ROS 2."""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import anyio

from rtee.errors import ConfigError, MessageError, RemoteError, UserError, first_error
from rtee.hand.config_schema import Distro, Ros2Settings, ThermalSettings
from rtee.hand.model import Hand
from rtee.remote.client import RemoteHand, connect
from rtee.remote.model import model_of
from rtee.remote.session import LOCAL, TLS, is_safe
from rtee.ros2.diagnostics import Diagnostics
from rtee.ros2.grip_actions import Gripper
from rtee.ros2.hand_goals import GraspAction
from rtee.ros2.hand_services import Services, TypeDescriptions
from rtee.ros2.keys import node_name
from rtee.ros2.node import Context
from rtee.ros2.ros_end_effector import ActionCommand, RosEndEffector
from rtee.ros2.served_hand import Part, ServedHand
from rtee.ros2.setpoints import Setpoints
from rtee.ros2.topics import Topics, ros_name

log = logging.getLogger(__name__)

_AGAIN = 0.5
"""Time until the next search for a hand that has ended [s]."""

_AFTER_FAILURE = 10.0
"""Time until a node is made again after an unexpected error [s]: each further failure is logged."""

PARTS: tuple[Callable[[ServedHand], Part], ...] = (
    Topics,
    Diagnostics,
    Setpoints,
    Gripper,
    GraspAction,
    ActionCommand,
)
"""The parts of a node except its services, whose constructor needs the hand's actions."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A hand to show as a node.

    Attributes:
        settings: Domain, distribution, router and namespace.
        insecure: Whether to allow a router on another computer without certificates.
        configured: Model of the hand if it is configured here, otherwise ``None``.
        thermal: Temperatures at which the hand warns and disables.
        endpoint: Address of the hand; ``None``: this computer.
    """

    name: str
    settings: Ros2Settings
    insecure: bool = False
    configured: Hand | None = None
    thermal: ThermalSettings = field(default_factory=ThermalSettings)
    endpoint: str | None = None

    @property
    def node(self) -> str:
        """The fully qualified name of the node."""
        return node_name(ros_name(self.name), self.settings.namespace).full


def _others(router: str) -> str:
    """Return a reminder that ports on this computer are open to all of its users."""
    here = is_safe(router) and not router.startswith((TLS, LOCAL))
    return ", which is every user of this computer," if here else ""


def warnings(hands: Sequence[Shown]) -> list[str]:
    """Return sentences about the risks of showing these hands.

    Raises `ConfigError` if a namespace is malformed, or two hands would have the same node.
    """
    risks = [
        f"anyone who reaches the ROS 2 router at {router}{_others(router)} can move"
        f" {_listed(names)}: ROS 2 does not check identities"
        for router, names in _grouped((hand.settings.router, hand.name) for hand in hands).items()
    ]
    nodes = _grouped((hand.node, hand.name) for hand in hands)
    for node, names in nodes.items():
        if len(names) > 1:
            raise ConfigError(
                f"{_listed(names)} would be the same node {node}; give each a namespace of its own"
                " under 'ros2' in its hand.yaml"
            )
    spaces = _grouped((hand.settings.namespace.strip("/"), hand.name) for hand in hands)
    risks += [
        f"{_listed(names)} share the topics joint_states and robot_description; give each a"
        " namespace of its own under 'ros2' in its hand.yaml"
        for names in spaces.values()
        if len(names) > 1
    ]
    return risks


async def serve(hands: Sequence[Shown], environment: Mapping[str, str] | None = None) -> None:
    """Show hands as nodes of ROS 2 while they run, until cancelled.

    Hands with the same domain, distribution and router share a session. The variables of rmw_zenoh
    are those of the process unless an environment is given. Raises `ConfigError` if a setting
    cannot be used, and `MissingExtra` if the extra ``ros2`` is not installed.
    """
    sessions: dict[tuple[int, Distro, str, bool], list[Shown]] = {}
    for hand in hands:
        settings = hand.settings
        key = settings.domain, settings.distro, settings.router, hand.insecure
        sessions.setdefault(key, []).append(hand)
    async with anyio.create_task_group() as group:
        for together in sessions.values():
            group.start_soon(_serve_together, together, environment)


async def _serve_together(hands: Sequence[Shown], environment: Mapping[str, str] | None) -> None:
    first = hands[0]
    opened = Context.open(first.settings, environment, insecure=first.insecure)
    # The task group inside, so that the nodes end before the session that they use.
    async with opened as context, anyio.create_task_group() as group:
        for hand in hands:
            group.start_soon(_keep_showing, context, hand)


async def _keep_showing(context: Context, hand: Shown) -> None:
    """Show a hand each time it runs."""

    def waiting(reason: str) -> None:
        log.info("%s is not a node of ROS 2 yet: %s", hand.name, reason)

    while True:
        try:
            opened = connect(
                hand.name, endpoint=hand.endpoint, client="ros2", wait=math.inf, on_wait=waiting
            )
            async with (
                opened as remote,
                shown(context, hand, remote) as parts,
                anyio.create_task_group() as group,
            ):
                for part in parts:
                    group.start_soon(part.run)
        except* (RemoteError, MessageError) as errors:
            log.warning("%s has left ROS 2: %s", hand.name, first_error(errors))
        # Trying again does not help against a wrong setting, so the command ends.
        except* UserError:
            raise
        except* Exception:  # an error here must not end the nodes of other hands
            log.exception("the node of %s has failed; it will be started again", hand.name)
            await anyio.sleep(_AFTER_FAILURE)
        await anyio.sleep(_AGAIN)


@asynccontextmanager
async def shown(
    context: Context, hand: Shown, remote: RemoteHand
) -> AsyncIterator[Collection[Part]]:
    """Make the node of a running hand, which leaves the graph at the end of the context.

    Yields its parts, whose ``run`` the caller has to start.
    """
    # Query the hand before making the node: a hand that has ended never shows in the graph.
    model = await model_of(remote, hand.configured)
    info, openings, latest = await remote.info(), await remote.openings(), await remote.state()
    actions, status = await remote.actions(), await remote.status()
    node = context.node(ros_name(hand.name), hand.settings.namespace)
    try:
        served = ServedHand(
            hand=remote,
            model=model,
            info=info,
            openings=tuple(openings),
            node=node,
            settings=hand.settings,
            latest=latest,
            thermal=hand.thermal,
        )
        parts: list[Part] = [make(served) for make in PARTS]
        parts.append(Services(served, actions, status))
        # The node keeps the services of these two, which need no task.
        RosEndEffector(node, remote)
        TypeDescriptions(node)
        served.declare(parameter for part in parts for parameter in part.parameters())
        log.info("%s is the node %s of ROS 2", hand.name, node.name.full)
        yield parts
    finally:
        context.discard(node)


def _grouped(pairs: Collection[tuple[str, str]] | Any) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for key, name in pairs:
        groups.setdefault(key, []).append(name)
    return groups


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names)
