"""A model that rtee can read, from any format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtee.hand.model import DisabledPair


@dataclass(frozen=True, slots=True)
class ReadableModel:
    """A model as a URDF, with properties that a URDF cannot represent.

    Attributes:
        urdf: The URDF.
        passive: Joints without a motor; ``None`` if unknown, as for an MJCF without any motor.
        excluded: Pairs of links that are never checked for collision, with the reason.
        notes: Sentences about choices and omissions.
        package_dirs: Folders of mesh packages.
    """

    urdf: Path
    passive: tuple[str, ...] | None = None
    excluded: tuple[DisabledPair, ...] = ()
    notes: tuple[str, ...] = ()
    package_dirs: tuple[Path, ...] = ()
