"""What the commands share that define an action."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.actions.types import Action

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the new action.")]
Description = Annotated[str, typer.Option("--description", help="One sentence for people.")]
Replace = Annotated[bool, typer.Option("--replace", help="Replace an action of the same name.")]


def store(library: ActionLibrary, action: Action, replace: bool) -> None:
    """Store a new action, and say what was done and what is noteworthy about it.

    Raises:
        UserError: if the name is taken or the file cannot be written.
    """
    from rtee.actions.build import warnings_of

    library.add(action, store=True, replace_same=replace)
    for warning in warnings_of(action):
        print(f"rtee: warning: {warning}", file=sys.stderr)
    print(f"'{action.name}' is now an action of {library.hand.name}")
