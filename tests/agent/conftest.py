from __future__ import annotations

from patient import lease
from remote.conftest import hand, library, runtime

__all__ = ["hand", "lease", "library", "runtime"]
