"""Options that several commands share, their shell completion, and the making of typer apps."""

from __future__ import annotations

import contextlib
import copy
import inspect
import json
import math
import os
import re
import sys
import textwrap
from collections.abc import Callable, Coroutine, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_type_hints

import typer
from typer.core import TyperCommand

from rtee import monotonic
from rtee.errors import ConfigError, RteeError
from rtee.hand.catalog import hand_names
from rtee.hand.yamlfile import parse_yaml
from rtee.units import AngleUnit

if TYPE_CHECKING:
    from rtee.actions.cli_syntax import Efforts
    from rtee.actions.library import ActionLibrary
    from rtee.remote.client import RemoteHand


HAND_VARIABLE = "RTEE_HAND"
"""Environment variable that names the hand where no option does."""

_CONNECT = "RTEE_CONNECT"
"""Environment variable with the endpoint of a hand elsewhere."""


def complete_hand(incomplete: str) -> list[str]:
    """Return the configured hands that begin with the given text."""
    try:
        return [name for name in hand_names() if name.startswith(incomplete)]
    # Completion keeps silent about errors: a message would land in the line that is being typed.
    except (RteeError, OSError):
        return []


def complete_action(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the actions of the chosen hand that begin with the given text."""
    try:
        names = actions_of(_chosen_hand(ctx)).names
    except (RteeError, OSError):
        return []
    return spelled_like(incomplete, ((name, "") for name in names))


def spelled_like(incomplete: str, names: Iterable[tuple[str, str]]) -> list[str]:
    """Return the completions of a text in the spelling that the user began.

    ``pinch_t`` becomes ``pinch_tight``, and ``Pinch`` becomes ``PinchTight``. ``names`` has each
    action's name and the text that follows it.
    """
    from rtee.actions.naming import snake_case

    both = ((name + suffix, snake_case(name) + suffix) for name, suffix in names)
    matches = (next((s for s in pair if s.startswith(incomplete)), "") for pair in both)
    return [match for match in matches if match]


def complete_element(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the elements that fit the action and the elements typed so far."""
    typed = list(ctx.params.get("elements") or ())
    try:
        library = actions_of(_chosen_hand(ctx))
        primitives = library.all("primitive", str(ctx.params.get("action") or "") or None, typed)
    except (RteeError, OSError):
        return []
    elements = {e for primitive in primitives for e in getattr(primitive, "elements", ())}
    return sorted(e for e in elements - set(typed) if e.startswith(incomplete))


def _chosen_hand(ctx: typer.Context) -> str | None:
    chosen = ctx.params.get("hand") or os.environ.get(HAND_VARIABLE)
    if chosen:
        return str(chosen)
    names = complete_running("")  # like the command itself, take the only hand that runs
    return names[0] if len(names) == 1 else None


def complete_running(incomplete: str) -> list[str]:
    """Return the hands on this computer, running or just starting, that begin with the text."""
    from rtee.remote.directory import hands_running, starting

    try:
        return [name for name in (*hands_running(), *starting()) if name.startswith(incomplete)]
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
RUNNING_HELP = "Name of a running hand, also as the first word; not needed where only one runs."
RunningOption = Annotated[
    str | None,
    typer.Option(
        "--hand",
        envvar=HAND_VARIABLE,
        help=RUNNING_HELP,
        autocompletion=complete_running,
    ),
]
ConnectOption = Annotated[
    str | None,
    typer.Option(
        "--connect",
        envvar=_CONNECT,
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
TimeoutOption = Annotated[
    float | None, typer.Option("--timeout", metavar="S", help="Longest time it may take.")
]
EmulatedOption = Annotated[
    bool, typer.Option("--emulated", help="Talk to emulators instead of the real devices.")
]
IdealOption = Annotated[
    bool,
    typer.Option(
        "--ideal",
        help="With --emulated: as on their data sheets, without lag, backlash or noise.",
    ),
]
FrictionOption = Annotated[
    float | None,
    typer.Option(
        "--friction",
        min=0.0,
        max=10.0,
        metavar="MU",
        help="Friction of hand and object in simulation; 1 at fingertips and 0.8 elsewhere unless "
        "given.",
    ),
]
HandsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="HAND…", help="Names of hands, or their folders.", autocompletion=complete_hand
    ),
]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", "-v", help="Show every event, not only warnings.")
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
        metavar="[NAME:=VALUE]...",
        help="With --urdf or --mjcf: arguments of the xacro files.",
    ),
]
AngleOption = Annotated[
    AngleUnit | None,
    typer.Option(
        help="With --mjcf: unit of the angles, where the file does not say; degree unless given."
    ),
]
# Process of the `rtee run` that started this command, which ends with it, even if it is killed.
BesideOption = Annotated[int | None, typer.Option(metavar="PID", hidden=True)]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


