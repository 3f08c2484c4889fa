"""A CAN bus: sends frames, passes received ones to listeners, and matches requests and answers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rtee import monotonic
from rtee.buses.bus import Bus, listen
from rtee.buses.can_guard import GuardedCan, frame_of, message_of, open_bus
from rtee.buses.emulator import CanFrame
from rtee.errors import BusBroken, BusTimeout

if TYPE_CHECKING:
    from rtee.buses.simulated_can import DirectCan, SimulatedCan

_BUS_OFF = 0x40
"""CAN_ERR_BUSOFF, the class of an error frame (linux/can/error.h)."""


class CanBus(Bus):
    """A channel of a python-can interface, whose notifier passes frames to the event loop.

    Attributes:
        interface: Name of the python-can interface.
        bitrate: Bit rate [bit/s].
    """

    def __init__(
        self,
        name: str,
        *,
        interface: str = "socketcan",
        bitrate: int = 1_000_000,
        simulation: SimulatedCan | None = None,
    ) -> None:
        super().__init__(name)
        self.interface = interface
        self.bitrate = bitrate
        self._simulation = simulation
        self._bus: Any = None
        self._notifier: Any = None
        self._direct: DirectCan | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._by_id: dict[int, list[Callable[[CanFrame], None]]] = {}
        self._by_any: list[Callable[[CanFrame], None]] = []
        self._waiting: set[asyncio.Future[CanFrame]] = set()
        self._watching: list[Callable[[], None]] = []

    def send_now(self, frame: CanFrame) -> None:
        """Send a frame without waiting; may be called from any thread.

        It returns when the frame is in the controller's queue.

        Raises:
            BusBroken: if the bus is broken or its queue is full.
            BusClosed: if it is closed.
        """
        import can

        self.check()
        try:
            if self._direct is not None:
                self._direct.send(frame)
            else:
                # Without a timeout, since this may run in the event loop.
                self._bus.send(message_of(frame), timeout=0)
        except (can.CanError, OSError) as error:
            raise BusBroken(self.name, f"cannot send: {error}") from error
        self._count("tx", frame.data, monotonic.now(), frame.id.to_bytes(4, "big"))

    async def request(
        self, frame: CanFrame, accept: Callable[[CanFrame], bool], deadline: float, retries: int = 0
    ) -> CanFrame:
        """Send a frame and return the first one that ``accept`` identifies as its answer.

        Args:
            frame: The request.
            accept: Returns whether a frame is the answer.
            deadline: Longest time, including retries [s].
            retries: How often the request may be sent again within that time.

        Raises:
            BusTimeout: if no answer came in time; other errors as for `send_now`.
        """
        self.counters.transactions += 1
        end = monotonic.now() + deadline
        for attempt in range(retries + 1):
            if attempt:
                self.counters.retries += 1
            # Divide the remaining time among the remaining attempts.
            share = (end - monotonic.now()) / (retries + 1 - attempt)
            answer: asyncio.Future[CanFrame] = asyncio.get_running_loop().create_future()
            receive = self._receiver(answer, accept)
            self._by_any.append(receive)
            self._waiting.add(answer)
            try:
                async with asyncio.timeout(max(share, 0.0)):
                    self.send_now(frame)
                    return await answer
            except TimeoutError:
                self.counters.timeouts += 1
            finally:
                self._by_any.remove(receive)
                self._waiting.discard(answer)
                if answer.done() and not answer.cancelled():
                    # asyncio logs an exception of a future that is never retrieved.
                    answer.exception()
        raise BusTimeout(self.name, f"no answer to frame {frame.id:#x} within {deadline:.3f} s")

    @staticmethod
    def _receiver(
        answer: asyncio.Future[CanFrame], accept: Callable[[CanFrame], bool]
    ) -> Callable[[CanFrame], None]:
        def receive(frame: CanFrame) -> None:
            if not answer.done() and accept(frame):
                answer.set_result(frame)

        return receive

    def subscribe(
        self, callback: Callable[[CanFrame], None], identifier: int | None = None
    ) -> Callable[[], None]:
        """Call ``callback`` with every received frame, or with those of one identifier.

        The callback is called in the event loop and must return at once. The result is a function
        that ends the subscription.
        """
        listeners = self._by_any
        if identifier is not None:
            listeners = self._by_id.setdefault(identifier, [])
        return listen(listeners, callback)

    def watch(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Call ``callback`` in the event loop when the bus breaks.

        The result is a function that ends this.
        """
        return listen(self._watching, callback)

    def _on_message(self, message: Any) -> None:
        if message.is_error_frame:
            self.counters.checksum_errors += 1
            # A controller that went bus-off no longer sends; it must be opened again.
            if self.interface == "socketcan" and message.arbitration_id & _BUS_OFF:
                self._failed("bus-off: check the wiring, the termination and the bit rate")
            return
        self._on_frame(frame_of(message, monotonic.now()))

    def _on_frame(self, frame: CanFrame) -> None:
        self._count("rx", frame.data, frame.stamp, frame.id.to_bytes(4, "big"))
        # A copy of the lists, since a callback may add or remove callbacks.
        for callback in (*self._by_id.get(frame.id, ()), *self._by_any):
            callback(frame)

    def _failed(self, cause: str) -> None:
        """Handle a broken bus; called in the event loop's thread."""
        if not self._connected:
            return
        self._broke(cause)
        for answer in list(self._waiting):
            if not answer.done():
                answer.set_exception(BusBroken(self.name, f"the bus failed: {cause}"))
        for callback in list(self._watching):
            callback()

    def _failed_elsewhere(self, cause: str) -> None:
        """Handle a broken bus; called from any thread."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._failed, cause)

    async def _open(self) -> None:
        import can

        await self._close()
        if self._simulation is not None and not self._simulation.plugged:
            raise BusBroken(self.name, "the adapter does not exist")
        loop = self._loop = asyncio.get_running_loop()
        if self._simulation is not None:
            self._simulation.on_unplug = lambda: self._failed_elsewhere("the adapter was unplugged")
            self._direct = self._simulation.connect(self._on_frame)
            if self._direct is not None:
                return
        # In a thread, since some interfaces communicate with a USB device when they open.
        bus = await loop.run_in_executor(None, self._opened)
        self._bus = bus
        self._notifier = can.Notifier(bus, [self._on_message], timeout=0.05, loop=loop)

    def _opened(self) -> Any:
        raw = open_bus(self.interface, self.name, self.bitrate)
        return GuardedCan(raw, self._failed_elsewhere)

    async def _close(self) -> None:
        bus, notifier, direct = self._bus, self._notifier, self._direct
        self._bus = self._notifier = self._direct = None
        for answer in list(self._waiting):
            if not answer.done():
                answer.set_exception(BusBroken(self.name, "the bus was closed meanwhile"))
        if direct is not None:
            direct.shutdown()
        if bus is None:
            return
        # With a file descriptor, the notifier is a reader of the event loop and stops at once;
        # without one, it is a thread that has to be joined.
        if bus.fileno_or_none() is not None:
            notifier.stop()
            bus.shutdown()
            return

        def stop() -> None:
            bus.end()
            notifier.stop()
            bus.shutdown()

        await asyncio.shield(asyncio.get_running_loop().run_in_executor(None, stop))
