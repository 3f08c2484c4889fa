"""Make goals from the options of a call: check them, and convert them to SI units."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, Literal, TypedDict, TypeVar, Unpack

from rtee.actions.types import ActionKind, ActionReference
from rtee.errors import ActionError, GoalRejected, suggestion
from rtee.hand.names import listed
from rtee.messages.goals import goal_of
from rtee.types import Goal, OnContact, Stage
from rtee.units import FORCE, LENGTH, SHARE, SPEED, TIME, quantity
from rtee.values import number

F = TypeVar("F", bound=Callable[..., Any])

Reaction = OnContact | Literal["stop", "hold", "squeeze"]

OnContactWords = Mapping[str, Reaction] | Reaction
"""One reaction for all fingers, or reactions by finger, with "" for all others."""

StageWord = Stage | Literal["both", "pre_grasp", "grasp"]

KindWord = ActionKind | Literal["primitive", "composed", "timed", "generic"]


class GoalOptions(TypedDict, total=False):
    """Options of a goal that names an action.

    Attributes:
        intensity: 0 (rest) to 1 (the action's posture); or a string such as ``60%``.
        effort: Effort limit by actuator [N·m | N]; or one share of the limit of every actuator,
            above 0 up to 1, such as ``40%``.
        tolerance: Norm of the error at which the goal counts as reached [rad | m].
        speed: Share of the velocity limits, above 0 up to 1.
        timeout: Longest time the goal may take [s]; by default as configured for the hand.
        stage: Stages of a pinch: ``both``, ``pre_grasp`` or ``grasp``.
        kind: Kind of the action, where its name is ambiguous.
        opening: Target opening of the fingertips, instead of an intensity [m]; or such as ``40mm``.
        force: Force between the fingertips, with an opening [N].
        tip_speed: Speed at which the opening changes, instead of ``speed`` [m/s].
        on_contact: Reaction of fingers to a contact: ``stop``, ``hold`` or ``squeeze``; or
            reactions by finger, "" for all others. By default as configured for the hand.
        max_force: Force up to which slips raise ``force`` [N].
    """

    intensity: float | str
    effort: Mapping[str, float] | float | str | None
    tolerance: float
    speed: float | str
    timeout: float | str | None
    stage: StageWord
    kind: KindWord | None
    opening: float | str | None
    force: float | str | None
    tip_speed: float | str | None
    on_contact: OnContactWords | None
    max_force: float | str | None


class GraspOptions(TypedDict, total=False):
    """Options of a grasp of an object.

    Attributes:
        force: Force between the fingertips [N]; by default as the effort limits allow.
        tip_speed: Speed at which the opening changes [m/s]; by default as fast as the hand can.
        fingers: The fingers that hold the object; by default those of the hand's best action for
            that width.
        width_tolerance: How much narrower and wider than the width the object may be held [m].
        action: The action to close with, instead of the best one.
        timeout: Longest time the goal may take [s]; by default as configured for the hand.
        on_contact: Reaction of fingers to a contact: with ``squeeze`` they wait until enough of
            them touch, so that a light object is not pushed away; see `GoalOptions`.
        max_force: Force up to which slips raise ``force`` [N]; by default they do not.
    """

    force: float | str | None
    tip_speed: float | str | None
    fingers: Sequence[str] | None
    width_tolerance: tuple[float | str, float | str]
    action: ActionReference | str
    timeout: float | str | None
    on_contact: OnContactWords | None
    max_force: float | str | None


class TouchOptions(TypedDict, total=False):
    """Options of a touch.

    Attributes:
        fingers: The fingers to close; by default those of the action with the most fingers.
        action: The action to close with, instead of the fingers' own.
        tip_speed: Speed at which the opening closes [m/s]; 10 mm/s by default.
        timeout: Longest time the goal may take [s]; by default as configured for the hand.
    """

    fingers: Sequence[str] | None
    action: ActionReference | str
    tip_speed: float | str | None
    timeout: float | str | None


_DEFAULTS: Final = {
    "intensity": 1.0,
    "tolerance": 0.01,
    "speed": 1.0,
    "stage": "both",
    "width_tolerance": (0.005, 0.005),
    "action": "",
}
"""Defaults that a signature shows; those of all other options are ``None``."""


def spelled_out(method: F) -> F:
    """Give a method with ``**options: Unpack[…]`` the signature and the help of all options."""
    signature = inspect.signature(method)
    *given, last = signature.parameters.values()
    kind: Any = globals()[str(last.annotation).removeprefix("Unpack[").removesuffix("]")]
    options = [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=_DEFAULTS.get(name),
            annotation=annotation.__forward_arg__,
        )
        for name, annotation in kind.__annotations__.items()
    ]
    shown: Any = method
    shown.__signature__ = signature.replace(parameters=[*given, *options])
    _, _, told = str(inspect.getdoc(kind)).partition("Attributes:\n")
    method.__doc__ = f"{inspect.cleandoc(str(method.__doc__))}\n\nOptions:\n{told}"
    return method


_QUANTITIES: Final[Mapping[str, tuple[Mapping[str, float], str]]] = {
    "intensity": (SHARE, "intensity"),
    "speed": (SHARE, "speed"),
    "opening": (LENGTH, "opening"),
    "force": (FORCE, "force"),
    "tip_speed": (SPEED, "speed"),
    "max_force": (FORCE, "largest force"),
    "timeout": (TIME, "timeout"),
}
"""Units and names, for people, of the options that may have units."""

_MOST_READ: Final = 128
"""Most texts of actions that are remembered: a program uses fewer."""

_ALWAYS: Final = ("intensity", "speed")
"""Those of them that every goal has: ``None`` is not a valid value."""


def finite(value: object, what: str) -> float:
    """Return a finite number; raises `GoalRejected` for anything else."""
    plain = number(value)
    if plain is None or not math.isfinite(plain):
        raise GoalRejected(f"the {what} must be a finite number, not {value!r:.100}")
    return plain


def numbers(values: object, what: str) -> dict[str, float]:
    """Return numbers by name; raises `GoalRejected` that names any other value."""
    if not isinstance(values, Mapping):
        raise GoalRejected(
            f"give each {what} by name, such as {{'thumb': 0.4}}, not {values!r:.100}"
        )
    if wrong := [name for name in values if not isinstance(name, str)]:
        raise GoalRejected(f"give each {what} by name, as text, not {wrong[0]!r:.100}")
    return {name: finite(value, f"{what} '{name}'") for name, value in values.items()}


def share_of(effort: object) -> float | None:
    """Return the effort if it is one share of all limits; ``None`` if unset or by actuator.

    `shares` checks its range.
    """
    if effort is None or isinstance(effort, Mapping):
        return None
    if (plain := number(effort)) is not None:
        return plain
    try:
        return quantity(effort, SHARE, "effort")  # type: ignore[arg-type]
    except GoalRejected:
        raise GoalRejected(
            "the effort must be a share of all limits, such as 0.4 or 40%, or a number for each "
            f"actuator, not {effort!r:.100}"
        ) from None


def shares(
    limits: Mapping[str, float],
    share: float | str,
    only: Collection[str] | None = None,
    besides: Collection[str] = (),
) -> dict[str, float]:
    """Return a share of effort limits [N·m | N], of some actuators; raises `GoalRejected`."""
    # The range of a number is checked below.
    plain = number(share)
    share = quantity(share, SHARE, "effort") if plain is None else plain
    if not 0.0 < share <= 1.0:
        raise GoalRejected(
            f"an effort for all actuators must be a share of their limits, above 0 and at most 1 "
            f"(100 %), not {share:g}"
        )
    besides = listed(besides, "actuators to leave out", GoalRejected)
    given = limits if only is None else listed(only, "actuators", GoalRejected)
    chosen = [name for name in given if name not in besides]
    for name in chosen:
        if name not in limits:
            raise GoalRejected(
                f"effort for an unknown actuator '{name}'; {suggestion(name, limits)}"
            )
        if not math.isfinite(limits[name]):
            raise GoalRejected(
                f"'{name}' has no effort limit, so a share means nothing; give a limit under "
                "'limits' "
                "in hand.yaml, or its effort by name"
            )
    return {name: share * limits[name] for name in chosen}


def complete(goal: Goal) -> Goal:
    """Return a goal; raises `GoalRejected` for anything else, such as the name of an action."""
    if not isinstance(goal, Goal):
        raise GoalRejected(
            f"a complete goal is a Goal(…), not {goal!r:.100}; 'do' and 'start' take names"
        )
    return goal


@spelled_out
def action_goal(
    action: ActionReference | str, *elements: str, **options: Unpack[GoalOptions]
) -> Goal:
    """Return the goal to do an action; the effort is unset or given by actuator.

    Args:
        action: Its name, or the name with elements and scale, such as ``trig:ring*0.8``.
        elements: Fingers or actuator of a primitive.
        options: See below.

    Raises:
        GoalRejected: if a value is invalid; the hand checks what it can do.
    """
    return goal_by(action, elements, options)


def goal_by(
    action: ActionReference | str,
    elements: tuple[str, ...],
    options: GoalOptions,
    client: str = "",
) -> Goal:
    """Return the goal of a client to do an action; see `action_goal`."""
    _check_known(options, GoalOptions)
    use = _use(action, elements) if action else ActionReference("", _names(elements))
    values = _translated(options)
    if use.scale != 1.0:
        values["intensity"] = use.scale * values.get("intensity", 1.0)
    if "tolerance" in values:
        values["tolerance"] = finite(values["tolerance"], "tolerance")
    if values.get("effort") is not None:
        values["effort"] = numbers(values["effort"], "effort limit")
    return goal_of(use.action, use.elements, client=client, **values)


@spelled_out
def grasp_goal(width: float | str, **options: Unpack[GraspOptions]) -> Goal:
    """Return the goal to grasp an object of a width; see `rtee.RemoteHand.grasp`.

    Args:
        width: Width of the object [m]; or a string such as ``30mm``.
        options: See below.

    Raises:
        GoalRejected: if a value is invalid; the hand checks what it can do.
    """
    _check_known(options, GraspOptions)
    values = _translated(options)
    narrower, wider = _tolerances(values.pop("width_tolerance", _DEFAULTS["width_tolerance"]))
    use = _closing(values)
    return goal_of(
        use.action,
        use.elements,
        grasp=True,
        opening=quantity(width, LENGTH, "width"),
        narrower=narrower,
        wider=wider,
        **values,
    )


def opening_goal(
    opening: float | str, fingers: Sequence[str] | None = None, tip_speed: float | str | None = None
) -> Goal:
    """Return the goal to bring fingertips to an opening [m]; raises `GoalRejected`."""
    values = _translated({"opening": opening, "tip_speed": tip_speed})
    return goal_of("", _names(fingers), **values)


@spelled_out
def touch_goal(**options: Unpack[TouchOptions]) -> Goal:
    """Return the goal to close until a first contact; see `rtee.RemoteHand.touch`.

    Args:
        options: See below.

    Raises:
        GoalRejected: if a value is invalid; the hand checks what it can do.
    """
    _check_known(options, TouchOptions)
    values = _translated(options)
    use = _closing(values)
    return goal_of(use.action, use.elements, touch=True, **values)


def _check_known(options: Mapping[str, Any], kind: Any) -> None:
    known = kind.__annotations__
    if not options.keys() <= known.keys():
        unknown = next(name for name in options if name not in known)
        raise GoalRejected(
            f"unknown option '{unknown}' of a goal; {suggestion(unknown, known)}",
            option=unknown,
            given=unknown,
            valid=known,
        )


def _use(action: object, elements: Sequence[str]) -> ActionReference:
    for name in elements:
        if not isinstance(name, str):
            raise GoalRejected(
                f"an action and its elements must be names, one argument each, not {name!r:.100}"
            )
    try:
        if isinstance(action, str):
            return _read(action, tuple(elements))
        return ActionReference.of(action, elements)  # type: ignore[arg-type]
    except ActionError as error:
        raise GoalRejected(error.message) from None


_read = lru_cache(_MOST_READ)(ActionReference.of)


def _closing(values: dict[str, Any]) -> ActionReference:
    """Remove the fingers and the action from options, and return them."""
    fingers, action = _names(values.pop("fingers", None)), values.pop("action", "")
    return _use(action, fingers) if action else ActionReference("", fingers)


def _names(fingers: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of fingers; raises `GoalRejected` unless they are strings in a list."""
    return listed(() if fingers is None else fingers, "fingers", GoalRejected)


def _tolerances(pair: object) -> tuple[float, float]:
    """Return how much narrower and wider a width may be [m]; raises `GoalRejected`."""
    if isinstance(pair, str) or not isinstance(pair, Sequence) or len(pair) != 2:
        raise GoalRejected(
            f"the tolerance must be two lengths, narrower and wider, such as ('5mm', '5mm'), "
            f"not {pair!r:.100}"
        )
    narrower, wider = (quantity(each, LENGTH, "tolerance") for each in pair)
    return narrower, wider


def _translated(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with quantities in SI units and words as members of enumerations.

    The hand checks whether the number is possible, since it knows its limits.
    """
    values = dict(options)
    for name, value in options.items():
        if (how := _QUANTITIES.get(name)) and (value is not None or name in _ALWAYS):
            plain = None if how[0] is LENGTH else number(value)
            values[name] = quantity(value, *how) if plain is None else plain
    if "stage" in values:
        values["stage"] = word_of(values["stage"], Stage, "stage")
    if values.get("kind"):
        values["kind"] = str(word_of(values["kind"], ActionKind, "kind"))
    if given := values.pop("on_contact", None):
        words = given if isinstance(given, Mapping) else {"": given}
        if wrong := [finger for finger in words if not isinstance(finger, str)]:
            raise GoalRejected(f"give on_contact by the name of a finger, not {wrong[0]!r:.100}")
        values["on_contact"] = {
            f: word_of(word, OnContact, "on_contact") for f, word in words.items()
        }
    return values


W = TypeVar("W", Stage, OnContact, ActionKind)


def word_of(word: Any, kind: type[W], what: str) -> W:
    """Return the member of an enumeration that a word names; raises `GoalRejected`."""
    try:
        return kind(word)
    except ValueError:
        raise GoalRejected(
            f"unknown {what} '{word}'; {suggestion(str(word), kind)}",
            option=what,
            given=str(word),
            valid=list(kind),
        ) from None
