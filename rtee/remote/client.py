"""A client's interface to a running hand: execute actions, watch, stop.

async with rtee.connect("schunk_svh") as hand:
    result = await hand.do("pinch_tight", "index", "thumb", intensity=0.6)
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from functools import partial, wraps
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, NoReturn, ParamSpec, TypeVar

import anyio
import anyio.to_thread

from rtee import monotonic
from rtee.errors import ConfigError, NoHand, RemoteError, RequestRejected, suggestion
from rtee.messages.requests import REQUESTS, Role
from rtee.remote.action_client import LibraryClient, ReachClient
from rtee.remote.find import VARIABLE as CONNECT
from rtee.remote.find import FoundSession, chosen_here, open_hand
from rtee.remote.goal import GoalClient
from rtee.remote.goal_values import finite, numbers
from rtee.remote.link import ANSWER_WITHIN, Link, introduced
from rtee.remote.monitoring import Monitoring
from rtee.remote.session import close_session
from rtee.remote.stopping import ANSWER_WITHIN as STOPPED_WITHIN
from rtee.remote.stopping import silent, stop_at, stop_path
from rtee.remote.stream import StreamClient
from rtee.units import TIME, quantity

P = ParamSpec("P")
T = TypeVar("T")


_RECOVER_WITHIN = 60.0
"""Time to wait until devices have recovered [s]: twice what homing a hand takes."""

_STOP_OPENS_WITHIN = 3.0
"""Time to open a session for a stop [s]: TCP repeats a lost first packet after 1 s, and over a VPN
the rest takes up to 1 s. Then the user must learn that the hand is out of reach."""

_CONFIRMED_WITHIN = 0.5
"""Time in which devices that have not confirmed are stopped again [s]: then they count as lost."""

_LEAVE_WITHIN = 1.0
"""Time to wait for the answer when leaving a hand [s], which may be gone already."""


class LeaseClient:
    """Acquires and releases the right to move the hand.

    Args:
        link: The connection to the hand.

    Attributes:
        jogged: Whether this client has jogged the hand, and so holds the lease for a moment.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._acquired = False
        self._holding = 0  # open contexts of `lease`
        self.jogged = False

    async def acquire_lease(self) -> None:
        """Acquire the lease: until `release_lease`, no other client may move the hand."""
        await self._link.request("acquire")
        self._acquired = True

    async def release_lease(self) -> None:
        """Release the lease."""
        await self._link.request("release")
        self._acquired = self.jogged = False

    async def leave(self) -> None:
        """Release the lease of a hand that was only jogged; called at the end of `connect`.

        If the lease was acquired, or a goal of this client runs, the hand does what its
        configuration says for a lost client instead.
        """
        if self.jogged and not (self._acquired or self._holding):
            self.jogged = False
            with contextlib.suppress(RemoteError):
                await self._link.request("release", within=_LEAVE_WITHIN)

    @contextlib.asynccontextmanager
    async def lease(self) -> AsyncIterator[None]:
        """Hold the lease for as long as the context lasts.

        After `acquire_lease`, and inside another such context, the lease is kept at the end.
        """
        refused = False
        self._holding += 1
        try:
            try:
                await self._link.request("acquire")
            except RemoteError:
                refused = True
                raise
            yield
        finally:
            self._holding -= 1
            # Even if cancelled before the answer arrived: the hand may have granted the lease.
            if not (refused or self._acquired or self._holding):
                # Shielded: a cancelled task must not keep the lease from other clients.
                with anyio.CancelScope(shield=True), contextlib.suppress(RemoteError):
                    await self.release_lease()


