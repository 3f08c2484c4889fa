"""`rtee generic`: define a generic action."""

from __future__ import annotations

from typing import Annotated

import typer

from rtee.cli._common import HandOption, actions_of
from rtee.cli._define import Description, Name, Replace, complete_set_point, store

app = typer.Typer()


@app.command()
def generic(
    name: Name,
    set_points: Annotated[
        list[str],
        typer.Argument(
            metavar="ACTUATOR=VALUE…",
            help="Set-points [rad | m]; other actuators stay.",
            autocompletion=complete_set_point,
        ),
    ],
    hand: HandOption = None,
    description: Description = "",
    replace: Replace = False,
) -> None:
    """Define a generic action.

    Example: rtee generic point index_proximal=0 middle_proximal=0.8
    """
    from rtee.actions.build import generic as make
    from rtee.actions.cli_syntax import read_set_points

    library = actions_of(hand)
    values = read_set_points(set_points)
    store(library, make(library.hand, name, values, description=description), replace)
