"""Nodes of ROS 2 with their publishers, subscriptions, services and clients, and their context."""

from __future__ import annotations

import itertools
import logging
import math
import os
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import anyio
import anyio.to_thread
import zenoh

from rtee.errors import NoRouter, needing_extra
from rtee.hand.config_schema import Ros2Settings
from rtee.remote.connections import disable_linger
from rtee.remote.session import close_session
from rtee.ros2.endpoints import Callback, Client, Handler, Publisher, Service, Subscription
from rtee.ros2.keys import Entity, Kind, NodeName, key_expression, node_name
from rtee.ros2.participant import Participant
from rtee.ros2.qos import DEFAULT, Qos
from rtee.ros2.session import (
    configuration,
    domain_of,
    open_session,
    router_attempts,
    router_of,
)
from rtee.ros2.types import ServiceType, TopicType

log = logging.getLogger(__name__)

_WATCH = 1.0
"""Time between two checks of the connection to the router, and between two attempts [s]."""


class _Closable(Protocol):
    def close(self) -> None: ...


C = TypeVar("C", bound=_Closable)

AT_ONCE = 16
"""Default number of requests that a service handles at once."""


class Node:
    """A node; made by `Context.node`.

    Types are given by name, such as ``sensor_msgs/msg/JointState``, or as the `TopicType` or
    `ServiceType` of the context's interfaces; names of topics and services as in ROS 2:
    ``/absolute``, ``relative`` to the namespace or ``~/private``.

    Attributes:
        context: The context.
        name: Its name.
    """

    def __init__(self, context: Context, name: NodeName) -> None:
        self.context, self.name = context, name
        self._participant = context.participant
        self._id = self._participant.next_id()
        self._open: list[_Closable] = []
        self._token: zenoh.LivelinessToken = self._participant.session.liveliness().declare_token(
            self._entity(Kind.NODE, self._id).token
        )

    def _entity(self, kind: Kind, number: int) -> Entity:
        ids = str(self._participant.domain), self._participant.zid, str(self._id), str(number)
        return Entity(*ids, kind, self.name)

    def _add(
        self,
        make: Callable[..., C],
        kind: Kind,
        name: str,
        type_: TopicType | ServiceType,
        qos: Qos,
        *options: object,
    ) -> C:
        """Make an endpoint of a class with further options, add it to the node and return it."""
        full = self.name.resolve(name)
        key = key_expression(self._participant.domain, full, type_.name, type_.hash)
        entity = self._entity(kind, self._participant.next_id())
        entity = replace(entity, topic=full, type=type_.name, type_hash=type_.hash, qos=qos)
        endpoint = make(self._participant, entity, key, type_, *options)
        self._open.append(endpoint)
        return endpoint

    def _topic(self, type_: str | TopicType) -> TopicType:
        return self.context.interfaces.topic(type_) if isinstance(type_, str) else type_

    def _service(self, type_: str | ServiceType) -> ServiceType:
        return self.context.interfaces.service(type_) if isinstance(type_, str) else type_

    def publisher(self, topic: str, type_: str | TopicType, qos: Qos = DEFAULT) -> Publisher:
        """Return a new publisher.

        Raises:
            ConfigError: if ROS 2 would refuse the name.
            MessageError: if there is no such type.
        """
        return self._add(Publisher, Kind.PUBLISHER, topic, self._topic(type_), qos)

    def subscription(
        self,
        topic: str,
        type_: str | TopicType,
        callback: Callback,
        qos: Qos = DEFAULT,
    ) -> Subscription:
        """Return a new subscription.

        Args:
            topic: Name of the topic.
            type_: Type of the topic.
            callback: Called in the event loop with one message after another; may return an
                awaitable. While it is slow, the oldest messages beyond the QoS's depth are dropped.
            qos: Quality of service.

        Raises:
            ConfigError: if ROS 2 would refuse the name.
            MessageError: if there is no such type.
        """
        kind = self._topic(type_)
        return self._add(Subscription, Kind.SUBSCRIPTION, topic, kind, qos, callback)

    def service(
        self,
        name: str,
        type_: str | ServiceType,
        handler: Handler,
        qos: Qos = DEFAULT,
        *,
        at_once: int = AT_ONCE,
    ) -> Service:
        """Return a new service.

        Args:
            name: Name of the service.
            type_: Type of the service.
            handler: Returns the response to a request; may take any time. If it raises an error,
                the client gets an empty response, since ROS 2 has no error responses.
            qos: Quality of service.
            at_once: Most requests handled at once, those of one client only while as many places
                are left for others; 100 more wait, and further ones are dropped.

        Raises:
            ConfigError: if ROS 2 would refuse the name.
            MessageError: if there is no such type.
        """
        kind = self._service(type_)
        return self._add(Service, Kind.SERVICE, name, kind, qos, handler, at_once)

    def client(self, name: str, type_: str | ServiceType) -> Client:
        """Return a new client of a service.

        Raises:
            ConfigError: if ROS 2 would refuse the name.
            MessageError: if there is no such type.
        """
        return self._add(Client, Kind.CLIENT, name, self._service(type_), DEFAULT)

    def discard(self, made: _Closable) -> None:
        """Close a publisher, subscription, service or client of this node."""
        self._open.remove(made)
        made.close()

    def close(self) -> None:
        """Leave the graph with all endpoints of the node."""
        while self._open:
            # Removed before it is closed, so that a failure does not close it a second time.
            self._open.pop().close()
        # Last, so that no endpoint is in the graph without its node.
        self._token.undeclare()  # type: ignore[no-untyped-call]


