"""Reads the touch board of an ORCA hand; it moves nothing."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from rtee import monotonic
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.buses.serial import SerialBus
from rtee.buses.timing import wire_time
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.options import DeviceOptions, Positive
from rtee.drivers.orca_touch import codec
from rtee.errors import BusTimeout, ConfigError, NotConnected
from rtee.sample import ActuatorState, FloatArray
from rtee.touch import TouchReading, TouchSensor
from rtee.types import DeviceSpec, Reference

_WITHIN = 0.5
"""Longest time for a reply [s], with two retries, as in the hand's own client."""

_SILENT = 2.0
"""Without a frame for this long [s] the stream is started again: a reset of the board ends it."""

_AGAIN = 5.0
"""Shortest time between two such starts [s]."""

_CONTENT: Mapping[str, codec.Content] = {
    "taxels": codec.Content.TAXELS,
    "resultants": codec.Content.RESULTANTS,
    "both": codec.Content.RESULTANTS | codec.Content.TAXELS,
}


class OrcaTouchOptions(DeviceOptions, frozen=True):
    """Options of the touch board."""

    port: str = "/dev/ttyACM0"
    """A tty, socket:// or rfc2217://."""
    baudrate: Literal[921_600, 2_000_000] = 921_600
    """921600 for the board's own adapter, 2000000 for the shared line [baud]."""
    content: Literal["taxels", "resultants", "both"] = "both"
    """Data that the board sends: taxels, the force on each tip, or both."""
    touch_rate: Positive = 100.0
    """Highest rate of the readings that are passed on [Hz]."""
    retries: Annotated[int, Meta(ge=0, le=10)] = 2


