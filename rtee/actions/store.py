"""The folder of a hand's actions: one file per primitive kind, one per custom action.

::

    actions/primitives/PinchTight.yaml
    actions/composed/schunkGrasp.yaml
    actions/timed/drill.yaml
    actions/generic/point.yaml
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from rtee.actions.comments import rewritten
from rtee.actions.documents import (
    CUSTOM,
    WHAT,
    custom_document,
    located,
    primitives_document,
    read_primitives,
)
from rtee.actions.naming import normalise
from rtee.actions.resolve import Builder, Definition, read_definition
from rtee.actions.types import Action, ActionKind, CustomAction, Primitive, kind_of
from rtee.errors import ActionError
from rtee.hand.files import reason, write_all
from rtee.hand.model import Hand
from rtee.hand.yamlfile import read_emitted, read_text
from rtee.hand.yamlwrite import emit

PRIMITIVES = "primitives"


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
    from rtee.actions.index import Index

    named: dict[str, list[Primitive]] = {}
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


def custom_changes(folder: Path, actions: Iterable[CustomAction]) -> Changes:
    """Return what is to change so that a folder holds these composed, timed or generic actions.

    Comments in their files are kept.

    Raises:
        ActionError: if a file that is there cannot be read.
    """
    changed: dict[Path, str] = {}
    for action in actions:
        changed |= _change(_custom_path(folder, action), custom_document(action))
    return Changes(changed)


def delete_custom(folder: Path, action: Action) -> None:
    """Delete the file of a composed, timed or generic action, if there is one.

    Raises:
        ConfigError: if it cannot be deleted.
    """
    write_all({}, gone=[_custom_path(folder, action)])


def _custom_path(folder: Path, action: Action) -> Path:
    room = folder / kind_of(action)
    same = (path for path in _files(room) if normalise(path.stem) == normalise(action.name))
    return next(same, room / f"{action.name}.yaml")


def _change(path: Path, data: dict[str, Any], comments: Sequence[str] = ()) -> dict[Path, str]:
    """Return a file with its new text, comments kept; nothing if it is the same."""
    text = emit(data, comments)
    if path.exists():
        old = read_text(path, WHAT, ActionError)
        if old == text:
            return {}
        if read_emitted(old) is None or _header(old) != _header(text):
            text = rewritten(old, data) or text
    return {path: text}


def _header(text: str) -> list[str]:
    return list(takewhile(lambda line: line.startswith("#"), text.split("\n")))
