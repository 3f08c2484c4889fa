"""Entry point: a group of commands, each imported only when it is called."""

from __future__ import annotations

import errno
import importlib
import io
import os
import re
import sys
from typing import Any, Final, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from rtee.cli._common import app_of
from rtee.errors import RteeError, check_system, closest, first_error

COMMANDS: dict[str, tuple[str, str]] = {
    # offline
    "hands": ("rtee.cli.hands:hands", "List the configured hands."),
    "new": ("rtee.cli.new:new", "Make a hand's folder from a URDF."),
    "extract": ("rtee.cli.extract:extract", "Find the primitive grasping actions of a hand."),
    "actions": ("rtee.cli.actions:actions", "List the grasping actions of a hand."),
    "compose": ("rtee.cli.define:compose", "Define a composed action."),
    "time": ("rtee.cli.define:time", "Define a timed action."),
    "generic": ("rtee.cli.define:generic", "Define a generic action."),
    "openings": ("rtee.cli.openings:openings", "List how far fingertips open."),
    "grasp-plan": ("rtee.cli.grasp_plan:grasp_plan", "Rank the actions of a hand for an object."),
    "retarget": ("rtee.cli.retarget:retarget", "Show how a person's hand moves a hand."),
    "import": ("rtee.cli.import_:import_", "Import action files of ROS End-Effector."),
    "export": ("rtee.cli.export:export", "Write a hand's model for other programs."),
    # online
    "run": ("rtee.cli.run:run", "Run one hand or several."),
    "do": ("rtee.cli.do:do", "Execute a grasping action."),
    "grasp": ("rtee.cli.do:grasp", "Hold an object of a width with a force."),
    "touch": ("rtee.cli.do:touch", "Close slowly until the first contact."),
    "open": ("rtee.cli.do:open_", "Open the hand."),
    "stop": ("rtee.cli.stop:stop", "Stop the hand."),
    "recover": ("rtee.cli.stop:recover", "Bring devices out of a fault."),
    "state": ("rtee.cli.state:state", "Show the hand's state, live."),
    "status": ("rtee.cli.status:status", "Show the loop and the devices."),
    "info": ("rtee.cli.status:info", "Describe the hand, as a grasp planner needs it."),
    "gains": ("rtee.cli.status:gains", "Show or set the gains of the devices."),
    "teleop": ("rtee.cli.teleop:teleop", "Move a hand from a gamepad, the keyboard or a tracker."),
    "stream": ("rtee.cli.teleop:app", "Play recorded streams of set-points."),
    "gui": ("rtee.cli.gui:gui", "Open the hand in the browser."),
    "mcp": ("rtee.cli.mcp:mcp", "Offer hands to a language model, behind a gate."),
    "agent": ("rtee.cli.mcp:app", "Approve what a language model asks for, or let it in again."),
    "metrics": ("rtee.cli.metrics:metrics", "Serve the metrics of hands for Prometheus."),
    "router": ("rtee.cli.router:router", "Run a router between hands and their clients."),
    "ros2": ("rtee.cli.ros2:app", "Look at a ROS 2 graph that hands are part of."),
    "log": ("rtee.cli.log:app", "Inspect, replay and repair recordings."),
    # devices
    "emulate": ("rtee.cli.emulate:emulate", "Emulate a device for other software."),
    "scan": ("rtee.cli.scan:scan", "Find devices on all buses."),
    "secure": ("rtee.cli.secure:app", "Make certificates for a hand on a network."),
    "doctor": ("rtee.cli.devices:doctor", "Report what is wrong and what to type."),
    "locate": ("rtee.cli.devices:locate", "Twitch a hand to see which one it is."),
    "calibrate": ("rtee.cli.devices:calibrate", "Calibrate a device that has offsets."),
    "set-id": ("rtee.cli.set_id:set_id", "Give a bus servo its id."),
    "deploy": ("rtee.cli.deploy:app", "Make a hand a service of this computer."),
    "new-driver": ("rtee.cli.new:new_driver", "Write the skeleton of a driver package."),
    # dynamics
    "try": ("rtee.cli.try_:try_", "Try an action on an object in simulation."),
    "compare": ("rtee.cli.compare:compare", "Show which hands hold which parts, in simulation."),
}
"""Each command with its function, or group of commands, and its one-line help."""


class LazyGroup(TyperGroup):
    """A group that lists its commands without importing them."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the commands in the order of `COMMANDS`."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import a command; for a list of all commands, return only its help."""
        entry = COMMANDS.get(cmd_name)
        if entry is None:
            return None
        # A list shows all commands; importing them would take seconds. When a shell completes,
        # the words are in an environment variable instead of argv.
        if cmd_name not in sys.argv and "_RTEE_COMPLETE" not in os.environ:
            return TyperCommand(cmd_name, callback=None, help=entry[1], short_help=entry[1])
        module, _, name = entry[0].partition(":")
        command: Any = typer.main.get_command(
            app_of(getattr(importlib.import_module(module), name))
        )
        # The function may have another name, such as `open_`, but messages show this one.
        command.name = cmd_name
        command.short_help = entry[1]
        return command


