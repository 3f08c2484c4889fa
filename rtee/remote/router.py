"""The router of a site: a router of Zenoh that hands and clients connect to, with its rules.

Hands and clients need no router. It stands where clients cannot reach the computers of the hands,
or should know one address for all of them. Its certificates and its list of people are in a folder
as that of a hand that listens itself, and the list names hands besides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rtee.errors import ConfigError
from rtee.remote.access import router_access_control
from rtee.remote.credentials import Credentials, router_certificates
from rtee.remote.session import check_endpoints, is_safe

_MOST_SESSIONS = 1000
"""Most connections: Zenoh's own limit for routers, 200 hands with four clients each."""


def router_settings(site: Credentials | None, listen: Sequence[str]) -> dict[str, Any]:
    """Return Zenoh's settings of a router, beyond those of all that listens.

    Args:
        site: The site's certificates; ``None``: whoever reaches the router can move the hands.
        listen: Its endpoints.

    Raises:
        ConfigError: if an endpoint cannot be used or would let in those without a certificate, or
            certificates are missing.
    """
    check_endpoints(listen)
    settings: dict[str, Any] = {"mode": "router", "transport/unicast/max_sessions": _MOST_SESSIONS}
    if site is None:
        return settings
    if unsafe := [each for each in listen if not is_safe(each)]:
        raise ConfigError(
            f"whoever reaches {', '.join(unsafe)} could move the hands: write tls/HOST:PORT"
        )
    settings |= router_certificates(site.files())
    # With the names of later certificates, since Zenoh reads its rules once.
    people = {**site.spare, **{name: entry.role for name, entry in site.admitted.items()}}
    settings["access_control"] = router_access_control(people, site.hands)
    return settings
