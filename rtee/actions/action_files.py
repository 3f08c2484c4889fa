"""The files of a hand's actions: one per primitive kind, one per custom action.

::

    actions/primitives/PinchTight.yaml
    actions/composed/schunkGrasp.yaml
    actions/timed/drill.yaml
    actions/generic/point.yaml
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from rtee.actions.comments import rewritten
from rtee.actions.documents import (
    CUSTOM,
    WHAT,
    custom_document,
    located,
    primitives_document,
    read_primitives,
)
from rtee.actions.index import Index
from rtee.actions.naming import normalise
from rtee.actions.resolve import Builder, Definition, read_definition
from rtee.actions.types import Action, ActionKind, CustomAction, Primitive, kind_of
from rtee.errors import ActionError
from rtee.hand.catalog import FILE_NAME
from rtee.hand.files import reason, write_all
from rtee.hand.model import Hand
from rtee.hand.own_copy import copied_since, copy_notice, own
from rtee.hand.yamlfile import read_emitted, read_text
from rtee.hand.yamlwrite import emit

log = logging.getLogger(__name__)

ACTIONS: Final = "actions"
"""The folder of the actions in a hand's folder."""

PRIMITIVES: Final = "primitives"
"""The folder of the primitives in it; those of other actions are called like their kinds."""


