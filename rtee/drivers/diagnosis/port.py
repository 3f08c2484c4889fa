"""Check a tty or network address before anything is sent there."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import getpass
import grp
import os
import socket
import stat
from pathlib import Path

from rtee.buses.link import split_address
from rtee.drivers.diagnosis.checks import Check, Verdict, ok, warning, wrong

_MASTERS = frozenset({"/dev/ptmx", "/dev/pts/ptmx"})
"""Files that a program which creates pseudo-terminals keeps open."""


async def check_address(address: str, root: Path = Path("/")) -> list[Check]:
    """Check the tty or network address of a driver's options, up to the first obstacle.

    The folders ``sys`` and ``proc`` are below ``root``.
    """
    if "://" in address:
        return [await _network(address)]
    return _tty(address, root)


async def _network(address: str) -> Check:
    default = 502 if address.startswith("tcp://") else 2217 if address.startswith("rfc") else None
    host, port = split_address(address, default)
    try:
        # A host in the same network answers within milliseconds; TCP repeats a packet after 1 s.
        async with asyncio.timeout(2.0):
            _, writer = await asyncio.open_connection(host, port)
    except TimeoutError:
        return wrong("address", f"{host} does not answer", f"ping {host}   # cable, power, IP?")
    except socket.gaierror:
        return wrong("address", f"the name '{host}' cannot be resolved", "use its IP address")
    except UnicodeError:  # a part of the name is empty or too long
        return wrong("address", f"'{host}' is not a host name", "correct the address")
    except OSError as error:
        refused = error.errno == errno.ECONNREFUSED
        text = f"{host} refuses port {port}" if refused else f"{host} cannot be reached: {error}"
        return wrong("address", text, f"ping {host}   # and is it the right port?")
    # Closed at once, since many devices serve only one connection.
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return ok("address", f"{host} accepts connections at port {port}")


def _tty(address: str, root: Path) -> list[Check]:
    path = Path(address)
    found: list[Check] = []
    for look in (_exists, _permission):
        found.append(look(path))
        if found[-1].verdict == Verdict.WRONG:
            return found
    found.append(_owner(path, root))
    latency = _latency(path, root)
    return [*found, latency] if latency is not None else found


def _exists(path: Path) -> Check:
    if not path.exists():
        return wrong(
            "port",
            f"there is no {path}",
            "plug it in, then `rtee scan` lists the ports of this computer",
        )
    if not stat.S_ISCHR(path.stat().st_mode):
        return wrong(
            "port", f"{path} is not a serial port", "`rtee scan` lists the ports of this computer"
        )
    target = path.resolve()
    text = str(path) if target == path else f"{path} ({target})"
    if path.is_relative_to("/dev") and path.name.startswith(("ttyUSB", "ttyACM")):
        return ok("port", f"{text}; names below /dev/serial/by-id stay the same")
    return ok("port", text)


def _permission(path: Path) -> Check:
    if os.access(path, os.R_OK | os.W_OK):
        return ok("permission", "may be read and written")
    group = "dialout"
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except (KeyError, OSError):
        pass
    try:
        # In a container, a process may run under a user id that has no name.
        user = getpass.getuser()
    except (KeyError, OSError):
        user = "$USER"
    return wrong(
        "permission",
        f"{path} belongs to the group '{group}', which you are not in",
        f"sudo usermod -aG {group} {user}   # then log out and in again",
    )


def _owner(path: Path, root: Path) -> Check:
    users = [f"{name} ({pid})" for pid, name in port_users(path, root) if pid != os.getpid()]
    if not users:
        return ok("use", "no other program has it open")
    return wrong(
        "use", f"it is in use by {', '.join(users)}", f"end it: kill {users[0].split('(')[-1][:-1]}"
    )


def port_users(path: Path, root: Path = Path("/")) -> list[tuple[int, str]]:
    """Return the ids and names of the visible processes that have a port open.

    The program at the other end of a pseudo-terminal, such as `rtee emulate`, does not count.
    """
    target = str(path.resolve())
    pty = target.startswith("/dev/pts/")
    users = []
    for folder in (root / "proc").glob("[0-9]*"):
        try:
            links = list((folder / "fd").iterdir())
        except OSError:
            continue
        held = {_target(link) for link in links}
        plays = pty and not held.isdisjoint(_MASTERS)
        # The other end of a pty has it open to emulate the device, not to use it.
        if target in held and not plays:
            users.append((int(folder.name), _name(folder)))
    return sorted(users)


def _target(link: Path) -> str:
    try:
        return os.readlink(link)
    # Another user's process, or one that has just ended.
    except OSError:
        return ""


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text("utf-8").strip()
    except (OSError, ValueError):
        return "?"


def _latency(path: Path, root: Path) -> Check | None:
    """Check the latency timer of an FTDI adapter; ``None`` for other adapters."""
    name = path.resolve().name
    file = root / "sys/bus/usb-serial/devices" / name / "latency_timer"
    try:
        timer = int(file.read_text("ascii"))
    except (OSError, ValueError):
        return None
    if timer <= 1:
        return ok("latency timer", f"{timer} ms")
    return warning(
        "latency timer",
        f"{timer} ms, which delays every answer",
        f"echo 1 | sudo tee {file}   # the udev rule of `rtee doctor --files DIR` makes it last",
    )
