"""A base class for drivers of grippers that keep a grip while they are inactive."""

from __future__ import annotations

from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.errors import DeviceFault
from rtee.types import DeviceSpec


class GripperDriver(Driver):
    """A driver of a gripper that keeps its grip when it is deactivated, and after a fault."""

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._active = False

    def _fault(self, code: int, name: str, hint: str) -> DeviceFault:
        """Return a fault, with which the driver becomes inactive."""
        # An inactive driver only reads, so that the fault is raised once and not in every cycle.
        self._active = False
        return DeviceFault(self.spec.name, code, name, hint=hint)

    async def deactivate(self) -> None:
        """Stop; a grip is kept."""
        await self.stop()
        self._active = False

    async def close(self) -> None:
        """Detach from the bus."""
        self._active = False
        await super().close()