_NAME = r"(?:--[\w-]+|[A-Z]+)"
_NAMES = rf"{_NAME}(?: or {_NAME})*"
_PARTNERS = re.compile(rf"(?=With)(?:With ({_NAMES}))?(?:(?:, w|W)ithout ({_NAMES}))?: ")
"""Beginning of the help of an option that counts only with one of the options or arguments named,
without all of them, or both."""


_MAY_BE_EMPTY = ("connect", "description", "namespace")
"""Options that may be empty words: a script's unset variable must not keep a stop from the hands of
this computer, an action needs no description, and the root of ROS 2's names has none."""


class _Command(TyperCommand):
    """A command that refuses what would have no effect, and whose ``--wait`` may have no number.

    Refused are NaN and infinity, which the ranges of options let pass; empty words; and options
    without those that their help says they go with ("With --emulated: …"), or along with those that
    exclude them ("Without --check: …").

    A command that speaks to a running hand takes the hand as its first word, too.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; raise `typer.BadParameter` for those that are refused."""
        empty = any(word == "" or re.fullmatch("--[a-z-]+=", word) for word in args)
        words = self._with_hand(
            self._with_wait(args), finished=not (ctx.resilient_parsing or "--help" in args)
        )
        rest = super().parse_args(ctx, words)
        # A line that a shell completes is not finished.
        if ctx.resilient_parsing:
            return rest
        given = [each for each in self.params if _is_given(ctx, each)]
        for option in given:
            _check_partners(ctx, option, given)
            value = ctx.params.get(option.name)
            for each in value if isinstance(value, list | tuple) else (value,):
                # An empty path is the present folder.
                if empty and each in ("", Path()) and option.name not in _MAY_BE_EMPTY:
                    raise _Misplaced(f"{_shown(option)} is empty", ctx=ctx)
                if isinstance(each, float) and not math.isfinite(each):
                    raise typer.BadParameter("should be a finite number", ctx=ctx, param=option)
        return rest

    def _valued(self, name: str) -> bool:
        return any(
            name in option.opts and not getattr(option, "is_flag", False)
            for option in self.params
            if option.param_type_name == "option"
        )

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the pieces of the usage line, with the hand before the other arguments."""
        pieces: list[str] = super().collect_usage_pieces(ctx)
        return [*pieces[:1], "[HAND]", *pieces[1:]] if self._takes_running() else pieces

    def _takes_running(self) -> bool:
        return any(getattr(option, "help", None) == RUNNING_HELP for option in self.params)

    def _with_hand(self, args: list[str], *, finished: bool) -> list[str]:
        """Return the arguments; if the first word is a hand, it becomes the option ``--hand``.

        Where the word may mean something else, it counts as a hand if a hand of this name runs or
        starts where the command looks for it, or if one is configured here and the command waits
        for it or looks elsewhere. An endpoint is asked only for a ``finished`` line.
        """
        given = any(word == "--hand" or word.startswith("--hand=") for word in args)
        place = None if given or not self._takes_running() else self._first_word(args)
        if place is None:
            return args
        word = args[place]
        if any(option.param_type_name == "argument" for option in self.params):
            words = {each.partition("=")[0] for each in args}
            endpoint = _value(args, "--connect") or os.environ.get(_CONNECT)
            configured = bool(endpoint or "--wait" in words) and word in complete_hand(word)
            if not configured and word not in _hands_there(endpoint if finished else None, word):
                return args
        # As one word, since a hand's name may begin with a dash like an option.
        return [f"--hand={word}", *args[:place], *args[place + 1 :]]

    def _first_word(self, args: list[str]) -> int | None:
        """Return the index of the first argument that is neither an option nor its value."""
        place = 0
        while place < len(args):
            word = args[place]
            if word == "--":
                place += 1
                break
            if not word.startswith("-") or word == "-":
                break
            place += 2 if self._valued(word) else 1
        return place if place < len(args) else None

    def _with_wait(self, args: list[str]) -> list[str]:
        """Return the arguments with the usual time [s] after each ``--wait`` that lacks one."""
        if "--wait" not in args or all(option.name != "wait" for option in self.params):
            return args
        from rtee.remote.monitoring import READY_WITHIN

        # Words after -- are arguments, even if they look like the option.
        end = args.index("--") if "--" in args else len(args)
        # From the end, so that an insertion does not shift the words not yet examined.
        for index in [i for i, word in enumerate(args[:end]) if word == "--wait"][::-1]:
            if index + 1 >= end or not _is_number(args[index + 1]):
                args = [*args[: index + 1], f"{READY_WITHIN:g}", *args[index + 1 :]]
        return args


def _value(args: Sequence[str], option: str) -> str:
    """Return the value that the words of a command line give to an option, or an empty one."""
    found = ""
    for word, following in zip(args, (*args[1:], ""), strict=True):
        name, equals, value = word.partition("=")
        if word == "--":
            break
        if name == option:
            found = value if equals else following
    return found


def _hands_there(endpoint: str | None, word: str) -> Sequence[str]:
    """Return the hands at an endpoint, or of this computer those whose names begin with a word."""
    if not endpoint:
        return complete_running(word)
    from rtee.remote.find import hands_at

    try:
        return hands_at(endpoint, _LOOK)
    # The command, which looks there itself, says what is wrong.
    except (RteeError, OSError):
        return ()


def _is_given(ctx: Any, option: Any) -> bool:
    """Return whether the command line has this option or argument."""
    source = ctx.get_parameter_source(option.name)
    return source is not None and source.name == "COMMANDLINE"


def _check_partners(ctx: Any, option: Any, given: Sequence[Any]) -> None:
    """Refuse an option whose help names options that it needs, or that exclude it."""
    match = _PARTNERS.match(getattr(option, "help", None) or "")
    if match is None:
        return
    named = {name for other in given for name in (*other.opts, _plain(other.metavar))}
    needed, barred = (re.findall(_NAME, each or "") for each in match.groups())
    if needed and named.isdisjoint(needed):
        raise _Misplaced(f"{_shown(option)} needs {' or '.join(needed)}", ctx=ctx)
    for name in barred:
        if name in named:
            raise _Misplaced(f"{_shown(option)} and {name} exclude each other", ctx=ctx)


def _plain(metavar: str | None) -> str:
    """Return what stands for an argument in the help, without brackets and dots."""
    return (metavar or "").strip("[].…")


def _shown(option: Any) -> str:
    """Return the name of an option or an argument in messages."""
    if option.param_type_name == "option":
        return str(option.opts[0])
    return _plain(option.metavar) or str(option.name)


class _Misplaced(typer.BadParameter):
    """An option without another one that it needs, or with one that excludes it."""

    def format_message(self) -> str:
        """Return the sentence alone: it is no value that is wrong."""
        return str(self.message)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


_HEADING = "Arguments and options:\n"
"""Line of a command's docstring below which its parameters are described."""