class ActionFiles:
    """Where the actions of one hand are stored.

    Args:
        hand: The hand.
        folder: The folder.

    Attributes:
        folder: The folder.
    """

    def __init__(self, hand: Hand, folder: Path) -> None:
        self.hand = hand
        self.folder = folder
        self._stored: set[str] = set()  # normalised names of the custom actions in files
        self._seen: dict[Path, int] = {}
        self._gone = False

    def read(self, keep: Sequence[Action] = ()) -> Index:
        """Return the actions in the files.

        Args:
            keep: Further actions, which are in memory only.

        Raises:
            ActionError: for every mistake in the files, with file and line.
        """
        seen = stamps(self.folder)  # before reading: a change meanwhile is noticed later
        actions = read_actions(self.hand, self.folder)
        index = Index(self.hand, (*actions, *keep))
        self._stored = {normalise(a.name) for a in actions if not isinstance(a, Primitive)}
        self._seen = seen
        return index

    def changed(self) -> bool:
        """Return whether a file was changed, added or removed since it was read or written."""
        if _of_a_hand(self.folder):  # another program may have made a copy of the hand since
            copy = copied_since(self.folder.parent)
            if copy is not None and os.path.isdir(copy / ACTIONS):
                self.folder = copy / ACTIONS
        if self._seen and not os.path.isdir(self.folder):
            # A hand that runs keeps what it can do, whatever becomes of its files.
            if not self._gone:
                log.warning("%s is gone; the actions stay as they were read", self.folder)
            self._gone = True
            return False
        self._gone = False
        return stamps(self.folder) != self._seen

    def holds(self, name: str) -> bool:
        """Return whether a composed, timed or generic action is stored in a file."""
        return normalise(name) in self._stored

    def write(self, index: Index, action: Action) -> None:
        """Write one action to its file; of primitives all.

        Raises:
            ActionError: if it uses an action that is not stored.
            ConfigError: if the file cannot be written.
        """
        if isinstance(action, Primitive):
            primitive_changes(self._writable(), self.hand, index.primitives).write()
            self._remember()
            return
        # An action whose parts have no files could not be read again.
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
            ConfigError: if a file cannot be written.
        """

        def changes(folder: Path) -> Changes:
            primitives = primitive_changes(folder, self.hand, index.primitives)
            custom = custom_changes(folder, index.custom.values())
            files = {**primitives.files, **custom.files}
            return Changes(files, [*primitives.gone, *custom.gone], primitives.folders)

        # Compared first: the hand is copied only where there is something to change.
        found = changes(self.folder)
        if found.files or found.gone:
            found = changes(self._writable())
        found.write()
        self._remember(index.custom)

    def delete(self, action: Action) -> None:
        """Delete an action's file, if it has one.

        Raises:
            ConfigError: if it cannot be deleted.
        """
        if self.holds(action.name):
            write_all({}, gone=[_custom_path(self._writable(), action)])
            self._stored.discard(normalise(action.name))
            self._remember()

    def rename(self, action: Action, new_name: str, changed: Sequence[CustomAction]) -> None:
        """Store an action under another name, if it is stored, and what uses it.

        Args:
            action: The action, as it was called.
            new_name: What it is called now.
            changed: The action and those that use it, as they are now.

        Raises:
            ConfigError: if a file cannot be written.
        """
        if not self.holds(action.name):
            return
        new = normalise(new_name)
        # The old file goes last: an error in between leaves a file too many, not too few.
        before = _custom_path(self._writable(), action)
        stored = [a for a in changed if normalise(a.name) == new or self.holds(a.name)]
        self._write_custom(stored, {new: before})
        if new != normalise(action.name):
            self.delete(action)

    def _write_custom(
        self, actions: Sequence[CustomAction], before: Mapping[str, Path] | None = None
    ) -> None:
        custom_changes(self._writable(), actions, before or {}).write()
        self._remember(normalise(action.name) for action in actions)

    def _remember(self, stored: Iterable[str] = ()) -> None:
        """Remember that the files are as they were just written."""
        self._stored.update(stored)
        self._seen = stamps(self.folder)

    def _writable(self) -> Path:
        """Return the folder to write to; a hand that is not to be changed is copied for it.

        Raises:
            ConfigError: if a copy is needed and cannot be made.
        """
        if _of_a_hand(self.folder):
            home = self.folder.parent
            copy = own(home)
            if copy != home:
                log.info("%s", copy_notice(home, copy))
                self.folder = copy / ACTIONS
        return self.folder


def _of_a_hand(folder: Path) -> bool:
    """Return whether a folder of actions is that of a hand, not one that was given by itself."""
    return folder.name == ACTIONS and os.path.isfile(folder.parent / FILE_NAME)


def _files(folder: Path) -> list[Path]:
    try:
        return sorted(
            path
            for path in folder.iterdir()
            if path.suffix in (".yaml", ".yml") and not path.name.startswith(".")
        )
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise ActionError(f"cannot be read: {reason(error)}", path=folder) from None


def stamps(folder: Path) -> dict[Path, int]:
    """Return the files of a folder of actions with the times of their last change [ns]."""
    found: dict[Path, int] = {}
    for room in (PRIMITIVES, *CUSTOM):
        for path in _files(folder / room):
            try:
                found[path] = path.stat().st_mtime_ns
            except OSError:
                # Deleted since it was listed: that it is missing here shows as a change.
                continue
    return found


# --- reading ---------------------------------------------------------------------------------


def read_actions(hand: Hand, folder: Path) -> list[Action]:
    """Read all actions of a hand, those that others are made of first.

    Raises:
        ActionError: for every mistake, with file and line.
    """
    primitives: list[Primitive] = []
    for path in _files(folder / PRIMITIVES):
        primitives += read_primitives(hand, path)
    _refuse_twins(primitives, folder)
    definitions: dict[str, Definition] = {}
    for kind in CUSTOM:
        for path in _files(folder / kind):
            definition = _read_custom(kind, path)
            other = definitions.setdefault(normalise(definition.name), definition)
            if other is not definition:
                with located(definition.document, ("name",)):
                    raise ActionError(
                        f"the name '{definition.name}' is already that of {other.document.path}, "
                        "as case and underscores do not matter"
                    )
    return [*primitives, *Builder(hand, primitives, definitions).build()]


def _read_custom(kind: ActionKind, path: Path) -> Definition:
    definition = read_definition(kind, path)
    with located(definition.document, ("name",)):
        if normalise(path.stem) != normalise(definition.name):
            raise ActionError(f"the name '{definition.name}' and the file's name differ")
    return definition


def _refuse_twins(primitives: Iterable[Primitive], folder: Path) -> None:
    seen: set[tuple[str, frozenset[str]]] = set()
    for primitive in primitives:
        key = (primitive.name, frozenset(primitive.elements))
        if key in seen:
            raise ActionError(
                f"{primitive.name} of {', '.join(primitive.elements)} is there twice",
                path=_primitive_path(folder, primitive.name),
            )
        seen.add(key)


# --- writing ---------------------------------------------------------------------------------


def _primitive_path(folder: Path, name: str) -> Path:
    return folder / PRIMITIVES / f"{name}.yaml"


@dataclass(frozen=True)
class Changes:
    """What is to change in a folder of actions.

    Attributes:
        files: The files that are new or different, with their text.
        gone: The files to delete.
        folders: The folders that are there afterwards.
    """

    files: Mapping[Path, str]
    gone: Sequence[Path] = ()
    folders: Sequence[Path] = ()

    def write(self) -> None:
        """Write them: all, or none where the folder or disk does not allow one.

        Raises:
            ConfigError: if a file cannot be written.
        """
        write_all(self.files, folders=self.folders, gone=self.gone)


def primitive_changes(folder: Path, hand: Hand, primitives: Iterable[Primitive]) -> Changes:
    """Return what is to change so that a folder holds these primitives, one file per kind.

    The same primitives give the same text. Comments of people in the files are kept; files of
    kinds that are gone go too.

    Args:
        folder: The hand's folder of actions.
        hand: The hand.
        primitives: All its primitives.

    Raises:
        ActionError: if a file that is there cannot be read.
    """
    named: dict[str, list[Primitive]] = {}
    # In the index's order, so that the same primitives give the same text.
    for primitive in Index(hand, tuple(primitives)).primitives:
        named.setdefault(primitive.name, []).append(primitive)
    changed: dict[Path, str] = {}
    kept = set()
    for name, members in named.items():
        path = _primitive_path(folder, name)
        comment = f"{name}: {members[0].kind.label}."
        changed |= _change(path, primitives_document(members), (comment,))
        kept.add(path)
    room = folder / PRIMITIVES
    return Changes(changed, [path for path in _files(room) if path not in kept], [room])


def custom_changes(
    folder: Path, actions: Iterable[CustomAction], before: Mapping[str, Path] = MappingProxyType({})
) -> Changes:
    """Return what is to change so that a folder holds these composed, timed or generic actions.

    Comments in their files are kept.

    Raises:
        ActionError: if a file that is there cannot be read.
    """
    changed: dict[Path, str] = {}
    gone: list[Path] = []
    for action in actions:
        former = before.get(normalise(action.name))
        changed |= _change(_custom_path(folder, action), custom_document(action), former=former)
        # One that replaces an action of another kind: two files would define the name.
        gone += [
            path
            for kind in CUSTOM
            if kind != kind_of(action)
            for path in _files(folder / kind)
            if normalise(path.stem) == normalise(action.name)
        ]
    return Changes(changed, gone)


def _custom_path(folder: Path, action: Action) -> Path:
    room = folder / kind_of(action)
    # A file with another spelling is kept, as a second one would define the action twice.
    same = (path for path in _files(room) if normalise(path.stem) == normalise(action.name))
    return next(same, room / f"{action.name}.yaml")


def _change(
    path: Path, data: dict[str, Any], comments: Sequence[str] = (), former: Path | None = None
) -> dict[Path, str]:
    """Return a file with its new text, comments kept; nothing if it is the same."""
    text = emit(data, comments)
    source = path if former is None or path.exists() else former
    if source.exists():
        old = read_text(source, WHAT, ActionError)
        if source == path and old == text:
            return {}
        # What reads as emitted, under the same header, nobody has edited: no comments to keep.
        if read_emitted(old) is None or _header(old) != _header(text):
            text = rewritten(old, data) or text
    return {path: text}


def _header(text: str) -> list[str]:
    return list(takewhile(lambda line: line.startswith("#"), text.split("\n")))
