"""Watch temperatures: warn, derate, disable; and distinguish a broken sensor from a hot motor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

from rtee.errors import ConfigError, suggestion
from rtee.hand.config_schema import ThermalSettings
from rtee.types import Event

PLAUSIBLE = (-40.0, 150.0)
"""Range of real temperatures [°C]; anything else comes from a broken sensor."""

_CONFIRM = 0.5
"""A level must last this long before it counts [s]: temperatures rise slowly, noise does not
last."""

_AGAIN = 1.0
"""An actuator that is too hot but still driven is disabled again after this time [s]: its device
did not answer, or somebody has recovered it. Longer than `_CONFIRM`, so that an actuator that has
cooled is left alone."""

_HYSTERESIS = 2.0
"""A level ends this far below its threshold [K]: more than the resolution of 1 K of most
sensors."""

_LEAST = 0.1
"""Derating leaves at least this fraction of the effort limit until the device is disabled: a held
object may not fall."""


class ThermalLevel(IntEnum):
    """Levels of an actuator's temperature."""

    OK = 0
    WARN = 1
    DERATE = 2
    DISABLE = 3
    INVALID = 4


# Filled with an actuator's name and the factor on its effort limit.
_STATUS = {
    ThermalLevel.WARN: "{} is warm",
    ThermalLevel.DERATE: "{} is hot, its effort limited to {:.0%}",
    ThermalLevel.DISABLE: "{} is too hot",
    ThermalLevel.INVALID: "the temperature sensor of {} is invalid",
}
_EVENTS = {
    ThermalLevel.OK: ("is cool again:", "info"),
    ThermalLevel.WARN: ("is warm:", "warning"),
    ThermalLevel.DERATE: ("is hot and gets less effort:", "warning"),
    ThermalLevel.DISABLE: ("is too hot, its device is disabled:", "error"),
    ThermalLevel.INVALID: ("has an invalid temperature sensor:", "warning"),
}
_RISING = (ThermalLevel.WARN, ThermalLevel.DERATE, ThermalLevel.DISABLE)


@dataclass(frozen=True, slots=True)
class ThermalChange:
    """An actuator reached another level, or is still driven though it is too hot.

    Attributes:
        index: The actuator.
        level: Its present level.
        temperature: Its temperature [°C].
    """

    index: int
    level: ThermalLevel
    temperature: float

    def event(self, name: str, stamp: float, *, estimated: bool = False) -> Event:
        """Return the event that reports it.

        Args:
            name: The actuator's name.
            stamp: Now [s].
            estimated: Whether the temperature was estimated, not measured.
        """
        text, severity = _EVENTS[self.level]
        text = f"{name} {text} {self.temperature:.0f} °C"
        text += ", estimated from its current" if estimated else ""
        return Event("thermal", name, text, stamp, severity)


