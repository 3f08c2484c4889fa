"""The contract of a driver (the paper's EEHal): only `sense` and `move` must be written."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any, ClassVar, TypeVar

from rtee.buses.bus import Bus
from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.hold_on_attach import HoldOnAttach
from rtee.drivers.options import read_options
from rtee.drivers.standstill import Standstill
from rtee.errors import BusTimeout, DeviceFault, FrameError, HandshakeError, NotConnected, RteeError
from rtee.objects.description import ObjectDescription
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

B = TypeVar("B", bound=Bus)
L = TypeVar("L")


class Driver(ABC):
    """The code that talks to one device.

    A driver converts between SI units and the units of its device. It has no cycle timing, no retry
    statistics and no reconnect logic: the supervisor in `rtee.loop` adds those. The supervisor
    calls the methods of a driver one after the other, never two at once.

    Attributes:
        Options: Its options in hand.yaml, a `DeviceOptions`; ``None`` accepts any.
        spec: The device as configured.
        options: The options of the device, checked; only with a class `Options`. A driver declares
            their type, as that of `link`: ``options: MyOptions``.
        buses: The buses of this process, from which the driver acquires the one it needs.
        capabilities: What the device measures and accepts; may be refined by `configure`.
        active: Whether the device has been activated, in drivers that set it; an inactive device
            is only read.
        doing: A lengthy operation under way, in words such as ``homing the thumb``; otherwise
            empty. It is published while the call is under way.
        object_description: Shape of the object that a simulated device grasps, after `configure`.
        attached: The actuators that were active when the driver connected, for drivers that leave
            them alone until a reference moves them.
        standstill: Judges the positions that `hold` measures, before they are commanded; the caller
            passes it the states from `sense` and the references given to `move`.
    """

    Options: ClassVar[type[Any] | None] = None
    active: bool = False
    doing: str = ""
    object_description: ObjectDescription | None = None
    options: Any
    _home_asked = False

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        self.spec = spec
        self.buses = buses
        self.capabilities = Capabilities()
        self._owned_bus: Bus | None = None
        self._owned_link: Any = None
        self.attached = HoldOnAttach(spec.actuators)
        self.standstill = Standstill(spec)
        if self.Options is not None:
            self.options = read_options(self.Options, spec)

    @property
    def connected(self) -> bool:
        """Whether `open` was called since the last `close`; the bus may be broken."""
        return self._owned_bus is not None

    @property
    def link(self) -> Any:
        """The link that `open` made: the bus, or what implements the device's protocol on it.

        Raises:
            NotConnected: if the driver is not connected.
        """
        if self._owned_bus is None:
            raise NotConnected(self.spec.name, "is not connected")
        return self._owned_link

    async def configure(self) -> None:
        """Open the bus and identify the device, without moving anything.

        It is called again after `close` if the link was lost, so it must not rely on earlier state.

        Raises:
            NotConnected: if the device does not answer.
            HandshakeError: if the device that answers is not the expected one.
            BusError: if the bus cannot be used.
        """

    async def open(
        self,
        bus: Callable[..., Awaitable[B]],
        address: str,
        talk: Callable[[B], L],
        *,
        emulator: str | type[Emulator] | None = None,
        emulated: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> L:
        """Connect to the device, or to its emulator, and return the new link.

        Args:
            bus: The method of `buses` that acquires the bus.
            address: The bus's address.
            talk: Makes the link from the bus.
            emulator: The emulator or its name; by default the one with the driver's name.
            emulated: Options of an emulated device, beside those in hand.yaml.
            settings: Further arguments of ``bus``, such as ``baudrate``.

        Raises:
            BusError: if the bus cannot be opened.
        """
        # Imported only here: drivers without a bus do not need it.
        from rtee.drivers.emulators import emulator_of

        played = emulator_of(self.spec, emulator, **(emulated or {}))
        # A second `configure` must not leave the driver attached to the first bus.
        await self.detach()
        found = await bus(address, owner=self.spec.owner, emulator=played, **settings)
        link = talk(found)
        self._owned_bus, self._owned_link = found, link
        return link

    async def detach(self) -> None:
        """Detach from the bus; idempotent."""
        # Cleared before waiting: a second call meanwhile must not detach again.
        bus, self._owned_bus, self._owned_link = self._owned_bus, None, None
        if bus is not None:
            await bus.detach(self.spec.owner)

    @contextmanager
    def identifying(
        self,
        expected: str,
        absent: str,
        hint: str,
        *strangers: type[Exception],
        check: str = "check the address",
    ) -> Iterator[None]:
        """Convert errors of the first exchanges: either no device answers, or the wrong one does.

        Args:
            expected: The device, with its article, such as ``an SVH``.
            absent: The message if no device answers, such as ``no SVH answers at /dev/ttyUSB0``.
            hint: What to check in that case.
            strangers: The errors that another device causes.
            check: What to check if another device answers.

        Raises:
            NotConnected: if no device answers, its answer cannot be decoded, or it has failed.
            HandshakeError: if another device answers.
        """
        try:
            yield
        except strangers as error:
            reason = getattr(error, "message", None) or str(error)
            # An attribute of Modbus refusals, whose module most drivers need not load.
            if getattr(error, "passing", False):
                again = "wait a moment; if this goes on, switch its supply off and on"
                raise NotConnected(self.spec.name, f"it answers: {reason}", hint=again) from error
            raise self.stranger(expected, f"another device ({reason})", hint=check) from error
        except (BusTimeout, FrameError) as error:
            raise NotConnected(self.spec.name, absent, hint=hint) from error

    @contextmanager
    def busy(self, doing: str) -> Iterator[None]:
        """Set `doing` until the context ends."""
        self.doing = doing
        try:
            yield
        finally:
            self.doing = ""

    async def activate(self) -> None:
        """Power and enable the device; home it only if it is not homed and the options allow it.

        Raises:
            DeviceFault: if the device refuses.
            BusError: if the bus fails.
        """

    @abstractmethod
    async def sense(self) -> ActuatorState:
        """Return the present measurements, in SI units and in the order of ``spec.actuators``.

        Every state needs new arrays, which the driver must not change afterwards.

        Raises:
            DeviceFault: if the device reports a fault.
            BusError: if the exchange fails.
        """

    @abstractmethod
    async def move(self, reference: Reference) -> None:
        """Send a reference.

        Raises:
            CommandRejected: if the device cannot execute it.
            DeviceFault: if the device reports a fault.
            BusError: if the exchange fails.
        """

    async def stop(self) -> None:
        """Stop motion now and stay powered; must not raise.

        By default it calls `hold`; a device with a stop command of its own uses that instead.
        """
        with contextlib.suppress(RteeError, OSError):
            # The new targets end every grip, so no actuator is left alone any more.
            self.attached.begin()
            await self.hold()

    async def hold(self) -> None:
        """Command the measured posture.

        Except for the actuators for which ``standstill.instead`` gives another position: a
        measurement that cannot be true would make the device jump.

        Raises:
            BusError: if the bus fails; `stop` ignores it.
        """

    async def disable(self) -> None:
        """Switch off the drive power, so that the actuators are limp; the opposite of `activate`.

        By default, for a device whose power cannot be switched, stop it instead.

        Raises:
            BusError: if the bus fails.
        """
        await self.stop()
        self.active = False

    async def recover(self) -> None:
        """Clear a fault of the device, without moving it.

        Raises:
            DeviceFault: if the fault persists.
            BusError: if the bus fails.
        """

    async def examine(self) -> str:
        """Check whether a device that is connected, but not active, could be activated at once.

        Returns:
            The reason why it would have to move first, such as ``not homed``; otherwise empty.

        Raises:
            DeviceFault: if the device reports a fault.
            BusError: if the bus fails.
        """
        return ""

    def refine(self, **changes: Any) -> None:
        """Change fields of `capabilities` according to the device's answers."""
        self.capabilities = replace(self.capabilities, **changes)

    def fault(self, code: int, name: str, hint: str = "") -> DeviceFault:
        """Return the error for a fault that the device reports, and make the driver inactive."""
        # An inactive driver only reads, so that the fault is raised once and not in every cycle.
        self.active = False
        return DeviceFault(self.spec.name, code, name, hint=hint)

    def stranger(self, expected: str, found: str, hint: str = "") -> HandshakeError:
        """Return the error for a device other than the expected one."""
        return HandshakeError(self.spec.name, expected, found, hint=hint)

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the device's bus, for its status; must return at once."""
        return {} if self._owned_bus is None else asdict(self._owned_bus.counters)

    def gains(self) -> Mapping[str, float]:
        """Return the present values of those ``capabilities.gains`` that the driver knows.

        It must return at once.
        """
        return {}

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change gains while running; their names must be in ``capabilities.gains``."""

    async def close(self) -> None:
        """Detach from the bus; may be called any number of times, in any state."""
        self.active = False
        await self.detach()