class Context:
    """A program's participation in a ROS 2 domain; made by `Context.open`.

    Call its methods in the thread of the event loop in which it was opened.

    Attributes:
        settings: Domain, distribution and router.
        participant: The session and the objects that all nodes share.
        domain: The domain.
        interfaces: The interfaces of the distribution.
        graph: The ROS graph.
        warning_log: Problems with the messages of others.
        log: Logger of its nodes.
    """

    def __init__(self, settings: Ros2Settings, participant: Participant) -> None:
        self.settings, self.participant = settings, participant
        self.domain, self.interfaces = participant.domain, participant.interfaces
        self.graph, self.warning_log = participant.graph, participant.warning_log
        self.log = log
        self._nodes: list[Node] = []

    @classmethod
    @asynccontextmanager
    async def open(
        cls,
        settings: Ros2Settings,
        environment: Mapping[str, str] | None = None,
        *,
        insecure: bool = False,
        router_needed: bool = False,
    ) -> AsyncIterator[Context]:
        """Open a session; close it and all nodes at the end of the context.

        Logs a missing router once and keeps trying to connect. A program on the router's computer
        may go on without the router, others must wait for it; the variable
        `rtee.ros2.session.ROUTER_CHECK` sets how long to look for it.

        Args:
            settings: Domain, distribution and router.
            environment: Environment variables of rmw_zenoh; by default those of the process.
            insecure: Whether to allow a router on another computer without certificates.
            router_needed: Whether to raise `NoRouter` without a router, instead of going on.

        Raises:
            ConfigError: if a setting or variable cannot be used.
            MissingExtra: if the extra ``ros2`` is not installed.
            NoRouter: if it is needed and does not answer.
        """
        with needing_extra("ROS 2", "ros2"):
            import xxhash  # noqa: F401 - for the identifiers

        environment = os.environ if environment is None else environment
        domain, attempts = domain_of(settings, environment), router_attempts(environment)
        config = configuration(settings, environment, insecure=insecure)
        missing = (
            f"no router of ROS 2 at {router_of(config)}: nodes find each other only once it runs"
            " (ros2 run rmw_zenoh_cpp rmw_zenohd, or rtee ros2 router)"
        )
        # A client's session cannot open without its router; 0 attempts mean waiting for ever.
        session = await _opened(config, attempts if router_needed else 0, missing)
        try:
            context = cls(settings, Participant(session, domain, settings.distro.value))
            await context._look_for_router(attempts, missing)
            if router_needed and attempts >= 0 and not context.connected:
                raise NoRouter(missing)
            context.participant.start(context._watch(missing))
            try:
                yield context
            finally:
                # Also on cancellation, or the nodes would stay in the graph with the process.
                with anyio.CancelScope(shield=True):
                    await context._close()
        finally:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(close_session, session)

    @property
    def connected(self) -> bool:
        """Whether a router is connected."""
        return bool(self.participant.session.info.routers_zid())

    async def _look_for_router(self, attempts: int, missing: str) -> None:
        if attempts == 0 and not self.connected:
            log.warning("%s; waiting for it", missing)
        with anyio.move_on_after(_WATCH * attempts if attempts else math.inf):
            while attempts >= 0 and not self.connected:  # noqa: ASYNC110 - Zenoh has no event
                await anyio.sleep(_WATCH / 20)

    async def _watch(self, missing: str) -> None:
        """Log once when the router is lost, and once when it is back."""
        # None at the start: log a router that is missing then, but not one that is there.
        was: bool | None = None
        while True:
            disable_linger()  # dropping the link to a frozen node must not block Zenoh's thread
            now = self.connected
            if now and was is False:
                log.info("the router of ROS 2 at %s is there", self.settings.router)
            elif not now and was is not False:
                log.warning("%s", missing)
            was = now
            await anyio.sleep(_WATCH)

    def node(self, name: str, namespace: str = "") -> Node:
        """Return a new node.

        Raises:
            ConfigError: if ROS 2 would refuse the name or namespace.
        """
        node = Node(self, node_name(name, namespace))
        self._nodes.append(node)
        return node

    def discard(self, node: Node) -> None:
        """Close a node."""
        self._nodes.remove(node)
        node.close()

    def start(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine until it or the context ends."""
        self.participant.start(work)

    async def _close(self) -> None:
        while self._nodes:
            self._nodes.pop().close()
        await self.participant.close()


async def _opened(config: zenoh.Config, attempts: int, missing: str) -> zenoh.Session:
    """Open a session; a client's session opens once its router answers.

    Raises `NoRouter` with the sentence ``missing`` if it does not open within the given number of
    attempts (0: no limit), and `ConfigError` if an endpoint cannot be used.
    """
    for attempt in itertools.count(1):
        try:
            return await anyio.to_thread.run_sync(open_session, config)
        except NoRouter:
            if attempt == max(attempts, 1) and attempts != 0:
                raise NoRouter(missing) from None
            if attempt == 1:
                log.warning("%s", missing)
        await anyio.sleep(_WATCH)
    raise AssertionError  # the attempts never end
