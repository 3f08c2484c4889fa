"""All grasping actions of one hand, to be looked up, listed, added and removed."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtee.actions.build import StepPlan, check_custom_name, compose, sequence, warnings_of
from rtee.actions.index import Index
from rtee.actions.naming import label, normalise
from rtee.actions.types import (
    Action,
    ActionKind,
    ActionReference,
    Composed,
    CustomAction,
    Primitive,
    PrimitiveGroup,
    Timed,
)
from rtee.errors import ActionError
from rtee.hand.model import Hand

if TYPE_CHECKING:
    from rtee.actions.action_files import ActionFiles
    from rtee.actions.openings import Openings

log = logging.getLogger(__name__)


class ActionLibrary:
    """The grasping actions of one hand.

    Names are compared regardless of case, underscores, hyphens and spaces; the order of elements
    does not matter. Every change replaces the whole index at once, so that other threads may look
    up while one changes. Files are touched by `save`, `store` and ``add(store=True)`` only.

    Args:
        hand: The hand.
        actions: Its actions; what they refer to must be among them.
        folder: Where they are stored, or ``None`` to keep them in memory.

    Attributes:
        version: Counts the changes, so that what was derived from the actions can be kept.

    Raises:
        ActionError: if two actions have the same name, or one refers to a missing one.
    """

    def __init__(
        self, hand: Hand, actions: Iterable[Action] = (), folder: Path | None = None
    ) -> None:
        self.hand = hand
        self.version = 0
        self._index = Index(hand, tuple(actions))
        self._stored = None if folder is None else _files_in(hand, folder)
        self._openings: tuple[int | None, Openings] | None = None
        # A missing part is reported here, not by the first goal that needs it.
        for action in self._index.custom.values():
            for use in action.uses:
                self.find(use.action, use.elements)

    @classmethod
    def load(cls, hand: Hand, folder: Path) -> ActionLibrary:
        """Read the actions stored in a folder; a missing folder holds none.

        Raises:
            ActionError: for every mistake in the files, with file and line.
        """
        library = cls(hand, (), folder)
        library._read()
        return library

    def _read(self, keep: Sequence[Action] = ()) -> None:
        # Swapped in once all is read: a mistake in a file leaves the library as it was.
        self._index = self._files.read(keep)
        self.version += 1
        for action in self._index.custom.values():
            for warning in warnings_of(action) if self.is_stored(action.name) else ():
                log.warning("%s", warning)

    @property
    def folder(self) -> Path | None:
        """Where the actions are stored; ``None`` if they are kept in memory."""
        return None if self._stored is None else self._stored.folder

    @property
    def openings(self) -> Openings:
        """The openings of its actions, as the file beside them holds them now.

        Raises:
            ConfigError: if the file holds something else.
        """
        # Imported only here: a client's library needs no YAML.
        from rtee.actions.openings import FILE_NAME, Openings, read_openings

        if self._stored is None:
            return Openings(self.hand, made=False) if self._openings is None else self._openings[1]
        home = self._stored.folder.parent
        try:
            stamp: int | None = os.stat(home / FILE_NAME).st_mtime_ns
        except OSError:
            # No file is a state like any other: one that appears later is read.
            stamp = None
        if self._openings is None or self._openings[0] != stamp:
            self._openings = stamp, read_openings(home, self.hand)
        return self._openings[1]

    @property
    def _files(self) -> ActionFiles:
        if self._stored is None:
            raise ActionError("these actions have no folder to be stored in")
        return self._stored

    def __len__(self) -> int:
        return len(self._index.primitives) + len(self._index.custom)

    def __iter__(self) -> Iterator[Action]:
        return iter(self._index.ordered)

    @property
    def names(self) -> tuple[str, ...]:
        """The names there are, each once."""
        return self._index.names

    def find(
        self,
        name: str,
        elements: Sequence[str] = (),
        kind: ActionKind | str | None = None,
    ) -> Action:
        """Return one action.

        ``MultiPinchTight`` and ``SingleJointMultipleTips`` may be given without their count. A
        primitive that exists with one set of elements only needs none.

        Args:
            name: Its name.
            elements: For a primitive, the fingers or the actuator, in any order.
            kind: Which of the four kinds it must be, if that matters.

        Raises:
            UnknownAction: if there is none of that name (and kind).
            ActionError: if it does not exist with these elements; the possible ones are named.
        """
        return self._index.find(name, tuple(elements), kind)

    def all(
        self,
        kind: ActionKind | str | None = None,
        name: str | None = None,
        elements: Sequence[str] = (),
    ) -> list[Action]:
        """Return the actions that pass a filter, in a fixed order.

        Args:
            kind: Of this kind only.
            name: Of this name only.
            elements: Only primitives done with all of these elements.
        """
        return self._index.select(kind, name, tuple(elements))

    def primitives(self) -> list[PrimitiveGroup]:
        """Return the primitives as a user interface shows them, one group per name."""
        return self._index.groups()

    def partners(self, name: str, element: str) -> tuple[str, ...]:
        """Return the elements that a primitive can be done with together with a given one.

        Raises:
            UnknownAction: if there is no primitive of that name.
            ActionError: if it is never done with that element.
        """
        return self._index.partners(name, element)

    def users(self, name: str, elements: Sequence[str] = ()) -> tuple[str, ...]:
        """Return the names of the actions that use this one."""
        return self._index.users(self.find(name, elements))

    def is_stored(self, name: str) -> bool:
        """Return whether a composed, timed or generic action is stored in a file."""
        return self._stored is not None and self._stored.holds(name)

    def compose(
        self,
        name: str,
        parts: Sequence[ActionReference],
        *,
        independent: bool = False,
        description: str = "",
    ) -> Composed:
        """Make a composed action of this library's actions, without adding it; see `build`."""
        return compose(
            self.hand, self.find, name, parts, independent=independent, description=description
        )

    def sequence(self, name: str, steps: Sequence[StepPlan], *, description: str = "") -> Timed:
        """Make a timed action of this library's actions, without adding it; see `build`."""
        return sequence(self.hand, self.find, name, steps, description=description)

    def add(self, action: Action, store: bool = False, *, replace_same: bool = False) -> None:
        """Add an action.

        Args:
            action: The action.
            store: Write it to its file at once.
            replace_same: Replace the action of the same name, and bring those that use it up to
                date, instead of refusing.

        Raises:
            ActionError: if the name is taken, or what it refers to is missing or the action itself.
        """
        others = self._index.without(action)
        if len(others) < len(self) and not replace_same:
            there = self.find(action.name, action.elements).name
            raise ActionError(f"there already is an action '{label(there, action.elements)}'")
        if not isinstance(action, Primitive):
            check_custom_name(action.name)
        # The new index is checked, written to files and swapped in, in this order: whatever fails
        # leaves the library as it was.
        index = Index(self.hand, (*others, action))
        for use in action.uses:
            if normalise(use.action) == normalise(action.name):
                raise ActionError(f"the action '{action.name}' would contain itself")
            index.find(use.action, use.elements, None)
        # Its users hold postures that were computed from the action before.
        index = index.rebuilt() if replace_same else index
        if store:
            self._files.write(index, action)
        self._index = index
        self.version += 1

    def store(self, name: str, elements: Sequence[str] = ()) -> None:
        """Write one action to its file.

        Raises:
            ActionError: if the library has no folder.
            ConfigError: if the file cannot be written.
        """
        self._files.write(self._index, self.find(name, elements))
        self.version += 1

    def remove(self, name: str) -> None:
        """Remove a composed, timed or generic action, and its file.

        Raises:
            UnknownAction: if there is none.
            ActionError: if another action uses it, which is named; or if it is a primitive.
        """
        action = self.find(name)
        if isinstance(action, Primitive):
            raise ActionError(f"'{action.name}' is a primitive; the extraction decides on those")
        users = self._index.users(action)
        if users:
            raise ActionError(f"'{action.name}' is used by {', '.join(users)}; remove that first")
        if self._stored is not None:
            # The file first: if it cannot be deleted, it would bring the action back.
            self._stored.delete(action)
        self._index = Index(self.hand, self._index.without(action))
        self.version += 1

    def rename(self, name: str, new_name: str) -> None:
        """Give a composed, timed or generic action another name, everywhere it is used.

        Raises:
            UnknownAction: if there is none.
            ActionError: if the new name is taken or not good; or if it is a primitive.
        """
        action = self.find(name)
        if isinstance(action, Primitive):
            raise ActionError(f"'{action.name}' is a primitive; its name cannot change")
        check_custom_name(new_name)
        old, new = normalise(action.name), normalise(new_name)
        # Another spelling of its own name is free.
        if new != old and new in self._index.custom:
            raise ActionError(f"there already is an action '{new_name}'")

        def renamed(use: ActionReference) -> ActionReference:
            return replace(use, action=new_name) if normalise(use.action) == old else use

        changed: list[CustomAction] = []
        kept: list[Action] = list(self._index.primitives)
        for other in self._index.custom.values():
            if other is action:
                changed.append(replace(action, name=new_name))
            elif any(normalise(use.action) == old for use in other.uses):
                changed.append(other.with_uses(renamed))
            else:
                kept.append(other)
        # As in `add`: first checked, then written, then swapped in.
        index = Index(self.hand, (*kept, *changed))
        if self._stored is not None:
            self._stored.rename(action, new_name, changed)
        self._index = index
        self.version += 1

    def save(self, folder: Path | None = None) -> None:
        """Write all actions to their files, or none; nothing is written that is equal.

        Args:
            folder: Where to, and from now on; ``None``: where they came from.

        Raises:
            ActionError: if there is no folder.
            ConfigError: if a file cannot be written.
        """
        if folder is not None:
            self._stored = _files_in(self.hand, folder)
        self._files.write_all(self._index)
        self.version += 1

    def changed(self) -> bool:
        """Return whether a file was changed, added or removed since it was read or written."""
        return self._stored is not None and self._stored.changed()

    def reload(self, *, force: bool = False) -> bool:
        """Read the files again if they changed; actions that are only in memory stay.

        Returns:
            Whether they were read.

        Raises:
            ActionError: for every mistake in the files; the library stays as it was.
        """
        if not (force or self.changed()):
            return False
        # Actions that have no file would be lost with the old index.
        volatile = [
            action for action in self._index.custom.values() if not self.is_stored(action.name)
        ]
        self._read(volatile)
        return True


def _files_in(hand: Hand, folder: Path) -> ActionFiles:
    # Imported only here: a library in memory, as a client has one, needs neither pydantic nor YAML.
    from rtee.actions.action_files import ActionFiles

    return ActionFiles(hand, folder)
