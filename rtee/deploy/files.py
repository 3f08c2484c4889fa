"""System files of a robot PC: those shipped with rtee, and those for a hand."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rtee.deploy.needs import SECURE, Needs, Port, checked_path
from rtee.drivers.diagnosis.machine import LIMITS
from rtee.errors import ConfigError
from rtee.hand.files import files_below, write_all

PROGRAM = "/opt/rtee/bin/rtee"
"""Path of the `rtee` program in the shipped unit."""

HANDS = "/etc/rtee/hands"
"""Folder of the hands that run as a service."""

UNIT = "/etc/systemd/system/rtee@.service"
RULES = "/etc/udev/rules.d/99-rtee.rules"
ACCOUNTS = "/etc/sysusers.d/rtee.conf"
GOVERNOR = "/etc/tmpfiles.d/rtee-realtime.conf"
KERNEL_LINE = "/etc/default/grub.d/rtee.cfg"

_SHIPPED = {RULES: "99-rtee.rules", LIMITS: "limits.conf", UNIT: "rtee@.service"}

USER = "rtee"
"""The user that runs hands."""

STATE = Path("/var/lib/rtee")
"""Working directory of the service."""

_HIDDEN = {
    "/home": "ProtectHome",
    "/root": "ProtectHome",
    "/run/user": "ProtectHome",
    "/tmp": "PrivateTmp",  # noqa: S108 - nothing is written there
    "/var/tmp": "PrivateTmp",  # noqa: S108
}
"""Folders that the unit hides from its service, with the settings that hide them."""

_ALLOWED_PORTS = ("ttyUSB", "ttyACM", "ttyS", "ttyAMA")
"""Kinds of serial ports that the unit permits for every hand."""

_USER = """\
# The user that runs hands. Written by rtee deploy.
u rtee - "rtee hands" /var/lib/rtee
m rtee dialout
"""

_PERFORMANCE = """\
# The clock of the CPUs does not slow down between ticks. Written by rtee deploy.
w- /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor - - - - performance
"""


def shipped() -> Path:
    """Return the folder of the files shipped with rtee; `ConfigError` if there is none."""
    package = Path(__file__).resolve().parents[1]
    # Inside the package in a wheel, beside it in a checkout.
    for place in (package / "_deploy", package.parent / "deploy"):
        if (place / _SHIPPED[UNIT]).is_file():
            return place
    raise ConfigError("this installation of rtee has no files for a robot PC")


def own_program() -> str:
    """Return the path of this environment's ``rtee``."""
    return str(Path(sys.executable).parent / "rtee")


def check_visible(program: str | None, *, live: bool) -> None:
    """Refuse a program that the unit's sandbox would hide from the service.

    ``program`` is the path of an ``rtee``; ``None`` means that of this environment, whose
    interpreter and package the service needs, too. In an image, which is not ``live``, only the
    path of the program itself is checked, without following links.

    Raises:
        ConfigError: if the service cannot see the program, with a remedy.
    """
    paths = [Path(program or own_program())]
    if live:
        paths += [path.resolve() for path in paths]
        paths += [] if program else [Path(sys.executable).resolve(), Path(__file__).resolve()]
    for path in paths:
        for folder, setting in _HIDDEN.items():
            if path.is_relative_to(folder):
                raise ConfigError(
                    f"the service would not see {path}: its unit has {setting}; install rtee in"
                    " /opt/rtee (python3 -m venv /opt/rtee), or give --program"
                )


def write_files(folder: Path) -> list[Path]:
    """Write the shipped files, with this environment's `rtee` in the unit; return their paths.

    Creates the folder if necessary. Raises `ConfigError` if this installation lacks the files, or
    they cannot be written.
    """
    source = shipped()
    texts = {name: (source / name).read_text("utf-8") for name in _SHIPPED.values()}
    files = {folder / name: text.replace(PROGRAM, own_program()) for name, text in texts.items()}
    write_all(files)
    return list(files)


