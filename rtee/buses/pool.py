"""The buses of a process: devices with the same address share one, until the last detaches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, TypeVar, cast

from rtee.buses.bus import Bus, TraceHook
from rtee.buses.emulated_endpoints import EmulatedEndpoints
from rtee.buses.emulator import Emulator, EmulatorFactory
from rtee.errors import BusBusy

if TYPE_CHECKING:
    from rtee.buses.can import CanBus
    from rtee.buses.canopen import CanopenBus
    from rtee.buses.dynamixel import DynamixelBus
    from rtee.buses.ethercat import EthercatBus
    from rtee.buses.link import Line
    from rtee.buses.modbus import ModbusBus
    from rtee.buses.serial import SerialBus
    from rtee.buses.simulated import Simulation
    from rtee.buses.zmq import ZmqBus

B = TypeVar("B", bound=Bus)
C = TypeVar("C", bound="CanBus")


class BusPool:
    """Provides buses; devices with the same address share one.

    For an emulated device, the driver passes the factory of its emulator. The pool then runs the
    emulator on a real transport (a pty, a TCP port, a virtual CAN channel) and connects the bus to
    that transport instead of the address. The emulated device lives as long as the pool, as a real
    one outlives its connection. Devices of the same hand share an emulated line, channel, network
    or server; another hand with the same address in its configuration gets another one.

    Attributes:
        trace: Trace hook of every bus made from now on.
        wire_time: Whether bytes on simulated lines take as long as on real ones.
    """

    def __init__(self, *, trace: TraceHook | None = None, wire_time: bool = True) -> None:
        self.trace = trace
        self.wire_time = wire_time
        self._buses: dict[str, tuple[Bus, object, object]] = {}
        self._ends = EmulatedEndpoints(wire_time=wire_time)
        self._first: dict[str, str] = {}

    @property
    def simulations(self) -> Mapping[str, Simulation]:
        """The simulations by the address that they replace."""
        return MappingProxyType(self._ends.simulations)

    @property
    def buses(self) -> tuple[Bus, ...]:
        """The buses that have an owner."""
        return tuple(bus for bus, _, _ in self._buses.values() if bus.owners)

    def played(self, owner: str) -> Emulator:
        """Return the emulator of a device; raises `KeyError` if it has none."""
        return self._ends.emulators[owner]

    def simulation(self, owner: str) -> Simulation:
        """Return the simulated wire of an emulated device; raises `KeyError` for a real one."""
        emulator = self._ends.emulators[owner]
        return next(s for s in self._ends.simulations.values() if emulator in s.emulators)

    def _own_address(self, address: str, owner: str, emulator: EmulatorFactory | None) -> str:
        """Return an address that is not used by the emulated devices of another hand."""
        hand, slash, _ = owner.partition("/")
        if emulator is None or not slash:
            return address
        return address if self._first.setdefault(address, hand) == hand else f"{address} of {hand}"

    async def serial(
        self,
        url: str,
        *,
        owner: str,
        baudrate: int = 115200,
        parity: str = "N",
        stopbits: int = 1,
        gap: float = 0.0,
        fresh: bool = False,
        emulator: EmulatorFactory | None = None,
    ) -> SerialBus:
        """Return the line at a tty, ``socket://host:port`` or ``rfc2217://host:port``, connected.

        Args:
            url: Its address.
            owner: The device that will use the bus, until ``bus.detach(owner)``.
            baudrate: Bit rate [bit/s].
            parity: ``N``, ``E`` or ``O``.
            stopbits: 1 or 2.
            gap: Silence to keep before each request [s].
            fresh: Whether to discard bytes received before a request; see `SerialBus`.
            emulator: Makes the emulator that replaces the device.

        Raises:
            BusBusy: if the line is open with other settings or by another program.
            BusBroken: if it cannot be opened.
            ConfigError: if the address is malformed.
        """
        from rtee.buses.link import Line
        from rtee.buses.serial import SerialBus

        line = Line(baudrate, parity, stopbits)
        return await self._on_line(SerialBus, url, line, owner, emulator, gap=gap, fresh=fresh)

    async def modbus(
        self,
        url: str,
        *,
        owner: str,
        baudrate: int = 115200,
        parity: str = "N",
        stopbits: int = 1,
        behind: int = 0,
        gap: float | None = None,
        emulator: EmulatorFactory | None = None,
    ) -> ModbusBus:
        """Return the Modbus line or network connection at an address, connected.

        A tty, ``socket://`` and ``rfc2217://`` speak Modbus RTU, ``tcp://host[:502]`` speaks
        Modbus TCP. Arguments and errors as for `serial`, ``behind`` and ``gap`` as for
        `ModbusBus`; on a shared line, the longest gap that a device asks for is kept.
        """
        from rtee.buses.link import Line
        from rtee.buses.modbus import ModbusBus

        line = Line(baudrate, parity, stopbits)
        # On an emulated line without wire time, no silence separates the frames.
        keep_gap = emulator is None or self.wire_time
        usual = None if keep_gap else 0.0
        bus = await self._on_line(ModbusBus, url, line, owner, emulator, gap=usual, behind=behind)
        if keep_gap and gap is not None:
            # Set afterwards, since the devices of a line need not agree on the gap.
            bus.gap = max(bus.gap, gap)
        return bus

    async def dynamixel(
        self,
        port: str,
        *,
        owner: str,
        baudrate: int = 57600,
        emulator: EmulatorFactory | None = None,
    ) -> DynamixelBus:
        """Return the Dynamixel line at a tty, connected. Arguments and errors as for `serial`."""
        from rtee.buses.dynamixel import DynamixelBus
        from rtee.buses.link import Line

        line = Line(baudrate)
        return await self._on_line(DynamixelBus, port, line, owner, emulator)

    async def can(
        self,
        channel: str,
        *,
        owner: str,
        interface: str = "socketcan",
        bitrate: int = 1_000_000,
        emulator: EmulatorFactory | None = None,
    ) -> CanBus:
        """Return the CAN bus at a channel of a python-can interface, connected.

        Args:
            channel: For example ``can0``.
            owner: The device that will use the bus, until ``bus.detach(owner)``.
            interface: Name of a python-can interface.
            bitrate: Bit rate [bit/s].
            emulator: Makes the emulator that replaces the node, on a virtual channel.

        Raises:
            BusBusy: if the channel is open with other settings.
            BusBroken: if it cannot be opened.
        """
        from rtee.buses.can import CanBus

        return await self._on_can(CanBus, channel, owner, interface, bitrate, emulator)

    async def canopen(
        self,
        channel: str,
        *,
        owner: str,
        interface: str = "socketcan",
        bitrate: int = 1_000_000,
        emulator: EmulatorFactory | None = None,
    ) -> CanopenBus:
        """Return the CANopen network at a channel, connected. Arguments and errors as for `can`."""
        from rtee.buses.canopen import CanopenBus

        return await self._on_can(CanopenBus, channel, owner, interface, bitrate, emulator)

    async def zmq(
        self,
        address: str,
        *,
        owner: str,
        ports: tuple[int, int, int],
        emulator: EmulatorFactory | None = None,
    ) -> ZmqBus:
        """Return the ZeroMQ server at ``tcp://host``, connected in the background.

        ``ports`` are the TCP ports at which it publishes, receives commands and answers requests;
        other arguments and errors as for `serial`.
        """
        from rtee.buses.zmq import Endpoints, ZmqBus

        address = self._own_address(address, owner, emulator)
        if emulator is not None:
            places = self._ends.zmq(address, owner, emulator)
        else:
            given = Endpoints(*(f"{address}:{port}" for port in ports))
            places = lambda: given  # noqa: E731 - a function, as for simulated ones
        return await self._acquire(address, ZmqBus, ports, owner, lambda: ZmqBus(address, places))

    async def ethercat(
        self, interface: str, *, owner: str, emulator: EmulatorFactory | None = None
    ) -> EthercatBus:
        """Return the EtherCAT network at an interface such as ``eth1``, its slaves pre-operational.

        Slaves are emulated at the level of process data. Raises `BusBroken` if the network cannot
        be opened or no slave answers, `ConfigError` if pysoem is not installed.
        """
        from rtee.buses.ethercat import EthercatBus, PysoemRing

        place = self._own_address(interface, owner, emulator)
        ring = emulator and self._ends.ethercat(place, owner, emulator)
        return await self._acquire(
            place,
            EthercatBus,
            None,
            owner,
            lambda: EthercatBus(place, ring or (lambda: PysoemRing(interface))),
        )

    async def aclose(self) -> None:
        """Close every bus and every simulation; idempotent."""
        for bus, _, _ in list(self._buses.values()):
            await bus.close()
        self._buses.clear()
        self._ends.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.aclose()

    async def _acquire(
        self, key: str, kind: Callable[..., B], settings: object, owner: str, make: Callable[[], B]
    ) -> B:
        while (entry := self._buses.get(key)) is not None and not entry[0].owners:
            await entry[0].close()  # its last owner is detaching; afterwards, the port is free
            # Another device may have opened the address while this one waited.
            if self._buses.get(key) is entry:
                del self._buses[key]
        if entry is None:
            bus = make()
            bus.trace = self.trace
            entry = self._buses[key] = (bus, kind, settings)
        elif entry[1] is not kind or entry[2] != settings:
            users = ", ".join(sorted(entry[0].owners))
            raise BusBusy(
                key, f"'{users}' already uses it with settings that differ from those of '{owner}'"
            )
        found = cast("B", entry[0])

        async def forget() -> None:
            await found.close()
            if self._buses.get(key, (None,))[0] is found:
                del self._buses[key]

        found.acquire(owner, forget)
        try:
            await found.connect()
        except BaseException:  # including cancellation: no owner must be left behind
            await found.detach(owner)
            raise
        return found

    async def _on_line(
        self,
        kind: Callable[..., B],
        url: str,
        line: Line,
        owner: str,
        emulator: EmulatorFactory | None,
        **more: Any,
    ) -> B:
        url = self._own_address(url, owner, emulator)
        address = emulator and self._ends.line(url, owner, line, emulator)
        return await self._acquire(
            url, kind, (line, more), owner, lambda: kind(url, line, address=address, **more)
        )

    async def _on_can(
        self,
        kind: type[C],
        channel: str,
        owner: str,
        interface: str,
        bitrate: int,
        emulator: EmulatorFactory | None,
    ) -> C:
        simulation = None
        channel = self._own_address(channel, owner, emulator)
        if emulator is not None:
            # All pools of a process share python-can's virtual channels, so the name must be
            # unique.
            interface, channel = "virtual", f"emulated-{channel}-{id(self):x}"
            simulation = self._ends.can(channel, owner, bitrate, emulator)
        return await self._acquire(
            channel,
            kind,
            (interface, bitrate),
            owner,
            lambda: kind(channel, interface=interface, bitrate=bitrate, simulation=simulation),
        )
