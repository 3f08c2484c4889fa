"""Group reads and writes by dynamixel-sdk in the worker thread, with deadlines and retries."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

import dynamixel_sdk as sdk

from rtee import monotonic
from rtee.buses.dynamixel import DynamixelBus
from rtee.drivers.dynamixel.codec import Error
from rtee.drivers.dynamixel.table import Register
from rtee.drivers.servos import ServoLink
from rtee.errors import BusBroken, BusError, BusTimeout, DriverError, FrameError, NotConnected

T = TypeVar("T")

_ERROR_NUMBER = 0x7F
"""Bits of a status packet's error byte except for the hardware alert (protocol 2.0)."""

_ID, _LENGTH, _ERROR, _DATA = 4, 5, 8, 9
"""Places of id, length, error and data in a status packet of the SDK."""

_AROUND = 4
"""Bytes that its length counts besides the data: instruction, error, checksum."""

_AROUND_ALL = 11
"""Bytes of a status packet besides its data."""

_PING_DATA = 3
"""Data bytes of the answer to a ping: model and firmware."""


def _data_size(packet: Sequence[int]) -> int:
    """Return the number of data bytes in a status packet."""
    return (packet[_LENGTH] | packet[_LENGTH + 1] << 8) - _AROUND


_LATENCY = 0.008
"""Time allowed for an answer in a cycle, in addition to that of its bytes [s]: several polls of an
adapter with a latency timer of 1 ms."""

_PATIENT_LATENCY = 0.03
"""The same time during set-up [s]; the SDK allows 34 ms."""


_NAMING = 0.5
"""Shortest time between two plain reads that show which servo is silent [s]."""


_UNHURRIED = 5.0
"""Longest time for an exchange outside the cycle, retries included [s]."""


def _heard(result: int, error: int) -> int:
    """Return the SDK's result; if the servo received a damaged request, the result is "corrupt"."""
    if result == sdk.COMM_SUCCESS and error & _ERROR_NUMBER == Error.CRC:
        return int(sdk.COMM_RX_CORRUPT)
    return int(result)


def _receive(packets: Any, port: Any, number: int, size: int) -> tuple[Any, int]:
    """Return a servo's answer with ``size`` bytes of data, or with an error, and the SDK's result.

    Others answer earlier requests; the packet's timeout ends the wait.
    """
    while True:
        packet, result = packets.rxPacket(port, False)
        if result != sdk.COMM_SUCCESS:
            return packet, int(result)
        damaged = packet[_ERROR] & _ERROR_NUMBER == Error.CRC
        if packet[_ID] == number and (damaged or _data_size(packet) == size):
            return packet, _heard(result, packet[_ERROR])


class GroupRead(sdk.GroupSyncRead):  # type: ignore[misc]
    """A group read that also stores the error bytes of the answers, hardware alert included.

    Attributes:
        errors: Error byte of each servo's last answer, by id.
        stopped: The servo whose answer was missing or damaged in the last plain read, after others
            had answered; ``None``: no servo, or the first one.
        failed: Whether the last read failed.
        plain: When a plain read replaced a fast one last [s].
    """

    def __init__(
        self, port: Any, packets: Any, address: int, size: int, ids: Sequence[int]
    ) -> None:
        super().__init__(port, packets, address, size)
        self.errors: dict[int, int] = {}
        self.stopped: int | None = None
        self.failed = False
        self.plain = -math.inf
        for number in ids:
            self.addParam(number)

    def rxPacket(self) -> int:  # noqa: N802 - the SDK's name
        """Receive one answer per servo."""
        self.last_result = False
        self.stopped, first = None, next(iter(self.data_dict))
        for number in self.data_dict:
            packet, result = _receive(self.ph, self.port, number, self.data_length)
            if result != sdk.COMM_SUCCESS:
                self.stopped = None if number == first else number
                return int(result)
            self.data_dict[number] = packet[_DATA : _DATA + self.data_length]
            self.errors[number] = packet[_ERROR]
        self.last_result = True
        return int(sdk.COMM_SUCCESS)

    def fastSyncReadRxPacket(self) -> int:  # noqa: N802 - the SDK's name
        """Receive the single answer of all servos."""
        self.last_result = False
        # Each servo's part: error, id, data and checksum.
        part = self.data_length + 4
        raw, result, _ = self.ph.fastSyncReadRx(
            self.port, sdk.BROADCAST_ID, part * len(self.data_dict)
        )
        if result != sdk.COMM_SUCCESS:
            return int(result)
        if len(raw) != part * len(self.data_dict):
            return int(sdk.COMM_RX_CORRUPT)
        # Checked before anything is stored: half of an answer must not mix with the previous one.
        starts = range(0, part * len(self.data_dict), part)
        if {raw[at + 1] for at in starts} != self.data_dict.keys():
            return int(sdk.COMM_RX_CORRUPT)
        for at in starts:
            error, number = raw[at], raw[at + 1]
            self.data_dict[number] = raw[at + 2 : at + 2 + self.data_length]
            self.errors[number] = error
        self.last_result = True
        return int(sdk.COMM_SUCCESS)


