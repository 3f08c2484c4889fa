"""Reads and writes the registers of Feetech servos on one line."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from rtee.buses.retry import heard
from rtee.buses.serial import SerialBus
from rtee.buses.timing import wire_time
from rtee.drivers.deadlines import RelaxedDeadline
from rtee.drivers.feetech import codec
from rtee.drivers.feetech.table import MODEL, Family, Register
from rtee.drivers.servos import ServoLink
from rtee.errors import BusTimeout, FrameError


class FeetechLink(RelaxedDeadline, ServoLink):
    """Talks to servos on one line; several devices may share it.

    A frame counts as the answer if it has the servo's id and the right length.

    Args:
        bus: The line.
        family: The servos' family.
        deadline: Longest time for one exchange, retries included, in addition to its time on the
            line [s].
        retries: How often a request is sent again within that time.
        turnaround: Time per request in addition to that on the line [s].
        together: Whether one request reads several servos.

    Attributes:
        delay: Time that a servo waits before its answer [s].
    """

    # In addition to the time on the line.
    PATIENCE = 0.2

    def __init__(
        self,
        bus: SerialBus,
        family: Family,
        deadline: float,
        retries: int,
        turnaround: float = 0.0,
        together: bool = False,
    ) -> None:
        self.delay = 0.0
        self.turnaround = turnaround
        self.together = together
        self._bus = bus
        self._family = family
        self.deadline = deadline
        self._retries = retries
        self._parser = codec.ReplyParser()
        self._groups: dict[tuple[frozenset[int], int], codec.GroupParser] = {}

    def read_time(self, size: int, count: int = 1) -> float:
        """Return the time to read ``size`` bytes of each of ``count`` servos in one request [s]."""
        request = codec.OVERHEAD + 2 + (count if count > 1 else 0)
        answers = count * (codec.OVERHEAD + size)
        once = wire_time(request + answers, self._bus.line.baudrate) + self.turnaround
        return once + count * self.delay

    def write_time(self, size: int, count: int) -> float:
        """Return the time to write ``size`` bytes to each of ``count`` servos [s]."""
        return wire_time(codec.OVERHEAD + 2 + count * (size + 1), self._bus.line.baudrate)

    def _longest(self, size: int, count: int = 1) -> float:
        # Every attempt may need its full time on the line.
        return self.deadline + (self._retries + 1) * self.read_time(size, count)

    async def read(self, number: int, address: int, size: int) -> codec.Frame:
        """Return a servo's answer with ``size`` bytes of its registers; raises `BusError`."""
        request = codec.Frame(number, codec.Instruction.READ, bytes([address, size])).to_bytes()

        def answers(reply: codec.Frame) -> bool:
            return reply.device == number and len(reply.params) == size

        return await self._bus.transact(
            request,
            self._parser,
            self._longest(size),
            self._retries,
            accept=answers,
            encode=codec.Frame.to_bytes,
            whom=f"servo {number}",
        )

    async def data(self, number: int, address: int, size: int) -> bytes:
        """Return ``size`` bytes of a servo's registers; raises `BusError`."""
        return (await self.read(number, address, size)).params

    async def read_all(
        self, address: int, size: int, ids: Collection[int]
    ) -> Mapping[int, codec.Frame]:
        """Return the answers of servos with ``size`` bytes of registers, by id; raises `BusError`.

        Sends one request to all if servos are read together, which not every family answers.
        """
        if not self.together or len(ids) <= 1:
            return {number: await self.read(number, address, size) for number in ids}
        key = frozenset(ids), size
        parser = self._groups.setdefault(key, codec.GroupParser(ids, size))
        try:
            return await self._bus.transact(
                codec.sync_read(address, size, ids),
                parser,
                self._longest(size, len(ids)),
                self._retries,
                whom=f"{len(ids)} servos",
            )
        except FrameError as error:
            if not parser.missing or len(parser.missing) == len(ids):
                raise
            numbers = ", ".join(str(number) for number in parser.missing)
            raise BusTimeout(self._bus.name, f"no answer from servo {numbers}") from error

    async def values(self, register: Register, numbers: Collection[int]) -> dict[int, int]:
        """Return the value of a register of several servos, by id; raises `BusError`."""
        answers = await self.read_all(register.address, register.size, numbers)
        return {
            number: self._family.unpack(register, answer.params, register.address)
            for number, answer in answers.items()
        }

    async def model(self, number: int) -> int | None:
        """Return a servo's model number, or ``None`` if it does not answer."""
        there = await heard(self.values(MODEL, [number]))
        return None if there is None else there[number]

    async def write_all(self, address: int, data: Mapping[int, bytes]) -> None:
        """Set registers of several servos at once, by id, without answers; raises `BusError`."""
        for request in codec.sync_write(address, data):
            await self._bus.send(request)

    async def set_values(self, register: Register, values: Mapping[int, int]) -> None:
        """Set a register of several servos, which do not answer; raises `BusError`."""
        data = {number: self._family.pack(register, value) for number, value in values.items()}
        await self.write_all(register.address, data)
