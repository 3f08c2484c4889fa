"""Reading the action files of ROS End-Effector.

Its files hold, per action, a posture of all actuators (``JointPos``, a list per joint) and a count
per actuator that tells which are involved. Primitives are keyed by their fingers (``[index,
thumb]``) or their joint and keep several ``ActionState_N``; composed ones name their parts without
elements and scales; timed ones hold the postures of their inner actions. What a custom action was
made of is therefore found again by comparing postures; where that fails, set-points stay.

Older files name fingertips' links where newer ones name fingers. The oldest ones say neither which
primitive they hold nor, by name, which actuators it involves; those are left out.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rtee.actions.build import SLACK, StepPlan, full_posture, generic
from rtee.actions.documents import Node, read_document
from rtee.actions.library import ActionLibrary
from rtee.actions.naming import label, normalise
from rtee.actions.parts import find_parts, scale_of
from rtee.actions.types import (
    Action,
    ActionReference,
    Posture,
    Primitive,
    PrimitiveKind,
    Timed,
)
from rtee.errors import ActionError, UserError, suggestion
from rtee.hand.model import Hand
from rtee.hand.names import safe_name

_KINDS = {
    "trig": PrimitiveKind.TRIG,
    "tipflex": PrimitiveKind.TIP_FLEX,
    "fingflex": PrimitiveKind.FING_FLEX,
    "pinchtight": PrimitiveKind.PINCH_TIGHT,
    "pinchstrong": PrimitiveKind.PINCH_TIGHT,
    "pinchloose": PrimitiveKind.PINCH_LOOSE,
    "pinchweak": PrimitiveKind.PINCH_LOOSE,
    "multiplepinchtight": PrimitiveKind.MULTI_PINCH_TIGHT,
    "multiplepinchstrong": PrimitiveKind.MULTI_PINCH_TIGHT,
    "singlejointmultipletips": PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS,
    "moretips": PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS,
}
_GENERIC, _COMPOSED, _TIMED = 1, 2, 3
_EARLY = "the files of early versions have neither 'PrimitiveType' nor 'Type'"


@dataclass
class Imported:
    """What was found in a folder of ROS End-Effector.

    Attributes:
        actions: The actions, those that others are made of first.
        files: How many files they came from.
        notes: What could not be taken over as it was, one sentence each.
    """

    actions: list[Action] = field(default_factory=list)
    files: int = 0
    notes: list[str] = field(default_factory=list)


def import_folder(hand: Hand, folder: Path) -> Imported:
    """Read all action files of ROS End-Effector in a folder and those below it.

    Raises:
        ActionError: if there are none, or for a mistake in one, with file and line.
    """
    paths = sorted([*folder.rglob("*.yaml"), *folder.rglob("*.yml")])
    reader = _Reader(hand)
    entries: list[tuple[Any, Node]] = []
    for path in paths:
        root = read_document(path).root
        entries += _entries(root)
        if _is_early(root):
            reader.imported.notes.append(f"{path} is left out: {_EARLY}")
    if not entries:
        why = f"; {_EARLY}" if reader.imported.notes else ""
        raise ActionError(f"holds no action files of ROS End-Effector{why}", path=folder)
    reader.imported.files = len({node.document.path for _, node in entries})
    for stage in (None, _GENERIC, _COMPOSED, _TIMED):
        for key, node in entries:
            if _type_of(node) == stage:
                reader.take(key, node, stage)
    return reader.imported


def _entries(root: Node) -> list[tuple[Any, Node]]:
    if not isinstance(root.value, dict):
        return []
    return [
        (key, node)
        for key, node in root.pairs()
        if isinstance(node.value, dict) and ("PrimitiveType" in node.value or "Type" in node.value)
    ]


def _is_early(root: Node) -> bool:
    if not isinstance(root.value, dict):
        return False
    values = (root.value, *root.value.values())
    return any(
        isinstance(v, dict) and ("JointsInvolved" in v or "InvolvedJointsCount" in v)
        for v in values
    )


def _type_of(node: Node) -> int | None:
    if "PrimitiveType" in node.value:
        return None
    kind = node.value["Type"]
    if kind not in (_GENERIC, _COMPOSED, _TIMED) or isinstance(kind, bool):
        raise node.error(f"the type {kind!r} is unknown; there are 1, 2 and 3")
    return int(kind)


class _Reader:
    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self.library = ActionLibrary(hand)
        self.imported = Imported()

    def take(self, key: Any, node: Node, stage: int | None) -> None:
        try:
            if stage is None:
                action: Action = self._primitive(key, node)
            elif stage == _TIMED:
                action = self._timed(str(key), node)
            elif stage == _COMPOSED:
                action = self._composed(str(key), node)
            else:
                action = generic(self.hand, str(key), self._counted(node, str(key)))
            self._add(action)
        except UserError as error:
            if error.path is not None:
                raise
            raise node.error(error.message) from None

    def _add(self, action: Action) -> None:
        self.library.add(action)
        self.imported.actions.append(action)

    def _note(self, text: str) -> None:
        self.imported.notes.append(text)

    # --- primitives

    def _primitive(self, key: Any, node: Node) -> Primitive:
        elements = tuple(map(str, key)) if isinstance(key, (tuple, list)) else (str(key),)
        name = self._need(node, "ActionName").string()
        base = normalise(name).rstrip("0123456789")
        kind = _KINDS.get(base)
        if kind is None:
            raise node.error(f"unknown primitive '{name}'; {suggestion(base, _KINDS)}")
        what = label(name, elements)
        if kind is PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS:
            self.hand.actuator(elements[0])
            fingers = self._fingers(self._need(node, "FingersInvolved").strings())
            values = self._joints(self._need(node, "JointPosFurther"), what, elements)
            postures = [full_posture(self.hand, {elements[0]: values[elements[0]]})]
        else:
            fingers = elements = self._fingers(elements)
            postures = self._states(node, what)
        return Primitive(kind, elements, tuple(postures), fingers=fingers)

    def _fingers(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the fingers of these names, or of fingertips' links of these names."""
        by_tip = {f.tip: f.name for f in self.hand.fingers if f.name not in names}
        return tuple(self.hand.finger(by_tip.get(name, name)).name for name in names)

    def _states(self, node: Node, what: str) -> list[Posture]:
        states = sorted(
            (int(key.removeprefix("ActionState_")), entry)
            for key, entry in node.entries().items()
            if key.startswith("ActionState_") and key[12:].isdecimal()
        )
        if not states:
            raise node.error(f"{what} has no ActionState_1")
        counts = self._need(node, "JointsInvolvedCount")
        return [self._posture(self._positions(state), counts, what) for _, state in states]

    def _positions(self, node: Node) -> Node:
        entries = node.entries()
        found = entries.get("JointPos") or entries.get("JointStates")
        if found is None:
            raise node.error(f"{node.what} lacks the key 'JointPos'")
        return found

    # --- custom actions

    def _counted(self, node: Node, what: str) -> dict[str, float]:
        counts = self._need(node, "JointsInvolvedCount")
        return _involved(self._posture(self._positions(node), counts, what))

    def _composed(self, name: str, node: Node) -> Action:
        set_points = self._counted(node, name)
        entries = node.entries()
        names = entries["InnerActionsNames"].strings() if "InnerActionsNames" in entries else ()
        fingers = entries["FingersInvolved"].strings() if "FingersInvolved" in entries else ()
        parts = find_parts(
            self.hand,
            [self._called(n) for n in sorted(names, key=names.index)],
            set_points,
            self._fingers(fingers),
        )
        if parts is None:
            self._note(
                f"'{name}' is imported as a generic action: its file names its parts "
                f"({', '.join(names)}) without elements and scales"
            )
            return generic(self.hand, name, set_points, description=f"made of {', '.join(names)}")
        flag = entries.get("Independent")
        return self.library.compose(name, parts, independent=bool(flag and flag.value))

    def _called(self, name: str) -> list[Action]:
        """Return the actions that the files call so."""
        base = normalise(name)
        kind = _KINDS.get(base.rstrip("0123456789"))
        return [
            action
            for action in self.library
            if (
                action.kind is kind
                if isinstance(action, Primitive)
                else normalise(action.name) == base
            )
        ]

    def _timed(self, name: str, node: Node) -> Timed:
        margins = self._need(node, "ActionsTimeMargins").entries()
        positions = self._need(node, "ActionsJointPos").entries()
        counts = self._need(node, "ActionsJointCount").entries()
        plans = []
        for item in self._need(node, "ActionsNamesOrdered").items():
            alias = item.string()
            if alias not in margins or alias not in positions or alias not in counts:
                raise item.error(f"the inner action '{alias}' has no margins, positions or counts")
            posture = self._posture(positions[alias], counts[alias], f"{name}, {alias}")
            before = self._need(margins[alias], "marginBefore").number(lowest=0.0)
            after = self._need(margins[alias], "marginAfter").number(lowest=0.0)
            use = self._use(name, alias, _involved(posture))
            plans.append(StepPlan(use, safe_name(alias, "step"), before, after))
        return self.library.sequence(name, plans)

    def _use(self, timed: str, alias: str, set_points: Mapping[str, float]) -> ActionReference:
        """Return the action of these set-points, the one called like the alias first."""
        for action in sorted(self.library, key=lambda a: normalise(a.name) != normalise(alias)):
            if isinstance(action, Timed):
                continue
            scale = scale_of(self.hand, action.posture, set_points)
            if scale is not None:
                elements = action.elements if isinstance(action, Primitive) else ()
                return ActionReference(action.name, elements, scale)
        made = generic(
            self.hand,
            safe_name(f"{timed}_{alias}"),
            set_points,
            description=f"inner action {alias} of {timed}",
        )
        self._add(made)
        self._note(
            f"'{made.name}' is made for the inner action '{alias}' of '{timed}': "
            "no imported action has its posture"
        )
        return ActionReference(made.name)

    # --- values

    def _need(self, node: Node, key: str) -> Node:
        found = node.entries().get(key)
        if found is None:
            raise node.error(f"{node.what} lacks the key '{key}'")
        return found

    def _posture(self, positions: Node, counts: Node, what: str) -> Posture:
        involved = {key for key, n in counts.entries().items() if n.number(lowest=0.0) > 0.0}
        values = self._joints(positions, what, involved)
        chosen = {name: value for name, value in values.items() if name in involved}
        return full_posture(self.hand, chosen)

    def _joints(self, node: Node, what: str, involved: Collection[str]) -> dict[str, float]:
        """Return positions [rad | m] by actuator, brought into the limits."""
        found: dict[str, float] = {}
        for name, entry in node.entries().items():
            if name not in self.hand.actuator_names:
                if name not in involved:
                    continue
                hint = suggestion(name, self.hand.actuator_names)
                raise entry.error(f"the hand has no actuator '{name}'; {hint}")
            value = entry.numbers(1)[0] if isinstance(entry.value, list) else entry.number()
            spec = self.hand.actuator(name)
            clamped = min(max(value, spec.lower), spec.upper)
            if name in involved and not math.isclose(clamped, value, abs_tol=SLACK):
                self._note(f"{what}: the set-point {value:g} of '{name}' is clamped to {clamped:g}")
            found[name] = clamped
        for name in involved:
            if name not in found:
                raise node.error(f"{node.what} lacks the involved actuator '{name}'")
        return found


def _involved(posture: Posture) -> dict[str, float]:
    return {name: posture.position[name] for name in posture.involved}