def system_files(needs: Needs, program: str, *, realtime: bool) -> dict[str, bytes]:
    """Return the contents of the system files for a hand, by path; the service starts ``program``.

    With ``realtime``, the files also set the CPU governor, and isolate the CPUs of the loop.
    """
    source = shipped()
    program = checked_path(program, "the program")
    files = {
        path: (source / name).read_text("utf-8").replace(PROGRAM, program)
        for path, name in _SHIPPED.items()
    } | {
        ACCOUNTS: _USER,
        # Above 60, since udev's own 60-serial.rules set the serial number that this rule compares.
        f"/etc/udev/rules.d/90-rtee-{needs.hand}.rules": _rules(needs),
    }
    if realtime:
        files[GOVERNOR] = _PERFORMANCE
        if needs.cpus:
            files[KERNEL_LINE] = (
                "# CPUs for the loop alone. Written by rtee deploy; update-grub reads it.\n"
                'GRUB_CMDLINE_LINUX_DEFAULT="$GRUB_CMDLINE_LINUX_DEFAULT '
                f'{kernel_words(needs.cpus)}"\n'
            )
    return {path: text.encode() for path, text in files.items() if text} | drop_in(needs)


def drop_in(needs: Needs) -> dict[str, bytes]:
    """Return the drop-in of the unit for a hand, by path; empty if the hand needs none.

    Raises `ConfigError` if the path of the recordings is not valid in a unit.
    """
    lines = [f"# Additions for {needs.hand}. Written by rtee deploy.", "[Service]"]
    kinds = sorted({port.kind for port in needs.ports} - {"", *_ALLOWED_PORTS})
    lines += [f"DeviceAllow=char-{kind} rw" for kind in kinds]
    lines += [f"IPAddressAllow={address}" for address in needs.addresses]
    if needs.certificates is not None and needs.certificates.is_relative_to(SECURE):
        lines.append(f"Environment=RTEE_SECURE_DIR={SECURE}")
    if needs.ethercat:
        lines += [
            "RestrictAddressFamilies=AF_PACKET",
            "CapabilityBoundingSet=CAP_NET_RAW",
            "AmbientCapabilities=CAP_NET_RAW",
        ]
    if needs.log.is_absolute() and not needs.log.is_relative_to(STATE):
        # The minus lets the service start even if the folder is missing.
        lines.append(f"ReadWritePaths=-{checked_path(needs.log, 'log: directory')}")
    if not lines[2:]:
        return {}
    path = f"/etc/systemd/system/rtee@{needs.hand}.service.d/10-hand.conf"
    return {path: ("\n".join(lines) + "\n").encode()}


def kernel_words(cpus: Sequence[int], of: int | None = None) -> str:
    """Return the kernel command-line parameters that isolate CPUs from other programs.

    If ``of`` gives the number of all CPUs, the parameters also keep interrupts off these CPUs.
    """
    these = ",".join(map(str, cpus))
    words = f"isolcpus={these} nohz_full={these} rcu_nocbs={these}"
    others = [str(cpu) for cpu in range(of or 0) if cpu not in cpus]
    return f"{words} irqaffinity={','.join(others)}" if others else words


def link_of(port: Port, hand: str) -> str:
    """Return the name that a udev rule gives to a port with a known serial number."""
    return port.path if port.has_own_name else f"/dev/rtee/{hand}-{port.device}"


def hand_files(needs: Needs, root: Path) -> dict[str, bytes]:
    """Return the files of a hand that must be copied for the service, by path.

    The result is empty for hands that are shipped with rtee or already in `HANDS`. Raises
    `ConfigError` if a file cannot be read.
    """
    folder = needs.folder.resolve()
    inside = Path(__file__).resolve().parents[1] / "_config"
    if folder.is_relative_to(inside) or folder == (root / HANDS[1:] / needs.hand).resolve():
        return {}
    # A link, even one made meanwhile, could lead to a file that other users must not read.
    return {
        f"{HANDS}/{needs.hand}/{name.as_posix()}": content for name, content in files_below(folder)
    }


