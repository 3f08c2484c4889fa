"""Drivers, emulators and wires of these tests share one simulated time."""

from __future__ import annotations

from typing import Any

import pytest

from rtee.testing import simulated_time


@pytest.fixture(scope="session")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return simulated_time()
