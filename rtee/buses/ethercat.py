"""An EtherCAT network: a master in a worker thread, and process data by position of the slave."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, TypeVar

from rtee import monotonic
from rtee.buses.bus import Bus
from rtee.buses.worker import Worker
from rtee.errors import BusBroken, BusTimeout, RteeError, needing_extra

T = TypeVar("T")


_FRAME_TIMEOUT = 2000
"""Longest time for a frame to travel round the ring [µs]; SOEM's default."""

_OPENING, _CLOSING = 5.0, 2.0
"""Longest time to find the slaves, and to bring them to INIT [s]; a slave changes its state within
1 s."""


class SlaveState(IntEnum):
    """States of a slave, as in the AL control register (ETG.1000.6)."""

    INIT = 1
    PRE_OPERATIONAL = 2
    SAFE_OPERATIONAL = 4
    OPERATIONAL = 8


class Slave(NamedTuple):
    """Identity of a slave (object 1018h).

    Attributes:
        name: Its name.
        vendor: Vendor id.
        product: Product code.
        revision: Revision number.
    """

    name: str
    vendor: int
    product: int
    revision: int


class Ring(ABC):
    """A master and its slaves; the methods block and are called from one thread."""

    @abstractmethod
    def open(self) -> list[Slave]:
        """Find the slaves and bring them to PRE-OPERATIONAL; raises `OSError`."""

    @abstractmethod
    def request(self, state: SlaveState, within: float) -> None:
        """Bring all slaves to a state within a time [s]; raises `TimeoutError`."""

    @abstractmethod
    def exchange(self, outputs: Sequence[bytes]) -> list[bytes] | None:
        """Exchange process data by position; return ``None`` if a slave did not take part."""

    @abstractmethod
    def read(self, position: int, index: int, subindex: int) -> bytes:
        """Read an object of a slave; raises `OSError`."""

    @abstractmethod
    def write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object of a slave; raises `OSError`."""

    @abstractmethod
    def watchdog(self, position: int, seconds: float) -> None:
        """Set a slave's process data watchdog [s]; raises `OSError`."""

    @abstractmethod
    def close(self) -> None:
        """Bring the slaves to INIT and close the port; idempotent."""


