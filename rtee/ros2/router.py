"""A stand-in for the router of ROS 2 (``rmw_zenohd``), for computers without ROS."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import anyio.to_thread
import zenoh

from rtee.errors import ConfigError
from rtee.remote.session import is_safe

PLACE = "tcp/localhost:7447"
"""Default endpoint of the router of ROS 2."""

_SETTINGS: dict[str, Any] = {
    "mode": "router",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "scouting/gossip/multihop": False,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "timestamping/enabled": True,
    "routing/router/peers_failover_brokering": True,
    "adminspace/enabled": False,
}
"""Settings of rmw_zenoh's router; see ``DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5`` there."""


@asynccontextmanager
async def router(listen: str = PLACE, *, insecure: bool = False) -> AsyncIterator[zenoh.Session]:
    """Run a router for the duration of the context.

    Args:
        listen: The endpoint to listen on.
        insecure: Allow an endpoint that others in the network reach without certificates.

    Raises:
        ConfigError: if the router cannot listen there, or would be open to the network.
    """
    if not insecure and not is_safe(listen):
        raise ConfigError(
            f"whoever reaches {listen} could move every hand in the ROS graph: listen on"
            " tcp/localhost:PORT, or allow it with --insecure"
        )
    config = zenoh.Config()
    for key, value in _SETTINGS.items():
        config.insert_json5(key, json.dumps(value))
    try:
        config.insert_json5("listen/endpoints", json.dumps([listen]))
        session = await anyio.to_thread.run_sync(zenoh.open, config)
    except zenoh.ZError as error:
        words = str(error).partition(" at /")[0]
        raise ConfigError(f"the router cannot listen on {listen}: {words}") from None
    try:
        yield session
    finally:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(session.close)
