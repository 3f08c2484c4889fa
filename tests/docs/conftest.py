from __future__ import annotations

import sys

import pytest


@pytest.fixture(scope="session", autouse=True)
def scripts(repository: object) -> None:
    """The scripts beside the documentation can be imported."""
    folder = f"{repository}/docs"
    if folder not in sys.path:
        sys.path.append(folder)