def _rules(needs: Needs) -> str:
    lines = [f"# Names and buses of {needs.hand}. Written by rtee deploy."]
    for port in needs.ports:
        if port.serial:
            name = link_of(port, needs.hand).removeprefix("/dev/")
            lines.append(
                f'SUBSYSTEM=="tty", ENV{{ID_SERIAL_SHORT}}=="{port.serial}", SYMLINK+="{name}",'
                ' GROUP="dialout", MODE="0660"'
            )
    for name, bitrate in needs.can.items():
        # restart-ms lets the controller recover from bus-off.
        lines.append(
            f'ACTION=="add", SUBSYSTEM=="net", KERNEL=="{name}", RUN+="/usr/bin/env ip link set'
            f' {name} up type can bitrate {bitrate} restart-ms 100"'
        )
    return "\n".join(lines) + "\n" if lines[1:] else ""


def advice(needs: Needs, program: str | None, *, realtime: bool, live: bool) -> list[str]:
    """Return the steps that the user must or may take after the installation.

    ``program`` is the path of an ``rtee``, or ``None`` for that of this environment; ``live`` means
    that the system is the running one.
    """
    sentences: list[str] = []
    for port in needs.ports:
        name = link_of(port, needs.hand)
        if port.serial and name != port.path:
            sentences.append(f"in hand.yaml, at '{port.device}': port: {name}")
        elif not port.serial and port.has_own_name:
            sentences.append(f"{port.path} needs a udev rule: give --serial {port.device}=NUMBER")
    if needs.addresses:
        sentences.append(f"its network is open to: {', '.join(needs.addresses)}")
    if needs.unknown:
        sentences.append(
            f"the drivers of {', '.join(needs.unknown)} are not part of rtee: if they need more"
            " than their options in hand.yaml, add it to a drop-in of your own (systemctl edit"
            f" rtee@{needs.hand})"
        )
    if needs.certificates is not None:
        sentences += [f"certificates: {words}" for words in certificates_made(needs, program)]
    sentences.append(
        f"recordings: {STATE / needs.log}, at most {needs.log_size / 1e9:g} GB"
        " (log: max_total_size in hand.yaml)"
    )
    if not realtime:
        sentences.append("real time: --realtime sets the CPUs' governor to performance")
        words = kernel_words(needs.cpus, os.cpu_count() if live else None)
        sentences.append(
            f"real time: on the kernel's command line: {words}"
            if needs.cpus
            else "real time: a CPU for the loop alone: realtime: {cpus: [N]} in hand.yaml"
        )
    if live:
        sentences.append(f"start it: sudo systemctl start rtee@{needs.hand}")
        sentences.append("for users who command hands: sudo usermod -aG rtee USER; log in again")
    return sentences


def certificates_made(needs: Needs, program: str | None = None) -> list[str]:
    """Return the commands that create a hand's certificates, or give them to the service's user."""
    if needs.certificates is None:
        return []
    if needs.certificates.is_relative_to(SECURE):
        make = f"{secure_command(needs, program)} init {needs.hand}"
        return [f"sudo install -d -o {USER} -g {USER} -m 750 {STATE}", make]
    return [f"sudo chown -R {USER}: {needs.certificates}"]


def secure_command(needs: Needs, program: str | None = None) -> str:
    """Return the `rtee secure` command for the certificates of a hand's service."""
    folder = needs.certificates
    where = f"env RTEE_SECURE_DIR={SECURE} " if folder and folder.is_relative_to(SECURE) else ""
    return f"sudo -u {USER} {where}{program or own_program()} secure"


def words_of(files: Mapping[str, bytes]) -> list[str]:
    """Return the lines of system files, each file with a heading."""
    lines: list[str] = []
    for path, content in files.items():
        lines += [f"# {path}", *content.decode("utf-8", "replace").splitlines(), ""]
    return lines
