"""What others may ask of a device's task: stop, hold, disable, recover, how it is doing."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Mapping

from rtee.buses.retry import patiently
from rtee.errors import DriverError
from rtee.loop.connection import BACKOFF
from rtee.loop.exchange import Exchange
from rtee.types import DeviceStatus, Lifecycle, Reference

log = logging.getLogger(__name__)


class Supervisor(Exchange):
    """Looks after one device and answers for it; see `Exchange` for the task itself."""

    def status(self) -> DeviceStatus:
        """Return how it is doing."""
        now, accounts, fault = self._now(), self._accounts, self._fault
        return DeviceStatus(
            name=self.name,
            driver=self.spec.driver,
            lifecycle=self.lifecycle,
            identity=self.driver.capabilities.identity,
            rate=accounts.rate(now),
            every=self.every,
            age=math.inf if self.state is None else max(0.0, now - self.state.stamp),
            exchanges=accounts.exchanges,
            overruns=accounts.overruns,
            errors=accounts.errors,
            reconnects=accounts.reconnects,
            counters=self.driver.counters(),
            fault_code=0 if fault is None else fault.code,
            fault_name="" if fault is None else fault.name,
            recoverable=fault is not None and fault.recoverable,
            hint="" if fault is None else fault.hint,
            message=self.driver.doing or self._message,
            gains=self.driver.capabilities.gains,
        )

    async def stop(self, within: float) -> bool:
        """Stop the device now, again where an answer was not heard; cannot raise.

        Args:
            within: Time it may take [s].

        Returns:
            Whether the device still answered after it was told.
        """
        return await self._confirmed("stop", self._stop, within)

    async def disable(self, within: float) -> bool:
        """Disable the device; it is limp and inactive afterwards. Returns as `stop`."""
        return await self._confirmed("disable", self._disable, within)

    async def hold(self, reference: Reference | None, within: float) -> bool:
        """Send one last reference: the given one, else where it is. Returns as `stop`."""
        return await self._confirmed("hold", lambda: self._send_last(reference), within)

    async def _confirmed(
        self, name: str, action: Callable[[], Awaitable[bool]], within: float
    ) -> bool:
        if self.lifecycle in (Lifecycle.UNCONFIGURED, Lifecycle.CLOSED):
            return False
        self._interrupt(within / 3)
        try:
            async with asyncio.timeout(within):
                return bool(await self._requests.ask(name, action, first=True))
        except Exception as error:
            self._interrupt(0.0)
            log.warning("device '%s' did not confirm '%s': %r", self.name, name, error)
            return False

    async def _stop(self) -> bool:
        self._reference = None
        await patiently(self.driver.stop)
        self._take(await patiently(self.driver.sense))
        return True

    async def _disable(self) -> bool:
        self._reference = None
        await patiently(self.driver.disable)
        await patiently(self.driver.deactivate)
        self.lifecycle = Lifecycle.INACTIVE
        self.trouble = "it was disabled"
        self._activate_on_connect = False
        self._take(await patiently(self.driver.sense))
        return True

    async def _send_last(self, reference: Reference | None) -> bool:
        self._reference = None
        state = await patiently(self.driver.sense)
        self._take(state)
        if self.lifecycle is not Lifecycle.ACTIVE:
            return False
        last = Reference.at(state.position) if reference is None else reference
        await patiently(lambda: self.driver.move(last))
        return True

    async def recover(self) -> None:
        """Bring it out of a fault, or connect and activate it; it starts where it is measured.

        Raises:
            RteeError: if it does not work, or was interrupted by a stop.
        """
        self._backoff = BACKOFF[0]
        await self._requests.ask("recover", self._recover)

    async def _recover(self) -> None:
        if self.lifecycle is Lifecycle.ACTIVE:
            return
        try:
            if self.lifecycle is Lifecycle.UNCONFIGURED:
                await self._configure()
            if self.lifecycle is Lifecycle.FAULT:
                await self.driver.recover()
                self._fault = None
                self.lifecycle = Lifecycle.INACTIVE
            await self._activate()
        except Exception as error:
            await self._sort(error)
            raise
        self._event("recovered", "is active again")

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change gains of the device.

        Raises:
            DriverError: if it has no such gain.
            RteeError: if the device doesn't take them.
        """
        known = self.driver.capabilities.gains
        for name in gains:
            if name not in known:
                raise DriverError(
                    self.name,
                    f"has no gain '{name}'",
                    hint=f"it has: {', '.join(known) or 'none'}",
                )
        await self._requests.ask("set gains", lambda: self.driver.set_gains(gains))
