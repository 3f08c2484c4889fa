"""The router of a site: a Zenoh router, with access rules, that hands and clients connect to.

A router is optional. Use one where clients cannot reach the hands' computers, or should use one
address for all of them. Its certificates and its list of people are in a folder like that of a hand
that listens itself; the list also names hands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import anyio
import zenoh
from anyio import to_thread

from rtee.errors import ConfigError
from rtee.messages import network_key
from rtee.messages.requests import CLIENTS, WATCHES
from rtee.remote.access import router_access_control
from rtee.remote.credentials import Credentials, router_certificates
from rtee.remote.session import check_endpoints, close_session, is_safe, open_listening

_MOST_SESSIONS = 1000
"""Most connections: Zenoh's own limit for routers, 200 hands with four clients each."""

_LOOK_EVERY = 1.0
"""Interval at which the list of hands is read [s], as hands read their lists of people."""


async def route(
    site: Credentials | None, listen: Sequence[str], tell: Callable[[str], object]
) -> None:
    """Run the router of a site until cancelled; raises the errors of `router_settings`.

    Zenoh reads its rules once, so the router restarts when hands are added. It waits until only
    watching clients are connected, since a hand stops the goals of clients that it loses.

    Args:
        site: The site's certificates; ``None``: anyone who reaches the router can move the hands.
        listen: Its endpoints.
        tell: Called with a sentence about hands that are admitted or waiting.
    """
    while True:
        settings = router_settings(site, listen)
        hands = {} if site is None else site.hands
        session = open_listening(listen, (), settings)
        try:
            tell(_names(hands) if site else "all")
            before = hands
            while site is None or site.hands == hands or await to_thread.run_sync(_busy, session):
                if site is not None and site.hands != before:
                    before = site.hands
                    tell(f"{_names(before)}, once no client is connected")
                await anyio.sleep(_LOOK_EVERY)
                # An unreadable list may be in the middle of an update; keep the rules.
                with suppress(ConfigError):
                    _ = site and site.read()
        finally:
            close_session(session)


def _names(hands: Mapping[str, str]) -> str:
    return ", ".join(sorted(set(hands.values())))


def _busy(session: zenoh.Session) -> bool:
    """Return whether a client is connected that may have sent a goal to a hand."""
    tokens = session.liveliness().get(network_key("*", f"{CLIENTS}/*"))
    names = (str(reply.ok.key_expr).rpartition("/")[2] for reply in tokens if reply.ok)
    return not all(name.startswith(WATCHES) for name in names)


def router_settings(site: Credentials | None, listen: Sequence[str]) -> dict[str, Any]:
    """Return Zenoh's settings of a router, besides those of every listening session.

    Args:
        site: The site's certificates; ``None``: anyone who reaches the router can move the hands.
        listen: Its endpoints.

    Raises:
        ConfigError: if an endpoint cannot be used or would admit clients without a certificate, or
            certificates are missing.
    """
    check_endpoints(listen)
    settings: dict[str, Any] = {"mode": "router", "transport/unicast/max_sessions": _MOST_SESSIONS}
    if site is None:
        return settings
    if unsafe := [each for each in listen if not is_safe(each)]:
        raise ConfigError(
            f"anyone who reaches {', '.join(unsafe)} could move the hands; write tls/HOST:PORT"
        )
    settings |= router_certificates(site.files())
    # With the names of later certificates, since Zenoh reads its rules once.
    people = {**site.spare, **{name: entry.role for name, entry in site.admitted.items()}}
    settings["access_control"] = router_access_control(people, site.hands)
    return settings
