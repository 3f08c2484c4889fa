"""Read and check a hand from hand.yaml and the command line, without opening any device."""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from msgspec import structs

from rtee.actions.library import ActionLibrary
from rtee.actions.resting import pinch_at_rest
from rtee.actions.types import Primitive
from rtee.buses.pool import BusPool
from rtee.drivers.objects import between_fingers
from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError
from rtee.hand.config import HandConfig
from rtee.hand.config_schema import Lines
from rtee.hand.load import load_documented
from rtee.hand.model import Hand
from rtee.hand.validation import defaults
from rtee.log import RecorderSettings
from rtee.loop.handloop import HandLoop
from rtee.loop.settings import (
    DeviceChoice,
    DeviceSettings,
    LoopSettings,
    device_settings,
    loop_settings,
)
from rtee.types import DeviceSpec

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of the command line that override hand.yaml.

    Attributes:
        driver: ``kinematic``, ``devices``, or a driver's name; ``None``: as in hand.yaml.
        emulated: Whether to use emulators instead of the real devices.
        ideal: Whether emulated devices match their data sheets, instead of being worn.
        object_in_hand: The object between the fingers of emulated devices, as on the command line.
        driver_options: Options of the driver, which take precedence over those in hand.yaml.
        home: Whether to home devices that need it at the start; this moves them.
        rate: Ticks per second [Hz]; ``None``: as in hand.yaml.
        realtime: Whether to request real-time scheduling, even if hand.yaml does not.
        log: Folder of the recordings; ``None``: as in hand.yaml.
        record: Whether to write recordings; faults are always written if a folder is configured.
        duration: Time after which the run ends [s]; ``None``: no limit.
        trace: Whether to record the bytes of all buses.
        companions: Commands that run beside the hands, and end with them.
        ros2: Whether all hands are ROS 2 nodes, even if hand.yaml says otherwise.
        metrics: ``HOST:PORT`` on which to serve the metrics of all hands; empty: as in hand.yaml.
        events: Destination of the lines about events; ``None``: none.
        config_dirs: Folders to search for hands before the usual ones.
    """

    driver: str | None = None
    emulated: bool = False
    ideal: bool = False
    object_in_hand: str | None = None
    driver_options: Mapping[str, object] = field(default_factory=dict)
    home: bool = False
    rate: float | None = None
    realtime: bool = False
    log: Path | None = None
    record: bool = True
    duration: float | None = None
    trace: bool = False
    companions: tuple[tuple[str, ...], ...] = ()
    ros2: bool = False
    metrics: str = ""
    events: Lines | None = None
    config_dirs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class PreparedHand:
    """A hand whose files have been read and checked, before any device is opened."""

    hand: Hand
    config: HandConfig
    folder: Path
    library: ActionLibrary
    settings: LoopSettings
    devices: tuple[DeviceSettings, ...]

    def loop(self, pool: BusPool) -> HandLoop:
        """Return the hand's loop with its drivers, whose buses are in a pool."""
        devices = [
            (device, find_driver(device.spec.driver, source=device.spec.source)(device.spec, pool))
            for device in self.devices
        ]
        return HandLoop(self.hand, self.library, self.settings, devices)

    def warnings(self) -> list[str]:
        """Return warnings about the hand's files, one sentence each."""
        pinched = pinch_at_rest(
            self.hand, (action for action in self.library if isinstance(action, Primitive))
        )
        return [*([pinched] if pinched else []), *open_to_everybody(self.folder)]

    def attachments(self) -> dict[str, bytes]:
        """Return the contents of the files to attach to a recording, by name."""
        files = [self.folder / "hand.yaml"]
        if self.config.srdf is not None:
            files.append(self.folder / self.config.srdf)
        files += sorted((self.folder / "actions").rglob("*.yaml"))
        contents: dict[str, bytes] = {}
        for file in files:
            try:
                contents[file.relative_to(self.folder).as_posix()] = file.read_bytes()
            except (OSError, ValueError) as error:  # ValueError: an SRDF outside of the folder
                log.warning("%s is not attached to the recording: %s", file, error)
        return contents

    def recorder_settings(self, options: RunOptions) -> RecorderSettings:
        """Return the settings of the hand's recorder."""
        given = self.config.log
        settings = structs.asdict(given)
        # The shell does not expand the `~` in `--log=~/logs`.
        log_folder = None if options.log is None else Path(os.path.expanduser(options.log))
        settings["directory"] = folder = log_folder or given.directory
        settings["enabled"] = recorded = options.record and (
            given.enabled or options.log is not None
        )
        # Without recordings and a folder for them, users expect no files at all; and a replay is
        # a recording already.
        if (not recorded and folder is None) or options.driver == "replay":
            settings["flight_recorder"] = 0.0
        found = RecorderSettings(**settings)
        common = found.common_directory
        if common and not found.folder.absolute().is_relative_to(common.absolute()):
            raise ConfigError(
                f"log: common_directory '{common}' should be above the folder of the recordings, "
                f"'{found.folder}'",
                path=self.folder / "hand.yaml",
            )
        return found


def open_to_everybody(folder: Path) -> list[str]:
    """Return a warning if all users can change a hand's files, and thereby its motions."""
    for path in (folder, *sorted(folder.rglob("*"))):
        try:
            status = path.lstat()
        except OSError:
            continue
        # Linux sets the mode of a link itself to 0o777, which permits nothing.
        if stat.S_IMODE(status.st_mode) & stat.S_IWOTH and not stat.S_ISLNK(status.st_mode):
            return [f"{path} can be changed by everybody; 'chmod -R o-w {folder}' prevents it"]
    return []


def prepare(name: str, options: RunOptions) -> PreparedHand:
    """Read and check all files of a hand, without opening any device.

    Raises:
        UserError: if there is a mistake in the files or the options.
    """
    hand, config, document = load_documented(name, config_dirs=options.config_dirs)
    folder = document.path.parent
    settings = loop_settings(config, rate=options.rate)
    choice = DeviceChoice(
        options.driver,
        options.emulated,
        options.ideal,
        tuple(options.driver_options.items()),
        str(document.path),
        {device: document.line(("devices", device)) or 1 for device in config.devices},
        str(folder),
    )
    devices = tuple(device_settings(hand, config, settings.rate, choice))
    library = ActionLibrary.load(hand, folder / "actions")
    return PreparedHand(
        hand=hand,
        config=config,
        folder=folder,
        library=library,
        settings=settings,
        devices=_with_options(hand.name, devices, options),
    )


def _with_options(
    hand: str, devices: Sequence[DeviceSettings], options: RunOptions
) -> tuple[DeviceSettings, ...]:
    """Return the devices, with homing allowed and an object in the hand if the options say so."""
    specs = tuple(device.spec for device in devices)
    if options.home:
        specs = homing_allowed(specs)
    if options.object_in_hand is not None:
        specs = between_fingers(hand, specs, options.object_in_hand)
    return tuple(replace(d, spec=spec) for d, spec in zip(devices, specs, strict=True))


def homing_allowed(specs: Sequence[DeviceSpec]) -> tuple[DeviceSpec, ...]:
    """Return the devices of a hand, with homing allowed at their first activation.

    A device that is already homed, or never needs homing, does not move.
    """
    return tuple(
        replace(spec, options={**spec.options, "home": "on_connect"})
        if "home" in defaults(find_driver(spec.driver, source=spec.source).Options)
        else spec
        for spec in specs
    )
