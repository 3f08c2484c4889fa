"""`rtee grasp` and `rtee touch`: hold an object of a width, or close until the first contact."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtee.cli._common import (
    ConnectOption,
    JsonOption,
    OnContactOption,
    RunningOption,
    TimeoutOption,
    WaitOption,
)
from rtee.cli._online import result_json, with_hand
from rtee.cli.do import follow
from rtee.remote.words import sentence
from rtee.types import Around, Outcome

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand
    from rtee.types import Result


def grasp(
    width: Annotated[
        str, typer.Option(metavar="LENGTH", help="Width of the object, such as 30mm, 3cm or 0.03.")
    ],
    fingers: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FINGER…", help="Fingers to hold it with; the hand's best action unless given."
        ),
    ] = None,
    force: Annotated[
        str | None, typer.Option(metavar="FORCE", help="Force to hold it with, such as 10N.")
    ] = None,
    speed: Annotated[
        str | None,
        typer.Option(metavar="SPEED", help="Speed of opening and closing, such as 50mm/s."),
    ] = None,
    narrower: Annotated[
        str, typer.Option(metavar="LENGTH", help="It may be held at less than its width by this.")
    ] = "5mm",
    wider: Annotated[
        str, typer.Option(metavar="LENGTH", help="It may be held at more than its width by this.")
    ] = "5mm",
    action: Annotated[
        str, typer.Option(help="The action to close with, instead of the best one.")
    ] = "",
    timeout: TimeoutOption = None,
    on_contact: OnContactOption = None,
    max_force: Annotated[
        str | None,
        typer.Option(metavar="FORCE", help="Force up to which a slip raises --force."),
    ] = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Open wider than an object, close on it, and keep a force; Ctrl-C cancels it.

    Exit status 1 when nothing of that width is held.

    Example: rtee grasp --width 30mm --force 10N index thumb
    """
    from rtee.actions.cli_syntax import read_on_contact
    from rtee.remote.goal_values import grasp_goal

    options: dict[str, Any] = {"on_contact": read_on_contact(on_contact or [])}
    goal = grasp_goal(
        width,
        force=force,
        tip_speed=speed,
        fingers=fingers,
        width_tolerance=(narrower, wider),
        action=action,
        timeout=timeout,
        max_force=max_force,
        **options,
    )
    asked = goal.to if isinstance(goal.to, Around) else Around(math.nan)

    async def execute(remote: RemoteHand) -> Result:
        return await follow(remote.start_goal(goal), f"grasp {asked.width * 1e3:g} mm")

    result = with_hand(hand, connect, "grasp", execute, wait=wait)
    if as_json:
        print(result_json(result))
    else:
        print(sentence(result, result.elements))
        # The exit status alone would not say why it is a failure.
        if result.outcome is Outcome.WRONG_WIDTH:
            least, most = (1e3 * (asked.width + by) for by in (-asked.narrower, asked.wider))
            print(f"what is held is not {max(least, 0.0):g} to {most:g} mm wide, as asked")
    raise typer.Exit(0 if result.succeeded else 1)


def touch(
    fingers: Annotated[
        list[str] | None,
        typer.Argument(metavar="FINGER…", help="Fingers to close; as many as possible by default."),
    ] = None,
    action: Annotated[str, typer.Option(help="The action to close with.")] = "",
    speed: Annotated[
        str | None, typer.Option(metavar="SPEED", help="Speed of closing; 10mm/s by default.")
    ] = None,
    timeout: TimeoutOption = None,
    hand: RunningOption = None,
    connect: ConnectOption = None,
    wait: WaitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Close slowly until a finger touches something, and stop there; Ctrl-C cancels it.

    Exit status 1 when nothing was touched.

    Example: rtee touch index thumb
    """
    from rtee.remote.goal_values import touch_goal

    goal = touch_goal(fingers=fingers, action=action, tip_speed=speed, timeout=timeout)

    async def execute(remote: RemoteHand) -> Result:
        return await follow(remote.start_goal(goal), "touch")

    result = with_hand(hand, connect, "touch", execute, wait=wait)
    if as_json:
        print(result_json(result))
    else:
        print(sentence(result, result.elements))
        # A goal that was ended has an outcome of its own, and touched nothing all the same.
        if not result.touched and result.outcome is not Outcome.EMPTY:
            print("nothing was touched")
    raise typer.Exit(0 if result.succeeded else 1)