_ENTRY = re.compile(r"(\w+)(?: \((.+?)\))?: (.*)")
"""An entry below it: ``name (SPEC; SPEC): text``; each SPEC is an option's name such as ``--from``,
a range such as ``1..50``, or what stands for the value in the help."""


def described(command: F) -> F:
    """Give the parameters of a command the help texts of its docstring.

    As in a call, those before ``*`` are arguments and the others options, called like the parameter
    unless the entry names them.
    """
    text, _, entries = (inspect.getdoc(command) or "").partition(_HEADING)
    hints = get_type_hints(command, include_extras=True)
    parameters = inspect.signature(command).parameters
    for entry in re.split(r"\n(?=\S)", textwrap.dedent(entries).strip()) if entries else ():
        match = _ENTRY.fullmatch(" ".join(entry.split()))
        assert match is not None, entry  # noqa: S101 - a mistake in a docstring
        name, specs, told = match.groups()
        optional = parameters[name].kind is inspect.Parameter.KEYWORD_ONLY
        known = getattr(hints[name], "__metadata__", ())
        new = typer.Option() if optional else typer.Argument()
        # Of a shared option a copy: what is said here is true of this command only.
        info: Any = copy.copy(known[0]) if known else new
        info.help, names = told, []
        for spec in specs.split("; ") if specs else ():
            low, dots, high = spec.partition("..")
            if dots and _is_number(low or high):  # first, since a bound may be negative
                info.min, info.max = _bound(low), _bound(high)
            elif spec.startswith("-"):
                names.append(spec)
            else:
                info.metavar = spec
        if optional:
            info.param_decls = names or [f"--{name.strip('_').replace('_', '-')}"]
            info.default = ...  # where a shared option has its first name
        kind = get_args(hints[name])[0] if known else hints[name]
        hints[name] = Annotated[kind, info]
    command.__doc__, command.__annotations__ = text.strip(), hints
    return command