class PysoemRing(Ring):
    """A ring on a network interface, through pysoem (the extra ``ethercat``)."""

    def __init__(self, interface: str) -> None:
        with needing_extra("EtherCAT", "ethercat"):
            import pysoem
        self._soem: Any = pysoem
        self._interface = interface
        self._master: Any = None
        self._state = SlaveState.INIT

    def open(self) -> list[Slave]:
        """Find the slaves."""
        master = self._soem.Master()
        try:
            master.open(self._interface)
        except ConnectionError as error:
            raise OSError(f"{error}; EtherCAT needs permission for raw sockets") from error
        self._master = master
        # It returns the number of slaves, or -1 if no frame came back.
        if master.config_init() <= 0:
            raise OSError("no slave answers")
        slaves = [Slave(s.name, s.man, s.id, s.rev) for s in master.slaves]
        master.config_map()
        return slaves

    def request(self, state: SlaveState, within: float) -> None:
        """Bring all slaves to a state."""
        master = self._master
        master.read_state()
        failed = self._soem.STATE_ERROR
        for slave in master.slaves:
            if slave.state & failed:  # it left its state by itself: acknowledge that
                slave.state = (slave.state & ~failed) | self._soem.STATE_ACK
                slave.write_state()
        master.state = int(state)
        master.write_state()
        reached = master.state_check(int(state), round(within * 1e6))
        if reached != int(state):
            master.read_state()
            behind = [f"{s.name} ({s.state:#x})" for s in master.slaves if s.state != int(state)]
            raise TimeoutError(f"did not become {state.name.lower()}: {', '.join(behind)}")
        self._state = state

    def exchange(self, outputs: Sequence[bytes]) -> list[bytes] | None:
        """Send outputs and return inputs."""
        master = self._master
        for slave, data in zip(master.slaves, outputs, strict=False):
            slave.output = data
        master.send_processdata()
        count = master.receive_processdata(_FRAME_TIMEOUT)
        # Safe-operational slaves report their inputs but ignore outputs.
        reporting = sum(1 for slave in master.slaves if slave.input)
        if count < (
            reporting if self._state is SlaveState.SAFE_OPERATIONAL else master.expected_wkc
        ):
            return None
        # Copies: SOEM reuses its process image in the next cycle.
        return [bytes(slave.input) for slave in master.slaves]

    def read(self, position: int, index: int, subindex: int) -> bytes:
        """Read an object."""
        try:
            return bytes(self._master.slaves[position].sdo_read(index, subindex))
        except (self._soem.SdoError, self._soem.PacketError, self._soem.WkcError) as error:
            raise OSError(f"object {index:04X}h:{subindex} cannot be read: {error}") from error

    def write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object."""
        try:
            self._master.slaves[position].sdo_write(index, subindex, data)
        except (self._soem.SdoError, self._soem.PacketError, self._soem.WkcError) as error:
            raise OSError(f"object {index:04X}h:{subindex} cannot be written: {error}") from error

    def watchdog(self, position: int, seconds: float) -> None:
        """Set the process data watchdog."""
        # pysoem takes milliseconds.
        self._master.slaves[position].set_watchdog("processdata", seconds * 1000.0)

    def close(self) -> None:
        """Bring the slaves to INIT and close the port."""
        master, self._master = self._master, None
        if master is not None:
            master.state = int(SlaveState.INIT)
            master.write_state()
            master.close()


class EthercatBus(Bus):
    """An EtherCAT network with this process as its master.

    Attributes:
        slaves: The slaves found, by position.
    """

    def __init__(self, name: str, ring: Callable[[], Ring]) -> None:
        super().__init__(name)
        self.slaves: list[Slave] = []
        self._make = ring
        self._ring: Ring | None = None
        self._worker = Worker(f"ethercat {name}")

    async def run(self, function: Callable[[Ring], T], deadline: float) -> T:
        """Call a blocking function with the ring in the worker thread; one at a time.

        Raises:
            BusTimeout: if it has not returned within ``deadline`` [s].
            BusBroken: if the network breaks.
            BusClosed: if the bus is closed.
        """
        self.check()
        ring = self._ring
        if ring is None:
            raise BusBroken(self.name, "no link")
        self.counters.transactions += 1
        try:
            return await self._worker.run(lambda: function(ring), deadline)
        except RteeError:
            raise
        except TimeoutError as error:
            self.counters.timeouts += 1
            text = str(error) or f"not done within {deadline:.3f} s"
            raise BusTimeout(self.name, text) from None
        except OSError as error:
            self._broke(str(error))
            raise BusBroken(self.name, str(error)) from error

    async def exchange(self, outputs: Sequence[bytes], deadline: float) -> list[bytes]:
        """Send outputs and return inputs, both by position of the slave; errors as for `run`.

        Also raises `BusTimeout` if a slave did not take part.
        """
        inputs = await self.run(lambda ring: ring.exchange(outputs), deadline)
        self._count("tx", b"".join(outputs), monotonic.now())
        if inputs is None:
            self.counters.timeouts += 1
            raise BusTimeout(self.name, "not every slave took part in the exchange")
        self._count("rx", b"".join(inputs), monotonic.now())
        return inputs

    async def _open(self) -> None:
        await self._close()
        # Stored before it is open, so that an error or a cancellation closes it, too.
        ring = self._ring = self._make()
        try:
            self.slaves = await self._worker.run(ring.open, _OPENING)
        except BaseException as error:
            await self._close()
            if isinstance(error, OSError):  # a `TimeoutError` is one
                raise BusBroken(self.name, f"cannot be opened: {error}") from error
            raise

    async def _close(self) -> None:
        ring, self._ring = self._ring, None
        if ring is not None:
            try:
                await self._worker.run(ring.close, _CLOSING)
            except (OSError, TimeoutError) as error:
                self._cause = str(error)
        await self._worker.close()
