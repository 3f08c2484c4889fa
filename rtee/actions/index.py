"""Immutable index of actions, which the library replaces as a whole at every change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from rtee.actions.build import rebuilt
from rtee.actions.naming import label, normalise
from rtee.actions.types import (
    DEEPEST,
    Action,
    ActionKind,
    CustomAction,
    Primitive,
    PrimitiveGroup,
    PrimitiveKind,
    kind_of,
)
from rtee.errors import ActionError, UnknownAction, suggestion
from rtee.hand.model import Hand

_KIND_ORDER = {kind: order for order, kind in enumerate(PrimitiveKind)}
_CUSTOM_ORDER = {kind: order for order, kind in enumerate(ActionKind)}
Key = frozenset[str]


def _as_kind(kind: ActionKind | str | None) -> ActionKind | None:
    if kind is None:
        return None
    plain = normalise(kind)
    try:
        return ActionKind(plain)
    except ValueError:
        raise ActionError(
            f"unknown kind '{kind}'; {suggestion(kind, [str(k) for k in ActionKind])}"
        ) from None


class ActionIndex:
    """Actions by name and elements, in the order of the hand's fingers and actuators.

    Raises:
        ActionError: if two actions have the same name (and elements).
    """

    def __init__(self, hand: Hand, actions: Sequence[Action]) -> None:
        self.hand = hand
        order = [*hand.finger_names, *hand.actuator_names]
        # Elements may be spelled in any case, unless two of them differ only in case.
        ambiguous = any(
            len({normalise(name) for name in names}) < len(names)
            for names in (hand.finger_names, hand.actuator_names)
        )
        self._spelling: Callable[[str], str] = str if ambiguous else normalise
        # Reversed, so that a finger takes precedence over an actuator of the same name.
        self._place = {name: index for index, name in reversed(list(enumerate(order)))}
        primitives = [action for action in actions if isinstance(action, Primitive)]
        self.primitives = tuple(sorted(primitives, key=self._primitive_order))
        custom = [action for action in actions if not isinstance(action, Primitive)]
        custom.sort(key=lambda a: (_CUSTOM_ORDER[kind_of(a)], normalise(a.name)))
        self.custom: dict[str, CustomAction] = {}
        for action in custom:
            other = self.custom.setdefault(normalise(action.name), action)
            if other is not action:
                raise ActionError(
                    f"the names '{other.name}' and '{action.name}' are the same: "
                    "case and underscores are ignored"
                )
        self.ordered: tuple[Action, ...] = (*self.primitives, *self.custom.values())
        self.names = tuple(dict.fromkeys(action.name for action in self.ordered))
        self._named: dict[str, dict[Key, Primitive]] = {}
        for primitive in self.primitives:
            self._enter(primitive)

    # A set, since elements may be given in any order.
    def _key(self, elements: Iterable[str]) -> Key:
        return frozenset(map(self._spelling, elements))

    def _primitive_order(self, primitive: Primitive) -> tuple[int, int, list[int]]:
        places = sorted(self._place.get(e, len(self._place)) for e in primitive.elements)
        return (_KIND_ORDER[primitive.kind], primitive.tips, places)

    def _enter(self, primitive: Primitive) -> None:
        key = self._key(primitive.elements)
        group = self._named.setdefault(normalise(primitive.name), {})
        if key in group:
            what = label(primitive.name, primitive.elements)
            raise ActionError(f"the primitive {what} occurs twice")
        group[key] = primitive
        # Also under the name without its count, which follows from the elements.
        if primitive.kind.counted:
            self._named.setdefault(normalise(primitive.kind), {}).setdefault(key, primitive)

    def find(
        self,
        name: str,
        elements: tuple[str, ...],
        kind: ActionKind | str | None,
        known: Sequence[str] | None = None,
    ) -> Action:
        """Return one action; see `ActionLibrary.find`. ``known``: names for a suggestion."""
        wanted, kind = normalise(name), _as_kind(kind)
        plain, _, which = name.partition("@")
        if which:
            return self._deepest(plain, which, elements, kind, name)
        custom = self.custom.get(wanted)
        if custom is not None and kind in (None, kind_of(custom)):
            if elements:
                raise ActionError(
                    f"'{custom.name}' is a {kind_of(custom)} action and takes no elements"
                )
            return custom
        group = self._named.get(wanted)
        if group is None or kind not in (None, ActionKind.PRIMITIVE):
            raise UnknownAction(name, self._names_of(kind) if known is None else known)
        if not elements and len(group) == 1:
            return next(iter(group.values()))
        key = self._key(elements)
        primitive = group.get(key)
        # The key is a set, in which a repeated element would count once.
        if primitive is None or len(key) != len(elements):
            raise self._wrong_elements(name, elements, group)
        return primitive

    def _deepest(
        self,
        plain: str,
        which: str,
        elements: tuple[str, ...],
        kind: ActionKind | str | None,
        name: str,
    ) -> Primitive:
        action = self.find(plain, elements, kind)
        if normalise(which) != DEEPEST:
            raise ActionError(f"'{name}': only '{plain}@{DEEPEST}' asks for another posture")
        if not isinstance(action, Primitive) or not action.evidence:
            raise ActionError(f"'{action.name}' is not a pinch, so it has no deepest posture")
        return action.deepest

    def _names_of(self, kind: ActionKind | None) -> list[str]:
        chosen = [a.name for a in self.ordered if kind in (None, kind_of(a))]
        return list(dict.fromkeys(chosen))

    def _wrong_elements(
        self, name: str, elements: tuple[str, ...], group: dict[Key, Primitive]
    ) -> ActionError:
        possible = [" ".join(primitive.elements) for primitive in group.values()]
        shown = ", ".join(possible[:12]) + (", …" if len(possible) > 12 else "")
        proper = next(iter(group.values())).name if len(group) else name
        if not elements:
            return ActionError(f"{proper} needs elements; valid: {shown}")
        given = " ".join(elements)
        return ActionError(f"{proper} does not exist with '{given}'; it does with: {shown}")

    def select(
        self, kind: ActionKind | str | None, name: str | None, elements: tuple[str, ...]
    ) -> list[Action]:
        """Return the actions that pass a filter; see `ActionLibrary.all`."""
        wanted_kind = _as_kind(kind)
        wanted_name = None if name is None else normalise(name)
        key = self._key(elements)

        def passes(action: Action) -> bool:
            if wanted_kind not in (None, kind_of(action)):
                return False
            # A counted primitive passes by its name with and without the count.
            names = {normalise(action.name)}
            if isinstance(action, Primitive):
                names.add(normalise(action.kind))
                if not key <= self._key(action.elements):
                    return False
            elif key:
                return False
            return wanted_name is None or wanted_name in names

        return [action for action in self.ordered if passes(action)]

    def groups(self) -> list[PrimitiveGroup]:
        """Return the primitives, one group per name."""
        by_name: dict[str, list[Primitive]] = {}
        for primitive in self.primitives:
            by_name.setdefault(primitive.name, []).append(primitive)
        return [
            PrimitiveGroup(
                name=name,
                selectable=self._sorted({e for p in members for e in p.elements}),
                count=len(members[0].elements),
                combinations=tuple(p.elements for p in members),
            )
            for name, members in by_name.items()
        ]

    def _sorted(self, elements: Iterable[str]) -> tuple[str, ...]:
        return tuple(sorted(elements, key=lambda e: (self._place.get(e, len(self._place)), e)))

    def partners(self, name: str, element: str) -> tuple[str, ...]:
        """Return the elements that go with a given one; see `ActionLibrary.partners`."""
        group = self._named.get(normalise(name))
        if group is None:
            raise UnknownAction(name, self._names_of(ActionKind.PRIMITIVE))
        wanted = self._spelling(element)
        with_it = [p for key, p in group.items() if wanted in key]
        if not with_it:
            known = {e for p in group.values() for e in p.elements}
            raise ActionError(
                f"{name} does not exist with '{element}'; {suggestion(element, known)}"
            )
        return self._sorted({e for p in with_it for e in p.elements if self._spelling(e) != wanted})

    def users(self, action: Action) -> tuple[str, ...]:
        """Return the names of the actions that use one."""
        return tuple(
            other.name
            for other in self.custom.values()
            if any(
                self.find(use.action.partition("@")[0], use.elements, None) is action
                for use in other.uses
            )
        )

    def without(self, action: Action) -> tuple[Action, ...]:
        """Return all actions except the one with the same name (and elements)."""
        if isinstance(action, Primitive):
            key = self._key(action.elements)
            return tuple(
                a
                for a in self.ordered
                if not (
                    isinstance(a, Primitive)
                    and a.name == action.name
                    and self._key(a.elements) == key
                )
            )
        wanted = normalise(action.name)
        return tuple(
            a for a in self.ordered if isinstance(a, Primitive) or normalise(a.name) != wanted
        )

    def rebuilt(self) -> ActionIndex:
        """Return an index in which all composed and timed actions are rebuilt from their parts.

        Raises:
            ActionError: if an action would contain itself.
        """
        fresh = dict(self.custom)
        under_way: list[str] = []
        done: set[str] = set()

        def find(inner: str, elements: tuple[str, ...]) -> Action:
            key = normalise(inner)
            if key not in fresh:
                return self.find(inner, elements, None)
            if key in under_way:
                chain = " > ".join([*under_way[under_way.index(key) :], key])
                raise ActionError(f"the action '{inner}' would contain itself: {chain}")
            if key not in done:
                under_way.append(key)
                # Its parts, which it looks up by `find`, are rebuilt first.
                fresh[key] = rebuilt(self.hand, find, fresh[key])
                under_way.pop()
                done.add(key)
            return fresh[key]

        for action in self.custom.values():
            find(action.name, ())
        return ActionIndex(self.hand, (*self.primitives, *fresh.values()))
