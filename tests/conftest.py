"""What every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# No test asserts times, and a busy computer must not fail one.
settings.register_profile("rtee", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rtee")

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="session")
def repository() -> Path:
    return REPOSITORY


@pytest.fixture(scope="session")
def shared() -> Path:
    """Real models of hands and fact sheets for tests; not part of the project."""
    folder = Path(os.environ.get("RTEE_SHARED", REPOSITORY.parent / "shared"))
    if not folder.is_dir():
        pytest.skip("no folder 'shared' with real models beside the checkout")
    return folder
