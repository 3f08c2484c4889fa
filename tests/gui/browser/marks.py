"""What tests in a browser have in common."""

from __future__ import annotations

from typing import Final

import pytest

from tests.testing.browser import find_browser

in_a_browser: Final = [
    pytest.mark.browser,
    pytest.mark.skipif(find_browser() is None, reason="no Chromium was found"),
]