def _bound(text: str) -> float | None:
    return None if not text else float(text) if "." in text else int(text)


class Commands(typer.Typer):
    """A group of commands, each with the parameters that its docstring describes."""

    def __init__(self, **given: Any) -> None:
        # Rich's own markup would take units in brackets for tags and drop them.
        given |= {"rich_markup_mode": "markdown", "no_args_is_help": True}
        super().__init__(**given, add_completion=False)  # only `rtee` itself installs it

    def command(self, name: str | None = None, **given: Any) -> Callable[[F], F]:
        """Return a decorator that adds a command."""
        add = super().command(name, cls=_Command, **given)
        return lambda command: add(described(command))


def app_of(command: Callable[..., None] | typer.Typer) -> typer.Typer:
    """Return the typer app of a command, given as a function or as a group of commands."""
    if isinstance(command, typer.Typer):
        return command
    app = Commands()
    app.command()(command)
    return app


def log_to_stderr(verbose: bool) -> None:
    """Log warnings to stderr with their time; if ``verbose``, every event."""
    import logging

    logging.basicConfig(
        format="%(asctime)s %(levelname)s %(message)s",
        level=logging.INFO if verbose else logging.WARNING,
    )


_FILES = 64
"""Files that a program on the network may have open at once; a hand has about 25."""


def check_files() -> None:
    """Raise the limit of open files: with too few, the Zenoh library panics.

    Raises `ConfigError` if the limit is too low.
    """
    from rtee.remote.connections import raise_file_limit

    limit = raise_file_limit()
    if 0 <= limit < _FILES:
        raise ConfigError(
            f"only {limit} files may be open at once; raise the limit with 'ulimit -n 1024'"
        )


_NICE = 10
"""Nice value of clients that compute: a tenth of an ordinary program's share of a processor."""


def lower_priority() -> None:
    """Lower the priority of the calling thread and of all threads that it starts.

    On a robot PC the control loop has precedence. Under SCHED_BATCH, a client does not preempt
    another program when it wakes.
    """
    with contextlib.suppress(OSError):  # some containers permit neither
        # `os.nice` adds to the present value; a higher one stays.
        os.nice(max(0, _NICE - os.nice(0)))
        # Any other policy was chosen by the user and stays.
        if sys.platform.startswith("linux") and os.sched_getscheduler(0) == os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def named_values(words: Sequence[str], option: str, what: str) -> dict[str, Any]:
    """Return the values given as NAME=VALUE to an option, each parsed as YAML.

    Raises `ConfigError`, which calls a value ``what``, if a text has no name, or its value is not
    YAML.
    """
    values: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not (name and equals):
            raise ConfigError(f"{option} should be NAME=VALUE, not '{word}'")
        # The option takes the place of the file in error messages.
        values |= parse_yaml(f"{name}: {text}\n", Path(option), what).data
    return values


