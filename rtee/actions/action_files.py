"""The files of a library: what is stored in them, and whether somebody changed them."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rtee.actions.index import Index
from rtee.actions.naming import normalise
from rtee.actions.types import Action, CustomAction, Primitive
from rtee.errors import ActionError
from rtee.hand.catalog import FILE_NAME
from rtee.hand.model import Hand

log = logging.getLogger(__name__)

ACTIONS: Final = "actions"
"""The folder of the actions in a hand's folder."""


class Shelf:
    """Where the actions of one hand are stored.

    Args:
        hand: The hand.
        folder: The folder, or ``None`` if they are kept in memory.

    Attributes:
        folder: The folder.
    """

    def __init__(self, hand: Hand, folder: Path | None) -> None:
        self.hand = hand
        self.folder = folder
        self._stored: dict[str, str] = {}
        self._seen: dict[Path, int] = {}

    def read(self, keep: Sequence[Action] = ()) -> Index:
        """Return the actions in the files.

        Args:
            keep: Further actions, which are in memory only.

        Raises:
            ActionError: for every mistake in the files, with file and line.
        """
        from rtee.actions.store import read_actions, stamps

        folder = self._home()
        seen = stamps(folder)
        actions = read_actions(self.hand, folder)
        index = Index(self.hand, (*actions, *keep))
        custom = (action.name for action in actions if not isinstance(action, Primitive))
        self._stored = {normalise(name): name for name in custom}
        self._seen = seen
        return index

    def changed(self) -> bool:
        """Return whether a file was changed, added or removed since it was read or written."""
        from rtee.actions.store import stamps

        if self.folder is None:
            return False
        self._follow()
        return stamps(self.folder) != self._seen

    def holds(self, name: str) -> bool:
        """Return whether a composed, timed or generic action is stored in a file."""
        return normalise(name) in self._stored

    def write(self, index: Index, action: Action) -> None:
        """Write one action to its file; of primitives all.

        Raises:
            ActionError: if there is no folder, or it uses an action that is not stored.
            ConfigError: if the file cannot be written.
        """
        from rtee.actions.store import primitive_changes

        if isinstance(action, Primitive):
            primitive_changes(self._own_home(), self.hand, index.primitives).write()
            return
        for use in action.uses:
            inner = index.find(use.action, use.elements, None)
            if not isinstance(inner, Primitive) and not self.holds(inner.name):
                raise ActionError(
                    f"'{action.name}' uses '{inner.name}', which is not stored itself"
                )
        self._write_custom([action])

    def write_all(self, index: Index) -> None:
        """Write all actions to their files, or none; nothing is written that is equal.

        Raises:
            ActionError: if there is no folder.
            ConfigError: if a file cannot be written.
        """
        from rtee.actions.store import Changes, custom_changes, primitive_changes

        def changes(folder: Path) -> Changes:
            primitives = primitive_changes(folder, self.hand, index.primitives)
            custom = custom_changes(folder, index.custom.values())
            files = {**primitives.files, **custom.files}
            return Changes(files, primitives.gone, primitives.folders)

        found = changes(self._home())
        if found.files or found.gone:
            found = changes(self._own_home())
        found.write()
        self._stored.update(
            (normalise(action.name), action.name) for action in index.custom.values()
        )
        self._note()

    def delete(self, action: Action) -> None:
        """Delete an action's file, if it has one.

        Raises:
            ConfigError: if it cannot be deleted.
        """
        from rtee.actions.store import delete_custom

        if self.holds(action.name):
            delete_custom(self._own_home(), action)
            del self._stored[normalise(action.name)]
            self._note()

    def rename(self, action: Action, new_name: str, changed: Sequence[CustomAction]) -> None:
        """Store an action under another name, if it is stored, and what uses it.

        Args:
            action: The action, as it was called.
            new_name: What it is called now.
            changed: The action and those that use it, as they are now.

        Raises:
            ConfigError: if a file cannot be written.
        """
        from rtee.actions.store import delete_custom

        old, new = normalise(action.name), normalise(new_name)
        if old not in self._stored:
            return
        self._write_custom(
            [other for other in changed if normalise(other.name) == new or self.holds(other.name)]
        )
        if new != old:
            delete_custom(self._own_home(), action)
            del self._stored[old]
            self._note()

    def _write_custom(self, actions: Sequence[CustomAction]) -> None:
        from rtee.actions.store import custom_changes

        custom_changes(self._own_home(), actions).write()
        self._stored.update((normalise(action.name), action.name) for action in actions)
        self._note()

    def _home(self) -> Path:
        if self.folder is None:
            raise ActionError("these actions have no folder to be stored in")
        return self.folder

    def _follow(self) -> None:
        """Go to the copy of the hand, where another program has made one since."""
        from rtee.hand.own_copy import copied_since

        if self.folder is not None and _of_a_hand(self.folder):
            copy = copied_since(self.folder.parent)
            if copy is not None and os.path.isdir(copy / ACTIONS):
                self.folder = copy / ACTIONS

    def _own_home(self) -> Path:
        """Return the folder to write to; a hand that is not to be changed is copied for it.

        Raises:
            ActionError: if there is no folder.
            ConfigError: if a copy is needed and cannot be made.
        """
        from rtee.hand.own_copy import own, told

        home = self._home()
        if not _of_a_hand(home):
            return home
        copy = own(home.parent)
        if copy != home.parent:
            log.info("%s", told(home.parent, copy))
            self.folder = copy / ACTIONS
        return self._home()

    def _note(self) -> None:
        from rtee.actions.store import stamps

        self._seen = stamps(self._home())


def _of_a_hand(folder: Path) -> bool:
    """Return whether a folder of actions is that of a hand, not one that was given by itself."""
    return folder.name == ACTIONS and os.path.isfile(folder.parent / FILE_NAME)
