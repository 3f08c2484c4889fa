"""`rtee new` and `rtee new-driver`: make a hand's folder, or the package of a driver.

Both write new files only and never change an existing hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import (
    AngleOption,
    XacroArguments,
    complete_hand,
    hand_folder,
)
from rtee.errors import ConfigError, needing_extra
from rtee.hand.config_schema import Outside
from rtee.hand.names import check_name
from rtee.hand.own_copy import copy_hand

if TYPE_CHECKING:
    from rtee.hand.scaffold import NewHand
    from rtee.hand.subtree import Subtree

RootOption = Annotated[
    str | None,
    typer.Option(
        "--root",
        metavar="LINK",
        help="With --urdf or --mjcf: the link below which the hand is, out of a whole robot.",
    ),
]
OutsideOption = Annotated[
    Outside,
    typer.Option(
        help="With --root: how to treat links that are not below it: absent, or rigid, as an "
        "obstacle."
    ),
]


def new(
    name: str,
    arguments: XacroArguments = None,
    *,
    urdf: Path | None = None,
    mjcf: Path | None = None,
    srdf: Path | None = None,
    angle: AngleOption = None,
    root: RootOption = None,
    outside: OutsideOption = Outside.ABSENT,
    package_dir: list[Path] | None = None,
    source: Annotated[str | None, typer.Option(autocompletion=complete_hand)] = None,
    into: Path = Path("config"),
    ask: bool = False,
) -> None:
    """Make config/NAME with hand.yaml, URDF, SRDF and meshes; or copy a hand.

    Arguments and options:
        name: Name of the new hand.
        urdf: Its URDF, or a xacro file, which is run.
        mjcf: Its model in MuJoCo's MJCF instead of a URDF.
        srdf: With --urdf or --mjcf: its SRDF; without one the fingers are found.
        package_dir: With --urdf or --mjcf: folder to look packages up in; may be repeated.
        source (--from; HAND): A hand to copy instead, with its actions.
        into: Folder of the hands.
        ask: With --urdf or --mjcf: ask about choices that the files leave open.
    """
    if sum(given is not None for given in (urdf, mjcf, source)) != 1:
        raise ConfigError("give one of --urdf FILE, --mjcf FILE and --from HAND")
    from rtee.hand.load import is_path

    # Checked, since it becomes a part of a path.
    if is_path(check_name(name, "hand")):
        raise ConfigError(
            f"hand name '{name}' would be taken for a file; choose one without this ending"
        )
    if source is not None:
        _copy(hand_folder(source), into / name)
        return
    with needing_extra("making a hand from a URDF", "extract"):
        from rtee.hand.scaffold import make_hand

    from rtee.exchange.reading import as_urdf_and_srdf

    words, folders = arguments or [], package_dir or []
    with as_urdf_and_srdf(urdf, mjcf, srdf, words, folders, root, angle) as (model, groups):
        new_hand = make_hand(
            name, model.urdf, groups, package_dirs=model.package_dirs, into=into,
            ask=typer.confirm if ask else None, passive=model.passive, excluded=model.excluded,
            subtree=subtree_of(root, outside),
        )  # fmt: skip
    _print(new_hand, model.notes)


def _copy(folder: Path, target: Path) -> None:
    copy_hand(folder, target)
    print(f"{target} is made, a copy of {folder}.\nNext: rtee actions {_known(target)}")


def _known(folder: Path) -> str:
    """Return the argument that finds a hand: its name in ./config or here, otherwise its folder."""
    return folder.name if folder.parent in (Path("config"), Path()) else str(folder)


def _print(new_hand: NewHand, notes: Sequence[str]) -> None:
    hand = new_hand.hand
    print(f"{new_hand.folder} is made.")
    for finger, reason in zip(hand.fingers, new_hand.reasons, strict=True):
        print(f"\nfinger {reason}\n  tip: {finger.tip or 'none'}")
        print(f"  moved by: {', '.join(finger.actuators) or 'nothing'}")
    print()
    for note in (*notes, *new_hand.notes):
        print(f"note: {note}")
    print(
        f"{len(new_hand.pairs)} pairs of links are never checked for collision; "
        f"{hand.name}.srdf says why.\nNext: rtee extract {_known(new_hand.folder)} --save"
    )


def new_driver(
    name: str,
    *,
    folder: Path = Path(),
) -> None:
    """Write a driver package: codec, driver, emulator, and tests that it passes.

    Arguments and options:
        name (NAME): Such as my_gripper.
        folder (--in; DIR): Where the package's folder is made.
    """
    from rtee.testing.scaffold import write_package

    for path in write_package(name, folder):
        print(path)
    print(f"now: cd {folder / name} && pip install -e '.[test]' && pytest")


def subtree_of(root: str | None, outside: Outside) -> Subtree | None:
    """Return the part of a robot that is the hand; ``None``: all."""
    from rtee.hand.subtree import Subtree

    return None if root is None else Subtree(root, outside)
