"""From hand.yaml and the command line to a hand that was read and checked; nothing is opened."""

from __future__ import annotations

import logging
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from rtee.actions.library import ActionLibrary
from rtee.actions.resting import pinch_at_rest
from rtee.actions.types import Primitive
from rtee.drivers.objects import between_fingers
from rtee.drivers.plain_options import default_options
from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError
from rtee.hand.config import HandConfig, read_document
from rtee.hand.load import hand_folder, load_configured
from rtee.hand.model import Hand
from rtee.log import RecorderSettings
from rtee.loop.configure import DeviceChoice, device_settings, loop_settings
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.types import DeviceSpec

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What the command line may override.

    Attributes:
        driver: ``kinematic``, ``devices``, or a driver's name; ``None``: as in hand.yaml.
        emulated: Talk to emulators instead of the real devices.
        object_in_hand: What is between the fingers of the emulated devices, as a person writes it.
        driver_options: Options of the driver, before those in hand.yaml.
        home: Home devices that need it at the start, whatever hand.yaml says; this moves them.
        rate: Ticks per second [Hz]; ``None``: as in hand.yaml.
        realtime: Ask for real-time scheduling whatever hand.yaml says.
        log: Folder of the recordings; ``None``: as in hand.yaml.
        record: ``False``: write no recordings; faults are written where a folder is configured.
        duration: End after this long [s]; ``None``: never by itself.
        trace: Log the bytes of all buses.
        companions: Commands that run beside, and are ended with the hands.
        ros2: Show all hands as nodes of ROS 2, whatever hand.yaml says.
        config_dirs: Folders to look hands up in, before the usual ones.
    """

    driver: str | None = None
    emulated: bool = False
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
    config_dirs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class PreparedHand:
    """A hand that was read and checked, before anything is opened.

    Attributes:
        hand: The hand.
        config: Its hand.yaml.
        folder: Where that stands.
        library: Its grasping actions.
        settings: The loop's settings.
        devices: Its devices.
    """

    hand: Hand
    config: HandConfig
    folder: Path
    library: ActionLibrary
    settings: LoopSettings
    devices: tuple[DeviceSettings, ...]

    def warnings(self) -> list[str]:
        """Return what makes the hand do other than expected, one sentence each."""
        pinched = pinch_at_rest(
            self.hand, (action for action in self.library if isinstance(action, Primitive))
        )
        return [*([pinched] if pinched else []), *open_to_everybody(self.folder)]

    def attachments(self) -> dict[str, bytes]:
        """Return the files that belong into a recording, by name."""
        files = [self.folder / "hand.yaml"]
        if self.config.srdf is not None:
            files.append(self.folder / self.config.srdf)
        files += sorted((self.folder / "actions").rglob("*.yaml"))
        found: dict[str, bytes] = {}
        for file in files:
            try:
                found[file.relative_to(self.folder).as_posix()] = file.read_bytes()
            except (OSError, ValueError) as error:
                log.warning("%s is not attached to the recording: %s", file, error)
        return found

    def recorder_settings(self, options: RunOptions) -> RecorderSettings:
        """Return how it is to be recorded."""
        given = self.config.log
        settings = {each.name: getattr(given, each.name) for each in fields(given)}
        settings["directory"] = folder = options.log or given.directory
        settings["enabled"] = recorded = options.record and (
            given.enabled or options.log is not None
        )
        # Who wants no recordings, and names no folder for them, expects no files; and what is shown
        # again has been recorded.
        if (not recorded and folder is None) or options.driver == "replay":
            settings["flight_recorder"] = 0.0
        return RecorderSettings(**settings)


def open_to_everybody(folder: Path) -> list[str]:
    """Return a sentence if other users can change the files of a hand, and so what it does."""
    for path in (folder, *sorted(folder.rglob("*"))):
        try:
            found = path.lstat()
        except OSError:
            continue
        if stat.S_IMODE(found.st_mode) & stat.S_IWOTH and not stat.S_ISLNK(found.st_mode):
            return [f"{path} can be changed by everybody; 'chmod -R o-w {folder}' prevents it"]
    return []


def prepare(name: str, options: RunOptions) -> PreparedHand:
    """Read everything about a hand and check it; nothing is opened.

    Raises:
        UserError: for every mistake in its files or the options.
    """
    hand, config = load_configured(name, config_dirs=options.config_dirs)
    folder, file = hand_folder(name, config_dirs=options.config_dirs)
    document = read_document(file)[1]
    settings = loop_settings(config, rate=options.rate)
    choice = DeviceChoice(
        options.driver,
        options.emulated,
        tuple(options.driver_options.items()),
        str(file),
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
        devices=_asked_for(hand.name, devices, options),
    )


def _asked_for(
    hand: str, devices: Sequence[DeviceSettings], options: RunOptions
) -> tuple[DeviceSettings, ...]:
    """Return the devices with leave to home, and what is between their fingers, where asked."""
    specs = tuple(device.spec for device in devices)
    if options.home:
        specs = homing_allowed(hand, specs)
    if options.object_in_hand is not None:
        specs = between_fingers(hand, specs, options.object_in_hand)
    return tuple(replace(d, spec=spec) for d, spec in zip(devices, specs, strict=True))


def homing_allowed(hand: str, specs: Sequence[DeviceSpec]) -> tuple[DeviceSpec, ...]:
    """Return the devices of a hand with leave to home when they are first activated.

    A device that is homed already stays where it is; the others move.

    Args:
        hand: The hand's name.
        specs: Its devices.

    Raises:
        ConfigError: if none of them is ever homed.
    """
    found = tuple(
        replace(spec, options={**spec.options, "home": "on_connect"}) if _homes(spec) else spec
        for spec in specs
    )
    if not any(spec is not given for spec, given in zip(found, specs, strict=True)):
        drivers = ", ".join(sorted({spec.driver for spec in specs}))
        hint = "; give --driver devices, too" if drivers == "kinematic" else ""
        raise ConfigError(f"no device of hand '{hand}' needs homing (driver {drivers}){hint}")
    return found


def _homes(spec: DeviceSpec) -> bool:
    return "home" in default_options(find_driver(spec.driver, source=spec.source).Options)