class OrcaTouchDriver(Driver):
    """The board with the touch sensors of up to five fingertips.

    It sends frames by itself, as fast as its line carries them. A reading has the normal force of
    every taxel, or of every tip if the board sends no taxels. The resultants, and the angles of
    joint encoders on the same line, are further channels.
    """

    Options = OrcaTouchOptions
    options: OrcaTouchOptions
    link: SerialBus

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        if spec.actuators:
            raise ConfigError(
                f"{spec.source + ': ' if spec.source else ''}device '{spec.name}' only measures "
                "touch and drives no actuators; write `actuators: []`"
            )
        self._content = _CONTENT[self.options.content]
        self._stream = codec.AnswerParser()
        self._counts: tuple[int, ...] = ()
        self._newest: tuple[codec.Stream, float] | None = None
        self._heard = self._armed = -math.inf
        self._taken = -math.inf
        self._reading: TouchReading | None = None
        self._extras: dict[str, FloatArray] = {}
        self._error = 0
        self.capabilities = Capabilities(measures=frozenset(), accepts=frozenset())

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line, read which fingertips are connected, and start the stream of frames."""
        options = self.options
        bus = await self.open(
            self.buses.serial,
            options.port,
            lambda bus: bus,
            baudrate=options.baudrate,
        )
        self._newest, self._error = None, 0
        self._reading, self._extras = None, {}
        with self.identifying(
            "a touch board",
            f"no touch board answers at {options.port}",
            "check supply, cable and `baudrate`",
            CodecError,
            check="check the port",
        ):
            fingers = codec.connected(
                await self._read(bus, codec.Register.CONNECTED, codec.CONNECTED_SIZE)
            )
            counts = codec.tip_counts(
                await self._read(bus, codec.Register.COUNTS, codec.COUNTS_SIZE)
            )
        if not fingers or any(not counts[finger] for finger in fingers):
            problem = "no fingertip is connected" if not fingers else "a fingertip without taxels"
            raise self.stranger("a touch board with fingertips", problem, hint="check their cables")
        self._counts = tuple(counts[finger] for finger in fingers)
        single = not self._content & codec.Content.TAXELS
        taxels = (1,) * len(fingers) if single else self._counts
        full = codec.NEWTONS * 255
        sensors = tuple(TouchSensor(f, n, full=full) for f, n in zip(fingers, taxels, strict=True))
        self.refine(
            best_rate=self._best_rate(),
            identity={
                "model": "ORCA touch board",
                "fingertips": ", ".join(
                    f"{s.name} {c}" for s, c in zip(sensors, self._counts, strict=True)
                ),
                "content": options.content,
            },
            touch=sensors,
        )
        # The rest of a frame from the previous connection would spoil the first new frame.
        self._stream.reset()
        bus.listen(self._hear)
        await self._arm(bus)
        await self._first(bus)

    def _best_rate(self) -> float:
        """Return the highest rate of frames on the line [Hz]."""
        # Around the data: header, zero, length, error and check.
        size = codec.data_size(self._content, self._counts) + 7
        # The board sends at most one frame every millisecond.
        return 1.0 / max(1e-3, wire_time(size, self.options.baudrate))

    async def _read(self, bus: SerialBus, register: codec.Register, size: int) -> bytes:
        reply = await self._ask(bus, codec.Request(codec.Function.READ, register, size))
        if len(reply.data) != size:
            raise CodecError(f"register {register:#06x}: {len(reply.data)} bytes instead of {size}")
        return reply.data

    async def _write(self, bus: SerialBus, register: codec.Register, value: int) -> None:
        reply = await self._ask(
            bus, codec.Request(codec.Function.WRITE, register, 1, bytes([value]))
        )
        if reply.data != b"\0":
            raise NotConnected(
                self.spec.name, f"the board refused a write to register {register:#06x}"
            )

    async def _ask(self, bus: SerialBus, request: codec.Request) -> codec.Reply:
        def answers(answer: codec.Answer) -> bool:
            wanted = (request.function, request.address)
            return isinstance(answer, codec.Reply) and (answer.function, answer.address) == wanted

        # A separate parser: bytes of the stream must not end up in the buffer of this one.
        reply = await bus.transact(
            request.to_bytes(), codec.AnswerParser(), _WITHIN, self.options.retries, accept=answers
        )
        assert isinstance(reply, codec.Reply)  # noqa: S101 - narrows the type
        return reply

    async def _arm(self, bus: SerialBus) -> None:
        """Start the stream, as the hand's own client does; raises `BusError`."""
        # Before the writes, so that even a failed start is repeated only after `_AGAIN`.
        self._armed = monotonic.now()
        await self._write(bus, codec.Register.STREAM, 0)
        await self._write(bus, codec.Register.CONTENT, int(self._content))
        await self._write(bus, codec.Register.STREAM, 1)
        self._heard = monotonic.now()

    async def _first(self, bus: SerialBus) -> None:
        """Wait for the first frame; raises `BusTimeout`."""
        end = monotonic.now() + _WITHIN
        while self._newest is None:
            bus.check()
            if monotonic.now() > end:
                raise BusTimeout(bus.name, f"the board sent no frame within {_WITHIN:g} s")
            await asyncio.sleep(0.002)

    def _hear(self, data: bytes) -> None:
        now = monotonic.now()
        for frame in self._stream.feed(data):
            match frame:
                case codec.Encoders():
                    self._extras = {**self._extras, "joint_encoders": frame.angles()}
                case codec.Stream():
                    self._newest, self._heard = (frame, now), now

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the newest reading; a stream that has stopped is started again."""
        bus = self.link
        bus.check()
        now = monotonic.now()
        if now - self._heard > _SILENT:
            # The start takes several exchanges, which would delay every cycle of a board that is
            # gone.
            if now - self._armed < _AGAIN:
                raise BusTimeout(bus.name, f"the board sent no frame for {now - self._heard:.1f} s")
            await patiently(lambda: self._arm(bus))
        self._take()
        warnings = (f"the board reports error {self._error:#04x}",) if self._error else ()
        return ActuatorState.measured(
            [], now, extras=self._extras, warnings=warnings, touch=self._reading
        )

    def _take(self) -> None:
        """Make a reading from the newest frame, no more often than the option's rate."""
        if self._newest is None:
            return
        frame, stamp = self._newest
        # A tenth less than the period, since frames do not arrive at multiples of it.
        if stamp - self._taken < 0.9 / self.options.touch_rate:
            return
        # Taken once: the same frame must not become a second reading.
        self._newest, self._taken, self._error = None, stamp, frame.error
        if frame.error:
            return  # its forces cannot be trusted; the last reading becomes stale
        try:
            forces = codec.Forces.from_bytes(frame.data, self._content, self._counts)
        except CodecError:
            # A code of the driver's own: the frame does not match the fingertips found at first.
            self._error = 0xFF
            return
        if self._content & codec.Content.RESULTANTS:
            self._extras = {**self._extras, "resultants": forces.resultants.ravel()}
        pressing = forces.taxels if self._content & codec.Content.TAXELS else forces.resultants
        self._reading = TouchReading(np.ascontiguousarray(pressing[:, 2]), stamp)

    async def move(self, reference: Reference) -> None:
        """See `Driver.move`: the board moves nothing."""

    async def close(self) -> None:
        """Detach from the line; the board continues to send."""
        if self.connected:
            # The board continues to send, and this driver must not receive it any more.
            self.link.listen(None)
        await super().close()