def hand_folder(name: str | None) -> Path:
    """Return the folder of a hand given by name or path; ``None``: the only hand.

    Raises `ConfigError` if there is no such hand, or there are several and none is given.
    """
    from rtee.hand.load import hand_folder as find_folder

    if name is None:
        names = hand_names()
        if len(names) != 1:
            raise ConfigError(
                f"which hand? give --hand or set {HAND_VARIABLE}; hands: {', '.join(names)}"
            )
        name = names[0]
    return find_folder(name)[0]


def actions_of(name: str | None) -> ActionLibrary:
    """Return the stored actions of a hand; print warnings about them on stderr.

    Raises `UserError` if the hand or one of its files cannot be used.
    """
    import logging

    from rtee.actions.library import ActionLibrary
    from rtee.hand.load import load_hand

    logging.basicConfig(format="rtee: warning: %(message)s")
    folder = hand_folder(name)
    return ActionLibrary.load(load_hand(folder), folder / "actions")


def owned(folder: Path) -> Path:
    """Return the folder in which a hand can be changed: a shipped hand is copied, with a notice."""
    from rtee.hand.own_copy import own

    home = own(folder)
    report_copy(folder, home)
    return home


def report_copy(before: Path | None, after: Path | None) -> None:
    """Print a notice if a change of a hand, or of its actions, copied the shipped folder."""
    if before is None or after is None or before == after:
        return
    from rtee.hand.own_copy import copy_notice

    # A library knows only the folder of its actions; people know the hand's folder.
    if before.name == after.name == "actions":
        before, after = before.parent, after.parent
    print(copy_notice(before, after), file=sys.stderr)


F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


_SILENCE = 3.0
"""Time after which a command says that it waits for a hand's answer [s], which takes milliseconds;
it gives up after some ten seconds."""

_LOOK = 1.0
"""Time for a look at an endpoint for hands [s], twice at most: one in the same network answers in
milliseconds, and no sentence tells of this wait."""


def with_hand(
    hand: str | None,
    endpoint: str | None,
    what: str,
    function: Callable[[RemoteHand], Coroutine[Any, Any, T]],
    *,
    wait: float | None = None,
) -> T:
    """Connect to a running hand, call a function with it and return the function's result.

    Args:
        hand: Name of the hand; not needed if only one hand runs.
        endpoint: Address of the hand; ``None``: that in ``RTEE_CONNECT``, otherwise this computer.
        what: Name of the command; the client is called ``rtee-`` and this name.
        function: The function.
        wait: Longest time to wait until the hand runs and is ready [s]; ``None``: do not wait.
    """
    import asyncio

    import anyio

    from rtee.remote.client import connect

    async def main() -> T:
        began, within = monotonic.now(), wait or 0.0
        name = f"rtee-{what}"
        told = waiting if wait else None
        silence = f"the hand has not answered for {_SILENCE:g} s"
        late = asyncio.get_running_loop().call_later(_SILENCE, waiting, silence)
        if told:  # which says more
            late.cancel()
        async with connect(
            hand, endpoint=endpoint, client=name, wait=within, on_wait=told
        ) as remote:
            late.cancel()
            if wait is not None:
                # Connecting has used up part of the time.
                await remote.ready(max(0.0, began + wait - monotonic.now()), waiting)
            return await function(remote)

    return anyio.run(main)


def waiting(text: str) -> None:
    """Print what a command waits for, beside its output."""
    print(f"rtee: waiting: {text}", file=sys.stderr, flush=True)


def to_json(values: Any, indent: int | None = None) -> str:
    """Return data as JSON; arrays become lists, and numbers that are not finite ``null``."""
    from rtee.values import plain  # which needs numpy

    return json.dumps(plain(values), indent=indent)


async def effort_limits(remote: RemoteHand, efforts: Efforts) -> dict[str, float]:
    """Return the effort limits given on the command line, by actuator [N·m | N]."""
    limits = dict(efforts.limits)
    for name, share in efforts.shares.items():
        limits |= await remote.effort_limits(share, only=[name])
    if efforts.share is not None:
        # A limit given for one actuator takes precedence over the limit for all.
        limits = await remote.effort_limits(efforts.share, besides=list(limits)) | limits
    return limits
