"""A Zenoh session in router mode as the router, and others beside ours."""

from __future__ import annotations

import importlib.util
import json
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from patient import lease  # noqa: F401 - for this folder
from remote.conftest import hand, library, runtime  # noqa: F401 - fixtures of this folder, too

from rtee.hand.config_schema import Ros2Settings

FOLDER = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests of this folder where the extra is not installed."""
    if importlib.util.find_spec("xxhash") is None:
        for item in items:
            if item.path.is_relative_to(FOLDER):
                item.add_marker(pytest.mark.skip(reason="needs the extra ros2"))


def session(**settings: Any) -> zenoh.Session:
    """Open a Zenoh session without scouting; settings by key, with ``__`` for a slash."""
    config = zenoh.Config()
    for key, value in {"scouting__multicast__enabled": False, **settings}.items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


def open_router(endpoint: str, **settings: Any) -> zenoh.Session:
    """Open a session as a router."""
    return session(mode="router", listen__endpoints=[endpoint], **settings)


def free_endpoint() -> str:
    """Return a loopback endpoint with a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a router that runs."""
    endpoint = free_endpoint()
    with open_router(endpoint):
        yield endpoint


@pytest.fixture
def settings(router: str) -> Ros2Settings:
    return Ros2Settings(router=router)


@pytest.fixture
def peer(router: str) -> Iterator[Callable[[], zenoh.Session]]:
    """Opens sessions of others, which speak only what the tests put."""
    opened: list[zenoh.Session] = []

    def open_peer() -> zenoh.Session:
        made = session(
            mode="peer", connect__endpoints=[router], listen__endpoints=["tcp/localhost:0"]
        )
        opened.append(made)
        return made

    yield open_peer
    for each in opened:
        each.close()
