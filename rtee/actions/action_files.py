"""The files of a hand's actions: one per primitive kind, one per custom action.

::

    actions/primitives/PinchTight.yaml
    actions/composed/schunkGrasp.yaml
    actions/timed/drill.yaml
    actions/generic/point.yaml
"""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from rtee.actions.documents import (
    CUSTOM,
    WHAT,
    CustomDocument,
    custom_document,
    located,
    primitives_document,
    read_document,
    read_primitives,
)
from rtee.actions.index import ActionIndex
from rtee.actions.naming import normalise
from rtee.actions.openings import FILE_NAME as OPENINGS
from rtee.actions.types import Action, ActionKind, CustomAction, Primitive, kind_of
from rtee.errors import ActionError
from rtee.hand.catalog import FILE_NAME
from rtee.hand.files import reason, write_all
from rtee.hand.model import Hand
from rtee.hand.own_copy import copied_since, copy_notice, own
from rtee.hand.validation import checked
from rtee.hand.yamlfile import YamlDocument, emit, read_emitted, read_text, yaml_reader

_IDENTITY = ("elements", "alias", "action")
"""Keys that identify the entries of a list; the first one present counts."""


def rewritten(text: str, data: Mapping[str, Any]) -> str | None:
    """Return an edited file with new data, as for `emit`, changed as little as possible.

    Returns:
        The new text; ``None`` if the old one cannot be kept.
    """
    from ruamel.yaml.error import YAMLError

    yaml = yaml_reader(keep_comments=True)
    yaml.preserve_quotes = True
    # At the default width, ruamel would fold long lines that have not changed.
    yaml.width = 4096
    try:
        # Through text, so that both sides have the types that YAML gives them.
        fresh = yaml_reader().load(emit(data))
        document = yaml.load(text)
        if not isinstance(document, dict):
            return None
        stream = io.StringIO()
        yaml.dump(_merged(document, fresh), stream)
        # A merge that reads back as other data would be worse than a lost comment.
        same = yaml_reader().load(stream.getvalue()) == fresh
    except (YAMLError, ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return None
    return stream.getvalue() if same else None


def _merged(old: Any, new: Any) -> Any:
    if isinstance(old, dict) and isinstance(new, Mapping):
        # A new list, since the loop deletes keys.
        for key in [key for key in old if key not in new]:
            del old[key]
        for key, value in new.items():
            old[key] = _merged(old[key], value) if key in old else _styled(value)
        return old
    if isinstance(old, list) and isinstance(new, list):
        return _merged_list(old, new)
    # Equal values keep their old form, such as 0.50; but in Python, True equals 1.
    return old if old == new and isinstance(old, bool) == isinstance(new, bool) else new


def _merged_list(old: list[Any], new: list[Any]) -> list[Any]:
    if not all(isinstance(item, Mapping) for item in [*old, *new]):
        if old != new:
            old[:] = new
        return old
    known = {_identity(item, index): item for index, item in enumerate(old)}
    merged = []
    for index, item in enumerate(new):
        same = known.get(_identity(item, index))
        merged.append(_styled(item) if same is None else _merged(same, item))
    # Only if needed, since replacing the items drops the comments between them.
    if len(merged) != len(old) or any(a is not b for a, b in zip(old, merged, strict=True)):
        old[:] = merged
    return old


def _identity(item: Mapping[str, Any], index: int) -> object:
    key = next((key for key in _IDENTITY if key in item), None)
    if key is None:
        return index
    value = item[key]
    return tuple(value) if isinstance(value, list) else value


def _styled(value: Any) -> Any:
    """Return new data in the style of `emit`: lists of scalars in one line."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, Mapping):
        return CommentedMap((key, _styled(item)) for key, item in value.items())
    if isinstance(value, list):
        entries = CommentedSeq(_styled(item) for item in value)
        if not any(isinstance(item, Mapping) for item in value):
            entries.fa.set_flow_style()
        return entries
    return value


log = logging.getLogger(__name__)

ACTIONS: Final = "actions"
"""Name of the folder of the actions in a hand's folder."""

PRIMITIVES: Final = "primitives"
"""Name of the folder of the primitives; those of other actions have the names of their kinds."""


class ActionFiles:
    """The stored actions of one hand.

    Attributes:
        hand: The hand.
        folder: Their folder; changes if the hand is copied.
        openings: Path of the file of their openings, beside the folder.
    """

    def __init__(self, hand: Hand, folder: Path) -> None:
        self.hand = hand
        self._move(folder)
        self._stored: set[str] = set()  # normalised names of the custom actions in files
        self._seen: dict[Path, int] = {}
        self._gone = False

    def _move(self, folder: Path) -> None:
        # Joined once, since every goal looks at the file.
        self.folder, self.openings = folder, os.path.join(folder.parent, OPENINGS)

    def read(self, keep: Sequence[Action] = ()) -> ActionIndex:
        """Return the actions in the files together with those in ``keep``, which have no file.

        Raises:
            ActionError: for every mistake in the files, with file and line.
        """
        seen = stamps(self.folder)  # before reading, so that a concurrent change is noticed later
        actions = read_actions(self.hand, self.folder)
        index = ActionIndex(self.hand, (*actions, *keep))
        self._stored = {normalise(a.name) for a in actions if not isinstance(a, Primitive)}
        self._seen = seen
        return index

    def changed(self) -> bool:
        """Return whether a file was changed, added or removed since it was read or written."""
        if _of_a_hand(self.folder):  # another program may have made a copy of the hand since
            copy = copied_since(self.folder.parent)
            if copy is not None and os.path.isdir(copy / ACTIONS):
                self._move(copy / ACTIONS)
        if self._seen and not os.path.isdir(self.folder):
            # A running hand keeps its actions even if its files are deleted.
            if not self._gone:
                log.warning("%s is gone; the actions stay as they were last read", self.folder)
            self._gone = True
            return False
        self._gone = False
        return stamps(self.folder) != self._seen

    def holds(self, name: str) -> bool:
        """Return whether a file holds a composed, timed or generic action of this name."""
        return normalise(name) in self._stored

    def write(self, index: ActionIndex, action: Action) -> None:
        """Write an action to its file; for a primitive, write all primitives.

        Raises:
            ActionError: if the action uses one that is not stored.
            ConfigError: if the file cannot be written.
        """
        if isinstance(action, Primitive):
            primitive_changes(self._writable(), self.hand, index.primitives).write()
            self._remember()
            return
        # An action whose parts have no files could not be read back.
        for use in action.uses:
            inner = index.find(use.action, use.elements, None)
            if not isinstance(inner, Primitive) and not self.holds(inner.name):
                raise ActionError(f"'{action.name}' uses '{inner.name}', which is not stored")
        self._write_custom([action])

    def write_all(self, index: ActionIndex) -> None:
        """Write all actions to their files, or none; leave unchanged files untouched.

        Raises:
            ConfigError: if a file cannot be written.
        """

        def changes(folder: Path) -> Changes:
            primitives = primitive_changes(folder, self.hand, index.primitives)
            custom = custom_changes(folder, index.custom.values())
            files = {**primitives.files, **custom.files}
            return Changes(files, [*primitives.gone, *custom.gone], primitives.folders)

        # Compared first, so that a shipped hand is copied only if something changes.
        pending = changes(self.folder)
        if pending.files or pending.gone:
            pending = changes(self._writable())
        pending.write()
        self._remember(index.custom)

    def delete(self, action: Action) -> None:
        """Delete an action's file, if it has one.

        Raises:
            ConfigError: if the file cannot be deleted.
        """
        if self.holds(action.name):
            write_all({}, gone=[_custom_path(self._writable(), action)])
            self._stored.discard(normalise(action.name))
            self._remember()

    def rename(self, action: Action, new_name: str, changed: Sequence[CustomAction]) -> None:
        """Rename an action in its file, and in the files of the actions that use it.

        Args:
            action: The action with its old name.
            new_name: Its new name.
            changed: The renamed action and those that use it.

        Raises:
            ConfigError: if a file cannot be written.
        """
        if not self.holds(action.name):
            return
        new = normalise(new_name)
        # The old file goes last, so that an error in between loses no action.
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
        """Record the present times of the files as those of this library's last write."""
        self._stored.update(stored)
        self._seen = stamps(self.folder)

    def _writable(self) -> Path:
        """Return the folder to write to; copy a shipped hand first.

        Raises:
            ConfigError: if a copy is needed and cannot be made.
        """
        if _of_a_hand(self.folder):
            home = self.folder.parent
            copy = own(home)
            if copy != home:
                log.info("%s", copy_notice(home, copy))
                self._move(copy / ACTIONS)
        return self.folder


def _of_a_hand(folder: Path) -> bool:
    """Return whether a folder of actions belongs to a hand's folder."""
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
    """Return the time of the last change [ns] of each file in a folder of actions."""
    times: dict[Path, int] = {}
    for subfolder in (PRIMITIVES, *CUSTOM):
        for path in _files(folder / subfolder):
            try:
                times[path] = path.stat().st_mtime_ns
            except OSError:
                # Deleted since the listing; its absence from the result shows as a change.
                continue
    return times


# --- reading ---------------------------------------------------------------------------------


def read_actions(hand: Hand, folder: Path) -> list[Action]:
    """Read all actions of a hand, parts before the actions that use them.

    Raises:
        ActionError: for every mistake, with file and line.
    """
    for place in (folder, *(folder / each for each in (PRIMITIVES, *CUSTOM))):
        if os.path.lexists(place) and not os.path.isdir(place):
            raise ActionError("is not a folder", path=place)
    primitives: list[Primitive] = []
    # First, since custom actions refer to them.
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
                        f"the name '{definition.name}' is already taken by {other.document.path}: "
                        "case and underscores are ignored"
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
        # A set, since the order of elements does not matter.
        key = (primitive.name, frozenset(primitive.elements))
        if key in seen:
            raise ActionError(
                f"{primitive.name} of {', '.join(primitive.elements)} occurs twice",
                path=_primitive_path(folder, primitive.name),
            )
        seen.add(key)


# --- writing ---------------------------------------------------------------------------------


def _primitive_path(folder: Path, name: str) -> Path:
    return folder / PRIMITIVES / f"{name}.yaml"


@dataclass(frozen=True)
class Changes:
    """Changes of a folder of actions.

    Attributes:
        files: Texts of new and different files, by path.
        gone: The files to delete.
        folders: The folders that exist afterwards.
    """

    files: Mapping[Path, str]
    gone: Sequence[Path] = ()
    folders: Sequence[Path] = ()

    def write(self) -> None:
        """Make all changes, or none if one of them fails.

        Raises:
            ConfigError: if a file cannot be written.
        """
        write_all(self.files, folders=self.folders, gone=self.gone)


def primitive_changes(folder: Path, hand: Hand, primitives: Iterable[Primitive]) -> Changes:
    """Return the file changes that leave exactly these primitives in a folder, one file per kind.

    The same primitives give the same text. Keeps people's comments in the files, and deletes files
    of kinds without primitives.

    Raises:
        ActionError: if an existing file cannot be read.
    """
    named: dict[str, list[Primitive]] = {}
    # In the index's order, so that the same primitives give the same text.
    for primitive in ActionIndex(hand, tuple(primitives)).primitives:
        named.setdefault(primitive.name, []).append(primitive)
    changed: dict[Path, str] = {}
    kept = set()
    for name, members in named.items():
        path = _primitive_path(folder, name)
        comment = f"{name}: {members[0].kind.label}."
        changed |= _change(path, primitives_document(members), (comment,))
        kept.add(path)
    subfolder = folder / PRIMITIVES
    return Changes(changed, [path for path in _files(subfolder) if path not in kept], [subfolder])


def custom_changes(
    folder: Path, actions: Iterable[CustomAction], before: Mapping[str, Path] = MappingProxyType({})
) -> Changes:
    """Return the file changes that store these composed, timed or generic actions in a folder.

    Keeps comments in their files.

    Raises:
        ActionError: if an existing file cannot be read.
    """
    changed: dict[Path, str] = {}
    gone: list[Path] = []
    for action in actions:
        former = before.get(normalise(action.name))
        changed |= _change(_custom_path(folder, action), custom_document(action), former=former)
        # The file of a replaced action of another kind would define the name a second time.
        gone += [
            path
            for kind in CUSTOM
            if kind != kind_of(action)
            for path in _files(folder / kind)
            if normalise(path.stem) == normalise(action.name)
        ]
    return Changes(changed, gone)


def _custom_path(folder: Path, action: Action) -> Path:
    subfolder = folder / kind_of(action)
    # Reuse a file with another spelling, since a second one would define the action twice.
    same = (path for path in _files(subfolder) if normalise(path.stem) == normalise(action.name))
    return next(same, subfolder / f"{action.name}.yaml")


def _change(
    path: Path, data: dict[str, Any], comments: Sequence[str] = (), former: Path | None = None
) -> dict[Path, str]:
    """Return a file with its new text, with comments kept; ``{}`` if it is unchanged."""
    text = emit(data, comments)
    source = path if former is None or path.exists() else former
    if source.exists():
        old = read_text(source, WHAT, ActionError)
        if source == path and old == text:
            return {}
        # A file in the emitted form with the same header was never edited and has no comments.
        if read_emitted(old) is None or _header(old) != _header(text):
            text = rewritten(old, data) or text
    return {path: text}


def _header(text: str) -> list[str]:
    return list(takewhile(lambda line: line.startswith("#"), text.split("\n")))


@dataclass(frozen=True, slots=True)
class Definition:
    """A custom action as defined in its file, before its references are resolved.

    Attributes:
        content: The content of the file.
        document: The document of the file, with line numbers.
    """

    content: CustomDocument
    document: YamlDocument

    @property
    def name(self) -> str:
        """The action's name."""
        return self.content.name


def read_definition(kind: ActionKind, path: Path) -> Definition:
    """Read the file of a composed, timed or generic action.

    Raises:
        ActionError: for every mistake, with file and line.
    """
    document = read_document(path)
    return Definition(checked(CUSTOM[kind], document, ActionError), document)


class Builder:
    """Makes actions from definitions, in the order of their references."""

    def __init__(
        self, hand: Hand, primitives: Sequence[Primitive], definitions: Mapping[str, Definition]
    ) -> None:
        self.hand = hand
        self.definitions = definitions
        self.primitives = ActionIndex(hand, primitives)
        self.done: dict[str, Action] = {}
        self.under_way: list[str] = []

    def build(self) -> list[Action]:
        """Return the actions.

        Raises:
            ActionError: for every mistake in a definition, with file and line.
        """
        for key in self.definitions:
            self._action(key)
        return list(self.done.values())

    def _action(self, key: str) -> Action:
        if key not in self.done:
            self.under_way.append(key)
            self.done[key] = self._make(self.definitions[key])
            self.under_way.pop()
        return self.done[key]

    def _find(self, name: str, elements: tuple[str, ...]) -> Action:
        key = normalise(name)
        if key not in self.definitions:
            # Suggestions include custom actions that are not made yet.
            known = [*self.primitives.names, *(d.name for d in self.definitions.values())]
            return self.primitives.find(name, elements, None, known)
        # Otherwise a cycle would end at Python's recursion limit, without any names.
        if key in self.under_way:
            chain = [*self.under_way[self.under_way.index(key) :], key]
            names = " > ".join(self.definitions[k].name for k in chain)
            raise ActionError(f"the action would contain itself: {names}")
        if elements:
            raise ActionError(f"'{name}' is not a primitive and takes no elements")
        return self._action(key)

    def _make(self, definition: Definition) -> Action:
        content, document = definition.content, definition.document
        count = 0
        at: list[str | int] = []  # the part or step that was looked up last

        def find(name: str, elements: tuple[str, ...]) -> Action:
            nonlocal count
            at[:] = (content.body, count)
            count += 1
            return self._find(name, elements)

        # `located` reads `at` when an error occurs, for the line of the faulty part.
        with located(document, at):
            return content.make(self.hand, find, document)
