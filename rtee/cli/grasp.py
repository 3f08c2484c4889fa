"""`rtee grasp` and `rtee touch`: hold an object of a width, or close until the first contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

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
from rtee.types import Outcome

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
    from rtee.units import FORCE, LENGTH, SPEED, quantity

    words = read_on_contact(on_contact or [])
    wanted = quantity(width, LENGTH, "width")
    newtons = None if force is None else quantity(force, FORCE, "force")
    fast = None if speed is None else quantity(speed, SPEED, "speed")
    within = quantity(narrower, LENGTH, "tolerance"), quantity(wider, LENGTH, "tolerance")

    async def execute(remote: RemoteHand) -> Result:
        start = remote.start_grasp(
            wanted,
            newtons,
            fast,
            fingers,
            within,
            action=action,
            timeout=timeout,
            on_contact=words,
            max_force=max_force,
        )
        return await follow(start, f"grasp {wanted * 1e3:g} mm")

    result = with_hand(hand, connect, "grasp", execute, wait=wait)
    if as_json:
        print(result_json(result))
    else:
        print(sentence(result, result.elements))
        # The exit status alone would not say why it is a failure.
        if result.outcome is Outcome.WRONG_WIDTH:
            least, most = (1e3 * (wanted + each) for each in (-within[0], within[1]))
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

    async def execute(remote: RemoteHand) -> Result:
        start = remote.start_touch(fingers, action=action, speed=speed, timeout=timeout)
        return await follow(start, "touch")

    result = with_hand(hand, connect, "touch", execute, wait=wait)
    if as_json:
        print(result_json(result))
    else:
        print(sentence(result, result.elements))
        # A goal that was ended has an outcome of its own, and touched nothing all the same.
        if not result.touched and result.outcome is not Outcome.EMPTY:
            print("nothing was touched")
    raise typer.Exit(0 if result.succeeded else 1)