cli = typer.Typer(
    cls=LazyGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(value: bool) -> None:
    if value:
        from importlib.metadata import version

        typer.echo(f"rtee {version('rtee')}")
        raise typer.Exit


@cli.callback()
def root(
    version: bool = typer.Option(
        False,
        "--version",
        help="Print the version and leave.",
        callback=_show_version,
        is_eager=True,
    ),
) -> None:
    """Command any robotic hand or gripper by grasping actions."""


_Usage: Final[Any] = typer.BadParameter.__mro__[2]
"""The base class of typer's usage errors, which typer does not export."""

_NO_COMMAND: Final = re.compile("No such command '(.+?)'")

_FAILING: Final = ("strict", "surrogateescape")
"""How streams that fail at a character treat errors, which Python chooses by the locale."""

_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a full disk."""


_EXHAUSTED: Final = {
    errno.EMFILE: "too many files would be open; raise this shell's limit with 'ulimit -n 1024'",
    errno.ENFILE: "too many files are open on this computer",
    errno.ENOMEM: "there is not enough memory; 'ulimit -v' shows this shell's limit",
}
"""Messages for an exhausted computer, or a limit of the shell, by error number."""


def main() -> None:
    """Run the command line; a user's mistake is one sentence on stderr and exit status 2."""
    _open_standard_streams()
    # As Python does on stderr: escape characters that the terminal's encoding lacks and file names
    # that are not text, instead of failing after the work is done. In the locale C, Python escapes
    # such names only.
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors in _FAILING:
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        check_system()
        # In standalone mode, typer would print errors in its own form and exit.
        status = cli(prog_name="rtee", standalone_mode=False)
        # Flush here, where a failure to write becomes a sentence below; at exit it would not.
        sys.stdout.flush()
        sys.exit(status if isinstance(status, int) else 0)
    except SystemExit as exit_:
        # The reader has closed the pipe (`rtee … | head`), which typer counts as a failure.
        if isinstance(exit_.__context__, BrokenPipeError):
            _exit_unflushed(0)
        raise
    except RteeError as error:
        print(f"rtee: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except BaseExceptionGroup as group:
        # Several parallel tasks may raise the same mistake; it is reported once.
        mistake = first_error(group)
        if mistake is None:
            raise
        print(f"rtee: {mistake}", file=sys.stderr)
        sys.exit(mistake.exit_status)
    except _Usage as error:
        _explain(error)
        sys.exit(error.exit_code)
    except BrokenPipeError:
        _exit_unflushed(0)
    # Before RuntimeError, of which typer's Abort is one.
    except (KeyboardInterrupt, typer.Abort) as error:
        if isinstance(error.__context__, EOFError):
            print("\nrtee: the input has ended before the question was answered", file=sys.stderr)
        sys.exit(130)  # 128 + SIGINT, the shells' convention
    except (ImportError, MemoryError, OSError, RuntimeError) as error:
        shortage = _shortage(error)
        if not shortage:
            raise
        print(f"rtee: {shortage}", file=sys.stderr)
        _exit_unflushed(2)


def _open_standard_streams() -> None:
    """Open the null device for standard streams that the caller has closed (``>&-``).

    Python has no stream there; the next file that is opened would take its place.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(null)
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


def _shortage(error: Exception) -> str:
    """Return a sentence about the exhausted resource; ``""`` for any other error."""
    # The dynamic linker reports a lack of memory as "failed to map segment".
    # Without memory for a thread's stack, Python raises a RuntimeError.
    words = ("failed to map segment", "can't start new thread")
    if isinstance(error, MemoryError) or any(each in str(error) for each in words):
        return _EXHAUSTED[errno.ENOMEM]
    number = error.errno if isinstance(error, OSError) else None
    # Functions that write files report a full disk themselves; this one is about stdout.
    if number is not None and number in _FULL:
        return f"the output cannot be written: {os.strerror(number).lower()}"
    return _EXHAUSTED.get(number or 0, "")


def _exit_unflushed(status: int) -> NoReturn:
    """Exit without flushing stdout."""
    # Python flushes stdout once more at exit, which would fail again.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    sys.exit(status)


_NUMBER: Final = re.compile(r"is not a valid (int|float)\w*( range)?")
_NUMBERS: Final = {"int": "whole number", "float": "number"}
"""Plain words for typer's types of options."""


def _explain(error: Any) -> None:
    """Print a sentence about a mistake on the command line."""
    if type(error).__name__ == "NoArgsIsHelpError":  # typer has printed the help already
        return
    message = " ".join(error.format_message().split()).rstrip(".")
    message = _NUMBER.sub(lambda kind: f"is not a {_NUMBERS[kind[1]]}", message)
    context = getattr(error, "ctx", None)
    remedy = f"; see '{context.command_path} --help'" if context is not None else ""
    if context is not None and (unknown := _NO_COMMAND.match(message)):
        close = closest(unknown[1], context.command.list_commands(context))
        message = f"{unknown[0]} (did you mean '{close}'?)" if close else unknown[0]
    # A sentence begins small after the program's name, but not the name of an argument.
    small = message[:1].lower() + message[1:] if message[1:2].islower() else message
    print(f"rtee: {small}{remedy}", file=sys.stderr)
