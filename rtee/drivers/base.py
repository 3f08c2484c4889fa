"""The contract of a driver (the paper's EEHal): only `sense` and `move` must be written."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from rtee.buses.pool import BusPool
from rtee.capabilities import Capabilities
from rtee.drivers.connection import Connection
from rtee.object_description import ObjectDescription
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference


class Driver(ABC):
    """The code that talks to one device.

    A driver converts between SI units and the device's own at its edge. It holds no timing, no
    accounting of retries and no reconnect logic: the supervisor in `rtee.loop` adds those. It calls
    the methods of one driver one after the other, never two at once.

    Attributes:
        Options: Its options in hand.yaml: a pydantic model, or a dataclass; ``None`` takes any.
        spec: The device as configured.
        buses: The buses of this process; a driver asks it for the bus it needs.
        capabilities: What the device measures and accepts; may be refined by `configure`.
        doing: A lengthy operation under way, in words such as ``homing the thumb``; else empty;
            published while the call is under way.
        object_description: What a simulated device grasps looks like, once it is configured.
        connection: Its bus from `configure` to `close`, for drivers that have one bus.
    """

    Options: ClassVar[type[Any] | None] = None
    doing: str = ""
    object_description: ObjectDescription | None = None
    connection: Connection[Any] | None = None

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        self.spec = spec
        self.buses = buses
        self.capabilities = Capabilities()

    async def configure(self) -> None:
        """Open the bus and identify the device; never moves anything.

        Called again after `close` when the link was lost, so it must start from nothing.

        Raises:
            NotConnected: if the device does not answer.
            HandshakeError: if another device answers than the one expected.
            BusError: if the bus cannot be used.
        """

    async def activate(self) -> None:
        """Power and enable the device; homes it only where asked and needed.

        Raises:
            DeviceFault: if the device refuses.
            BusError: if the bus fails.
        """

    @abstractmethod
    async def sense(self) -> ActuatorState:
        """Return what the device measures now, in SI units and the order of ``spec.actuators``.

        Every state has arrays of its own, which the driver must not change afterwards.

        Raises:
            DeviceFault: if the device reports a fault.
            BusError: if the exchange fails.
        """

    @abstractmethod
    async def move(self, reference: Reference) -> None:
        """Send a reference.

        Raises:
            CommandRejected: if the device cannot take it.
            DeviceFault: if the device reports a fault.
            BusError: if the exchange fails.
        """

    async def stop(self) -> None:
        """Stop motion now and stay powered; must not raise."""

    async def disable(self) -> None:
        """Take the drive power away, so that the actuators are limp; must not raise.

        A device whose power cannot be switched is stopped instead.
        """
        # The least that every device can do; a driver that can cut the power overrides this.
        await self.stop()

    async def recover(self) -> None:
        """Bring the device out of a fault; it must not move by this.

        Raises:
            DeviceFault: if the fault persists.
            BusError: if the bus fails.
        """

    async def examine(self) -> str:
        """Ask a device that is connected, but not active, for what would keep it from that.

        Returns:
            What it has to do first and would move by, such as ``not homed``; else empty.

        Raises:
            DeviceFault: if it reports a fault.
            BusError: if the bus fails.
        """
        return ""

    def counters(self) -> Mapping[str, int]:
        """Return the counters of its bus, for the device's status; must return at once."""
        return {} if self.connection is None else self.connection.counters()

    def gains(self) -> Mapping[str, float]:
        """Return those of ``capabilities.gains`` that the driver knows, with their present values.

        It must return at once.
        """
        return {}

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change gains while running; only those named in ``capabilities.gains``."""

    async def deactivate(self) -> None:
        """Disable the device; the opposite of `activate`."""

    async def close(self) -> None:
        """Detach from the bus; may be called any number of times, in any state."""
        if self.connection is not None:
            await self.connection.close()