def _part(
    name: str, method: Callable[Concatenate[Any, P], T]
) -> Callable[Concatenate[RemoteHand, P], T]:
    """Return a method of `RemoteHand` that calls the given method of one of its parts."""

    @wraps(method)
    def call(self: RemoteHand, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return method(getattr(self, name), *args, **kwargs)

    return call


ONE_PROCESS = "a connected hand cannot be copied or pickled; connect in each process"
"""What is said to programs that hand a connection to another process."""


class RemoteHand:
    """A running hand; made by `connect`.

    It has all methods of `GoalClient`, `StreamClient`, `LeaseClient`, `Monitoring`, `LibraryClient`
    and `ReachClient`.

    Requests that move the hand are refused with `LeaseHeld` while another client holds the lease.
    A client holds the lease while its own goal or stream runs, and from `acquire_lease` to
    `release_lease`; `stop` needs no lease.

    Attributes:
        name: The hand's name.
        client: This client's name on the network.
    """

    def __init__(self, link: Link, stops: Path | None = None) -> None:
        self.name, self.client = link.hand, link.client
        self._link, self._stops = link, stops
        self._monitoring = Monitoring(link)
        self._actions = LibraryClient(link)
        self._goals = GoalClient(link, self._monitoring.info)
        self._lease = LeaseClient(link)
        self._streams = StreamClient(link, self._monitoring, self._goals)
        self._reaching = ReachClient(link, self._actions, self._goals)

    def __reduce__(self) -> NoReturn:
        """Refuse to be copied or pickled."""
        raise TypeError(ONE_PROCESS)

    @property
    def role(self) -> Role:
        """This client's role; the hand refuses requests that need a higher one."""
        return self._link.role

    start = _part("_goals", GoalClient.start)
    start_goal = _part("_goals", GoalClient.start_goal)
    do = _part("_goals", GoalClient.do)
    open = _part("_goals", GoalClient.open)
    move_opening = _part("_goals", GoalClient.move_opening)
    grasp = _part("_goals", GoalClient.grasp)
    touch = _part("_goals", GoalClient.touch)
    cancel = _part("_goals", GoalClient.cancel)
    effort_limits = _part("_goals", GoalClient.effort_limits)

    stream = _part("_streams", StreamClient.stream)

    acquire_lease = _part("_lease", LeaseClient.acquire_lease)
    release_lease = _part("_lease", LeaseClient.release_lease)
    lease = _part("_lease", LeaseClient.lease)
    leave = _part("_lease", LeaseClient.leave)

    state = _part("_monitoring", Monitoring.state)
    states = _part("_monitoring", Monitoring.states)
    collected_states = _part("_monitoring", Monitoring.collected_states)
    touch_state = _part("_monitoring", Monitoring.touch_state)
    touch_states = _part("_monitoring", Monitoring.touch_states)
    events = _part("_monitoring", Monitoring.events)
    feedback = _part("_monitoring", Monitoring.feedback)
    results = _part("_monitoring", Monitoring.results)
    status = _part("_monitoring", Monitoring.status)
    ready = _part("_monitoring", Monitoring.ready)
    info = _part("_monitoring", Monitoring.info)
    object_description = _part("_monitoring", Monitoring.object_description)
    robot_description = _part("_monitoring", Monitoring.robot_description)

    actions = _part("_actions", LibraryClient.actions)
    primitives = _part("_actions", LibraryClient.primitives)
    partners = _part("_actions", LibraryClient.partners)
    openings = _part("_actions", LibraryClient.openings)
    limits = _part("_actions", LibraryClient.limits)
    trials = _part("_actions", LibraryClient.trials)
    grasp_plan = _part("_actions", LibraryClient.grasp_plan)
    reach = _part("_reaching", ReachClient.reach)
    grasp_at = _part("_reaching", ReachClient.grasp_at)
    add_generic = _part("_actions", LibraryClient.add_generic)
    add_composed = _part("_actions", LibraryClient.add_composed)
    add_timed = _part("_actions", LibraryClient.add_timed)
    add_action = _part("_actions", LibraryClient.add_action)
    store_action = _part("_actions", LibraryClient.store_action)
    remove_action = _part("_actions", LibraryClient.remove_action)
    rename_action = _part("_actions", LibraryClient.rename_action)

    async def ask(
        self, name: str, fields: Mapping[str, Any] | None = None, *, within: float = ANSWER_WITHIN
    ) -> dict[str, Any]:
        """Send a network request and return the fields of its answer.

        For bridges to other networks, which pass on messages as they are; use the other methods for
        everything else.

        Args:
            name: Its name in `rtee.messages.requests`.
            fields: Its fields; ``None`` for a request that has none.
            within: Time to wait for the answer [s].

        Raises:
            RequestRejected: if the hand refuses the request, with the reason; or there is none of
                this name.
            MessageError: if the fields are not those of the request.
            GoalRejected: if the time cannot be used.
            NoHand: if the hand does not answer.
        """
        if not isinstance(name, str) or name not in REQUESTS:
            raise RequestRejected(f"no request '{name}'; {suggestion(name, REQUESTS)}")
        within = quantity(within, TIME, "time to wait")
        return await self._link.ask(name, fields, within=within)

    async def hold(self) -> None:
        """Hold the measured posture; a running goal is cancelled."""
        await self._link.request("hold")

    async def jog(self, positions: Mapping[str, float], max_velocity: float | None = None) -> None:
        """Move some actuators; returns at once.

        Args:
            positions: Target by actuator, inside its limits [rad | m].
            max_velocity: Velocity limit [rad/s | m/s]; ``None``: the actuators' own limits.

        Raises:
            GoalRejected: if a value is not a number or beyond a limit, or an actuator is unknown.
        """
        await self._send_values("jog", "", positions, max_velocity)
        self._lease.jogged = True

    async def stop(self) -> dict[str, bool]:
        """Stop all devices now, even if another client holds the lease.

        Returns:
            Whether each device has confirmed the stop, after up to half a second.

        Raises:
            NoHand: if the hand has not answered after a second.
        """
        return await _stopped(
            self._stops, self.name, self.client, lambda: _asked_to_stop(self._link)
        )

    async def admit_agents(self) -> None:
        """Let agents move the hand again after a stop has locked them out; see `rtee mcp`.

        Raises:
            RequestRejected: if this client is an agent itself.
        """
        await self._link.request("admit")

    async def recover(self, device: str | None = None) -> None:
        """Recover one device, or all, from a fault; moves only devices that must be homed."""
        await self._link.request("recover", device or "", within=_RECOVER_WITHIN)

    async def set_gains(self, gains: Mapping[str, float], device: str | None = None) -> None:
        """Change gains of a device, or of every device that has them.

        Without a device, ``grip_effort`` is the effort kept on a grasped object, 0 to 1 of the
        effort limit.
        """
        await self._send_values("gains", device or "", gains)

    async def record(self, what: str, text: str = "") -> None:
        """Start, stop or mark the recording; returns at once.

        Args:
            what: ``start`` a recording unless one is being written, ``stop`` it, or ``mark`` it.
            text: Text of the mark, one line.

        Raises:
            RequestRejected: if the hand refuses the request, with the reason.
        """
        await self._link.ask("record", {"client": self.client, "what": what, "text": text})

    async def _send_values(
        self, name: str, source: str, values: Mapping[str, float], limit: float | None = None
    ) -> None:
        given = numbers(values, "value")
        fields = {
            "client": self.client,
            "source": source,
            "name": list(given),
            "value": list(given.values()),
            "limit": math.nan if limit is None else finite(limit, "velocity"),
        }
        await self._link.ask(name, fields)


async def _stopped(
    stops: Path | None,
    hand: str,
    client: str,
    otherwise: Callable[[], Awaitable[dict[str, bool]]],
) -> dict[str, bool]:
    """Stop a hand through its stop socket, or through the network if it has none.

    A device that has not confirmed is stopped again: its answer was lost, or it had to wait.
    """
    until = monotonic.now() + _CONFIRMED_WITHIN
    while True:
        confirmed = await _stopped_once(stops, hand, client, otherwise)
        if all(confirmed.values()) or monotonic.now() > until:
            return confirmed
        await anyio.sleep(_CONFIRMED_WITHIN / 10.0)


async def _stopped_once(
    stops: Path | None,
    hand: str,
    client: str,
    otherwise: Callable[[], Awaitable[dict[str, bool]]],
) -> dict[str, bool]:
    if stops is not None:
        # A program that cleans temporary files may have removed it. A hand that has it but is
        # silent would not answer otherwise either, and the caller should know soon.
        with contextlib.suppress(OSError):
            return await anyio.to_thread.run_sync(
                partial(stop_at, stops, hand, client),
                limiter=anyio.CapacityLimiter(1),  # other calls may use up the threads of a loop
            )
    return await otherwise()


async def _asked_to_stop(link: Link) -> dict[str, bool]:
    try:
        reply = await link.request("stop", within=STOPPED_WITHIN)
    except NoHand:
        raise silent(link.hand) from None
    return dict(zip(reply["device"], reply["confirmed"].tolist(), strict=True))


async def stop_hand(
    hand: str | None = None, *, endpoint: str | None = None, client: str = "python"
) -> tuple[str, dict[str, bool]]:
    """Stop a hand without connecting first; return its name and which devices confirmed.

    On this computer the stop goes through a socket of its own. Elsewhere it is sent without
    ``hello``, so that no limit of clients and requests applies. The arguments and errors
    are those of `connect`; a hand that does not answer within a second, or that cannot be reached
    within three over a network, raises `NoHand`.
    """
    name, stops = hand or "", None
    if endpoint is None and not os.environ.get(CONNECT):
        running = chosen_here(hand)
        name = running.hand
        stops = stop_path(running.endpoints[0]) if running.endpoints else None

    async def there() -> dict[str, bool]:
        nonlocal name
        found = open_hand(hand, endpoint, 0.0, within=_STOP_OPENS_WITHIN)
        async with _linked(found, client) as (link, _):
            name = link.hand
            return await _asked_to_stop(link)

    done = await _stopped(stops, name, client, there)
    return name, done


class HandConnection(contextlib.AbstractAsyncContextManager[RemoteHand, None]):
    """A connection to be opened by ``async with``, once; made by `connect`."""

    def __init__(self, opened: contextlib.AbstractAsyncContextManager[RemoteHand]) -> None:
        self._opened = opened
        self._used = False

    async def __aenter__(self) -> RemoteHand:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            raise ConfigError(
                "this client runs on asyncio; on trio, use "
                "rtee.connect_blocking, and call its methods with trio.to_thread.run_sync"
            ) from None
        if self._used:
            raise ConfigError("this connection was opened before; call rtee.connect again")
        self._used = True
        return await self._opened.__aenter__()

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self._opened.__aexit__(kind, error, trace)

    if not TYPE_CHECKING:  # type checkers report by themselves what is missing

        def __getattr__(self, name: str) -> object:
            if hasattr(RemoteHand, name):
                self._refuse()
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")

        def __enter__(self) -> object:
            self._refuse()

        def __exit__(self, *_: object) -> None: ...

        def __await__(self) -> object:
            self._refuse()

        def _refuse(self) -> None:
            raise ConfigError(
                "the connection is not open: write 'async with rtee.connect(…) as hand:', or use "
                "rtee.connect_blocking in a program without an event loop"
            )


def connect(
    hand: str | None = None,
    *,
    endpoint: str | None = None,
    client: str = "python",
    wait: float | str = 0.0,
    on_wait: Callable[[str], object] | None = None,
) -> HandConnection:
    """Connect to a running hand for as long as the context lasts.

    The hand it yields belongs to the event loop of asyncio in which it was opened; other threads
    use `rtee.connect_blocking`, and other processes connect themselves.

    If this process dies while it holds the lease, the hand does what its configuration says
    (``safety: on_client_lost``). It does the same if the context ends with an error, or while the
    lease is acquired or a goal of this client runs.

    Args:
        hand: The hand's name; not needed if only one hand runs.
        endpoint: The hand's address, such as ``tcp/robot:7447``; by default that in
            ``RTEE_CONNECT``, otherwise on this computer.
        client: A name for this client, shown to people.
        wait: Time to wait until the hand runs [s]; `RemoteHand.ready` waits until its
            devices are active, too.
        on_wait: Called with the reason for waiting, in words, whenever it changes.

    Raises:
        NoHand: if no such hand runs.
        ConfigError: if several hands run and none is named, or an argument is not a string.
    """
    for what, value in (("hand", hand), ("endpoint", endpoint), ("client", client)):
        if not isinstance(value, str) and (value is not None or what == "client"):
            raise ConfigError(f"the {what} to connect with must be a string, not {value!r:.100}")
    return HandConnection(_connected(hand, endpoint, client, wait, on_wait))


@contextlib.asynccontextmanager
async def _connected(
    hand: str | None,
    endpoint: str | None,
    client: str,
    wait: float | str,
    on_wait: Callable[[str], object] | None,
) -> AsyncIterator[RemoteHand]:
    async with _linked(open_hand(hand, endpoint, wait, on_wait), client) as (link, stops):
        remote = RemoteHand(link, stops)
        await link.connect()
        yield remote
        await remote.leave()  # not after an error, which counts as losing the client


@contextlib.asynccontextmanager
async def _linked(
    opening: Awaitable[FoundSession], client: str
) -> AsyncIterator[tuple[Link, Path | None]]:
    """Open a link to a hand, which does not know this client yet, and find its stop socket."""
    found = await opening
    try:
        async with introduced(found.session, found.hand, found.access_path, client) as link:
            yield link, found.stops
    finally:
        # Even when cancelled: while the session is open, the client is alive to the hand.
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(close_session, found.session)
