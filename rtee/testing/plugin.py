"""The pytest plugin of rtee: fixtures for authors of drivers.

It is loaded through the entry point ``pytest11``, so everything heavy is imported inside the fixtures.
"""

from __future__ import annotations
