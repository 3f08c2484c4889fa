"""Checks of an installed hand's service, for `rtee doctor`."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from rtee.deploy.files import STATE, USER, certificates_made, drop_in, hand_files, link_of
from rtee.deploy.install import FileState, Installation
from rtee.deploy.needs import Needs
from rtee.drivers.diagnosis.checks import Check, ok, warning, wrong
from rtee.errors import ConfigError
from rtee.hand.files import reason
from rtee.remote.credentials import HAND_KEY


def is_installed(hand: str) -> bool:
    """Return whether a hand is a service on this computer; false if the manifest is unreadable."""
    try:
        return bool(Installation(Path("/")).manifest.of(hand))
    except ConfigError:
        return False


def check_service(needs: Needs, root: Path = Path("/")) -> list[Check]:
    """Return the checks of a hand's service below a root folder; only one if none is installed."""
    install = f"sudo rtee deploy install {needs.hand}"
    try:
        installation = Installation(root)
    except ConfigError as error:
        return [wrong("service", str(error), f"restore it, or remove it and type: {install}")]
    if not installation.manifest.of(needs.hand):
        return [ok("service", f"none for {needs.hand}; `{install}` installs one")]
    return [
        _files(needs, installation, install),
        _user(installation, install),
        *_certificates(needs, installation),
        *_ports(needs),
        _recordings(needs, installation.root),
        *_kernel(needs, installation.root),
    ]


def _files(needs: Needs, installation: Installation, install: str) -> Check:
    states = {path: installation.written(path) for path in installation.manifest.of(needs.hand)}
    if not installation.manifest.before.keys().isdisjoint(states):
        return wrong("service", "its installation was interrupted", install)
    lost = [path for path, state in states.items() if state is FileState.NEW]
    if lost:
        return wrong("service", f"missing: {', '.join(lost)}", install)
    changed = [path for path, state in states.items() if state is FileState.KEPT]
    if changed:
        # Installing again would keep such a file, so the user must remove it first.
        text = f"changed by hand: {', '.join(changed)}"
        return warning("service", text, f"if not intended, remove it and type: {install}")
    wanted = drop_in(needs) | hand_files(needs, installation.root)
    behind = [path for path, content in wanted.items() if installation.content(path) != content]
    if behind:
        text = f"the hand has changed since its installation: {', '.join(behind)}"
        return warning("service", text, install)
    return ok("service", f"{len(states)} files as installed")


def _user(installation: Installation, install: str) -> Check:
    if not installation.has_user():
        return wrong("service's user", f"there is no user {USER}", install)
    return ok("service's user", USER)


def _certificates(needs: Needs, installation: Installation) -> list[Check]:
    """Check that the service can use the certificates for its network."""
    if needs.certificates is None:
        return []
    what = "service's certificates"
    key = installation.root / str(needs.certificates / HAND_KEY).lstrip("/")
    remedy = "; ".join(certificates_made(needs))
    try:
        owner = key.stat().st_uid
    # Other users cannot see whether the folder has a key.
    except PermissionError:
        return [warning(what, f"you may not read {key.parent}", "sudo rtee doctor " + needs.hand)]
    except OSError:
        return [wrong(what, f"there are none in {key.parent}", remedy)]
    if owner != installation.user_id():
        return [
            wrong(what, f"{key} is not the user {USER}'s", f"sudo chown -R {USER}: {key.parent}")
        ]
    return [ok(what, f"in {key.parent}")]


def _ports(needs: Needs) -> list[Check]:
    """Return warnings about serial ports whose names may go to other adapters at the next start."""
    return [
        warning(
            f"name of {port.path}",
            "the first adapter to appear gets this name",
            f"sudo rtee deploy install {needs.hand} --serial {port.device}=NUMBER   "
            f"# and in hand.yaml: port: {link_of(port, needs.hand)}; "
            f"the number: udevadm info {port.path} | grep SERIAL_SHORT",
        )
        for port in needs.ports
        if port.kind in ("ttyUSB", "ttyACM")  # numbered in the order in which they were found
    ]


def _recordings(needs: Needs, root: Path) -> Check:
    folder = root / str(STATE / needs.log).lstrip("/")
    try:
        # The first run creates the folder; until then, its nearest parent is on the same disk.
        while not folder.exists() and folder != root:
            folder = folder.parent
        space = shutil.disk_usage(folder)
        # Existing recordings already use part of the space. `iterdir`, since `glob` ignores a
        # folder that it cannot read.
        files = [file for file in folder.iterdir() if file.suffix == ".mcap"]
        used = sum(file.stat().st_size for file in files)
    except OSError as error:  # other users may not read the service's folders
        text = f"{folder} cannot be read: {reason(error)}"
        return warning("recordings", text, f"sudo rtee doctor {needs.hand}")
    wanted = f"{needs.log_size / 1e9:.0f} GB of recordings are kept"
    if space.free + used < needs.log_size:
        return warning(
            "recordings",
            f"{wanted}, {space.free / 1e9:.0f} GB are free",
            "set log: {max_total_size: BYTES} in hand.yaml",
        )
    return ok("recordings", f"{wanted}, {space.free / 1e9:.0f} GB are free")


def _kernel(needs: Needs, root: Path) -> list[Check]:
    """Check that the CPUs of the loop are isolated from other programs."""
    if not needs.cpus:
        return []
    try:
        text = (root / "sys/devices/system/cpu/isolated").read_text("ascii").strip()
    except (OSError, ValueError):
        text = ""
    alone = {cpu for part in text.split(",") if part for cpu in _cpus(part)}
    shared = [str(cpu) for cpu in needs.cpus if cpu not in alone]
    if not shared:
        return [ok("CPUs of the loop", f"{text}, isolated")]
    return [
        warning(
            "CPUs of the loop",
            f"{', '.join(shared)}: shared with other programs",
            f"sudo rtee deploy install {needs.hand} --realtime; sudo update-grub   # then restart",
        )
    ]


def _cpus(part: str) -> range:
    """Return the CPUs in a part of a kernel list, such as ``2`` or ``2-3``."""
    first, _, last = part.partition("-")
    if not (first.isdecimal() and (last or first).isdecimal()):
        return range(0)
    return range(int(first), min(int(last or first), os.cpu_count() or 1) + 1)
