"""Settings of a loop and its devices: those in hand.yaml, and some fixed ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import structs

from rtee.errors import ConfigError
from rtee.hand.config_schema import (
    MAX_RATE,
    MIN_RATE,
    DeviceSection,
    LoopSection,
    ProfileKind,
    ProfileSettings,
    RealtimeSettings,
    SafetySettings,
    ThermalSettings,
)
from rtee.hand.limits import mechanism
from rtee.hand.model import Hand
from rtee.loop.free_motion import LearnedMotion
from rtee.types import DeviceSpec

if TYPE_CHECKING:
    from rtee.hand.config import HandConfig


def usual_profile() -> ProfileKind:
    """Return the default profile: ``s_curve`` where ruckig is not installed."""
    try:
        import ruckig  # noqa: F401
    except ImportError:
        return ProfileKind.S_CURVE
    return ProfileKind.JERK_LIMITED


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """The settings of a device, for its supervisor.

    Attributes:
        spec: The specification of the device, for its driver.
        reconnect_active: Whether to activate the device after reconnecting; else it stays inactive.
    """

    spec: DeviceSpec
    reconnect_active: bool = False


class LoopSettings(LoopSection, frozen=True):
    """The settings of one hand's loop.

    Attributes:
        profile: The profile between set-points.
        safety: Behaviour after the end of a run, and after the loss of clients and devices.
        thermal: Temperature limits.
        feedback_rate: Highest rate of feedback [Hz].
        statistics_window: Interval of device status and loop statistics [s].
        free_motion: The free motion of actuators learned before the start, by name.

    Raises:
        ConfigError: if the rate is out of range.
    """

    profile: ProfileSettings = msgspec.field(
        default_factory=lambda: ProfileSettings(usual_profile())
    )
    safety: SafetySettings = SafetySettings()
    thermal: ThermalSettings = ThermalSettings()
    feedback_rate: float = 50.0
    statistics_window: float = 1.0
    free_motion: Mapping[str, LearnedMotion] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the rate, which may come from the command line."""
        if not (math.isfinite(self.rate) and MIN_RATE <= self.rate <= MAX_RATE):
            raise ConfigError(
                f"the loop's rate must be {MIN_RATE:g} to {MAX_RATE:g} Hz, not {self.rate:g}"
            )

    @property
    def period(self) -> float:
        """Time between ticks [s]."""
        return 1.0 / self.rate


KINEMATIC = "kinematic"
"""The driver that needs no device."""

DEVICES = "devices"
"""The choice of the devices in hand.yaml."""


def loop_settings(config: HandConfig, *, rate: float | None = None) -> LoopSettings:
    """Return the loop's settings of a hand; a rate [Hz] overrides the configured one.

    Raises:
        ConfigError: if the rate is out of range.
    """
    kind = config.profile.kind
    if kind is ProfileKind.JERK_LIMITED:
        # ruckig is optional; a recording must name the profile that really ran, for its replay.
        kind = usual_profile()
    return LoopSettings(
        **structs.asdict(config.loop) | ({} if rate is None else {"rate": rate}),
        profile=structs.replace(config.profile, kind=kind),
        safety=config.safety,
        thermal=config.thermal,
    )


def profile_words(config: HandConfig, settings: LoopSettings) -> str:
    """Return the profile's name, and the reason if it is not the configured one."""
    kind = settings.profile.kind
    if kind == config.profile.kind:
        return str(kind)
    return f"{kind} instead of {config.profile.kind}: ruckig is not installed"


def realtime_settings(config: HandConfig, *, enabled: bool = False) -> RealtimeSettings:
    """Return the real-time settings of a hand; ``enabled`` overrides those of hand.yaml."""
    return structs.replace(config.realtime, enabled=config.realtime.enabled or enabled)


@dataclass(frozen=True, slots=True)
class DeviceChoice:
    """The user's choice of drivers for a hand.

    Attributes:
        driver: ``kinematic``, ``devices``, or a driver's name; ``None``: as in hand.yaml.
        emulated: Talk to emulators instead of the real devices.
        ideal: Emulated devices match their data sheets instead of being worn.
        options: Options of the driver, which take precedence over those in hand.yaml.
        source: The hand.yaml, for messages.
        lines: Line of each device in it, for messages.
        folder: The hand's folder.
    """

    driver: str | None = None
    emulated: bool = False
    ideal: bool = False
    options: tuple[tuple[str, object], ...] = ()
    source: str = ""
    lines: Mapping[str, int] = field(default_factory=dict)
    folder: str = ""


