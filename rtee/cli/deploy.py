"""`rtee deploy`: install a hand as a service of this computer, or of a system image."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import Commands, Hand
from rtee.errors import ConfigError
from rtee.hand.names import check_name

if TYPE_CHECKING:
    from rtee.deploy.install import FileState, Installation
    from rtee.deploy.needs import Needs

app = Commands(help="Make a hand a service that starts with the computer.")

Root = Annotated[
    Path, typer.Option(metavar="DIR", help="The system: an image's folder; by default this one.")
]
Serial = Annotated[
    list[str] | None,
    typer.Option(
        metavar="DEVICE=NUMBER", help="Serial number of a device's adapter: its port gets a name."
    ),
]
Program = Annotated[
    str | None,
    typer.Option(metavar="PATH", help="The rtee that the service starts; by default this one."),
]
Realtime = Annotated[
    bool,
    typer.Option("--realtime", help="Also set the CPUs' governor, and isolate those of hand.yaml."),
]
THIS_SYSTEM = Path("/")


@app.command()
def plan(
    hand: Hand,
    root: Root = THIS_SYSTEM,
    serial: Serial = None,
    program: Program = None,
    realtime: Realtime = False,
) -> None:
    """Print what `install` would write, and what it leaves to you."""
    from rtee.deploy.files import words_of

    installation, needs, files, copies = _wanted(hand, root, serial, program, realtime)
    for line in words_of(files):
        print(line)
    _print_states(installation, installation.compare(needs.hand, files | copies))
    _advise(needs, installation, program, realtime)


@app.command()
def install(
    hand: Hand,
    *,
    root: Root = THIS_SYSTEM,
    serial: Serial = None,
    program: Program = None,
    realtime: Realtime = False,
    dry_run: bool = False,
) -> None:
    """Write unit, user, udev rules and limits for a hand, and enable its service.

    Example: sudo rtee deploy install robotiq_2f_85 --serial gripper=FT4XXXXX

    Arguments and options:
        dry_run: Only say what it would do.
    """
    from rtee.deploy.install import Installation

    if not dry_run:
        _check_rights(Installation(root), f"install {hand}")
    installation, needs, files, copies = _wanted(hand, root, serial, program, realtime)
    if dry_run:
        _print_states(installation, installation.compare(needs.hand, files | copies))
        return
    _print_states(installation, installation.install(needs.hand, files | copies))
    # Only once the files are written, since both read them.
    for problem in (installation.make_user(), *installation.reload()):
        if problem:
            print(f"! {problem}")
    _advise(needs, installation, program, realtime)


@app.command()
def uninstall(hand: Hand, root: Root = THIS_SYSTEM) -> None:
    """Remove the files that `install` wrote for a hand; its recordings stay."""
    from rtee.deploy.install import Installation

    installation = Installation(root)
    _check_rights(installation, f"uninstall {hand}")
    check_name(hand, "hand")
    # Only a hand that was installed is stopped: `uninstall` refuses any other below.
    known = {each for hands in installation.manifest.hands.values() for each in hands}
    # If it cannot be stopped, its files still go, and the user learns that it runs on.
    if hand in known and (problem := installation.stop(hand)):
        print(f"! {problem}")
    _print_states(installation, installation.uninstall(hand))
    for problem in (installation.remove_user(), *installation.reload()):
        if problem:
            print(f"! {problem}")


def _wanted(
    hand: str, root: Path, serial: list[str] | None, program: str | None, realtime: bool
) -> tuple[Installation, Needs, dict[str, bytes], dict[str, bytes]]:
    """Return the system, the hand's needs, the files to write, and copies of the hand's files.

    Files are contents by absolute path within the system.
    """
    from rtee.deploy.files import check_visible, hand_files, own_program, system_files
    from rtee.deploy.install import Installation
    from rtee.deploy.needs import Needs
    from rtee.running.run import RunOptions, prepare

    pairs = [text.partition("=") for text in serial or ()]
    wrong = next((name for name, _, number in pairs if not name or not number), None)
    if wrong is not None:
        raise ConfigError(f"--serial should be DEVICE=NUMBER, not '{wrong}'")
    installation = Installation(root)
    check_visible(program, live=installation.live)
    prepared = prepare(hand, RunOptions(driver="devices"))
    needs = Needs.of(prepared, {name: number for name, _, number in pairs})
    files = system_files(needs, program or own_program(), realtime=realtime)
    return installation, needs, files, hand_files(needs, installation.root)


def _check_rights(installation: Installation, command: str) -> None:
    # An image's folder may belong to any user.
    if installation.live and os.geteuid() != 0:
        raise ConfigError(
            f"only root may change the system's files; type: sudo rtee deploy {command}"
        )


def _print_states(installation: Installation, states: dict[str, FileState]) -> None:
    for path, state in states.items():
        print(f"{state}: {installation.root / path.lstrip('/')}")


def _advise(needs: Needs, installation: Installation, program: str | None, realtime: bool) -> None:
    """Print the steps that are left to the user."""
    from rtee.deploy.files import KERNEL_LINE, advice

    for line in advice(needs, program, realtime=realtime, live=installation.live):
        print(f"- {line}")
    if realtime and needs.cpus:
        print(f"- for {KERNEL_LINE}: sudo update-grub, and restart")
