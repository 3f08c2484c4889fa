"""`rtee export`: a hand's model for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rtee.cli._common import Hand, hand_folder


def export(
    hand: Hand,
    target: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder to write to; it is made if needed.")
    ],
    urdf: Annotated[
        bool, typer.Option("--urdf", help="Write its URDF, with meshes beside it.")
    ] = False,
    mjcf: Annotated[bool, typer.Option("--mjcf", help="Write it as MJCF, for MuJoCo.")] = False,
    srdf: Annotated[
        bool, typer.Option("--srdf", help="Write its SRDF: fingers, rest, collisions.")
    ] = False,
) -> None:
    """Write a hand's model for other programs: URDF, MJCF and SRDF, or those asked for."""
    from rtee.exchange.export import ExportFormat, export_hand

    paths = {ExportFormat.URDF: urdf, ExportFormat.MJCF: mjcf, ExportFormat.SRDF: srdf}
    kinds = [kind for kind, wanted in paths.items() if wanted] or list(ExportFormat)
    exported = export_hand(hand_folder(hand), target, kinds)
    for note in exported.notes:
        print(f"note: {note}")
    for file in exported.files:
        print(f"written to {file}")
