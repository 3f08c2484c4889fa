"""What is diagnosed are ports of this computer, on simulated time.

No answer comes too late on a busy computer, after which another rate of the line would be tried.
"""

from __future__ import annotations

from typing import Any

import pytest

from rtee.testing.session import simulated_time


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return simulated_time()
