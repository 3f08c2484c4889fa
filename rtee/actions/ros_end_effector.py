"""Import the action files of ROS End-Effector.

Its files hold, per action, a posture of all actuators (``JointPos``, a list per joint) and a count
per actuator, which is not 0 for involved ones. Primitives are keyed by their fingers (``[index,
thumb]``) or their joint and have several ``ActionState_N``; composed actions name their parts
without elements and scales; timed ones hold the postures of their inner actions. The parts of a
custom action are therefore found by comparing postures; if that fails, it becomes a generic action.

Older files name the links of fingertips instead of fingers. The oldest ones name neither their
primitive nor the involved actuators, and are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from msgspec import Meta

from rtee.actions.build import SLACK, StepPlan, full_posture, generic
from rtee.actions.documents import located, read_document
from rtee.actions.library import ActionLibrary
from rtee.actions.naming import label, normalise
from rtee.actions.types import Action, ActionReference, Posture, Primitive, PrimitiveKind, Timed
from rtee.errors import ActionError, suggestion
from rtee.hand.files import failing
from rtee.hand.model import Hand
from rtee.hand.names import safe_name
from rtee.hand.validation import Amount, Finite, checked
from rtee.hand.yamlfile import Location, YamlDocument
from rtee.types import from_rest

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


Names = tuple[str, ...]
Counts = dict[str, Amount]
"""Counts by name of the joint; 0 for joints that are not involved."""

Joints = dict[str, Any]
"""Positions by joint; those of joints that the hand does not have may be anything."""

_Positions = dict[str, Annotated[tuple[Finite, ...], Meta(min_length=1, max_length=1)] | Finite]


@dataclass(frozen=True, kw_only=True)
class _Named:
    ActionName: str


@dataclass(frozen=True, kw_only=True)
class _SingleJoint:
    FingersInvolved: Names
    JointPosFurther: Joints


@dataclass(frozen=True, kw_only=True)
class _Counted:
    JointsInvolvedCount: Counts


@dataclass(frozen=True, kw_only=True)
class _State:
    JointPos: Joints = field(default_factory=dict)
    JointStates: Joints = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class _Composed:
    InnerActionsNames: Names = ()
    FingersInvolved: Names = ()
    Independent: Any = False


@dataclass(frozen=True, kw_only=True)
class _Margins:
    marginBefore: Amount  # noqa: N815 - the key
    marginAfter: Amount  # noqa: N815


@dataclass(frozen=True, kw_only=True)
class _Timed:
    ActionsTimeMargins: dict[str, _Margins]
    ActionsJointPos: dict[str, Joints]
    ActionsJointCount: dict[str, Counts]
    ActionsNamesOrdered: Names


M = TypeVar("M")


@dataclass(frozen=True, slots=True)
class _Source:
    """An action in a file.

    Attributes:
        key: Name of the action, or the elements of a primitive.
        data: Content of the action.
        document: Document of the file.
    """

    key: Any
    data: dict[str, Any]
    document: YamlDocument

    def read(self, model: type[M], *at: str) -> M:
        """Return the content, or the part of it at a location, as a dataclass."""
        data: Any = self.data
        for part in at:
            data = data[part]
        return checked(model, self.document, ActionError, (self.key, *at), data)

    def joints(self, *at: str) -> tuple[Location, Joints]:
        """Return the location of a state's joint positions, and the positions."""
        state = self.read(_State, *at)
        if not (state.JointPos or state.JointStates):
            with located(self.document, (self.key, *at)):
                raise ActionError(f"'{(self.key, *at)[-1]}' lacks the key 'JointPos'")
        if state.JointPos:
            return (self.key, *at, "JointPos"), state.JointPos
        return (self.key, *at, "JointStates"), state.JointStates


@dataclass
class ImportedActions:
    """Result of an import from ROS End-Effector.

    Attributes:
        actions: The actions, parts before the actions that use them.
        files: Number of files read.
        notes: Sentences about content that could not be imported unchanged.
    """

    actions: list[Action] = field(default_factory=list)
    files: int = 0
    notes: list[str] = field(default_factory=list)


