"""Copy a hand that must not be changed to a folder of the user.

Hands that came with rtee stay as they were installed, and a folder may be write-protected. Before
such a hand is changed (to store an action, its primitives or results of trials), it is copied to a
folder that takes precedence: from then on, the copy is the hand of that name.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
from pathlib import Path
from typing import Final

from rtee.errors import ConfigError
from rtee.hand.catalog import FILE_NAME, VARIABLE, own_dirs
from rtee.hand.files import new_tree, read_bytes, write_atomically
from rtee.hand.load import load_configured
from rtee.hand.names import check_name
from rtee.hand.schema import SCHEMA_FILE, schema_text
from rtee.hand.yamlfile import emit_scalar

SHIPPED: Final = Path(__file__).resolve().parents[1] / "_config"
"""Folder of the hands in an installed rtee. A checkout has none; its ``config/`` may be changed."""

TRIALS: Final = "trials.yaml"
"""File of the results of trials in a hand's folder; they are valid only for the hand tested."""

_NAME = re.compile(r"^(name:[ \t]*)\S+", re.MULTILINE)


def is_own(folder: Path) -> bool:
    """Return whether the files of a hand may be changed."""
    real = folder.resolve()
    if real.is_relative_to(SHIPPED):
        return False
    # The subfolders, too: with a protected one, a later change would fail halfway.
    inside = (place for place in real.rglob("*") if place.is_dir())
    return all(os.access(place, os.W_OK | os.X_OK) for place in (real, *inside))


def own_place(folder: Path) -> Path:
    """Return the folder for changes of a hand: its own, or that of the copy made by `own`.

    The copy is made in the first of the folders for users' hands that can be written to.

    Raises:
        ConfigError: if there is no such folder, it has a hand of that name already, or another hand
            of that name takes precedence over the copy.
    """
    if is_own(folder):
        return folder
    name = load_configured(folder)[1].name
    fixed = f"hand '{name}' cannot be changed in {folder}"
    places = own_dirs()
    number = next((i for i, place in enumerate(places) if _can_be_made(place)), None)
    if number is None:
        raise ConfigError(f"{fixed}, and there is no folder for a copy")
    target = places[number] / name
    if os.path.exists(target / FILE_NAME):
        raise ConfigError(f"{fixed}; your own is {target}: give that, or its name")
    for earlier in places[:number]:
        if os.path.exists(earlier / name / FILE_NAME):
            raise ConfigError(
                f"{fixed}, and a copy in {places[number]} would be shadowed by {earlier / name}; "
                "put "
                f"a folder of your own first into {VARIABLE}"
            )
    return target


def own(folder: Path) -> Path:
    """Return the folder in which a hand may be changed: its own, or that of a new copy.

    Raises:
        ConfigError: if a copy is needed and cannot be made; see `own_place`.
    """
    target = own_place(folder)
    if target != folder:
        copy_hand(folder, target)
    return target


def copied_since(folder: Path) -> Path | None:
    """Return the user's copy of a hand that came with rtee, if there is one."""
    if not folder.resolve().is_relative_to(SHIPPED):
        return None
    copies = (place / folder.name for place in own_dirs())
    return next((copy for copy in copies if os.path.isfile(copy / FILE_NAME)), None)


def copy_notice(folder: Path, copy: Path) -> str:
    """Return the message about a copy for the user."""
    why = "came with rtee" if folder.resolve().is_relative_to(SHIPPED) else "is write-protected"
    return f"hand '{copy.name}' {why}; it is copied to {copy}, which is used from now on"


def copy_hand(folder: Path, target: Path) -> None:
    """Copy the folder of a hand, completely or not at all.

    A copy with another name gets this name, and no results of trials.

    Args:
        folder: The hand's folder.
        target: Folder of the copy, which must not exist; its name is that of the copy.

    Raises:
        ConfigError: if the name is not allowed or taken, or the folder cannot be written.
        ModelError: if the copy cannot be loaded, because the hand has files outside of its folder.
    """
    name = check_name(target.name, "hand")
    with new_tree(target) as copy:
        _fill(folder, copy, name)
        if not (target.parent / SCHEMA_FILE).exists():
            write_atomically(target.parent / SCHEMA_FILE, schema_text())


def _fill(folder: Path, copy: Path, name: str) -> None:
    """Copy the files, make them writable, set the name, and check that the copy can be loaded."""
    config = load_configured(folder)[1]
    ignored = ["__pycache__", ".*", *([] if config.name == name else [TRIALS])]
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(*ignored), dirs_exist_ok=True)
    for place in (copy, *copy.rglob("*")):
        # copytree keeps permissions, so the copy of a read-only file would be read-only.
        place.chmod(stat.S_IMODE(place.stat().st_mode) | stat.S_IWUSR)
    if config.name != name:
        file = copy / FILE_NAME
        # As text, to keep comments and layout.
        text = read_bytes(file, FILE_NAME).decode("utf-8")
        write_atomically(file, _NAME.sub(lambda found: found[1] + emit_scalar(name), text, count=1))
    # Loaded under its temporary name, so that a copy that cannot be loaded does not remain.
    made = load_configured(copy)[1]
    if made.name != name:
        raise ConfigError(
            f"the name cannot be changed to '{name}' automatically; edit it yourself", path=folder
        )


def _can_be_made(place: Path) -> bool:
    """Return whether a folder exists and can be written to, or could be made."""
    while not os.path.exists(place) and place != place.parent:
        place = place.parent
    return os.path.isdir(place) and os.access(place, os.W_OK | os.X_OK)