def device_settings(
    hand: Hand, config: HandConfig, rate: float, choice: DeviceChoice
) -> list[DeviceSettings]:
    """Return the settings of the devices to run a hand with.

    A driver's name selects the devices of hand.yaml that use it; a kinematic device replaces the
    others. A driver that no device of hand.yaml uses drives all actuators.

    Args:
        hand: The hand.
        config: Its hand.yaml.
        rate: Rate of the loop [Hz].
        choice: The choice of drivers.

    Raises:
        ConfigError: if hand.yaml has no devices, they leave an actuator out, or options are given
            for several.
    """
    driver = choice.driver or (DEVICES if choice.emulated else config.driver)
    if driver == DEVICES:
        if not config.devices:
            raise ConfigError(
                f"the hand '{hand.name}' has no devices; give it some under 'devices:' in"
                f" {choice.source or 'hand.yaml'}, or run it with --driver {KINEMATIC}"
            )
        chosen = list(config.devices.items())
    else:
        # The devices of this driver keep their options; a kinematic driver takes the other
        # actuators.
        chosen = [(n, d) for n, d in config.devices.items() if d.driver == driver]
    # Drivers have different options: most would be wrong for one of several devices.
    if choice.options and len(chosen) > 1:
        raise ConfigError(
            f"--option is for one device, and {hand.name} has {', '.join(n for n, _ in chosen)}; "
            f"give their options in {choice.source or 'hand.yaml'}"
        )
    settings = [_settings_of(hand, name, device, rate, choice) for name, device in chosen]
    driven = {actuator.name for device in settings for actuator in device.spec.actuators}
    left = [name for name in hand.actuator_names if name not in driven]
    if not left:
        return settings
    if driver == DEVICES:
        raise ConfigError(
            f"{choice.source or hand.name}: no device drives the actuator '{left[0]}'"
        )
    stand_in = KINEMATIC if settings else driver
    given = choice.driver or choice.options
    own = replace(
        choice,
        options=choice.options if stand_in == driver else (),
        source=f"--driver {driver}" if given else choice.source,
        lines={},
    )
    name = _free_name(stand_in, [name for name, _ in chosen])
    section = DeviceSection(stand_in, tuple(left))
    return [*settings, _settings_of(hand, name, section, rate, own)]


_PATIENT: Final = 1.0
"""Longest exchange with an ideal emulated device [s]; three of them lose it: tests compare its
numbers, and on a busy computer its thread waits for a processor longer than a real device takes to
answer."""


def _free_name(driver: str, taken: Sequence[str]) -> str:
    name = driver.partition(":")[2] or driver
    while name in taken:
        name += "_"
    return name


def _settings_of(
    hand: Hand, name: str, device: DeviceSection, rate: float, choice: DeviceChoice
) -> DeviceSettings:
    names = hand.actuator_names if device.actuators == "all" else tuple(device.actuators)
    # In the hand's order, not that of hand.yaml: drivers and arrays rely on it.
    ordered = [actuator for actuator in hand.actuators if actuator.name in names]
    spec = DeviceSpec(
        name=name,
        hand=hand.name,
        driver=device.driver,
        actuators=tuple(ordered),
        options={**device.options, **dict(choice.options)},
        rate=rate,
        every=device.every,
        deadline=device.deadline or (_PATIENT if choice.emulated and choice.ideal else None),
        emulated=choice.emulated,
        worn=choice.emulated and not choice.ideal,
        source=f"{choice.source}:{choice.lines[name]}" if name in choice.lines else choice.source,
        folder=choice.folder,
        mechanisms={actuator.name: mechanism(actuator, hand.urdf) for actuator in ordered},
        overridden=tuple(option for option, _ in choice.options),
    )
    return DeviceSettings(spec, reconnect_active=device.reconnect == "active")
