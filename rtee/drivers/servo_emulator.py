"""Common parts of emulated lines of servos: all receive every request, each answers for itself."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from rtee.buses.emulator import Emulator
from rtee.buses.parser import Parser
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.servo_lines import DELAY_UNIT


class EmulatedServo(ABC):
    """One servo of an emulated line.

    Attributes:
        ID: The register of its id.
        MODEL: That of its model number.
        BAUD_RATE: That of the rate of its line.
        PENDING: The register that shows whether bytes wait for `action`.
        RETURN_DELAY: That of its return delay.
        axis: Its shaft.
        silent_until: Time before which it does not answer [s].
        get: Returns a register's value.
        set: Sets a register without any check.
        keep: Sets it and stores the value.
        cause: The bits of errors whose cause persists.
        model: Its model number.
        travel: Positions of the axis at power-up and when closed.
    """

    ID: ClassVar[Any]
    MODEL: ClassVar[Any]
    BAUD_RATE: ClassVar[Any]
    PENDING: ClassVar[Any]
    RETURN_DELAY: ClassVar[Any]
    axis: Axis
    silent_until: float = -math.inf
    get: Callable[[Any], int]
    set: Callable[[Any, int], None]
    keep: Callable[[Any, int], None]
    cause: int = 0
    model: int
    travel: tuple[float, float]
    _pending: tuple[int, bytes] | None = None
    _strained: float | None = None

    @property
    def number(self) -> int:
        """Its id."""
        return self.get(self.ID)

    @property
    def delay(self) -> float:
        """Time that it waits before it answers [s]."""
        return self.get(self.RETURN_DELAY) * DELAY_UNIT

    def strained_for(self, strained: bool, now: float) -> float:
        """Return how long the servo has been strained [s]; 0 if it is not."""
        self._strained = (now if self._strained is None else self._strained) if strained else None
        return 0.0 if self._strained is None else now - self._strained

    @abstractmethod
    def reboot(self, now: float) -> None:
        """Restart."""

    @abstractmethod
    def step(self, now: float) -> None:
        """Let time pass up to ``now`` [s]."""

    @abstractmethod
    def fail(self, error: Any) -> None:
        """Set an error, which may disable the torque."""

    @abstractmethod
    def write(self, address: int, data: bytes) -> object:
        """Write bytes, with the checks of a host's write, and act on them."""

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


class ServoLine(Emulator, Grasps, Generic[S]):
    """Servos on one line; all receive every request, each answers for itself.

    Raises `ValueError` if two servos have the same id.

    Args:
        parser: The parser of requests.

    Attributes:
        ERRORS: The errors of the first servo that can be injected.
        RATES: Rates of the line by the value of their register [baud].
        STRANGER: Model number of a servo of another kind.
        ordered: The servos in the order of the argument.
        properties: The properties of the line.
    """

    SHARED: ClassVar[tuple[str, ...]] = ("baudrate",)
    ERRORS: ClassVar[Mapping[str, int]]
    RATES: ClassVar[Sequence[int]]
    STRANGER: ClassVar[int]
    properties: Any

    def __init__(self, servos: Sequence[S], parser: Parser[Any]) -> None:
        super().__init__()
        self.ordered = list(servos)
        if len(self.servos) < len(self.ordered):
            raise ValueError("two of the servos have the same id")
        self.axes = [servo.axis for servo in servos]
        self.parser = parser
        self._shown_rate = 0

    @classmethod
    def fitting(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the properties from a device's options: ids, initial positions and latency."""
        found = super().fitting(options)
        if "turnaround" in options:
            found["latency"] = options["turnaround"]
        if servos := options.get("servos"):
            emulated = options.get("emulator") or {}
            found["ids"] = tuple(dict(servo)["id"] for servo in servos.values())
            common = emulated.get("servo") or {}
            places = {} if "special" in emulated else cls._places(options)
            found["special"] = {number: {**at, **common} for number, at in places.items()}
        return found

    @classmethod
    @abstractmethod
    def _places(cls, options: Mapping[str, Any]) -> dict[int, dict[str, Any]]:
        """Return the initial position and closing travel of each servo of a device, by id."""

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

    def write_each(self, address: int, size: int, entries: bytes, now: float) -> None:
        """Write to several servos; ``entries`` holds an id and ``size`` bytes for each."""
        for at in range(0, len(entries) - size, size + 1):
            for servo in self.listening([entries[at]], now):
                servo.write(address, entries[at + 1 : at + 1 + size])

    def delayed(self, answers: list[bytes], servos: Iterable[S]) -> list[bytes]:
        """Return answers, after the return delays of servos and the adapter's latency."""
        self.turnaround = sum(servo.delay for servo in servos) + self.properties.latency
        return answers

    def power_cycle(self, now: float) -> None:
        """Cut the supply of all servos and bring it back."""
        for servo in self.ordered:
            servo.reboot(now)
        self.line_reset()

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``, and show the rate of the line in the servos' registers."""
        for servo in self.ordered:
            servo.step(now)
        if self.baudrate != self._shown_rate and self.baudrate in self.RATES:
            self._shown_rate = self.baudrate
            for servo in self.ordered:
                servo.keep(servo.BAUD_RATE, self.RATES.index(self.baudrate))

    def inject(self, fault: str) -> None:
        """Put a fault into the servos: an error into the first, any other fault into all."""
        super().inject(fault)
        for servo in self.ordered[:1] if fault in self.ERRORS else ():
            servo.fail(self.ERRORS[fault])

    def on_faults(self) -> None:
        """Apply the faults: block stuck servos, and set errors and model numbers."""
        super().on_faults()
        for servo in self.ordered[:1]:
            servo.cause = sum(bit for name, bit in self.ERRORS.items() if name in self.faults)
        for servo in self.ordered:
            servo.keep(servo.MODEL, self.STRANGER if "wrong_device" in self.faults else servo.model)

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the servos, from their positions at power-up."""
        return [Closing(servo.axis, *servo.travel, servo.axis.rating) for servo in self.ordered]
