from __future__ import annotations

from remote.conftest import hand, library, runtime

__all__ = ["hand", "library", "runtime"]
