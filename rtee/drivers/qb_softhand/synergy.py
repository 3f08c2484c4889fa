"""Conversion between closures and motor ticks, for a SoftHand and for the two synergies of a 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

CLOSURE_TICKS = 19_000
"""Travel of the motor of a Research hand from open to closed [ticks], as from the factory."""
MANIPULATION_TICKS = -4_000
"""Lower limit of the motors of a two-motor hand [ticks], as from the factory."""


class Mapping(Protocol):
    """Conversion between the hand's actuators and its motors."""

    def to_ticks(self, closure: tuple[float, ...]) -> tuple[float, float]:
        """Return the references of both motors [ticks]."""
        ...

    def to_closure(self, positions: tuple[int, ...]) -> tuple[float, ...]:
        """Return the actuators' positions from the encoders [ticks]."""
        ...


@dataclass(frozen=True, slots=True)
class OneMotor:
    """A SoftHand: one actuator, 0 open to 1 closed.

    Attributes:
        ticks: Travel of the motor [ticks].
    """

    ticks: int = CLOSURE_TICKS

    def to_ticks(self, closure: tuple[float, ...]) -> tuple[float, float]:
        """Return the references of both motors [ticks]; there is no second one."""
        return closure[0] * self.ticks, 0.0

    def to_closure(self, positions: tuple[int, ...]) -> tuple[float, ...]:
        """Return the closure from the encoders [ticks]."""
        return (positions[0] / self.ticks,)


@dataclass(frozen=True, slots=True)
class TwoMotors:
    """A SoftHand 2: synergy 0 (open) to 1 (closed), manipulation -1 to 1.

    The motors are at ``(1 + m) s R - m L`` and ``(1 - m) s R + m L`` for the synergy s and the
    manipulation m, with R half the sum of their limits and L their (negative) lower limit. The
    first and the third measured position are the motors' own encoders.

    Attributes:
        lower: Lower limit of the motors [ticks], negative.
        upper: Upper limit of the motors [ticks].
    """

    lower: int = MANIPULATION_TICKS
    upper: int = CLOSURE_TICKS - MANIPULATION_TICKS

    @property
    def half(self) -> float:
        """Half of the common travel [ticks]."""
        return (self.upper + self.lower) / 2.0

    def to_ticks(self, closure: tuple[float, ...]) -> tuple[float, float]:
        """Return the references of both motors [ticks]."""
        synergy, manipulation = closure
        shift = manipulation * self.lower
        return (
            (1.0 + manipulation) * synergy * self.half - shift,
            (1.0 - manipulation) * synergy * self.half + shift,
        )

    def to_closure(self, positions: tuple[int, ...]) -> tuple[float, ...]:
        """Return synergy and manipulation from the encoders [ticks]."""
        # The motors' sum is 2 s R and their difference m (2 s R - 2 L); solved for s and m.
        first, second = positions[0], positions[2]
        total = first + second
        # At the lower limit of both motors, no manipulation is possible, and none is measured.
        reach = total - 2.0 * self.lower
        return (total / (2.0 * self.half), (first - second) / reach if abs(reach) >= 1.0 else 0.0)
