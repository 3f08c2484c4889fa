"""Call a driver so that its faults affect only its own device.

Drivers may be written by anybody. Their states are checked here, on entry: later, an invalid one
would end the run of all devices. There is no protection against a driver that blocks the thread
instead of awaiting.
"""

from __future__ import annotations

import asyncio
import math
import types
from collections.abc import Awaitable, Callable, Coroutine, Generator, Mapping
from typing import Any, TypeVar

import numpy as np

from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.errors import DeviceFault, DriverError, foreign
from rtee.objects.description import ObjectDescription
from rtee.sample import NOTHING, ActuatorState, measured_arrays
from rtee.touch import TouchReading
from rtee.types import Reference

T = TypeVar("T")

_MOST_CHANNELS = 256
"""Most additional channels of a device: each is recorded and published with every state."""

_MOST_VALUES = 65_536
"""Most values in a channel or a touch reading: an image of 256 by 256 pixels."""

_MOST_WARNINGS = 20
"""Most warnings read from a state: as many as a status word has bits."""

_LONGEST = 500
"""Longest text kept from a driver [characters]: some lines on a terminal."""

_CANCELLATIONS = 3
"""Cancellations after which a call that is still running is abandoned: clean-up code may await, and
so outlive the first ones."""


class GuardedDriver:
    """Calls a driver's methods so that they end in time and raise nothing but `Exception`.

    Args:
        driver: The driver.
        name: The device's name.
        size: Number of its actuators.

    Attributes:
        abandoned: Set to make the next cancellation of a call the last one, see `Runner`.
    """

    def __init__(self, driver: Driver, name: str, size: int) -> None:
        self._driver, self._name, self._size = driver, name, size
        self._capabilities = Capabilities()
        self.abandoned = False

    # --- what the driver reports about itself ----------------------------------------------------

    @property
    def capabilities(self) -> Capabilities:
        """The device's capabilities: the last valid ones."""
        found = self._read(lambda: self._driver.capabilities, None)
        if isinstance(found, Capabilities):
            self._capabilities = found
        return self._capabilities

    @property
    def doing(self) -> str:
        """A lengthy operation under way, in words, or an empty string."""
        found = self._read(lambda: self._driver.doing, "")
        return "" if type(found) is str and not found else line(found)

    @property
    def object_description(self) -> ObjectDescription | None:
        """Shape of the object that a simulated device grasps."""
        found = self._read(lambda: self._driver.object_description, None)
        return found if isinstance(found, ObjectDescription) else None

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the device's bus."""
        return self._read(lambda: {line(k): int(v) for k, v in self._driver.counters().items()}, {})

    def gains(self) -> Mapping[str, float]:
        """Return the present gains, as far as the driver knows them."""
        return self._read(lambda: {line(k): float(v) for k, v in self._driver.gains().items()}, {})

    def _read(self, read: Callable[[], T], default: T) -> T:
        try:
            return read()
        except BaseException:  # a bug in the driver, and no reason to end the run
            return default

    def _moved(self) -> None:
        """Forget the device's last position: the device may go limp, or move by itself."""
        self._read(lambda: self._driver.standstill.forget(), None)

    # --- calls -----------------------------------------------------------------------------------

    async def configure(self) -> None:
        """See `Driver.configure`."""
        self._moved()
        await self._call(self._driver.configure)

    async def activate(self) -> None:
        """See `Driver.activate`."""
        self._moved()
        await self._call(self._driver.activate)

    async def sense(self) -> ActuatorState:
        """Return a valid state of the device's actuators; raises `DriverError` otherwise."""
        state = await self._call(self._driver.sense)
        self._check(state)
        self._read(lambda: self._driver.standstill.measured(state), None)
        return state

    async def move(self, reference: Reference) -> None:
        """See `Driver.move`."""
        # Before the call: the reference may reach the device even if the call fails.
        self._read(lambda: self._driver.standstill.asked(reference), None)
        await self._call(lambda: self._driver.move(reference))

    async def stop(self) -> None:
        """See `Driver.stop`."""
        await self._call(self._driver.stop)

    async def disable(self) -> None:
        """See `Driver.disable`."""
        await self._call(self._driver.disable)

    async def recover(self) -> None:
        """See `Driver.recover`."""
        self._moved()
        await self._call(self._driver.recover)

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """See `Driver.set_gains`."""
        await self._call(lambda: self._driver.set_gains(gains))

    async def close(self) -> None:
        """See `Driver.close`."""
        await self._call(self._driver.close)

    async def _call(self, method: Callable[[], Awaitable[T]]) -> T:
        self.abandoned = False
        try:
            work = method()
            if not isinstance(work, types.CoroutineType):
                work = _awaited(work)
            return await _bounded(work, self)
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            raise self._bug("its driver cancelled itself") from None
        except DeviceFault as fault:
            raise _plain_fault(self._name, fault) from fault
        except Exception:
            raise
        # SystemExit and KeyboardInterrupt of a driver would end the event loop of all devices.
        except BaseException as error:
            raise self._bug(f"its driver raised {type(error).__name__}") from error

    def _bug(self, text: str) -> DriverError:
        return DriverError(self._name, text, hint="fix its driver")

    # --- states ----------------------------------------------------------------------------------

    def _check(self, state: ActuatorState) -> None:
        """Raise `DriverError` unless a state is valid; fast, since it is called at each tick."""
        n = self._size
        if not isinstance(state, ActuatorState):
            raise self._bug(f"gave {type(state).__name__} instead of a state")
        for values in measured_arrays(state):
            if type(values) is not np.ndarray or values.dtype != np.float64:
                raise self._bug("gave a state whose quantities are not arrays of float64")
            # A wrong length would only show up much later, as values of another actuator.
            if values.shape != (n,):
                raise self._bug(f"gave a state that is not one of {n} actuators")
        if not (isinstance(state.stamp, int | float) and math.isfinite(state.stamp)):
            raise self._bug("gave a state without the time of its measurement")
        if state.extras is not NOTHING:
            self._check_channels(state.extras)
        if state.grasped is not None:
            self._check_grasped(state.grasped)
        touch = state.touch
        if touch is not None and not (
            isinstance(touch, TouchReading)
            and _is_channel(touch.values)
            and isinstance(touch.stamp, int | float)
            and math.isfinite(touch.stamp)
        ):
            raise self._bug("gave an invalid touch reading")
        if not (isinstance(state.warnings, tuple) and isinstance(state.fresh, bool | np.bool_)):
            raise self._bug("gave a state whose warnings are not a tuple")

    def _check_channels(self, extras: Mapping[str, Any]) -> None:
        if not isinstance(extras, Mapping) or len(extras) > _MOST_CHANNELS:
            raise self._bug(f"gave channels that are not a mapping of at most {_MOST_CHANNELS}")
        for name, values in extras.items():
            if not (isinstance(name, str) and name.isprintable() and _is_channel(values)):
                raise self._bug(f"gave a channel {line(name)!r} that is not an array of float64")

    def _check_grasped(self, grasped: object) -> None:
        if not (
            isinstance(grasped, tuple)
            and len(grasped) == self._size
            and all(each is None or isinstance(each, bool | np.bool_) for each in grasped)
        ):
            raise self._bug(f"gave grasp reports that are not {self._size} of True, False or None")


