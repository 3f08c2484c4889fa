"""Common parts of emulated lines of servos: all receive every request, each answers for itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Generic, Protocol, TypeVar

from rtee.buses.emulator import Emulator
from rtee.drivers.axis import Axis


class EmulatedServo(Protocol):
    """One servo of an emulated line.

    Attributes:
        axis: Its shaft.
        silent_until: Time before which it does not answer [s].
    """

    axis: Axis
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
    """A parser of the host's requests."""

    def reset(self) -> None:
        """Forget the bytes of an incomplete frame."""
        ...


S = TypeVar("S", bound=EmulatedServo)


class ServoLine(Emulator, Generic[S]):
    """Servos on one line.

    Args:
        servos: The servos.
        parser: The parser of requests.

    Attributes:
        ordered: The servos in the order of the argument.
    """

    def __init__(self, servos: Sequence[S], parser: Resets) -> None:
        super().__init__()
        self.ordered = list(servos)
        self._incoming = parser

    @property
    def servos(self) -> dict[int, S]:
        """The servos by id."""
        # Not stored, since a write may change a servo's id.
        return {servo.number: servo for servo in self.ordered}

    def listening(self, numbers: Iterable[int], now: float) -> list[S]:
        """Return the servos with these ids that can answer, in the order of the ids."""
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
