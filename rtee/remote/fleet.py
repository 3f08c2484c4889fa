"""The hands of a computer and of a site: discovery and common monitoring.

Hands come and go. A `Fleet` searches for them every two seconds, introduces itself to each, and
asks all at once on demand. Hands behind one endpoint share a session.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncIterator, Collection, Sequence
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass

import anyio
import anyio.to_thread
import zenoh
from anyio.abc import TaskGroup

from rtee.errors import NoHand, RteeError
from rtee.messages.requests import WATCHES
from rtee.messages.state import State
from rtee.remote.directory import Running, hands_running
from rtee.remote.find import FoundSession, alive, open_here
from rtee.remote.link import introduced
from rtee.remote.monitoring import HandStatus, Monitoring
from rtee.remote.session import access_path, close_session, open_client
from rtee.types import DeviceStatus, Lifecycle

_SEARCH_EVERY = 2.0
"""Interval of searches for hands [s], and so the longest time until a new one appears."""

_ANSWER_WITHIN = 2.0
"""Time for all hands to answer [s]; those that have not by then are shown with the reason."""

_POLL = 0.02
"""Interval of the checks whether all have answered for the first time [s]."""

Opened = AbstractAsyncContextManager[FoundSession]
"""A hand in a session, which is closed with the context unless others share it."""


@dataclass(frozen=True, slots=True)
class HandAddress:
    """A hand and the endpoint through which it is reached; empty: on this computer."""

    hand: str
    endpoint: str = ""


@dataclass(frozen=True, slots=True)
class Look:
    """A hand's answer to a status request.

    Attributes:
        place: The hand; without a name, all hands at an endpoint that does not answer.
        status: Its status; ``None`` if it did not answer.
        state: Its state; ``None`` if it did not answer.
        trouble: Why there is no answer, in a sentence, or an empty string.
    """

    place: HandAddress
    status: HandStatus | None = None
    state: State | None = None
    trouble: str = ""

    @property
    def idle(self) -> Sequence[DeviceStatus]:
        """The devices that are not active, those with a fault first."""
        idle = self.status.inactive if self.status else []
        return sorted(idle, key=lambda device: device.lifecycle is not Lifecycle.FAULT)

    @property
    def condition(self) -> str:
        """The hand's condition in a word.

        It is ``absent``, otherwise the lifecycle of a device that is not active, otherwise
        ``moving``, ``leased`` or ``ready``.
        """
        if self.status is None:
            return "absent"
        if self.idle:
            return str(self.idle[0].lifecycle)
        if self.status.action or self.status.stream.stream:
            return "moving"
        return "leased" if self.status.holder else "ready"

    @property
    def temperature(self) -> float:
        """The highest temperature of an actuator [°C]; ``NaN``: none is measured."""
        values = self.state.temperature.tolist() if self.state else []
        return max((value for value in values if not math.isnan(value)), default=math.nan)


class Fleet:
    """Hands that are followed; made by `following`. With ``names``, these alone."""

    def __init__(self, names: Collection[str]) -> None:
        self._names = names
        self._monitors: dict[HandAddress, Monitoring] = {}
        self._troubles: dict[HandAddress, str] = {}
        self._followed: set[HandAddress] = set()
        self._awaited = 0  # searches and hands that have not answered for the first time

    async def known(self) -> None:
        """Wait until all hands that run now have answered, or have failed to."""
        while self._awaited:  # noqa: ASYNC110 - it becomes 0 in several places
            await anyio.sleep(_POLL)

    async def look(self) -> list[Look]:
        """Query all known hands at once, and return their answers by name."""
        looks = {place: Look(place, trouble=why) for place, why in self._troubles.items()}

        async def ask(place: HandAddress, monitor: Monitoring) -> None:
            looks[place] = Look(place, trouble="it does not answer")
            with anyio.move_on_after(_ANSWER_WITHIN):
                try:
                    status, state = await monitor.status(), await monitor.state()
                    looks[place] = Look(place, status, state)
                except RteeError as error:
                    looks[place] = Look(place, trouble=str(error))

        async with anyio.create_task_group() as group:
            for place, monitor in tuple(self._monitors.items()):
                group.start_soon(ask, place, monitor)
        return sorted(looks.values(), key=lambda look: (look.place.hand, look.place.endpoint))

    def follow(self, group: TaskGroup, endpoints: Sequence[str], *, here: bool) -> None:
        """Begin to follow the hands at endpoints, and on this computer."""
        self._awaited += len(endpoints) + here
        for endpoint in endpoints:
            group.start_soon(self._at, group, endpoint)
        if here:
            group.start_soon(self._here, group)

    async def _here(self, group: TaskGroup) -> None:
        first = 1
        while True:
            for running in hands_running().values():
                self._begin(group, HandAddress(running.hand), _opened_here(running))
            self._awaited, first = self._awaited - first, 0
            await anyio.sleep(_SEARCH_EVERY)

    async def _at(self, group: TaskGroup, endpoint: str) -> None:
        nowhere, first, path = HandAddress("", endpoint), 1, ""
        session: zenoh.Session | None = None
        try:
            while True:
                try:
                    if session is None:
                        session = await anyio.to_thread.run_sync(open_client, [endpoint])
                        path = access_path(endpoint)  # of the identity that opened it
                    self._troubles[nowhere] = "no hand runs there"
                    for name in await anyio.to_thread.run_sync(alive, session):
                        self._troubles.pop(nowhere, None)
                        found = FoundSession(session, name, path)
                        self._begin(group, HandAddress(name, endpoint), nullcontext(found))
                except NoHand as error:
                    self._troubles[nowhere] = str(error)
                self._awaited, first = self._awaited - first, 0
                await anyio.sleep(_SEARCH_EVERY)
        finally:
            await _close(session)

    def _begin(self, group: TaskGroup, place: HandAddress, opened: Opened) -> None:
        """Begin to follow a hand that was found, unless it is followed already."""
        if place not in self._followed and (not self._names or place.hand in self._names):
            self._followed.add(place)
            self._awaited += 1
            group.start_soon(self._stay, place, opened)

    async def _stay(self, place: HandAddress, opened: Opened) -> None:
        """Stay connected to a hand until it goes."""
        gone, first = anyio.Event(), 1
        try:
            async with (
                opened as found,
                introduced(
                    found.session, found.hand, found.access_path, "fleet", prefix=WATCHES
                ) as link,
            ):
                await link.connect()
                link.on_gone(gone.set)
                self._monitors[place] = Monitoring(link)
                self._troubles.pop(place, None)
                self._awaited, first = self._awaited - first, 0
                await gone.wait()
                self._troubles[place] = "it has ended or no longer answers"
        except RteeError as error:
            self._troubles[place] = str(error)
        finally:
            self._awaited -= first
            self._monitors.pop(place, None)
            self._followed.discard(place)


@contextlib.asynccontextmanager
async def _opened_here(running: Running) -> AsyncIterator[FoundSession]:
    found = await open_here(running)
    try:
        yield found
    finally:
        await _close(found.session)


async def _close(session: zenoh.Session | None) -> None:
    if session is not None:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(close_session, session)


@contextlib.asynccontextmanager
async def following(
    endpoints: Sequence[str] = (), names: Collection[str] = (), *, here: bool = True
) -> AsyncIterator[Fleet]:
    """Follow hands for as long as the context lasts: those of this computer and at endpoints.

    Args:
        endpoints: Endpoints of hands and routers on other computers.
        names: Follow these hands alone.
        here: Whether to look for hands on this computer.
    """
    fleet = Fleet(names)
    async with anyio.create_task_group() as group:
        fleet.follow(group, endpoints, here=here)
        yield fleet
        group.cancel_scope.cancel()
