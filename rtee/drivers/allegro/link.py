"""An Allegro Hand on a CAN bus: requests, commands, and the positions that it sends by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame
from rtee.drivers.allegro import codec

PATIENCE = 6.0
"""Longest time for an exchange outside the cycle [deadlines]."""

OnPositions = Callable[[int, Sequence[int], float], object]
"""Called with a finger's number, the counts of its four joints and their time of arrival [s]."""


class AllegroLink:
    """Talks to one hand; up to four share the bus by their numbers.

    Attributes:
        hand: The hand's number on it.
        deadline: Longest time to wait for an answer [s].
    """

    def __init__(self, bus: CanBus, hand: int, deadline: float) -> None:
        self.bus = bus
        self.hand = hand
        self.deadline = deadline
        self._undo: list[Callable[[], None]] = []

    async def _ask(self, command: codec.Command, least: int, within: float) -> CanFrame:
        wanted = codec.identifier(command, self.hand)

        def answers(frame: CanFrame) -> bool:
            return frame.id == wanted and not frame.remote and len(frame.data) >= least

        return await self.bus.request(codec.request(command, self.hand), answers, within, retries=2)

    async def info(self, *, patient: bool = False) -> codec.HandInfo:
        """Return the hand's information; raises `BusError`."""
        within = PATIENCE * self.deadline if patient else self.deadline
        return codec.HandInfo.from_bytes((await self._ask(codec.Command.HAND_INFO, 7, within)).data)

    async def serial(self) -> str:
        """Return the hand's serial number; raises `BusError`."""
        frame = await self._ask(codec.Command.SERIAL, 1, PATIENCE * self.deadline)
        return frame.data.decode("ascii", "replace").strip("\x00 ")

    async def order(self, command: codec.Command) -> None:
        """Send a command without data; raises `BusError`."""
        await self.bus.send(codec.order(command, self.hand))

    async def set_periods(self, periods: codec.Periods) -> None:
        """Set the periods at which the hand sends data by itself; raises `BusError`."""
        await self.bus.send(periods.to_frame(self.hand))

    def torques(self, counts: Sequence[Sequence[int]]) -> None:
        """Send the torques of all fingers; raises `BusError`."""
        for finger, four in enumerate(counts):
            number = codec.identifier(codec.Command.SET_TORQUE + finger, self.hand)
            # Without waiting, since this runs in a callback, which cannot await.
            self.bus.send_now(CanFrame(number, codec.pack_counts(four)))

    def listen(self, on_positions: OnPositions) -> None:
        """Call a function with the positions that the hand sends, until `deafen`."""
        for finger in range(codec.FINGERS):
            number = codec.identifier(codec.Command.FINGER_POSE + finger, self.hand)
            self._undo.append(self.bus.subscribe(_reader(finger, on_positions), number))

    def deafen(self) -> None:
        """Stop calling the function; idempotent."""
        for undo in self._undo:
            undo()
        self._undo.clear()


def _reader(finger: int, on_positions: OnPositions) -> Callable[[CanFrame], None]:
    def read(frame: CanFrame) -> None:
        # Another host's request has the same identifier as the hand's answer.
        if frame.remote:
            return
        try:
            counts = codec.read_counts(frame.data)
        except codec.AllegroFrameError:
            return
        on_positions(finger, counts, frame.stamp)

    return read
