"""Find a running hand: on this computer by its announcement, elsewhere by its endpoint."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import anyio
import anyio.to_thread
import zenoh

from rtee import monotonic
from rtee.errors import ConfigError, NoHand, suggestion
from rtee.hand.names import check_name
from rtee.messages import network_key
from rtee.messages.requests import ALIVE
from rtee.remote.directory import Running, hands_running, starting
from rtee.remote.session import TLS, access_path, close_session, open_client
from rtee.remote.stopping import stop_path
from rtee.units import longest_wait

VARIABLE = "RTEE_CONNECT"
"""Environment variable with the endpoint of a hand on another computer."""

_POLL_PERIOD = 0.02
"""Time between two searches for a hand that is not running yet [s]: too short to be noticed."""

_STARTING = 10.0
"""Longest wait for a hand that is just starting [s]: before clients can reach it, Python needs a
second or more to import it, and its devices have 3 s to connect."""

_ANSWER_WITHIN = 3.0
"""Time for the hands at an endpoint to report that they are alive [s]: a round trip or two, but on
a busy computer and behind the flood of another client more than a second."""


class FoundSession(NamedTuple):
    """A session with a hand, its name, and the access path.

    The access path is `HERE`, `PLAIN`, or the name of this user's certificate. A hand on this
    computer has a stop socket.
    """

    session: zenoh.Session
    hand: str
    access_path: str
    stops: Path | None = None


async def open_hand(
    hand: str | None,
    endpoint: str | None,
    wait: float | str,
    on_wait: Callable[[str], object] | None = None,
    within: float | None = None,
) -> FoundSession:
    """Find a hand and open a session with it; waits for one that starts on this computer.

    Args:
        hand: The hand's name; ``None`` if only one hand runs.
        endpoint: The hand's address; ``None``: that in ``RTEE_CONNECT``, otherwise this computer.
        wait: Time to wait for a hand that is not running yet [s].
        on_wait: Called with the reason for waiting, in words, whenever it changes.
        within: Time to open the session once the hand is found [s]; by default 10 s.

    Raises:
        NoHand: if there is no such hand.
        ConfigError: if several hands run and none is named.
    """
    if hand is not None:
        check_name(hand, "hand")
    endpoint = endpoint or os.environ.get(VARIABLE) or None
    began, longest, reported = monotonic.now(), longest_wait(wait, "wait"), ""
    while True:
        try:
            return await (
                _elsewhere(hand, endpoint, within)
                if endpoint
                else open_here(chosen_here(hand), within)
            )
        except NoHand as error:
            least = _STARTING if endpoint is None and _starts(hand) else 0.0
            if monotonic.now() >= began + max(longest, least):
                raise
            if on_wait is not None and str(error) != reported:
                reported = str(error)
                on_wait(reported)
        await anyio.sleep(_POLL_PERIOD)


def _starts(hand: str | None) -> bool:
    names = starting()
    return bool(names) if hand is None else hand in names


def chosen_here(hand: str | None) -> Running:
    """Return a hand that runs on this computer; raises the errors of `open_hand`."""
    hands = hands_running()
    return hands[_chosen(hand, hands, "on this computer")]


async def open_here(there: Running, within: float | None = None) -> FoundSession:
    """Open a session with a hand that runs on this computer; raises `NoHand`."""
    try:
        session = await anyio.to_thread.run_sync(open_client, there.endpoints, within)
    except NoHand:
        raise NoHand(
            f"the hand '{there.hand}' does not answer; it runs in process {there.pid}"
        ) from None
    # A server announces one endpoint here, its Unix socket.
    endpoint = there.endpoints[0]
    return FoundSession(session, there.hand, access_path(endpoint), stop_path(endpoint))


async def _elsewhere(hand: str | None, endpoint: str, within: float | None) -> FoundSession:
    session = await anyio.to_thread.run_sync(open_client, [endpoint], within)
    try:
        names = await anyio.to_thread.run_sync(alive, session)
        # A router shows nothing to a certificate that it does not know, or that was revoked.
        blind = endpoint.startswith(TLS) and not names
        where = f"at {endpoint}" + (" as far as this certificate may see" if blind else "")
        return FoundSession(session, _chosen(hand, names, where), access_path(endpoint))
    except BaseException:  # cancellation, too, since an open session keeps threads
        close_session(session)
        raise


def hands_at(endpoint: str, within: float | None = None) -> list[str]:
    """Return the names of the hands at an endpoint; none if nothing answers.

    Blocks for milliseconds where a hand answers, at most for the given time for the session and
    once more for its answers [s]; by default for 10 s and 3 s.
    """
    try:
        session = open_client([endpoint], within)
    except NoHand:
        return []
    try:
        return alive(session, within)
    finally:
        close_session(session)


def alive(session: zenoh.Session, within: float | None = None) -> list[str]:
    """Return the names of the hands that a session reaches; blocks until all have answered.

    At most for the given time [s], by default 3 s.
    """
    limit = _ANSWER_WITHIN if within is None else within
    tokens = session.liveliness().get(network_key("*", ALIVE), timeout=limit)
    return [str(reply.ok.key_expr).split("/")[1] for reply in tokens if reply.ok is not None]


def _chosen(hand: str | None, names: Collection[str], where: str) -> str:
    if hand is not None:
        if hand in names:
            return hand
        hint = suggestion(hand, names) if names else f"start it with 'rtee run {hand}'"
        raise NoHand(f"the hand '{hand}' is not running {where}; {hint}")
    if not names:
        raise NoHand(f"no hand is running {where}; start one with 'rtee run HAND'")
    if len(names) > 1:
        raise ConfigError(
            f"several hands are running {where}; name one of: {', '.join(sorted(names))}"
        )
    return next(iter(names))
