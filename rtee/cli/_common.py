"""What several commands share: the hand they are about, its actions, and shell completion."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from rtee.errors import ConfigError, RteeError

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary

HAND_VARIABLE = "RTEE_HAND"


def complete_hand(incomplete: str) -> list[str]:
    """Return the hands there are that begin like this."""
    from rtee.hand.catalog import hand_names

    try:
        return [name for name in hand_names() if name.startswith(incomplete)]
    except (RteeError, OSError):
        return []


def complete_action(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the actions of the hand in question that begin like this.

    A shell completes what was typed letter by letter, so ``pinch_t`` becomes ``pinch_tight`` and
    ``Pinch`` becomes ``PinchTight``.
    """
    from rtee.actions.naming import snake_case

    try:
        names = actions_of(_hand_asked(ctx)).names
    except (RteeError, OSError):
        return []
    spellings = ((name, snake_case(name)) for name in names)
    found = (next((s for s in both if s.startswith(incomplete)), None) for both in spellings)
    return [name for name in found if name is not None]


def complete_element(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the elements that go with the action and the elements typed so far."""
    typed = list(ctx.params.get("elements") or ())
    try:
        library = actions_of(_hand_asked(ctx))
        names = {primitive.name for primitive in library.all("primitive")}
        action = str(ctx.params.get("action") or "")
        found = library.all("primitive", action if action else None, typed)
        if not names or not found:
            return []
        there = {e for primitive in found for e in getattr(primitive, "elements", ())}
    except (RteeError, OSError):
        return []
    return sorted(e for e in there - set(typed) if e.startswith(incomplete))


def _hand_asked(ctx: typer.Context) -> str | None:
    asked = ctx.params.get("hand") or os.environ.get(HAND_VARIABLE)
    if asked:
        return str(asked)
    there = complete_running("")
    return there[0] if len(there) == 1 else None


def complete_running(incomplete: str) -> list[str]:
    """Return the hands that run on this computer and begin like this."""
    from rtee.remote.directory import running

    try:
        return [name for name in running() if name.startswith(incomplete)]
    except (RteeError, OSError):
        return []


Hand = Annotated[
    str,
    typer.Argument(
        metavar="HAND", help="Name of a hand, or its folder.", autocompletion=complete_hand
    ),
]
HandOption = Annotated[
    str | None,
    typer.Option(
        "--hand",
        envvar=HAND_VARIABLE,
        help="Name of a hand, or its folder; not needed where there is only one.",
        autocompletion=complete_hand,
    ),
]
RunningOption = Annotated[
    str | None,
    typer.Option(
        "--hand",
        envvar=HAND_VARIABLE,
        help="Name of a running hand; not needed where only one runs.",
        autocompletion=complete_running,
    ),
]
ConnectOption = Annotated[
    str | None,
    typer.Option(
        "--connect",
        envvar="RTEE_CONNECT",
        metavar="ENDPOINT",
        help="Where the hand runs, if elsewhere, such as tcp/robot:7447.",
    ),
]
WaitOption = Annotated[
    float | None,
    typer.Option(
        "--wait",
        min=0.0,
        metavar="[SECONDS]",
        help="Wait until the hand runs and its devices are active; 60 s unless given.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


class WaitingCommand(TyperCommand):
    """A command whose ``--wait`` may be given without its number of seconds."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the number in where it is left out."""
        from rtee.remote.monitoring import READY_WITHIN

        end = args.index("--") if "--" in args else len(args)
        for number in [i for i, word in enumerate(args[:end]) if word == "--wait"][::-1]:
            if number + 1 >= end or not _is_number(args[number + 1]):
                args = [*args[: number + 1], f"{READY_WITHIN:g}", *args[number + 1 :]]
        return super().parse_args(ctx, args)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def hand_folder(name: str | None) -> Path:
    """Return the folder of a hand given by name or path; of the only hand if none is given.

    Raises:
        ConfigError: if there is no such hand, or several and none is given.
    """
    from rtee.hand.catalog import hand_names
    from rtee.hand.load import hand_folder as find_folder

    if name is None:
        names = hand_names()
        if len(names) != 1:
            raise ConfigError(
                f"which hand? give --hand or set {HAND_VARIABLE}; there are: {', '.join(names)}"
            )
        name = names[0]
    return find_folder(name)[0]


def actions_of(name: str | None) -> ActionLibrary:
    """Return the stored actions of a hand; what is noteworthy about them is said on stderr.

    Raises:
        UserError: if the hand or one of its files cannot be used.
    """
    import logging

    from rtee.actions.library import ActionLibrary
    from rtee.hand.load import load_hand

    logging.basicConfig(format="rtee: warning: %(message)s")
    folder = hand_folder(name)
    return ActionLibrary.load(load_hand(folder), folder / "actions")


def report_copy(before: Path | None, after: Path | None) -> None:
    """Say in a line that a hand was copied to be changed, if it was.

    Args:
        before: The hand's folder, or that of its actions, as it was.
        after: The same now.
    """
    if before is None or after is None or before == after:
        return
    from rtee.hand.own_copy import told

    if before.name == after.name == "actions":
        before, after = before.parent, after.parent
    print(told(before, after), file=sys.stderr)
