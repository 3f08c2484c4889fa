"""`rtee compose`: define a composed action."""

from __future__ import annotations

from typing import Annotated

import typer

from rtee.cli._common import HandOption, actions_of
from rtee.cli._define import Description, Name, Replace, complete_part, store

app = typer.Typer()


@app.command()
def compose(
    name: Name,
    parts: Annotated[
        list[str],
        typer.Argument(
            metavar="PART…",
            help="ACTION, ACTION:ELEMENT or ACTION:ELEMENT,ELEMENT, each *SCALE.",
            autocompletion=complete_part,
        ),
    ],
    hand: HandOption = None,
    independent: Annotated[
        bool, typer.Option("--independent", help="Refuse parts that share an actuator.")
    ] = False,
    description: Description = "",
    replace: Replace = False,
) -> None:
    """Define a composed action.

    Example: rtee compose grasp trig:index trig:middle trig:thumb*0.3
    """
    from rtee.actions.cli_syntax import read_use

    library = actions_of(hand)
    uses = [read_use(part) for part in parts]
    action = library.compose(name, uses, independent=independent, description=description)
    store(library, action, replace)
