"""`rtee import`: import the actions of ROS End-Effector."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import HandOption, actions_of, report_copy
from rtee.errors import ActionError

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.actions.types import Action


def import_(
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False)],
    *,
    hand: HandOption = None,
    out: Path | None = None,
    replace: bool = False,
) -> None:
    """Import action files of ROS End-Effector.

    Arguments and options:
        folder (DIR): Folder of action files.
        out: Write to this folder instead of the hand's own actions.
        replace: Replace actions of the same name.
    """
    from rtee.actions.library import ActionLibrary
    from rtee.actions.ros_end_effector import import_folder

    library = actions_of(hand)
    # All files are read before any action is stored, so that a mistake stores nothing.
    imported = import_folder(library.hand, folder)
    if out is not None:
        library = ActionLibrary.load(library.hand, out)
    kept = _add(library, imported.actions, replace)
    # Storing may copy a shipped hand, which the user has to know.
    before = library.folder
    library.save(out)
    if out is None:
        report_copy(before, library.folder)
    for note in imported.notes:
        print(f"note: {note}")
    for action in kept:
        print(f"note: {action} already exists and is kept; --replace would replace it")
    count = len(imported.actions) - len(kept)
    print(f"{count} actions from {imported.files} files are now in {library.folder}")


def _add(library: ActionLibrary, actions: list[Action], replace: bool) -> list[str]:
    """Add actions to a library; return the names of stored ones that stay as they are."""
    from rtee.actions.naming import label

    kept = []
    for action in actions:
        try:
            library.find(action.name, action.elements)
        except ActionError:
            library.add(action)
            continue
        if replace:
            library.add(action, replace_same=True)
        else:
            kept.append(label(action.name, action.elements))
    return kept