class DynamixelLink(ServoLink):
    """Reads and writes servos on one line.

    Attributes:
        bus: The line.
        ids: The device's servos, in the order of its actuators.
        fast: Whether groups are read with the fast sync read; ``None``: not decided yet.
        patient: Whether answers may take longer: during set-up there is no cycle to keep, and a
            computer that is busy for a moment must not cause a failure.
        delay: Sum of the servos' return delays [s], allowed in addition to the time on the wire.
    """

    def __init__(
        self,
        bus: DynamixelBus,
        ids: Sequence[int],
        deadline: float,
        retries: int,
        turnaround: float = 0.0,
    ) -> None:
        self.bus = bus
        self.ids = tuple(ids)
        self.fast: bool | None = None
        self.patient = False
        self.delay = 0.0
        self._deadline = deadline
        self._retries = retries
        self._latency = max(_LATENCY, 2.0 * turnaround)
        self._groups: dict[tuple[int, int], GroupRead] = {}
        self._end = math.inf
        self._fast_works = False  # not with older firmware, which a plain read would hide

    @contextmanager
    def relaxed_deadline(self) -> Iterator[None]:
        """Let exchanges take longer, outside the cycle."""
        before, self.patient = self.patient, True
        try:
            yield
        finally:
            self.patient = before

    async def run(self, function: Callable[[], T]) -> T:
        """Run a function in the worker thread, where it may make exchanges; raises `BusError`."""
        usual = 2.0 * (self._deadline + self.delay)
        return await self.bus.run(function, _UNHURRIED if self.patient else usual)

    async def model(self, number: int) -> int | None:
        """Return a servo's model number, or ``None`` if it does not answer; raises `BusError`."""
        return await self.run(partial(self.ping, number))

    async def data(self, number: int, address: int, size: int) -> bytes:
        """Return bytes of a servo's control table.

        Raises `NotConnected` if the servo answers nothing but pings, and `BusError`.
        """
        read = partial(self.run, partial(self.read_group, address, size, [number]))
        try:
            found, _ = await read()
        except BusTimeout:
            if await self.model(number) is None:
                raise
            try:
                # Again, since a disturbance may have ended before the ping.
                found, _ = await read()
            except BusTimeout as error:
                raise NotConnected(
                    self.bus.name,
                    f"servo {number} answers pings, but no reads",
                    hint="its status return level (address 68) is 0; switch its supply off and on, "
                    "which sets it to 2",
                ) from error
        return found[number]

    async def values(self, register: Register, numbers: Sequence[int]) -> dict[int, int]:
        """Return a register of several servos, by id; raises `BusError`."""
        return await self.run(partial(self._values, register, list(numbers))) if numbers else {}

    async def set_values(self, register: Register, values: Mapping[int, int]) -> None:
        """Set a register of several servos, which do not answer; raises `BusError`."""
        await self.run(partial(self.write_group, register, values))

    def repeated(self, attempt: Callable[[], int]) -> None:
        """Repeat an attempt until it succeeds, within deadline and retries, in the worker thread.

        The attempt makes one exchange and returns the SDK's result.

        Raises:
            BusTimeout: if there was no answer in time.
            FrameError: if the answer was not a valid packet.
            BusBroken: if the request could not be sent.
        """
        latency = max(_PATIENT_LATENCY, self._latency) if self.patient else self._latency
        end = self._end = monotonic.now() + self.delay + max(self._deadline, 5.0 * latency)
        counters, result = self.bus.counters, int(sdk.COMM_SUCCESS)
        self.bus.port.latency = (latency + self.delay) * 1000.0
        for number in range(self._retries + 1):
            if number:
                if monotonic.now() >= end:
                    break
                counters.retries += 1
            # When an exception ends a request, the SDK leaves this flag set and refuses all others.
            self.bus.port.is_using = False
            result = attempt()
            if result == sdk.COMM_SUCCESS:
                return
            if result == sdk.COMM_RX_CORRUPT:
                counters.checksum_errors += 1
            else:
                counters.timeouts += 1
        raise self._error(result)

    def _error(self, result: int) -> BusError:
        if result == sdk.COMM_RX_CORRUPT:
            return FrameError(self.bus.name, "the answer was damaged")
        if result in (sdk.COMM_TX_FAIL, sdk.COMM_PORT_BUSY):
            return BusBroken(self.bus.name, "the request could not be sent")
        return BusTimeout(self.bus.name, "no answer")

    # --- in the worker thread ----------------------------------------------------------------

    def ping(self, number: int) -> int | None:
        """Return a servo's model number, or ``None`` if it does not answer."""
        found: list[int] = []

        def attempt() -> int:
            # Not the SDK's own ping, which takes any answer of the servo for that to a ping.
            packets, port = self.bus.packets, self.bus.port
            result = packets.txPacket(port, [0, 0, 0, 0, number, 3, 0, sdk.INST_PING, 0, 0])
            if result != sdk.COMM_SUCCESS:
                return int(result)
            port.setPacketTimeout(_AROUND_ALL + _PING_DATA)
            packet, result = _receive(packets, port, number, _PING_DATA)
            if result == sdk.COMM_SUCCESS:
                found.append(packet[_DATA] | packet[_DATA + 1] << 8)
            return result

        try:
            self.repeated(attempt)
        # The error of a broken line propagates: it says nothing about this servo.
        except (BusTimeout, FrameError):
            return None
        return found[-1]

    def read_group(
        self, address: int, size: int, ids: Sequence[int] | None = None
    ) -> tuple[Mapping[int, bytes], Mapping[int, int]]:
        """Return bytes of the control tables and the error bytes, by id, in one exchange."""
        if ids is None:
            group = self._groups.get((address, size))
            # Kept between cycles, since building it takes time. A new link has another port.
            if group is None or group.port is not self.bus.port:
                group = GroupRead(self.bus.port, self.bus.packets, address, size, self.ids)
                self._groups[address, size] = group
        else:
            group = GroupRead(self.bus.port, self.bus.packets, address, size, ids)
        try:
            self.repeated(partial(self._read, group))
        except (BusTimeout, FrameError):
            if group.stopped is None:
                raise
            raise BusTimeout(self.bus.name, f"no answer from servo {group.stopped}") from None
        answers = {n: bytes(data) for n, data in group.data_dict.items()}
        return answers, group.errors

    def _read(self, group: GroupRead) -> int:
        """Read a group once and return the SDK's result."""
        now, plain = monotonic.now(), not self.fast
        if self._fast_works and group.failed and now - group.plain >= _NAMING:
            # The single answer to a fast read breaks off at a missing servo, so only a plain read
            # shows which: in place of a retry, and only if it ends before the deadline.
            port, count = self.bus.port, len(group.data_dict) * (_AROUND_ALL + group.data_length)
            plain = now + (count * port.tx_time_per_byte + port.latency) / 1000.0 < self._end
            group.plain = now if plain else group.plain
        result = int(group.txRxPacket() if plain else group.fastSyncRead())
        group.failed = result != sdk.COMM_SUCCESS
        if not group.failed:
            self._fast_works, group.stopped = not plain or self._fast_works, None
        return result

    def write_group(self, register: Register, values: Mapping[int, int]) -> None:
        """Write a register of several servos at once; servos do not answer."""
        params: list[int] = []
        for number, value in values.items():
            params.append(number)
            params += register.pack(value)
        write, port = self.bus.packets.syncWriteTxOnly, self.bus.port
        address, size = register.address, register.size
        if values:
            self.repeated(lambda: int(write(port, address, size, params, len(params))))

    def _values(self, register: Register, numbers: Sequence[int]) -> dict[int, int]:
        # Without ids if all servos are meant: that group is kept between calls.
        ids = None if set(numbers) == set(self.ids) else numbers
        there, _ = self.read_group(register.address, register.size, ids)
        return {number: register.unpack(there[number]) for number in numbers}

    def write(self, number: int, register: Register, value: int) -> None:
        """Write a register of one servo and check the answer.

        Raises `DriverError` if the servo refuses the value, and `BusError`.
        """
        data, errors = list(register.pack(value)), [0]

        def attempt() -> int:
            result, error = self.bus.packets.writeTxRx(
                self.bus.port, number, register.address, register.size, data
            )
            errors[0] = error
            return _heard(result, error)

        self.repeated(attempt)
        error = errors[0] & _ERROR_NUMBER
        if error:
            raise DriverError(
                self.bus.name,
                f"servo {number} refuses {value} at address {register.address}: "
                f"{Error(error).name.lower().replace('_', ' ')}",
            )

    def reboot(self, number: int) -> None:
        """Reboot a servo, whether it answers or not."""
        # As in `repeated`. The result does not matter: the caller pings the servo until it is back.
        self.bus.port.is_using = False
        self.bus.packets.reboot(self.bus.port, number)
