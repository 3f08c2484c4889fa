"""`rtee export`: a hand's model for other programs."""

from __future__ import annotations

from pathlib import Path

from rtee.cli._common import Hand, hand_folder


def export(
    hand: Hand,
    target: Path,
    *,
    urdf: bool = False,
    mjcf: bool = False,
    srdf: bool = False,
) -> None:
    """Write a hand's model for other programs: URDF, MJCF and SRDF, or those asked for.

    Arguments and options:
        target (DIR): Folder to write to; it is made if needed.
        urdf: Write its URDF, with meshes beside it.
        mjcf: Write it as MJCF, for MuJoCo.
        srdf: Write its SRDF: fingers, rest, collisions.
    """
    from rtee.exchange.export import ExportFormat, export_hand

    paths = {ExportFormat.URDF: urdf, ExportFormat.MJCF: mjcf, ExportFormat.SRDF: srdf}
    kinds = [kind for kind, wanted in paths.items() if wanted] or list(ExportFormat)
    exported = export_hand(hand_folder(hand), target, kinds)
    for note in exported.notes:
        print(f"note: {note}")
    for file in exported.files:
        print(f"written to {file}")
