"""`rtee actions`: the grasping actions of a hand."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import TYPE_CHECKING

from rtee.cli._common import Hand, JsonOption, actions_of, to_json
from rtee.cli._table import Column, Row, WideOption, on_terminal, prefix_to_drop, table_of

if TYPE_CHECKING:
    from rtee.actions.types import Action, ActionReference, Evidence, Primitive
    from rtee.hand.model import Hand as HandModel

_SHOWN = 3
"""Pairs of colliding links shown on a terminal, to keep a cell short; a pipe gets all."""


def actions(hand: Hand, wide: WideOption = False, as_json: JsonOption = False) -> None:
    """List the grasping actions of a hand."""
    from rtee.actions.describe import describe

    begun = time.perf_counter()
    library = actions_of(hand)
    if as_json:
        seconds = time.perf_counter() - begun
        print(to_json(describe(library.hand, library, seconds), indent=2))
        return
    _show(library.hand, list(library))


def _show(hand: HandModel, library: list[Action]) -> None:
    if not library:
        name = hand.name
        print(f"{name} has no actions yet; 'rtee extract {name} --save' finds its primitives")
        return
    prefix = prefix_to_drop(hand.actuator_names)
    title = f"Grasping actions of {hand.name}"
    if prefix:
        title += f"\n(names of actuators begin with {prefix})"
    columns = ("elements", Column("involves", whole=True), "remarks")
    rows = (_row(hand, action, prefix) for action in library)
    table_of(columns, rows, title, "action").show()


def _row(hand: HandModel, action: Action, prefix: str) -> Row:
    from rtee.actions.describe import abduction_sentence
    from rtee.actions.types import Primitive, Timed

    match action:
        case Primitive():
            elements = ", ".join(element.removeprefix(prefix) for element in action.elements)
            involved: Iterable[str] = action.posture.involved
            remark = abduction_sentence(hand, action, prefix)
            if action.evidence:
                remark = primitive_remarks(action, prefix)
        case Timed():
            elements = "timed"
            involved = dict.fromkeys(n for step in action.steps for n in step.posture.involved)
            remark = ", then ".join(
                f"{_use(step.use, prefix)} ({step.before:g} s before, {step.after:g} s after)"
                for step in action.steps
            )
        case _:
            elements, involved = str(action.action_kind), action.posture.involved
            remark = " + ".join(_use(use, prefix) for use in action.uses) or action.description
    names = "\n".join(name.removeprefix(prefix) for name in involved)
    return Row((elements, names, remark), action.name)


def _use(use: ActionReference, prefix: str) -> str:
    from rtee.actions.naming import label

    scale = "" if use.scale == 1.0 else f" × {use.scale:g}"
    return label(use.action, tuple(e.removeprefix(prefix) for e in use.elements)) + scale


def primitive_remarks(primitive: Primitive, prefix: str = "") -> str:
    """Return the evidence of a primitive's posture in words, and whether a deeper one exists."""
    from rtee.actions.describe import deeper_text

    lines = [remarks(primitive.evidence[0], prefix), deeper_text(primitive)]
    return "\n".join(line for line in lines if line)


def remarks(evidence: Evidence, prefix: str = "") -> str:
    """Return the evidence of a posture in words, one line per subject.

    Names of links are shown without the prefix.
    """
    from rtee.actions.describe import clearance_text

    lines = []
    if evidence.depth > 0.0:
        lines.append(f"depth {evidence.depth * 1e3:.2f} mm")
    elif evidence.distance > 0.0:
        lines.append(f"distance {evidence.distance * 1e3:.2f} mm")
    if evidence.contact_at is not None:
        lines.append(f"contact at {evidence.contact_at:.0%}")
    if not evidence.clear:
        pairs = [
            f"{a.removeprefix(prefix)} and {b.removeprefix(prefix)}" for a, b in evidence.colliding
        ]
        # "1 more" would take as much room as the pair itself.
        if on_terminal() and len(pairs) > _SHOWN + 1:
            pairs[_SHOWN:] = [f"{len(pairs) - _SHOWN} more"]
        lines.append("not clear: " + (", ".join(pairs) or "other links come too near"))
    else:
        if evidence.clearance is not None:
            lines.append(f"clearance {clearance_text(evidence.clearance)}")
        if not evidence.path_clear:
            lines.append("the way there is not clear")
    return "\n".join(lines)
