"""Estimate the temperature of motors that measure only current: first-order heating by I²; pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rtee.errors import ConfigError, suggestion
from rtee.hand.config_schema import ThermalSettings
from rtee.loop.thermal import PLAUSIBLE

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
