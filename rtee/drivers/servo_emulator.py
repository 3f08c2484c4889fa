"""Common parts of emulated lines of servos: all receive every request, each answers for itself."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from rtee.buses.emulator import Emulator
from rtee.buses.parser import Parser
from rtee.drivers.axis import Axis


class EmulatedServo(ABC):
    """One servo of an emulated line.

    Attributes:
        ID: The register of its id.
        PENDING: The register that tells whether bytes wait for `action`.
        axis: Its shaft.
        silent_until: Time before which it does not answer [s].
        get: Returns a register's value.
        set: Sets a register without any check.
    """

    ID: ClassVar[Any]
    PENDING: ClassVar[Any]
    axis: Axis
    silent_until: float = -math.inf
    get: Callable[[Any], int]
    set: Callable[[Any, int], None]
    _pending: tuple[int, bytes] | None = None

    @property
    def number(self) -> int:
        """Its id."""
        return self.get(self.ID)

    @abstractmethod
    def reboot(self, now: float) -> None:
        """Restart."""

    @abstractmethod
    def step(self, now: float) -> None:
        """Let time pass up to ``now`` [s]."""

    @abstractmethod
    def write(self, address: int, data: bytes) -> object:
        """Write bytes as a host may, and act on them."""

    def hold_back(self, address: int, data: bytes) -> None:
        """Store bytes to be written by `action`."""
        self._pending = address, data
        self.set(self.PENDING, 1)

    def action(self) -> None:
        """Write the bytes stored by `hold_back`."""
        if self._pending is not None:
            (address, data), self._pending = self._pending, None
            self.set(self.PENDING, 0)
            self.write(address, data)


S = TypeVar("S", bound=EmulatedServo)


class ServoLine(Emulator, Generic[S]):
    """Servos on one line.

    Args:
        parser: The parser of requests.

    Attributes:
        ordered: The servos in the order of the argument.
    """

    def __init__(self, servos: Sequence[S], parser: Parser[Any]) -> None:
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

    def motors(self) -> Sequence[Axis]:
        """Return its motors."""
        return [servo.axis for servo in self.ordered]

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
