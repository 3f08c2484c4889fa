"""Telling whether something was made with the files that a hand has now."""

from __future__ import annotations

import hashlib
from pathlib import Path


def fingerprint(folder: Path) -> str:
    """Return a word that changes with the hand's model, configuration or actions.

    Args:
        folder: The hand's folder.
    """
    digest = hashlib.sha256()
    files = [*folder.glob("*.urdf"), *folder.glob("*.srdf"), *folder.glob("hand.yaml")]
    for file in sorted([*files, *(folder / "actions").rglob("*.yaml")]):
        digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]
