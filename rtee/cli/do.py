"""`rtee do`: execute a grasping action."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import (
    ConnectOption,
    JsonOption,
    RunningOption,
    WaitingCommand,
    WaitOption,
    complete_action,
    complete_element,
)
from rtee.types import Stage

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand
    from rtee.types import Result

app = typer.Typer()


@app.command(cls=WaitingCommand)
def do(
    action: Annotated[
        str,
        typer.Argument(
            metavar="ACTION",
            help="Name of an action, in any spelling.",
            autocompletion=complete_action,
        ),
    ],
    elements: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ELEMENT…",
            help="Fingers, or the actuator, of a primitive, in any order.",
            autocompletion=complete_element,
        ),
    ] = None,
    intensity: Annotated[
        float, typer.Option(help="0 (rest posture) to 1 (the action's posture).")
    ] = 1.0,
    effort: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PERCENT%|ACTUATOR=VALUE",
            help="Effort limit: 40% of the limits of all actuators, or of one by name, or a value "
            "[N·m | N]; may be repeated.",
        ),
    ] = None,
    speed: Annotated[float, typer.Option(help="Scale of the velocity limits, up to 1.")] = 1.0,
    tolerance: Annotated[float, typer.Option(help="Error norm that counts as reached.")] = 0.01,
    timeout: Annotated[
        float | None, typer.Option(metavar="S", help="Longest time it may take.")
    ] = None,
    stage: Annotated[Stage, typer.Option(help="How far a pinch goes.")] = Stage.BOTH,
    kind: Annotated[
        str | None, typer.Option(help="Kind of the action, where its name is not enough.")
    ] = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Execute a grasping action; Ctrl-C cancels it.

    Example: rtee do pinch_tight index thumb --intensity 0.6
    """
    from rtee.actions.cli_syntax import read_efforts
    from rtee.actions.naming import label
    from rtee.cli._online import result_json, sentence, with_hand
    from rtee.cli._progress import follow

    efforts = read_efforts(effort or [])
    chosen = tuple(elements or ())

    async def execute(remote: RemoteHand) -> Result:
        limits = dict(efforts.limits)
        for name, share in efforts.shares.items():
            limits |= await remote.effort_limits(share, only=[name])
        if efforts.share is not None:
            limits = await remote.effort_limits(efforts.share, besides=list(limits)) | limits
        running = await remote.start(
            action,
            *chosen,
            intensity=intensity,
            effort=limits,
            speed=speed,
            tolerance=tolerance,
            timeout=timeout,
            stage=stage,
            kind=kind,
        )
        return await follow(running, label(action, chosen))

    result = with_hand(hand, connect, "do", execute, wait=wait)
    print(result_json(result) if as_json else sentence(result, chosen))
    raise typer.Exit(0 if result.succeeded else 1)
