"""Buses in real time, with real bytes on ports of this computer, and on simulated time."""

from __future__ import annotations

from typing import Any

import pytest

from rtee.testing import simulated_time


@pytest.fixture(scope="session", params=["real", "simulated"])
def anyio_backend(request: pytest.FixtureRequest) -> str | tuple[str, dict[str, Any]]:
    return "asyncio" if request.param == "real" else simulated_time()
