"""Recordings are read in threads of anyio, for which simulated time does not wait."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    return "asyncio"
