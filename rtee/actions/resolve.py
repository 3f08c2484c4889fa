"""From definitions, which refer to each other by name, to actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rtee.actions.documents import CUSTOM, CustomDocument, located, read_as, read_document
from rtee.actions.index import Index
from rtee.actions.naming import normalise
from rtee.actions.types import Action, ActionKind, Primitive
from rtee.errors import ActionError
from rtee.hand.model import Hand
from rtee.hand.yamlfile import YamlDocument


@dataclass(frozen=True, slots=True)
class Definition:
    """A custom action as its file defines it, before what it refers to is looked up.

    Attributes:
        content: The content of the file.
        document: The same, with its lines.
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
    return Definition(read_as(CUSTOM[kind], document), document)


class Builder:
    """Makes actions of definitions in the order in which they need each other."""

    def __init__(
        self, hand: Hand, primitives: Sequence[Primitive], definitions: Mapping[str, Definition]
    ) -> None:
        self.hand = hand
        self.definitions = definitions
        self.primitives = Index(hand, primitives)
        self.done: dict[str, Action] = {}
        self.under_way: list[str] = []

    def build(self) -> list[Action]:
        """Return the actions.

        Raises:
            ActionError: for every mistake in a definition, with file and line.
        """
        for key in self.definitions:
            self._made(key)
        return list(self.done.values())

    def _made(self, key: str) -> Action:
        if key not in self.done:
            self.under_way.append(key)
            self.done[key] = self._make(self.definitions[key])
            self.under_way.pop()
        return self.done[key]

    def _find(self, name: str, elements: tuple[str, ...]) -> Action:
        key = normalise(name)
        if key not in self.definitions:
            # A misspelled name may be meant for a custom action, made or not.
            known = [*self.primitives.names, *(d.name for d in self.definitions.values())]
            return self.primitives.find(name, elements, None, known)
        # Without this, a cycle would end at Python's recursion limit, with no names.
        if key in self.under_way:
            chain = [*self.under_way[self.under_way.index(key) :], key]
            names = " > ".join(self.definitions[k].name for k in chain)
            raise ActionError(f"the action would contain itself: {names}")
        if elements:
            raise ActionError(f"'{name}' is not a primitive and takes no elements")
        return self._made(key)

    def _make(self, definition: Definition) -> Action:
        content, document = definition.content, definition.document
        count = 0
        at: list[str | int] = []  # the part or step that was looked up last

        def find(name: str, elements: tuple[str, ...]) -> Action:
            nonlocal count
            at[:] = (content.body, count)
            count += 1
            return self._find(name, elements)

        # `at` is looked at when an error comes: the line is that of the part at fault.
        with located(document, at):
            return content.make(self.hand, find, document)
