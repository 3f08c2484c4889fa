"""The simulations of a pool, which run the emulators of devices on real transports."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

from rtee.buses.emulator import Emulator, EmulatorFactory

if TYPE_CHECKING:
    from rtee.buses.ethercat import Ring
    from rtee.buses.link import Line
    from rtee.buses.simulated import Simulation
    from rtee.buses.simulated_can import SimulatedCan
    from rtee.buses.zmq import DirectServer, Endpoints

S = TypeVar("S", bound="Simulation")


class EmulatedEndpoints:
    """The simulations of a pool; an emulator is made once and outlives its connections.

    Attributes:
        wire_time: Whether bytes on simulated lines take as long as on real ones.
        simulations: The simulations by the address that they replace.
        emulators: The emulators by the name of their device.
    """

    def __init__(self, *, wire_time: bool) -> None:
        self.wire_time = wire_time
        self.simulations: dict[str, Simulation] = {}
        self.emulators: dict[str, Emulator] = {}

    def line(self, url: str, owner: str, line: Line, factory: EmulatorFactory) -> Callable[[], str]:
        """Emulate a device on a line; return a function that returns its current address."""
        from rtee.buses.simulated import SimulatedLine

        def make() -> SimulatedLine:
            network = url.startswith(("tcp://", "socket://", "rfc2217://"))
            scheme = "tcp" if url.startswith("tcp://") else "socket"
            return SimulatedLine(
                [], name=url, tcp=network, scheme=scheme, line=line, wire_time=self.wire_time
            )

        simulation = self._playing(url, owner, factory, make)
        return lambda: simulation.address

    def can(self, channel: str, owner: str, bitrate: int, factory: EmulatorFactory) -> SimulatedCan:
        """Emulate a node on a virtual CAN channel of this process."""
        from rtee.buses.simulated_can import SimulatedCan

        rate = bitrate if self.wire_time else None
        return self._playing(
            channel,
            owner,
            factory,
            lambda: SimulatedCan([], name=channel, channel=channel, bitrate=rate),
        )

    def zmq(
        self, address: str, owner: str, factory: EmulatorFactory
    ) -> Callable[[], Endpoints | DirectServer]:
        """Emulate a ZeroMQ server; return a function that returns its current endpoints."""
        from rtee.buses.simulated_zmq import SimulatedZmq

        simulation = self._playing(address, owner, factory, lambda: SimulatedZmq(name=address))
        return lambda: simulation.place

    def ethercat(self, interface: str, owner: str, factory: EmulatorFactory) -> Callable[[], Ring]:
        """Emulate the slaves of an EtherCAT network; return a factory of the master's ring."""
        from rtee.buses.simulated_ethercat import SimulatedEthercat, SimulatedRing

        simulation = self._playing(
            interface, owner, factory, lambda: SimulatedEthercat(name=interface)
        )
        return lambda: SimulatedRing(simulation)

    def close(self) -> None:
        """End every simulation; idempotent."""
        for simulation in self.simulations.values():
            simulation.close()
        self.simulations.clear()
        self.emulators.clear()

    def _playing(self, key: str, owner: str, factory: EmulatorFactory, make: Callable[[], S]) -> S:
        simulation: Any = self.simulations.get(key)
        if simulation is None:
            simulation = self.simulations[key] = make().start()
        # A device that connects again must find the same emulator, in its last state.
        if owner not in self.emulators:
            emulator = self.emulators[owner] = factory()
            simulation.add(emulator)
        return cast("S", simulation)
