"""Wear: how real devices differ from ideal ones, as data that all emulators share."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from rtee.hand.validation import Section

Amount = Annotated[float, Meta(ge=0.0, le=1e3)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class Wear(Section, frozen=True):
    """Deviations of an emulated device from its data sheet.

    The shares are of a motor's full travel.

    Attributes:
        lag: Time from a command until a motor at rest or moving follows it [s].
        pace: Share of the sheet's speed that its motors reach.
        backlash: Play between motor and encoder, in which the encoder does not follow [share].
        offset: Constant error of a position [share].
        noise: Standard deviation of a measured position [share].
        warmth: Temperature rise of its idle motors above the ambient temperature [K].
        late: Delay of the first answer to a program that connects [s].
        garbled: Whether the first byte of that answer is damaged, on a serial line.
        touch: What its touch sensors read while nothing touches them [their counts].
        touch_noise: Standard deviation of a touch sensor [counts].
        force: What its force sensors read while nothing is held [their counts].
    """

    lag: Amount = 0.0
    pace: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.0
    backlash: Share = 0.0
    offset: Annotated[float, Meta(ge=-1.0, le=1.0)] = 0.0
    noise: Share = 0.0
    warmth: Amount = 0.0
    late: Amount = 0.0
    garbled: bool = False
    touch: tuple[int, ...] = ()
    touch_noise: Amount = 0.0
    force: tuple[int, ...] = ()


IDEAL = Wear()
"""A device that matches its data sheet."""

TYPICAL = Wear(
    lag=0.02,
    pace=0.9,
    backlash=0.004,
    offset=0.002,
    noise=0.0003,
    warmth=15.0,
    late=0.05,
    garbled=True,
)
"""Wear assumed for a device without measurements: a used hobby or industrial drive. It has two
exchanges of lag, a tenth less speed, about half a per cent of play and offset, and an adapter that
is slow and noisy when its port opens."""


@dataclass(slots=True)
class WornSensor:
    """A position sensor with backlash, an offset and noise.

    Attributes:
        backlash: Play within which it does not follow the motor [units of the position].
        offset: Constant error [units of the position].
        noise: Standard deviation [units of the position].
    """

    backlash: float = 0.0
    offset: float = 0.0
    noise: float = 0.0
    _held: float | None = None
    # One seed for all: an emulated device must measure the same in every run.
    _random: random.Random = field(default_factory=lambda: random.Random(1), repr=False)  # noqa: S311

    @classmethod
    def of(cls, wear: Wear, travel: float) -> WornSensor:
        """Return the sensor of a motor with this travel [units of the position]."""
        return cls(wear.backlash * travel, wear.offset * travel, wear.noise * travel)

    def read(self, position: float) -> float:
        """Return the measurement at a position."""
        half = self.backlash / 2.0
        if half > 0.0:
            held = position if self._held is None else self._held
            self._held = position = min(max(held, position - half), position + half)
        if self.noise > 0.0:
            position += self._random.gauss(0.0, self.noise)
        return position + self.offset
