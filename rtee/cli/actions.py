"""`rtee actions`: the grasping actions of a hand."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import typer

from rtee.cli._common import Hand, JsonOption, actions_of

if TYPE_CHECKING:
    from rtee.actions.types import Action, ActionReference, Evidence

app = typer.Typer()


@app.command()
def actions(hand: Hand, as_json: JsonOption = False) -> None:
    """List the grasping actions of a hand."""
    from rtee.actions.describe import describe

    library = actions_of(hand)
    if as_json:
        print(json.dumps(describe(library.hand, library), indent=2))
        return
    _show(library.hand.name, list(library))


def _show(hand: str, found: list[Action]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if not found:
        print(f"{hand} has no actions yet; 'rtee extract {hand} --out …' finds its primitives")
        return
    table = Table(title=f"Grasping actions of {hand}", title_justify="left", box=box.SIMPLE)
    for column in ("action", "elements", "involves", "remarks"):
        table.add_column(column, overflow="fold", no_wrap=column in ("action", "device"))
    for action in found:
        table.add_row(*(Text(cell) for cell in _row(action)))
    Console().print(table)


def _row(action: Action) -> tuple[str, str, str, str]:
    from rtee.actions.types import Composed, Generic, Primitive

    match action:
        case Primitive():
            remark = remarks(action.evidence[0]) if action.evidence else ""
            involved = ", ".join(action.posture.involved)
            return action.name, ", ".join(action.elements), involved, remark
        case Composed():
            parts = " + ".join(_use(part) for part in action.parts)
            return action.name, "composed", ", ".join(action.posture.involved), parts
        case Generic():
            involved = ", ".join(action.posture.involved)
            return action.name, "generic", involved, action.description
    steps = ", then ".join(
        f"{_use(step.use)} ({step.before:g} s before, {step.after:g} s after)"
        for step in action.steps
    )
    names = dict.fromkeys(name for step in action.steps for name in step.posture.involved)
    return action.name, "timed", ", ".join(names), steps


def _use(use: ActionReference) -> str:
    from rtee.actions.naming import label

    scale = "" if use.scale == 1.0 else f" × {use.scale:g}"
    return label(use.action, use.elements) + scale


def remarks(evidence: Evidence) -> str:
    """Return the evidence of a posture in words."""
    said = []
    if evidence.depth > 0.0:
        said.append(f"depth {evidence.depth * 1e3:.2f} mm")
    elif evidence.distance > 0.0:
        said.append(f"distance {evidence.distance * 1e3:.2f} mm")
    if evidence.contact_at is not None:
        said.append(f"contact at {evidence.contact_at:.0%}")
    if not evidence.clear:
        said.append("not clear: " + ", ".join(" and ".join(p) for p in evidence.colliding))
    elif not evidence.path_clear:
        said.append("the way there is not clear")
    return ", ".join(said)
