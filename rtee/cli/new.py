"""``rtee new``: make a hand's folder from a URDF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rtee.hand.scaffold import NewHand

app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="Name of the new hand.")],
    urdf: Annotated[Path, typer.Option("--urdf", help="Its URDF.")],
    srdf: Annotated[
        Path | None, typer.Option("--srdf", help="Its SRDF; without one the fingers are found.")
    ] = None,
    package_dir: Annotated[
        list[Path] | None,
        typer.Option("--package-dir", help="Where package:// is looked up; may be repeated."),
    ] = None,
    into: Annotated[Path, typer.Option("--into", help="Folder of the hands.")] = Path("config"),
    ask: Annotated[
        bool, typer.Option("--ask", help="Ask about what the files cannot say for sure.")
    ] = False,
) -> None:
    """Make config/NAME with hand.yaml, URDF, SRDF and meshes."""
    from rtee.hand.scaffold import make_hand

    asked = _ask if ask else None
    _print(make_hand(name, urdf, srdf, package_dirs=package_dir or (), into=into, ask=asked))


def _ask(question: str, default: bool) -> bool:
    return typer.confirm(question, default=default)


def _print(made: NewHand) -> None:
    hand = made.hand
    print(f"{made.folder} is made.")
    for finger, reason in zip(hand.fingers, made.reasons, strict=True):
        print(f"\nfinger {reason}\n  tip: {finger.tip or 'none'}")
        print(f"  moved by: {', '.join(finger.actuators) or 'nothing'}")
    # By its name a hand is found in ./config and here only.
    near = made.folder.parent in (Path("config"), Path())
    known = hand.name if near else str(made.folder)
    print()
    for note in made.notes:
        print(f"note: {note}")
    print(
        f"{len(made.pairs)} pairs of links are never checked for collision; {hand.name}.srdf says "
        f"why.\nNext: rtee extract {known}"
    )
