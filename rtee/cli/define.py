"""`rtee compose`, `rtee time` and `rtee generic`: define an action."""

from __future__ import annotations

import dataclasses
import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import (
    HAND_VARIABLE,
    HandOption,
    actions_of,
    report_copy,
    spelled_like,
    with_hand,
)
from rtee.errors import ActionError, RteeError, UnknownAction

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.actions.types import CustomAction

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the new action.")]
Description = Annotated[str, typer.Option("--description", help="One sentence for people.")]
Replace = Annotated[
    bool,
    typer.Option("--replace", help="Replace an action of the same name; it keeps its description."),
]


def complete_part(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the uses of actions, such as ``trig:index``, that begin with the given text."""
    from rtee.actions.types import Timed

    parts = (
        (action.name, f":{','.join(action.elements)}" if action.elements else "")
        for action in _library(ctx) or ()
        if not isinstance(action, Timed)  # it cannot be a part of another action
    )
    return spelled_like(incomplete, parts)


def complete_set_point(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the actuators that begin with the given text, each followed by ``=``."""
    library = _library(ctx)
    names = library.hand.actuator_names if library else ()
    return [f"{name}=" for name in names if name.startswith(incomplete)]


def _library(ctx: typer.Context) -> ActionLibrary | None:
    name = ctx.params.get("hand") or os.environ.get(HAND_VARIABLE)
    try:
        return actions_of(str(name) if name else None)
    except (RteeError, OSError):
        return None


def compose(
    name: Name,
    parts: Annotated[list[str], typer.Argument(autocompletion=complete_part)],
    *,
    hand: HandOption = None,
    independent: bool = False,
    description: Description = "",
    replace: Replace = False,
) -> None:
    """Define a composed action.

    Example: rtee compose grasp trig:index trig:middle trig:thumb*0.3

    Arguments and options:
        parts (PART…): ACTION, ACTION:ELEMENT or ACTION:ELEMENT,ELEMENT, each *SCALE.
        independent: Refuse parts that share an actuator.
    """
    from rtee.actions.types import ActionReference

    library = actions_of(hand)
    uses = [ActionReference.of(part) for part in parts]
    action = library.compose(name, uses, independent=independent, description=description)
    store(library, action, replace)


def time(
    name: Name,
    steps: Annotated[list[str], typer.Argument(autocompletion=complete_part)],
    *,
    hand: HandOption = None,
    description: Description = "",
    replace: Replace = False,
) -> None:
    """Define a timed action.

    Example: rtee time wide openWide:after=0.5 grasp:before=0.2,alias=close

    Arguments and options:
        steps (STEP…): ACTION[:ELEMENT,…][*SCALE][:before=SECONDS,after=SECONDS,alias=NAME]
    """
    from rtee.actions.cli_syntax import read_step

    library = actions_of(hand)
    plans = [read_step(step) for step in steps]
    store(library, library.sequence(name, plans, description=description), replace)


def generic(
    name: Name,
    set_points: Annotated[list[str], typer.Argument(autocompletion=complete_set_point)],
    *,
    hand: HandOption = None,
    description: Description = "",
    replace: Replace = False,
) -> None:
    """Define a generic action.

    Example: rtee generic point index_proximal=0 middle_proximal=0.8

    Arguments and options:
        set_points (ACTUATOR=VALUE…): Set-points [rad | m]; other actuators do not move.
    """
    from rtee.actions.build import generic as make
    from rtee.actions.cli_syntax import read_set_points

    library = actions_of(hand)
    values = read_set_points(set_points)
    store(library, make(library.hand, name, values, description=description), replace)


def store(library: ActionLibrary, action: CustomAction, replace: bool) -> None:
    """Store a new action, confirm it on stdout and print warnings about it.

    An action without a description inherits that of the action it replaces. Raises `UserError` if
    the name is taken or the file cannot be written.
    """
    from rtee.actions.build import warnings_of

    if replace and not action.description:
        # Before adding, which replaces the file with the earlier description.
        action = dataclasses.replace(action, description=_description(library, action.name))
    # Adding may copy a shipped hand; the library then points to the copy.
    before = library.folder
    library.add(action, store=True, replace_same=replace)
    report_copy(before, library.folder)
    for warning in warnings_of(action):
        print(f"rtee: warning: {warning}", file=sys.stderr)
    print(f"'{action.name}' is now an action of {library.hand.name}")
    _note_missing_opening(library, action)
    _reload_running(library.hand.name, action.name)


def _note_missing_opening(library: ActionLibrary, action: CustomAction) -> None:
    """Print a note if the hand has tables of openings, but none for the new action."""
    from rtee.actions.types import Timed

    openings = library.openings
    if not openings.made or isinstance(action, Timed):
        return
    try:
        openings.of(action)
    except ActionError as error:
        print(f"note: {error}", file=sys.stderr)


def _description(library: ActionLibrary, name: str) -> str:
    from rtee.actions.types import Primitive

    with suppress(UnknownAction):
        action = library.find(name)
        return "" if isinstance(action, Primitive) else action.description
    return ""


def _reload_running(hand: str, action: str) -> None:
    """Make a running hand reload its actions, which it does whenever they are requested."""
    from rtee.remote.directory import hands_running

    try:
        if hand not in hands_running():
            return

        # Its own list decides, since a hand of this name may run from another folder.
        known = with_hand(hand, None, "define", lambda remote: remote.actions())
        if action not in {each.name for each in known}:
            raise RteeError(f"it runs from other files; end it, then type 'rtee run {hand}' here")
    except RteeError as error:
        print(f"rtee: warning: the running hand does not know it yet: {error}", file=sys.stderr)
