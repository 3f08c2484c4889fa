"""Resolution of definitions, which refer to each other by name, into actions."""

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
    return Definition(read_as(CUSTOM[kind], document), document)


class Builder:
    """Makes actions from definitions, each after those that it refers to."""

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
