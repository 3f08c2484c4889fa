"""From definitions, which refer to each other by name, to actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rtee.actions.build import compose, full_posture, sequence
from rtee.actions.index import Index
from rtee.actions.naming import normalise
from rtee.actions.schema import Definition
from rtee.actions.types import Action, ActionKind, Generic, Primitive
from rtee.errors import ActionError, UserError
from rtee.hand.model import Hand


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
            known = [*self.primitives.names, *(d.name for d in self.definitions.values())]
            return self.primitives.find(name, elements, None, known)
        if key in self.under_way:
            chain = [*self.under_way[self.under_way.index(key) :], key]
            names = " > ".join(self.definitions[k].name for k in chain)
            raise ActionError(f"the action would contain itself: {names}")
        if elements:
            raise ActionError(f"'{name}' is no primitive and takes no elements")
        return self._made(key)

    def _make(self, definition: Definition) -> Action:
        at: list[int] = []

        def find(name: str, elements: tuple[str, ...]) -> Action:
            at.append(len(at))
            return self._find(name, elements)

        try:
            if definition.kind is ActionKind.COMPOSED:
                return compose(
                    self.hand,
                    find,
                    definition.name,
                    definition.parts,
                    independent=definition.independent,
                    description=definition.description,
                )
            if definition.kind is ActionKind.TIMED:
                return sequence(
                    self.hand,
                    find,
                    definition.name,
                    definition.steps,
                    description=definition.description,
                )
            return self._generic(definition)
        except UserError as error:
            if error.path is not None:
                raise
            node = definition.uses[at[-1]] if at else definition.node
            raise node.error(error.message) from None

    def _generic(self, definition: Definition) -> Generic:
        values = dict(definition.set_points or {})
        for node, (name, value) in zip(definition.uses, values.items(), strict=True):
            try:
                full_posture(self.hand, {name: value})
            except UserError as error:
                raise node.error(error.message) from None
        return Generic(definition.name, full_posture(self.hand, values), definition.description)