def import_folder(hand: Hand, folder: Path) -> ImportedActions:
    """Read all action files of ROS End-Effector in a folder and those below it.

    Raises:
        ActionError: if there are no files, the folder cannot be searched, or a file has a mistake;
            names file and line.
    """
    # A folder may vanish during the search, such as below /proc.
    with failing("cannot be searched", folder, ActionError):
        paths = sorted([*folder.rglob("*.yaml"), *folder.rglob("*.yml")])
    reader = _ActionReader(hand)
    entries: list[_Source] = []
    for path in paths:
        document = read_document(path)
        # The folder may also hold YAML files of other programs.
        if not isinstance(document.data, dict):
            continue
        entries += _entries(document)
        if _is_early(document.data):
            reader.imported.notes.append(f"{path} is left out: {_EARLY}")
    if not entries:
        why = f"; {_EARLY}" if reader.imported.notes else ""
        raise ActionError(f"holds no action files of ROS End-Effector{why}", path=folder)
    reader.imported.files = len({source.document.path for source in entries})
    # In this order, since parts are searched among the actions read before.
    for stage in (None, _GENERIC, _COMPOSED, _TIMED):
        for source in entries:
            with located(source.document, (source.key,)):
                if _type_of(source) == stage:
                    reader.add(source, stage)
    return reader.imported


def _entries(document: YamlDocument) -> list[_Source]:
    return [
        _Source(key, value, document)
        for key, value in document.data.items()
        if isinstance(value, dict) and ("PrimitiveType" in value or "Type" in value)
    ]


def _is_early(data: dict[str, Any]) -> bool:
    return any(
        isinstance(v, dict) and ("JointsInvolved" in v or "InvolvedJointsCount" in v)
        for v in (data, *data.values())
    )


def _type_of(source: _Source) -> int | None:
    if "PrimitiveType" in source.data:
        return None
    kind = source.data["Type"]
    # In Python, True equals 1.
    if kind not in (_GENERIC, _COMPOSED, _TIMED) or isinstance(kind, bool):
        raise ActionError(f"the type {kind!r} is unknown; it must be 1, 2 or 3")
    return int(kind)


