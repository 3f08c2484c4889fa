"""The learned free motion of a hand, stored from one run to the next.

Each hand has a file in the user's state folder, ``$XDG_STATE_HOME/rtee/free_motion``;
``$XDG_STATE_HOME`` is ``~/.local/state`` unless set. Each device has a section in the file, and its
emulator another one.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rtee.errors import RteeError
from rtee.hand.files import make_folder, write_atomically
from rtee.log.dataclass_json import from_json, to_json
from rtee.loop.free_motion import LearnedMotion
from rtee.loop.settings import DeviceSettings

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Stored:
    """Content of a file: estimates by device and actuator name."""

    devices: Mapping[str, Mapping[str, LearnedMotion]] = field(default_factory=dict)


def _file_of(hand: str) -> Path | None:
    """Return the file of a hand; ``None`` if the user has no folder for it."""
    folder = Path(os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state"))
    # Without a home directory, `~` stays as it is, and the file would be in the working directory.
    return folder / "rtee" / "free_motion" / f"{hand}.json" if folder.is_absolute() else None


def _key(device: DeviceSettings) -> str:
    """Return the key that distinguishes a device from other devices and from its emulator."""
    spec = device.spec
    return f"{spec.name}: {spec.driver}{' (emulated)' if spec.emulated else ''}"


def _kept(hand: str) -> _Stored:
    file = _file_of(hand)
    if file is None:
        return _Stored()
    try:
        return from_json(file.read_bytes(), _Stored)
    except FileNotFoundError:
        return _Stored()
    except (OSError, RteeError) as error:
        # The next slow closing learns the estimate again.
        log.warning("%s: free motion is learned again: %s", file, error)
        return _Stored()


def recall(hand: str, devices: Sequence[DeviceSettings]) -> dict[str, LearnedMotion]:
    """Return the learned free motion of a hand with these devices, by actuator."""
    kept = _kept(hand).devices
    known: dict[str, LearnedMotion] = {}
    for device in devices:
        of_device = kept.get(_key(device), {})
        for actuator in device.spec.actuators:
            if (learned := of_device.get(actuator.name)) is not None and learned.sound:
                known[actuator.name] = learned
    return known


def keep(hand: str, devices: Sequence[DeviceSettings], known: Mapping[str, LearnedMotion]) -> None:
    """Store the learned free motion by actuator, and keep that of the hand's other devices."""
    file = _file_of(hand)
    if file is None or not known:
        return
    now = {
        _key(device): {a.name: known[a.name] for a in device.spec.actuators if a.name in known}
        for device in devices
    }
    try:
        make_folder(file.parent)
        write_atomically(file, to_json(_Stored({**_kept(hand).devices, **now})) + "\n")
    except RteeError as error:
        log.warning("the learned free motion is not stored: %s", error)
