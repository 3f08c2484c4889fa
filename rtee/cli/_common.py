"""Options that several commands share, their shell completion, and how commands are made."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from rtee.errors import ConfigError, RteeError

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary

HAND_VARIABLE = "RTEE_HAND"


def complete_hand(incomplete: str) -> list[str]:
    """Return the configured hands that begin with the given text."""
    from rtee.hand.catalog import hand_names

    try:
        return [name for name in hand_names() if name.startswith(incomplete)]
    # Completions say nothing of errors: the text would get into the line that is being typed.
    except (RteeError, OSError):
        return []


def complete_action(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the actions of the chosen hand that begin with the given text.

    Names are completed in the spelling that was begun: ``pinch_t`` becomes ``pinch_tight``, and
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
    """Return the elements that fit the action and the elements typed so far."""
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
    there = complete_running("")  # as the command itself: the only one that runs
    return there[0] if len(there) == 1 else None


def complete_running(incomplete: str) -> list[str]:
    """Return the hands running on this computer that begin with the given text."""
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
OnContactOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="WORD|FINGER=WORD",
        help="What fingers do when they touch something: stop, hold or squeeze; may be repeated.",
    ),
]
EffortOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PERCENT%|ACTUATOR=VALUE",
        help="Effort limit: 40% of the limits of all actuators, or of one by name, or a value "
        "[N·m | N]; may be repeated.",
    ),
]
XacroArguments = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[NAME:=VALUE]...", help="Arguments of the xacro file that --urdf names."
    ),
]
# The run that has started this command: it ends with it, also when that is killed.
BesideOption = Annotated[int | None, typer.Option(metavar="PID", hidden=True)]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


class _Command(TyperCommand):
    """A command whose numbers are finite, and whose option ``--wait`` needs no number."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, and refuse what no range of an option refuses: not a number."""
        rest = super().parse_args(ctx, self._with_wait(args))
        for option in self.params:
            value = ctx.params.get(option.name)
            for each in value if isinstance(value, list | tuple) else (value,):
                if isinstance(each, float) and not math.isfinite(each):
                    raise typer.BadParameter("should be a finite number", ctx=ctx, param=option)
        return rest

    def _with_wait(self, args: list[str]) -> list[str]:
        """Return the arguments with the number of seconds where it is missing."""
        if "--wait" not in args or all(option.name != "wait" for option in self.params):
            return args
        from rtee.remote.monitoring import READY_WITHIN

        # Words after -- are arguments, even if they look like the option.
        end = args.index("--") if "--" in args else len(args)
        # From the end, so that an insertion does not shift what is still to be looked at.
        for number in [i for i, word in enumerate(args[:end]) if word == "--wait"][::-1]:
            if number + 1 >= end or not _is_number(args[number + 1]):
                args = [*args[: number + 1], f"{READY_WITHIN:g}", *args[number + 1 :]]
        return args


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def app_of(command: Callable[..., None] | typer.Typer) -> typer.Typer:
    """Return the typer app of a command, given as a function or as a group of commands."""
    app = command
    if not isinstance(app, typer.Typer):
        app = typer.Typer()
        app.command()(command)
    for made in app.registered_commands:
        # Here, since it has to hold for commands of groups, too.
        made.cls = _Command
    app._add_completion = False  # noqa: SLF001 - only `rtee` itself installs it
    # With rich's own markup, units in brackets would be taken for tags and vanish.
    app.rich_markup_mode = "markdown"
    return app


_FILES = 64
"""Files that a program on the network may need at once; a hand has some 25."""


def check_files() -> None:
    """Check that enough files may be open, as the network's library panics where they are not.

    Raises:
        ConfigError: if the shell's limit is too low.
    """
    import resource

    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    # Without a limit it is -1, which would look like too few.
    if limit != resource.RLIM_INFINITY and limit < _FILES:
        raise ConfigError(
            f"only {limit} files may be open at once; raise the limit with 'ulimit -n 1024'"
        )


def named_values(words: Sequence[str], option: str, what: str) -> dict[str, Any]:
    """Return the values given as NAME=VALUE, read as in YAML.

    Args:
        words: The texts.
        option: The option that they were given with.
        what: What a value is, for error messages.

    Raises:
        ConfigError: if a text has no name, or its value is not YAML.
    """
    from rtee.hand.yamlfile import parse_yaml

    found: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not (name and equals):
            raise ConfigError(f"{option} {word}: should be NAME=VALUE")
        # Where messages name the file, they name the option.
        found |= parse_yaml(f"{name}: {text}\n", Path(option), what).data
    return found


def hand_folder(name: str | None) -> Path:
    """Return the folder of a hand given by name or path; without one, of the only hand.

    Raises:
        ConfigError: if there is no such hand, or there are several and none is given.
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
    """Return the stored actions of a hand; warnings about them go to stderr.

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
    """Print a line if a hand was copied in order to be changed.

    Args:
        before: Folder of the hand, or of its actions, before the change.
        after: The same folder after it.
    """
    if before is None or after is None or before == after:
        return
    from rtee.hand.own_copy import copy_notice

    # A library knows the folder of its actions only; people know the hand's.
    if before.name == after.name == "actions":
        before, after = before.parent, after.parent
    print(copy_notice(before, after), file=sys.stderr)
