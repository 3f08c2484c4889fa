"""What emulated lines of servos share: all hear everything, each answers for itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Generic, Protocol, TypeVar

from rtee.buses.emulator import Emulator


class EmulatedServo(Protocol):
    """One servo of an emulated line.

    Attributes:
        silent_until: It answers nothing before this time [s].
    """

    silent_until: float

    @property
    def number(self) -> int:
        """Its id."""
        ...

    def reboot(self, now: float) -> None:
        """Restart."""
        ...

    def step(self, now: float) -> None:
        """Let time pass up to ``now`` [s]."""
        ...


class Resets(Protocol):
    """A parser of what the host sends."""

    def reset(self) -> None:
        """Forget the bytes of an incomplete frame."""
        ...


S = TypeVar("S", bound=EmulatedServo)


class ServoLine(Emulator, Generic[S]):
    """Servos on one line.

    Args:
        servos: The servos.
        parser: Finds what the host sends.

    Attributes:
        ordered: The servos as they were given.
    """

    def __init__(self, servos: Sequence[S], parser: Resets) -> None:
        super().__init__()
        self.ordered = list(servos)
        self._incoming = parser

    @property
    def servos(self) -> dict[int, S]:
        """The servos by id."""
        # Made anew for every call, since a write may change a servo's id.
        return {servo.number: servo for servo in self.ordered}

    def listening(self, numbers: Iterable[int], now: float) -> list[S]:
        """Return the servos of these ids that can answer, in this order."""
        servos = self.servos
        found = [servos[n] for n in numbers if n in servos]
        return [servo for servo in found if now >= servo.silent_until]

    def power_cycle(self, now: float) -> None:
        """Cut the supply of all servos and bring it back."""
        for servo in self.ordered:
            servo.reboot(now)
        self.line_reset()

    def line_reset(self) -> None:
        """Forget the bytes of an incomplete frame."""
        self._incoming.reset()

    def step(self, now: float) -> list[bytes]:
        """Let time pass; servos send nothing without a request."""
        for servo in self.ordered:
            servo.step(now)
        return []