def line(text: object) -> str:
    """Return a text of a driver as one printable line of bounded length."""
    try:
        return foreign(str(text)[:_LONGEST])
    except BaseException:  # even `str` runs code of the driver
        return type(text).__name__


def warnings_of(state: ActuatorState) -> tuple[str, ...]:
    """Return the warnings of a state as a bounded number of printable lines."""
    return tuple(map(line, state.warnings[:_MOST_WARNINGS]))


def _is_channel(values: object) -> bool:
    return (
        isinstance(values, np.ndarray)
        and values.ndim == 1
        and values.dtype.kind in "fiub"
        and values.size <= _MOST_VALUES
    )


def _plain_fault(device: str, fault: DeviceFault) -> DeviceFault:
    """Return a copy of a fault in which every attribute has the declared type."""
    try:
        code = int(fault.code)
    except BaseException:
        code = 0
    hint = line(getattr(fault, "hint", ""))
    name, recoverable = line(fault.name), bool(fault.recoverable)
    return DeviceFault(device, code, name, recoverable=recoverable, hint=hint)


async def _awaited(work: Awaitable[T]) -> T:
    return await work


@types.coroutine
def _bounded(work: Coroutine[Any, Any, T], driver: GuardedDriver) -> Generator[Any, Any, T]:
    """Run a coroutine; abandon it if it is still running after several cancellations."""
    task = asyncio.current_task()
    before = 0 if task is None else task.cancelling()
    try:
        waits_for = work.send(None)
        while True:
            try:
                yield waits_for
            except asyncio.CancelledError as error:
                if task is not None and driver.abandoned:
                    # `Runner` cancelled the task once more than its timeout will uncancel.
                    task.uncancel()
                    raise TimeoutError from None
                # The driver's own timeouts cancel the task, too, and uncancel it when they have
                # ended; what is left was asked for by others.
                if task is not None and task.cancelling() - before >= _CANCELLATIONS:
                    raise
                waits_for = work.throw(error)
            except Exception as error:
                # The exception of a future that the coroutine awaits, which it may handle.
                waits_for = work.throw(error)
            else:
                waits_for = work.send(None)
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]
    finally:
        try:
            work.close()
        except BaseException:  # it resists even closing; it is never resumed
            driver.abandoned = False
