"""A simulated EtherCAT ring: emulated slaves at the level of process data and objects.

There is no wire, since an Ethernet port cannot be simulated without privileges. The simulation
replaces the library of the master instead.
"""

from __future__ import annotations

import select
from collections.abc import Sequence
from typing import Protocol, cast

from rtee import monotonic
from rtee.buses.ethercat import Ring, Slave, SlaveState
from rtee.buses.line_model import MessageWire
from rtee.buses.simulated import Simulation


class PlaysSlaves(Protocol):
    """An emulator of one or more EtherCAT slaves."""

    def slaves(self) -> list[Slave]:
        """Return the slaves."""
        ...

    def become(self, state: SlaveState, now: float) -> bool:
        """Request a state of the slaves; return whether they reach it."""
        ...

    def cycle(self, outputs: Sequence[bytes], now: float) -> list[bytes] | None:
        """Exchange process data by position; ``None`` if a slave does not take part."""
        ...

    def read_object(self, position: int, index: int, subindex: int) -> bytes | None:
        """Return an object, or ``None`` if there is none."""
        ...

    def write_object(self, position: int, index: int, subindex: int, data: bytes) -> bool:
        """Write an object; return whether the slave accepts it."""
        ...

    def set_watchdog(self, position: int, seconds: float) -> None:
        """Set the process data watchdog [s]."""
        ...


class SimulatedEthercat(Simulation):
    """The slaves' end of a ring, with one emulator for all slaves.

    A lost or damaged frame does not return to the master.
    """

    def __init__(self, *, name: str = "ethercat") -> None:
        super().__init__(name)
        self._wire = MessageWire()

    @property
    def address(self) -> str:
        """The network interface that it replaces."""
        return self.name

    @property
    def played(self) -> PlaysSlaves:
        """The emulator of the slaves."""
        return cast("PlaysSlaves", self.emulators[0])

    def _plug(self) -> None:
        self._there = True

    def _unplug(self) -> None:
        self._there = False

    def _step(self, now: float) -> None:
        """Do nothing: the master asks in `SimulatedRing.exchange`."""

    def _next_due(self) -> float | None:
        return None  # nor does a slave send anything by itself

    def _turn(self, timeout: float | None) -> None:
        select.select([self._wake_out], [], [], timeout)


class SimulatedRing(Ring):
    """A master's view of a simulated ring."""

    def __init__(self, simulation: SimulatedEthercat) -> None:
        self._simulation = simulation

    def _played(self) -> PlaysSlaves:
        if not self._simulation.plugged:
            raise OSError("no slave answers")
        return self._simulation.played

    def open(self) -> list[Slave]:
        """Find the slaves."""
        played = self._played()
        played.become(SlaveState.PRE_OPERATIONAL, monotonic.now())
        return played.slaves()

    def request(self, state: SlaveState, within: float) -> None:
        """Bring all slaves to a state."""
        if not self._played().become(state, monotonic.now()):
            raise TimeoutError(f"the slaves did not become {state.name.lower()}")

    def exchange(self, outputs: Sequence[bytes]) -> list[bytes] | None:
        """Send outputs and return inputs."""
        played = self._played()
        inputs = played.cycle(outputs, monotonic.now())
        late = self._simulation.faults.copies()
        if not late:
            return None
        if late[0] > 0.0:
            monotonic.sleep(late[0])
        return inputs

    def read(self, position: int, index: int, subindex: int) -> bytes:
        """Read an object."""
        data = self._played().read_object(position, index, subindex)
        if data is None:
            raise OSError(f"object {index:04X}h:{subindex} cannot be read")
        return data

    def write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object."""
        if not self._played().write_object(position, index, subindex, data):
            raise OSError(f"object {index:04X}h:{subindex} cannot be written")

    def watchdog(self, position: int, seconds: float) -> None:
        """Set the process data watchdog."""
        self._played().set_watchdog(position, seconds)

    def close(self) -> None:
        """Bring the slaves to INIT."""
        if self._simulation.plugged and self._simulation.emulators:
            self._simulation.played.become(SlaveState.INIT, monotonic.now())
