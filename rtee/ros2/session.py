"""Zenoh sessions with the settings of rmw_zenoh, and a router for computers without ROS."""

from __future__ import annotations

import json
import os
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import zenoh
from msgspec import structs

from rtee.errors import ConfigError, NoRouter
from rtee.hand.config_schema import Distro, Ros2Settings
from rtee.remote import session as remote_session
from rtee.remote.credentials import identity
from rtee.remote.session import LOCAL, TLS, check_endpoints, close_session, is_safe

# Environment variables of ROS 2 and rmw_zenoh.
DOMAIN = "ROS_DOMAIN_ID"
SESSION_CONFIG = "ZENOH_SESSION_CONFIG_URI"
CONFIG_OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
ROUTER_CHECK = "ZENOH_ROUTER_CHECK_ATTEMPTS"

_LARGEST_DOMAIN = 232
"""Largest domain of ROS 2, limited by the ports of DDS."""

_LARGEST = 1 << 26
"""Largest message that Zenoh assembles [bytes]: those of cameras have some 10 MB. By default, Zenoh
allows 1 GiB per peer."""

_CONNECT_WITHIN = 1000
"""Longest time until a router answers a client, before the next attempt [ms]."""

_COMMON: dict[str, Any] = {
    # Nodes find each other through the router, by gossip.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "scouting/gossip/multihop": False,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    # Zenoh distinguishes the samples kept for later subscribers by their time.
    "timestamping/enabled": True,
    "routing/router/peers_failover_brokering": True,
    "adminspace/enabled": False,
}
"""Settings of rmw_zenoh's sessions and its router: ``DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5``
and ``DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5`` there."""

_SETTINGS: dict[str, Any] = _COMMON | {
    "scouting/gossip/autoconnect": {"router": [], "peer": ["router", "peer"]},
    "scouting/gossip/autoconnect_strategy": {
        # Only one of two peers connects, or they could have two links.
        "peer": {"to_router": "always", "to_peer": "greater-zid"}
    },
    "queries_default_timeout": 600_000,
    "transport/link/rx/max_message_size": _LARGEST,
    "transport/shared_memory/enabled": False,
}
"""Settings of rmw_zenoh's sessions."""

_PEER: dict[str, Any] = {
    "mode": "peer",
    "listen/endpoints": ["tcp/localhost:0"],
    # Without a router, a peer opens at once and keeps trying to connect. An environment variable
    # may make the session a client, which needs a router to open: it gives up after this time.
    "connect/timeout_ms": {"peer": -1, "client": _CONNECT_WITHIN},
    "connect/exit_on_failure": {"peer": False, "client": True},
}
"""Settings of sessions on the router's own computer, where nodes exchange messages directly."""

_CLIENT: dict[str, Any] = {
    "mode": "client",
    "listen/endpoints": [],
    "connect/timeout_ms": _CONNECT_WITHIN,
    "connect/exit_on_failure": True,
}
"""Settings of sessions whose messages all pass through the router: those of another computer, since
a router does not forward messages between peers, and those whose router does not let everybody in:
with certificates, or on a Unix socket."""


def overridden(settings: Ros2Settings, given: Mapping[str, Any]) -> Ros2Settings:
    """Return settings with the options of a command line that are not ``None``.

    Raises `ConfigError` if an option has an invalid value.
    """
    changes = {name: value for name, value in given.items() if value is not None}
    distro = changes.get("distro")
    if distro is not None:
        if distro not in list(Distro):
            known = ", ".join(Distro)
            raise ConfigError(f"--distro should be {known}, not {distro}")
        changes["distro"] = Distro(distro)
    try:
        return structs.replace(settings, **changes)
    except ValueError as error:
        raise ConfigError(f"the command line: {error}") from None


def domain_of(settings: Ros2Settings, environment: Mapping[str, str]) -> int:
    """Return the domain in the environment, otherwise the one in the settings.

    Raises `ConfigError` if the environment variable is not a domain.
    """
    text = environment.get(DOMAIN, "").strip()
    if not text:
        return settings.domain
    # Short and ASCII: `isdigit` accepts superscripts, which `int` refuses, as it does very long
    # numbers.
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) <= _LARGEST_DOMAIN):
        raise ConfigError(
            f"{DOMAIN}={text} is not a domain; it must be a number from 0 to {_LARGEST_DOMAIN}"
        )
    return int(text)


def check_environment() -> None:
    """Raise `ConfigError` if an environment variable has a value that no node could use."""
    check_session(Ros2Settings(), os.environ, insecure=False)


def check_session(
    settings: Ros2Settings, environment: Mapping[str, str], *, insecure: bool
) -> None:
    """Raise `ConfigError` if no session could open with these settings and variables."""
    domain_of(settings, environment)
    router_attempts(environment)
    configuration(settings, environment, insecure=insecure)


