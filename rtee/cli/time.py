"""`rtee time`: define a timed action."""

from __future__ import annotations

from typing import Annotated

import typer

from rtee.cli._common import HandOption, actions_of
from rtee.cli._define import Description, Name, Replace, complete_part, store

app = typer.Typer()


@app.command()
def time(
    name: Name,
    steps: Annotated[
        list[str],
        typer.Argument(
            metavar="STEP…",
            help="ACTION[:ELEMENT,…][*SCALE][:before=SECONDS,after=SECONDS,alias=NAME]",
            autocompletion=complete_part,
        ),
    ],
    hand: HandOption = None,
    description: Description = "",
    replace: Replace = False,
) -> None:
    """Define a timed action.

    Example: rtee time wide openWide:after=0.5 grasp:before=0.2,alias=close
    """
    from rtee.actions.cli_syntax import read_step

    library = actions_of(hand)
    plans = [read_step(step) for step in steps]
    store(library, library.sequence(name, plans, description=description), replace)
