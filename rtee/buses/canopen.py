"""A CANopen network on a CAN bus: PDO and SYNC as CAN frames, SDO in a worker thread."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from rtee.buses.can import CanBus
from rtee.buses.can_guard import frame_of
from rtee.buses.emulator import CanFrame
from rtee.buses.simulated_time import SimulatedQueue, on_simulated_time
from rtee.buses.worker import Worker
from rtee.errors import BusBroken, BusTimeout, RteeError

if TYPE_CHECKING:
    from rtee.buses.simulated_can import SimulatedCan

T = TypeVar("T")

# The package also raises what it logs, and the device's own message then names node and cause.
logging.getLogger("canopen").setLevel(logging.CRITICAL)


class CanopenBus(CanBus):
    """A CAN bus with the ``canopen`` package on top of it.

    The package's notifier is not used: the event loop passes received frames to ``network``, which
    sends through this bus. Use `run` for blocking calls of the package (SDO), and `send_now` and
    `subscribe` for process data.

    Attributes:
        network: The ``canopen.Network``.
    """

    def __init__(
        self,
        name: str,
        *,
        interface: str = "socketcan",
        bitrate: int = 1_000_000,
        simulation: SimulatedCan | None = None,
    ) -> None:
        import canopen

        super().__init__(name, interface=interface, bitrate=bitrate, simulation=simulation)
        self.network: Any = canopen.Network()
        self._worker = Worker(f"sdo {name}")
        self.subscribe(self._notify)

    async def run(self, function: Callable[[], T], deadline: float) -> T:
        """Call a blocking function of ``canopen`` (SDO) in the worker thread; one at a time.

        Raises:
            BusTimeout: if it has not returned within ``deadline`` [s], or the node did not answer.
            BusBroken: if the bus is broken.
            BusClosed: if it is closed.
        """
        import can
        import canopen

        self.check()
        self.counters.transactions += 1
        try:
            return await self._worker.run(function, deadline)
        except RteeError as error:  # before the next clause: some are TimeoutErrors
            self.counters.timeouts += isinstance(error, BusTimeout)
            raise
        except TimeoutError:
            self.counters.timeouts += 1
            raise BusTimeout(self.name, f"no answer within {deadline:.3f} s") from None
        except canopen.SdoCommunicationError as error:
            self.counters.timeouts += 1
            raise BusTimeout(self.name, str(error)) from error
        except can.CanError as error:
            raise BusBroken(self.name, str(error)) from error

    def join(self, node: Any) -> None:
        """Add a node of ``canopen`` to the network."""
        self.network.add_node(node)
        loop = on_simulated_time()
        if loop is not None:
            # The package waits for answers in this queue.
            node.sdo.responses = SimulatedQueue(loop)

    def _notify(self, frame: CanFrame) -> None:
        # The package's listener ignores remote frames, too.
        if not frame.remote:
            self.network.notify(frame.id, bytearray(frame.data), frame.stamp)

    async def _open(self) -> None:
        await super()._open()
        self.network.bus = _Outlet(self)

    async def _close(self) -> None:
        # First the worker: frames of a running call are refused, since the bus is disconnected.
        await self._worker.close()
        await super()._close()


class _Outlet:
    """Replaces the python-can bus of ``canopen``, which only uses it to send."""

    def __init__(self, bus: CanopenBus) -> None:
        self._bus = bus
        self.channel_info = bus.name

    def send(self, message: Any, timeout: float | None = None) -> None:
        import can

        try:
            self._bus.send_now(frame_of(message))
        except BusBroken as error:
            # The only kind of error after which the package tries again.
            raise can.CanOperationError(error.message) from error