def router_attempts(environment: Mapping[str, str]) -> int:
    """Return the number of checks for a router at the start; 0: no limit, negative: no check.

    Raises `ConfigError` if the environment variable is not a whole number.
    """
    text = environment.get(ROUTER_CHECK, "").strip() or "1"
    try:
        return int(text)
    except ValueError:
        raise ConfigError(f"{ROUTER_CHECK}={text} should be a whole number") from None


def configuration(
    settings: Ros2Settings, environment: Mapping[str, str], *, insecure: bool = False
) -> zenoh.Config:
    """Return the configuration of a session with the router in the settings.

    The environment has the variables of rmw_zenoh. Raises `ConfigError` if the router, a variable
    or the file that it names is invalid, or, unless ``insecure``, the router is open to the
    network.
    """
    if file := environment.get(SESSION_CONFIG, ""):
        config = _from_file(file)
    else:
        config, router = zenoh.Config(), settings.router
        check_endpoints([router])
        if not insecure and not is_safe(router):
            raise ConfigError(
                f"anyone who reaches {router} could move the hand; use a router on this computer or"
                " one with certificates (tls/HOST:PORT), or allow it with 'insecure: true' in"
                " remote.security",
                key="ros2.router",
            )
        # A program that needs a certificate, or access to a file, to reach the router must not
        # reach a node's own port without them.
        near = is_safe(router) and not router.startswith((TLS, LOCAL))
        entries = _SETTINGS | (_PEER if near else _CLIENT) | {"connect/endpoints": [router]}
        if router.startswith(TLS):
            entries |= identity().settings()
        for key, value in entries.items():
            _insert(config, key, json.dumps(value), f"the router '{settings.router}'")
    # Last, since this variable overrides the file, too.
    for entry in environment.get(CONFIG_OVERRIDE, "").split(";"):
        if entry.strip():
            key, equals, value = entry.partition("=")
            if not equals:
                raise ConfigError(f"{CONFIG_OVERRIDE}: '{entry}' should be PATH/KEY=VALUE")
            _insert(config, key.strip(), value.strip(), CONFIG_OVERRIDE)
    return config


def router_of(config: zenoh.Config) -> str:
    """Return the endpoints at which a session looks for its router, for messages."""
    endpoints = json.loads(config.get_json("connect/endpoints"))
    return " or ".join(endpoints) if isinstance(endpoints, list) else str(endpoints)


def _from_file(file: str) -> zenoh.Config:
    path = Path(file.removeprefix("file://"))
    try:
        # Read it first, since Zenoh's error hides why a file cannot be opened.
        path.read_bytes()
        return zenoh.Config.from_file(str(path))
    except (OSError, zenoh.ZError) as error:
        words = error.strerror if isinstance(error, OSError) else _words(error)
        raise ConfigError(f"{SESSION_CONFIG}: {words}", path=path) from None


def _insert(config: zenoh.Config, key: str, value: str, source: str) -> None:
    try:
        config.insert_json5(key, value)
    except zenoh.ZError as error:
        words = _words(error)
        why = "not JSON5, or not a valid value" if words.startswith("Json5Err") else words
        raise ConfigError(f"{source}: {key}={value} is not a setting of Zenoh: {why}") from None


def _words(error: zenoh.ZError) -> str:
    """Return an error's text without the location in Zenoh's source."""
    return str(error).partition(" at /")[0]


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open a session; blocks for some milliseconds, or until a router that a client needs answers.

    Raises `NoRouter` if the router does not answer, `ConfigError` if an endpoint cannot be used.
    """
    try:
        return remote_session.open_session(config)
    except zenoh.ZError as error:
        words = _words(error)
        # Zenoh has a single exception, whose text alone distinguishes the reasons.
        if words.startswith("Unable to connect"):
            raise NoRouter(words) from None
        raise ConfigError(f"the ROS 2 session cannot be opened: {words}") from None


@asynccontextmanager
async def open_router(listen: str, *, insecure: bool = False) -> AsyncIterator[None]:
    """Run a stand-in for ROS 2's router (``rmw_zenohd``) for the duration of the context.

    Raises `ConfigError` if it cannot listen there, or, unless ``insecure``, if others in the
    network would reach it without certificates.
    """
    if not insecure and not is_safe(listen):
        raise ConfigError(
            f"anyone who reaches {listen} could move every hand in the ROS graph; listen on"
            " tcp/localhost:PORT, or allow it with --insecure"
        )
    config = zenoh.Config()
    for key, value in ({"mode": "router"} | _COMMON).items():
        config.insert_json5(key, json.dumps(value))
    try:
        config.insert_json5("listen/endpoints", json.dumps([listen]))
        session = await anyio.to_thread.run_sync(remote_session.open_session, config)
    except zenoh.ZError as error:
        raise ConfigError(f"the router cannot listen on {listen}: {_words(error)}") from None
    try:
        yield
    finally:
        with anyio.CancelScope(shield=True):
            # In a thread, since closing may block for seconds.
            await anyio.to_thread.run_sync(close_session, session)
