"""The contract of a device's emulator: sans-I/O, driven by bytes or frames and the time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

from rtee.buses.parser import Parser
from rtee.buses.wear import IDEAL, TYPICAL, Wear
from rtee.errors import ConfigError, suggestion


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One frame on a CAN bus.

    Attributes:
        id: The identifier.
        data: Up to eight bytes.
        extended: Whether the identifier has 29 bits.
        remote: Whether it asks for data instead of carrying it.
        stamp: When it was received, CLOCK_MONOTONIC [s].
    """

    id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    stamp: float = 0.0


class Duplex(Enum):
    """Whether host and device can send at the same time."""

    HALF = "half"
    FULL = "full"


class Emulator(ABC):
    """Emulates a device: receives what comes over the wire and returns the device's answers.

    It does no I/O, has no clock and no thread: `rtee.buses.simulated` drives it over a pty, a TCP
    port or a CAN channel, tests drive it by hand. Times are those of CLOCK_MONOTONIC or of another
    clock that never goes back [s].

    Attributes:
        PROPERTIES: Its configurable properties (``emulator:`` in a driver's options), a `Section`
            that its constructor takes; ``None``: it has none.
        SHARED: Options of the driver that are properties, too.
        FAULTS: Names of the faults that `inject` accepts; every emulator accepts ``stuck`` (the
            position does not follow) and ``wrong_device`` (another model answers).
        turnaround: Time between a request's last byte and the answer's first [s].
        period: Time between calls of `step` without traffic [s]; 0: no such calls.
        baudrate: Rate of its line [baud], for programs that ask for none.
        BAUDRATES: Rates that its line can have [baud]; empty: any.
        SCHEME: Scheme of its address on TCP: ``tcp`` if it then speaks Modbus TCP, ``socket`` if
            its bytes are the same as on a line.
        duplex: Duplex of its line: half, as on two-wire RS-485 or a single data wire, or full.
        WEAR: Deviations of the real device from its data sheet, as far as they were measured.
        axes: Its motors, which `wear_down` affects and ``stuck`` blocks.
        parser: Finds the host's frames in the bytes of a line.
        faults: Faults injected at present.
        wear: Deviations of this emulator from the data sheet.
        echo: Whether the host's adapter returns what the host sends, as some on two-wire lines do.
        fresh: Whether no program has received an answer since the line was connected.
    """

    PROPERTIES: ClassVar[type[Any] | None] = None
    SHARED: ClassVar[tuple[str, ...]] = ()
    WEAR: ClassVar[Wear] = TYPICAL
    FAULTS: ClassVar[frozenset[str]] = frozenset({"stuck", "wrong_device"})
    BAUDRATES: ClassVar[frozenset[int]] = frozenset()
    SCHEME: ClassVar[str] = "tcp"
    turnaround: float = 0.0
    period: float = 0.0
    baudrate: int = 115200
    duplex: ClassVar[Duplex] = Duplex.HALF
    axes: Sequence[Any] = ()
    parser: Parser[Any] | None = None
    echo: bool = False

    def __init__(self) -> None:
        self.faults: set[str] = set()
        self.wear = IDEAL
        self.fresh = True
        self._clock: float | None = None

    @classmethod
    def fitting(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the properties that follow from a driver's valid options."""
        return {name: options[name] for name in cls.SHARED if options.get(name) is not None}

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive bytes from a line and return the answers, if any."""
        self.advance(now)
        if self.parser is None or "silent" in self.faults:
            return []
        return [one for frame in self.parser.feed(data) for one in self.answers(frame, now)]

    def answers(self, frame: Any, now: float) -> Iterable[bytes]:
        """Obey a frame that `parser` has found; return the answers, if any."""
        return ()

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        """Receive a frame from a CAN bus and return the answers, if any."""
        return []

    def step(self, now: float) -> list[bytes] | list[CanFrame]:
        """Let time pass up to ``now``; return what the device sends by itself."""
        self.advance(now)
        return []

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``; by default for the motors alone."""
        dt = self._elapsed(now)
        for motor in self.axes:
            motor.advance(dt)

    def line_reset(self) -> None:
        """Forget the bytes of an incomplete request: another program connected to the line."""
        if self.parser is not None:
            self.parser.reset()

    @abstractmethod
    def power_cycle(self, now: float) -> None:
        """Lose the state that the device loses in a power cycle."""

    def halt(self) -> None:
        """Let the motors stay where they are."""
        for motor in self.axes:
            motor.target = motor.position

    def wear_down(self, wear: Wear) -> None:
        """Make the device deviate from its data sheet."""
        self.wear = wear
        for motor in self.axes:
            motor.wear_down(wear)

    def inject(self, fault: str) -> None:
        """Inject a fault, which stays until `clear`.

        Raises:
            ConfigError: if this device has no such fault.
        """
        if fault not in self.FAULTS:
            raise ConfigError(f"unknown fault '{fault}'; {suggestion(fault, self.FAULTS)}")
        self.faults.add(fault)
        self.on_faults()

    def clear(self, fault: str | None = None) -> None:
        """Remove one fault, or all."""
        if fault is None:
            self.faults.clear()
        else:
            self.faults.discard(fault)
        self.on_faults()

    def on_faults(self) -> None:
        """Act on changed `faults`. By default, ``stuck`` blocks the motors."""
        for motor in self.axes:
            motor.stuck = "stuck" in self.faults

    def _elapsed(self, now: float) -> float:
        """Return the time since the last call [s]: 0 at the first one, and never negative."""
        before = now if self._clock is None else self._clock
        # If the clock went back, the same time must not be simulated twice.
        self._clock = max(before, now)
        return self._clock - before


EmulatorFactory = Callable[[], Emulator]
"""Makes a device's emulator; given to the pool by a driver whose device is emulated."""