class _ActionReader:
    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self.library = ActionLibrary(hand)
        self.imported = ImportedActions()

    def add(self, source: _Source, stage: int | None) -> None:
        name = str(source.key)
        if stage is None:
            self._add(self._primitive(source))
        elif stage == _TIMED:
            self._add(self._timed(name, source))
        elif stage == _COMPOSED:
            self._add(self._composed(name, source))
        else:
            self._add(generic(self.hand, name, self._counted(name, source)))

    def _add(self, action: Action) -> None:
        self.library.add(action)
        self.imported.actions.append(action)

    def _note(self, text: str) -> None:
        self.imported.notes.append(text)

    # --- primitives

    def _primitive(self, source: _Source) -> Primitive:
        key = source.key
        elements = tuple(map(str, key)) if isinstance(key, tuple) else (str(key),)
        name = source.read(_Named).ActionName
        base = normalise(name).rstrip("0123456789")
        kind = _KINDS.get(base)
        if kind is None:
            raise ActionError(f"unknown primitive '{name}'; {suggestion(base, _KINDS)}")
        what = label(name, elements)
        if kind.of_actuators:
            self.hand.actuator(elements[0])
            entry = source.read(_SingleJoint)
            fingers = self._fingers(entry.FingersInvolved)
            at = (key, "JointPosFurther")
            values = self._joints(source, at, entry.JointPosFurther, what, elements)
            postures = [full_posture(self.hand, {elements[0]: values[elements[0]]})]
        else:
            fingers = elements = self._fingers(elements)
            postures = self._states(source, what)
        return Primitive(kind, elements, tuple(postures), fingers=fingers)

    def _fingers(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the fingers with these names, or with tip links of these names."""
        # A finger that has its own entry is not also matched by the link of its tip.
        by_tip = {tip: name for tip, name in self.hand.tip_links.items() if name not in names}
        return tuple(self.hand.finger(by_tip.get(name, name)).name for name in names)

    def _states(self, source: _Source, what: str) -> list[Posture]:
        keys = [
            key
            for key in source.data
            if isinstance(key, str) and re.fullmatch("ActionState_[0-9]{1,9}", key)
        ]
        if not keys:
            raise ActionError(f"{what} has no ActionState_1")
        counts = source.read(_Counted).JointsInvolvedCount
        # By number, since the first one is executed and "10" sorts before "2".
        keys.sort(key=lambda key: int(key.removeprefix("ActionState_")))
        places = [source.joints(key) for key in keys]
        return [self._posture(source, *place, counts, what) for place in places]

    # --- custom actions

    def _counted(self, name: str, source: _Source) -> dict[str, float]:
        counts = source.read(_Counted).JointsInvolvedCount
        return _involved(self._posture(source, *source.joints(), counts, name))

    def _composed(self, name: str, source: _Source) -> Action:
        set_points = self._counted(name, source)
        entry = source.read(_Composed)
        names = entry.InnerActionsNames
        parts = find_parts(
            self.hand,
            # `find_parts` needs parts with the same candidates side by side.
            [self._called(n) for n in sorted(names, key=names.index)],
            set_points,
            self._fingers(entry.FingersInvolved),
        )
        if parts is None:
            self._note(
                f"'{name}' is imported as a generic action: its file names its parts "
                f"({', '.join(names)}) without elements and scales"
            )
            return generic(self.hand, name, set_points, description=f"made of {', '.join(names)}")
        return self.library.compose(name, parts, independent=bool(entry.Independent))

    def _called(self, name: str) -> list[Action]:
        """Return the imported actions of this name."""
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

    def _timed(self, name: str, source: _Source) -> Timed:
        entry = source.read(_Timed)
        margins, positions = entry.ActionsTimeMargins, entry.ActionsJointPos
        counts = entry.ActionsJointCount
        plans = []
        for i, alias in enumerate(entry.ActionsNamesOrdered):
            with located(source.document, (source.key, "ActionsNamesOrdered", i)):
                if alias not in margins or alias not in positions or alias not in counts:
                    raise ActionError(
                        f"the inner action '{alias}' has no margins, positions or counts"
                    )
            at = (source.key, "ActionsJointPos", alias)
            what = f"{name}, {alias}"
            posture = self._posture(source, at, positions[alias], counts[alias], what)
            use = self._use(name, alias, _involved(posture))
            before, after = margins[alias].marginBefore, margins[alias].marginAfter
            # Aliases of ROS End-Effector may have characters that rtee does not allow.
            plans.append(StepPlan(use, safe_name(alias, "step"), before, after))
        return self.library.sequence(name, plans)

    def _use(self, timed: str, alias: str, set_points: Mapping[str, float]) -> ActionReference:
        """Return the use of an action with these set-points; prefer one named like the alias."""
        for action in sorted(self.library, key=lambda a: normalise(a.name) != normalise(alias)):
            if isinstance(action, Timed):
                continue
            scale = scale_of(self.hand, action.posture, set_points)
            if scale is not None:
                return ActionReference(action.name, action.elements, scale)
        inner = generic(
            self.hand,
            safe_name(f"{timed}_{alias}"),
            set_points,
            description=f"inner action {alias} of {timed}",
        )
        self._add(inner)
        self._note(
            f"'{inner.name}' is made for the inner action '{alias}' of '{timed}': "
            "no imported action has its posture"
        )
        return ActionReference(inner.name)

    # --- values

    def _posture(
        self, source: _Source, at: Location, joints: Joints, counts: Counts, what: str
    ) -> Posture:
        involved = {name for name, count in counts.items() if count > 0.0}
        values = self._joints(source, at, joints, what, involved)
        chosen = {name: value for name, value in values.items() if name in involved}
        return full_posture(self.hand, chosen)

    def _joints(
        self, source: _Source, at: Location, joints: Joints, what: str, involved: Collection[str]
    ) -> dict[str, float]:
        """Return positions by actuator, clamped to the limits [rad | m]."""
        actuators = self.hand.actuator_names
        for name in joints:
            if name in involved and name not in actuators:
                with located(source.document, (*at, name)):
                    hint = suggestion(name, actuators)
                    raise ActionError(f"the hand has no actuator '{name}'; {hint}")
        # Joints that the hand does not have may have any values, even other than numbers.
        own = {name: value for name, value in joints.items() if name in actuators}
        values: dict[str, float] = {}
        for name, given in checked(_Positions, source.document, ActionError, at, own).items():
            value = given[0] if isinstance(given, tuple) else given
            spec = self.hand.actuator(name)
            clamped = min(max(value, spec.lower), spec.upper)
            if name in involved and not math.isclose(clamped, value, abs_tol=SLACK):
                self._note(f"{what}: the set-point {value:g} of '{name}' is clamped to {clamped:g}")
            values[name] = clamped
        for name in involved:
            if name not in values:
                with located(source.document, at):
                    raise ActionError(f"'{at[-1]}' lacks the involved actuator '{name}'")
        return values


def _involved(posture: Posture) -> dict[str, float]:
    return {name: posture.position[name] for name in posture.involved}


CLOSE: Final = 1e-4
"""Set-points no farther apart than this are the same [rad | m]."""


def scale_of(hand: Hand, posture: Posture, set_points: Mapping[str, float]) -> float | None:
    """Return the scale from rest at which a posture has set-points [rad | m], or ``None``."""
    if set(posture.involved) != set(set_points):
        return None
    rest = dict(zip(hand.actuator_names, hand.rest.tolist(), strict=True))
    whole = {name: posture.position[name] - rest[name] for name in set_points}
    # The rounding of stored set-points matters least for the longest travel.
    widest = max(whole, key=lambda name: abs(whole[name]))
    # The rest posture is the same at every scale.
    scale = 1.0
    if abs(whole[widest]) > SLACK:
        # Rounded, since the stored set-points are rounded, too.
        scale = round((set_points[widest] - rest[widest]) / whole[widest], 4)
    scaled = {name: from_rest(rest[name], posture.position[name], scale) for name in whole}
    close = all(abs(scaled[name] - set_points[name]) <= CLOSE for name in scaled)
    return scale if scale >= 0.0 and close else None


def find_parts(
    hand: Hand,
    choices: Sequence[Sequence[Action]],
    set_points: Mapping[str, float],
    fingers: Collection[str] = (),
    start: int = 0,
) -> list[ActionReference] | None:
    """Return actions with no actuator in common that together give these set-points, or ``None``.

    Args:
        hand: The hand.
        choices: Candidates for each part; parts with the same candidates are adjacent.
        set_points: Positions by actuator [rad | m].
        fingers: Fingers allowed in primitives; any if empty.
        start: First candidate for the first part.
    """
    if not choices:
        return None if set_points else []
    for i, action in enumerate(choices[0]):
        if i < start or isinstance(action, Timed):
            continue
        own = {n: set_points[n] for n in action.posture.involved if n in set_points}
        scale = scale_of(hand, action.posture, own)
        if scale is None or (fingers and not set(fingers).issuperset(action.fingers)):
            continue
        others = {name: value for name, value in set_points.items() if name not in own}
        # Parts with the same candidates give combinations instead of permutations.
        again = i + 1 if list(choices[1:2]) == [choices[0]] else 0
        more = find_parts(hand, choices[1:], others, fingers, again)
        if more is not None:
            return [ActionReference(action.name, action.elements, scale), *more]
    return None
