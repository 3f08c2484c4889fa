"""Library of all grasping actions of one hand."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtee.actions.build import StepPlan, check_custom_name, compose, sequence, warnings_of
from rtee.actions.index import ActionIndex
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
    kind_of,
)
from rtee.errors import ActionError
from rtee.hand.model import Hand
from rtee.hand.names import listed

if TYPE_CHECKING:
    from rtee.actions.action_files import ActionFiles
    from rtee.actions.openings import Openings

log = logging.getLogger(__name__)


class ActionLibrary:
    """The grasping actions of one hand.

    Names are compared regardless of case, underscores, hyphens and spaces; the order of elements
    does not matter. Every change replaces the whole index at once, so that other threads may read
    concurrently. `save`, `store` and ``add(store=True)`` write files, and `remove` and `rename` do
    so for stored actions.

    Args:
        hand: The hand.
        actions: Its actions, including all that others refer to.
        folder: Folder of their files, or ``None`` to keep them in memory.

    Attributes:
        version: Number of changes, to detect that derived data is outdated.

    Raises:
        ActionError: if two actions have the same name, or one refers to a missing one.
    """

    def __init__(
        self, hand: Hand, actions: Iterable[Action] = (), folder: Path | None = None
    ) -> None:
        self.hand = hand
        self.version = 0
        self._index = ActionIndex(hand, tuple(actions))
        self._stored = None if folder is None else _files_in(hand, folder)
        self._openings: tuple[int | None, Openings] | None = None
        # Report a missing part here instead of at the first goal that needs it.
        for action in self._index.custom.values():
            for use in action.uses:
                self.find(use.action, use.elements)

    @classmethod
    def load(cls, hand: Hand, folder: Path) -> ActionLibrary:
        """Read the actions stored in a folder; a missing folder counts as empty.

        Raises:
            ActionError: for every mistake in the files, with file and line.
        """
        library = cls(hand, (), folder)
        library._read()
        return library

    def _read(self, keep: Sequence[Action] = ()) -> None:
        # Assigned after reading all files, so that a mistake leaves the library unchanged.
        self._index = self._files.read(keep)
        self.version += 1
        for action in self._index.custom.values():
            for warning in warnings_of(action) if self.is_stored(action.name) else ():
                log.warning("%s", warning)

    @property
    def folder(self) -> Path | None:
        """Folder of the files; ``None`` if the actions are kept in memory."""
        return None if self._stored is None else self._stored.folder

    @property
    def openings(self) -> Openings:
        """The openings of the actions, from the present file beside them.

        Raises:
            ConfigError: if the file is invalid.
        """
        files = self._stored
        try:
            stamp = None if files is None else os.stat(files.openings).st_mtime_ns
        except OSError:
            # A missing file also has a stamp, so that a file that appears later is read.
            stamp = None
        if self._openings is None or self._openings[0] != stamp:
            # Imported only here, since a client's library needs no YAML.
            from rtee.actions.openings import Openings, read_openings

            read = files and read_openings(files.folder.parent, self.hand)
            self._openings = stamp, read or Openings(self.hand, made=False)
        return self._openings[1]

    @property
    def _files(self) -> ActionFiles:
        if self._stored is None:
            raise ActionError("this library has no folder to store actions in")
        return self._stored

    def __len__(self) -> int:
        return len(self._index.primitives) + len(self._index.custom)

    def __iter__(self) -> Iterator[Action]:
        return iter(self._index.ordered)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the actions, each once."""
        return self._index.names

    def find(
        self, name: str, elements: Sequence[str] = (), kind: ActionKind | str | None = None
    ) -> Action:
        """Return one action.

        ``MultiPinchTight`` and ``SingleJointMultipleTips`` may be given without their count. A
        primitive that exists with a single set of elements needs no elements. A pinch is found with
        its deepest posture first by ``@deepest`` after its name, even if that is not clear.

        Args:
            name: Name of the action.
            elements: For a primitive, the fingers or the actuator, in any order.
            kind: Kind of the action; ``None`` for any.

        Raises:
            UnknownAction: if there is no action of that name (and kind).
            ActionError: if it does not exist with these elements; names the possible ones.
        """
        return self._index.find(name, listed(elements, "elements", ActionError), kind)

    def all(
        self,
        kind: ActionKind | str | None = None,
        name: str | None = None,
        elements: Sequence[str] = (),
    ) -> list[Action]:
        """Return the actions that pass a filter, in a fixed order.

        Args:
            kind: Only actions of this kind.
            name: Only actions of this name.
            elements: Only primitives with all of these elements.
        """
        return self._index.select(kind, name, listed(elements, "elements", ActionError))

    def primitives(self) -> list[PrimitiveGroup]:
        """Return the primitives in groups of the same name, for user interfaces."""
        return self._index.groups()

    def partners(self, name: str, element: str) -> tuple[str, ...]:
        """Return the elements that occur together with a given one in a primitive.

        Raises:
            UnknownAction: if there is no primitive of that name.
            ActionError: if it never has that element.
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
        parts: Sequence[ActionReference | str],
        *,
        independent: bool = False,
        description: str = "",
    ) -> Composed:
        """Return a composed action of the library's actions, without adding it; see `build`."""
        return compose(
            self.hand, self.find, name, parts, independent=independent, description=description
        )

    def sequence(self, name: str, steps: Sequence[StepPlan], *, description: str = "") -> Timed:
        """Return a timed action of the library's actions, without adding it; see `build`."""
        return sequence(self.hand, self.find, name, steps, description=description)

    def add(self, action: Action, store: bool = False, *, replace_same: bool = False) -> None:
        """Add an action.

        Args:
            action: The action.
            store: Write it to its file at once.
            replace_same: Replace an action of the same name, and rebuild those that use it, instead
                of refusing.

        Raises:
            ActionError: if the name is taken, or the action refers to a missing one or to itself.
        """
        kind_of(action)
        others = self._index.without(action)
        if len(others) < len(self) and not replace_same:
            # In its own spelling, which may differ from the new one's.
            same = self.find(action.name, action.elements).name
            raise ActionError(
                f"there already is an action '{label(same, action.elements)}'; replace it, or "
                "choose another name"
            )
        if not isinstance(action, Primitive):
            check_custom_name(action.name)
        # The new index is checked, written to files and assigned, in this order, so that an error
        # leaves the library unchanged.
        index = ActionIndex(self.hand, (*others, action))
        for use in action.uses:
            if normalise(use.action) == normalise(action.name):
                raise ActionError(f"the action '{action.name}' would contain itself")
            index.find(use.action, use.elements, None)
        # The actions that use it hold postures computed from the old one.
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
            UnknownAction: if there is no such action.
            ActionError: if another action uses it, or it is a primitive.
        """
        action = self.find(name)
        if isinstance(action, Primitive):
            raise ActionError(
                f"'{action.name}' is a primitive; only the extraction changes primitives"
            )
        users = self._index.users(action)
        if users:
            raise ActionError(f"'{action.name}' is used by {', '.join(users)}; remove that first")
        if self._stored is not None:
            # The file first, since a file that cannot be deleted would bring the action back.
            self._stored.delete(action)
        self._index = ActionIndex(self.hand, self._index.without(action))
        self.version += 1

    def rename(self, name: str, new_name: str) -> None:
        """Give a composed, timed or generic action another name, everywhere it is used.

        Raises:
            UnknownAction: if there is no such action.
            ActionError: if the new name is taken or invalid, or the action is a primitive.
        """
        action = self.find(name)
        if isinstance(action, Primitive):
            raise ActionError(f"'{action.name}' is a primitive; its name cannot change")
        check_custom_name(new_name)
        old, new = normalise(action.name), normalise(new_name)
        # A new spelling of its own name is allowed.
        if new != old and new in self._index.custom:
            raise ActionError(f"there already is an action '{new_name}'")

        def renamed(use: ActionReference) -> ActionReference:
            return replace(use, action=new_name) if normalise(use.action) == old else use

        changed: list[CustomAction] = []
        kept: list[Action] = list(self._index.primitives)
        for other in self._index.custom.values():
            if other is action:
                # A copy, since other threads may still use the old action.
                changed.append(replace(action, name=new_name))
            elif any(normalise(use.action) == old for use in other.uses):
                changed.append(other.with_uses(renamed))
            else:
                kept.append(other)
        # As in `add`: checked, written and assigned, in this order.
        index = ActionIndex(self.hand, (*kept, *changed))
        if self._stored is not None:
            self._stored.rename(action, new_name, changed)
        self._index = index
        self.version += 1

    def save(self, folder: Path | None = None) -> None:
        """Write all actions to their files, or none; leave unchanged files untouched.

        Args:
            folder: Folder to write to, now and later; ``None``: the present one.

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

    def reload(self) -> bool:
        """Read the files again if they changed, and return whether they did.

        Actions that exist only in memory are kept.

        Raises:
            ActionError: for every mistake in the files; the library is then unchanged.
        """
        if not self.changed():
            return False
        # Actions without a file would be lost with the old index.
        volatile = [
            action for action in self._index.custom.values() if not self.is_stored(action.name)
        ]
        self._read(volatile)
        return True


def load_actions(hand: Hand | str | Path) -> ActionLibrary:
    """Return the stored actions of a hand.

    Args:
        hand: The hand, as `rtee.load_hand` returns it; or its name, or the path of its folder.

    Raises:
        ConfigError: if there is no such hand, or it was made without a folder.
        ActionError: for every mistake in the files, with file and line.
    """
    # Imported only here, since a client's library needs no YAML.
    from rtee.hand.load import hand_folder, load_hand

    folder = hand_folder(hand)[0]
    return ActionLibrary.load(
        hand if isinstance(hand, Hand) else load_hand(folder), folder / "actions"
    )


def _files_in(hand: Hand, folder: Path) -> ActionFiles:
    # Imported only here, since a library in memory, as in a client, needs no YAML.
    from rtee.actions.action_files import ActionFiles

    return ActionFiles(hand, folder)