class Thermal:
    """Evaluates the temperatures of a hand's actuators; pure.

    Attributes:
        level: Level of each actuator.
        factor: Factor on each actuator's effort limit, 0.1 to 1.
    """

    def __init__(self, settings: ThermalSettings, size: int) -> None:
        self._settings = settings
        self.level = [ThermalLevel.OK] * size
        self.factor = [1.0] * size
        self._pending = [ThermalLevel.OK] * size
        self._since = [math.nan] * size
        self._again = [math.inf] * size

    def words(self, names: Mapping[int, str]) -> str:
        """Describe the actuators, given by index, that are not cool."""
        return "; ".join(
            _STATUS[self.level[i]].format(name, self.factor[i])
            for i, name in names.items()
            if self.level[i] is not ThermalLevel.OK
        )

    def step(
        self, stamp: float, temperature: Sequence[float], driven: Sequence[bool] = ()
    ) -> list[ThermalChange]:
        """Evaluate temperatures; return the actuators whose level changed.

        The caller must disable those at the level `ThermalLevel.DISABLE`, which are returned
        repeatedly until they are disabled.

        Args:
            stamp: Now [s].
            temperature: Temperatures [°C]; ``NaN``: not measured.
            driven: Whether each actuator's device is active; empty: none is.
        """
        changes: list[ThermalChange] = []
        for i, celsius in enumerate(temperature):
            if math.isnan(celsius):
                continue
            level = self._judge(self.level[i], celsius)
            if level == self.level[i]:
                self._since[i] = math.nan
            elif level != self._pending[i] or math.isnan(self._since[i]):
                self._pending[i] = level
                self._since[i] = stamp
            elif stamp - self._since[i] >= _CONFIRM:
                self.level[i] = level
                self._since[i] = math.nan
                changes.append(ThermalChange(i, level, celsius))
            if not (driven and driven[i] and self.level[i] is ThermalLevel.DISABLE):
                self._again[i] = stamp + _AGAIN
            elif stamp >= self._again[i]:
                self._again[i] = stamp + _AGAIN
                changes.append(ThermalChange(i, self.level[i], celsius))
            self.factor[i] = self._factor(self.level[i], celsius, self.factor[i])
        return changes

    def _judge(self, present: ThermalLevel, celsius: float) -> ThermalLevel:
        low, high = PLAUSIBLE
        if not low <= celsius <= high:
            return ThermalLevel.INVALID
        reached = ThermalLevel.OK
        thresholds = (self._settings.warn, self._settings.derate, self._settings.disable)
        for level, threshold in zip(_RISING, thresholds, strict=True):
            # INVALID is the highest number, but not the hottest level.
            keep = _HYSTERESIS if present is not ThermalLevel.INVALID and present >= level else 0.0
            if celsius >= threshold - keep:
                reached = level
        return reached

    def _factor(self, level: ThermalLevel, celsius: float, before: float) -> float:
        if level in (ThermalLevel.OK, ThermalLevel.WARN):
            return 1.0
        if level is ThermalLevel.INVALID or not PLAUSIBLE[0] <= celsius <= PLAUSIBLE[1]:
            # Without a temperature, there is no reason to change the effort limit.
            return before
        span = self._settings.disable - self._settings.derate
        left = (self._settings.disable - celsius) / span if span > 0 else 0.0
        return min(1.0, max(_LEAST, left))


DEFAULTS = "defaults"
"""Stands for all actuators that have no nominal current of their own."""


class CurrentHeat:
    """Estimates the temperature of actuators from their current (I²t).

    The rise θ above the ambient temperature follows τ·θ′ = θ₁·(I / I₁)² − θ: losses grow with the
    square of the current, the heat given off with the temperature. At the nominal current I₁, which
    the motor may carry continuously, θ settles at θ₁, which corresponds to ``warn``.

    Args:
        settings: Nominal currents, time constant τ, ambient temperature.
        names: Names of the hand's actuators.

    Attributes:
        rise: Estimated rise of each actuator [K]; 0 where there is no nominal current.

    Raises:
        ConfigError: if a nominal current is given for an actuator that the hand doesn't have.
    """

    def __init__(self, settings: ThermalSettings, names: Sequence[str]) -> None:
        given = settings.nominal_current
        for name in given:
            if name not in names and name != DEFAULTS:
                raise ConfigError(
                    f"thermal.nominal_current in hand.yaml: unknown actuator '{name}';"
                    f" {suggestion(name, [*names, DEFAULTS])}"
                )
        common = given.get(DEFAULTS)
        nominal = {i: given.get(name, common) for i, name in enumerate(names)}
        self._nominal = {i: current for i, current in nominal.items() if current is not None}
        self._ambient = settings.ambient
        self._settled = settings.warn - settings.ambient
        self._time_constant = settings.time_constant
        self._last = math.nan
        self._highest = PLAUSIBLE[1] - settings.ambient
        self.rise = [0.0] * len(names)

    def step(
        self, stamp: float, temperature: Sequence[float], current: Sequence[float]
    ) -> Sequence[float]:
        """Advance to a time; return temperatures [°C], estimated where none is measured.

        Args:
            stamp: Now [s].
            temperature: Measured temperatures [°C]; ``NaN``: not measured.
            current: Measured currents [A]; ``NaN`` counts as 0.
        """
        if not self._nominal or not current:
            return temperature
        passed, self._last = stamp - self._last, stamp
        share = 0.0 if math.isnan(passed) else 1.0 - math.exp(-passed / self._time_constant)
        temperatures = list(temperature)
        for i, nominal in self._nominal.items():
            load = 0.0 if math.isnan(current[i]) else (current[i] / nominal) ** 2
            rise = self.rise[i] + share * (load * self._settled - self.rise[i])
            # Beyond the plausible range it would count as a broken sensor.
            self.rise[i] = min(rise, self._highest)
            if math.isnan(temperatures[i]):
                temperatures[i] = self._ambient + self.rise[i]
        return temperatures
