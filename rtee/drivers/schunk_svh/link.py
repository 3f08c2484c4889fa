"""The SVH's commands over a bus: one packet out, one packet back."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rtee.buses.serial import SerialBus
from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.codec import Command, ControllerState, Packet, Parser, SvhFrameError
from rtee.errors import FrameError

T = TypeVar("T")

PATIENCE = 1.0
"""Longest time for an exchange that belongs to no cycle [s]."""


class SvhLink:
    """Exchanges packets with one hand.

    Attributes:
        bus: The line to it.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        patient: Exchanges may take `PATIENCE` and twice the retries: set-up and homing have no
            cycle to keep, and must not fail for a lost packet.
        echoes: The hand's replies carry the index of their request, so a late one is recognised.
    """

    def __init__(self, bus: SerialBus, deadline: float, retries: int) -> None:
        self.bus = bus
        self.deadline = deadline
        self.retries = retries
        self.patient = True
        self.echoes = False
        self._index = 0
        self._parser = Parser()

    def exchange(
        self, command: Command, channel: int = 0, data: bytes = b""
    ) -> Coroutine[Any, Any, Packet]:
        """Send one packet and return the reply, when awaited.

        Raises:
            BusError: if the exchange fails.
        """
        # 0 to 254, as the vendor's library counts.
        self._index = (self._index + 1) % 255
        request = Packet(command, channel, data, self._index)

        def answers(reply: Packet) -> bool:
            same = reply.command is command and reply.channel == channel
            return same and (not self.echoes or reply.index == request.index)

        deadline = max(self.deadline, PATIENCE) if self.patient else self.deadline
        retries = 2 * self.retries + 1 if self.patient else self.retries
        return self.bus.transact(
            request.to_bytes(), self._parser, deadline, retries, accept=answers
        )

    def _read(self, reply: Packet, read: Callable[[Packet], T]) -> T:
        try:
            return read(reply)
        except SvhFrameError as error:
            raise FrameError(self.bus.name, str(error), reply.data) from error

    async def firmware(self) -> codec.FirmwareInfo:
        """Return the hand's identification; also finds out whether it echoes indices."""
        # Until this is known, every reply to the command counts, whatever its index.
        self.echoes = False
        reply = await self.exchange(Command.GET_FIRMWARE_INFO)
        self.echoes = reply.index == self._index
        return self._read(reply, codec.FirmwareInfo.from_bytes)

    async def state(self) -> ControllerState:
        """Return the controllers' state."""
        reply = await self.exchange(Command.GET_CONTROLLER_STATE)
        return self._read(reply, ControllerState.from_bytes)

    async def set_state(self, state: ControllerState) -> ControllerState:
        """Set the controllers' state and return the state that results."""
        reply = await self.exchange(Command.SET_CONTROLLER_STATE, 0, state.to_bytes())
        return self._read(reply, ControllerState.from_bytes)

    async def feedback(self, channel: int) -> codec.Feedback:
        """Return position and current of one channel."""
        reply = await self.exchange(Command.GET_CONTROL_FEEDBACK, channel)
        return self._read(reply, codec.Feedback.from_bytes)

    async def set_target(self, channel: int, ticks: int) -> codec.Feedback:
        """Set the target of one channel; its position and current come back."""
        reply = await self.exchange(Command.SET_CONTROL_COMMAND, channel, codec.target(ticks))
        return self._read(reply, codec.Feedback.from_bytes)

    async def feedback_all(self) -> codec.FeedbackAll:
        """Return positions and currents of all channels."""
        reply = await self.exchange(Command.GET_CONTROL_FEEDBACK_ALL)
        return self._read(reply, codec.FeedbackAll.from_bytes)

    async def set_targets(self, ticks: list[int]) -> codec.FeedbackAll:
        """Set the targets of all channels; their positions and currents come back."""
        reply = await self.exchange(Command.SET_CONTROL_COMMAND_ALL, 0, codec.targets(ticks))
        return self._read(reply, codec.FeedbackAll.from_bytes)

    async def position_settings(self, channel: int) -> codec.PositionSettings:
        """Return the position controller of a channel."""
        reply = await self.exchange(Command.GET_POSITION_SETTINGS, channel)
        return self._read(reply, codec.PositionSettings.from_bytes)

    async def current_settings(self, channel: int) -> codec.CurrentSettings:
        """Return the current controller of a channel."""
        reply = await self.exchange(Command.GET_CURRENT_SETTINGS, channel)
        return self._read(reply, codec.CurrentSettings.from_bytes)

    async def set_position_settings(self, channel: int, settings: codec.PositionSettings) -> None:
        """Set the position controller of a channel."""
        await self.exchange(Command.SET_POSITION_SETTINGS, channel, settings.to_bytes())

    async def set_current_settings(self, channel: int, settings: codec.CurrentSettings) -> None:
        """Set the current controller of a channel."""
        await self.exchange(Command.SET_CURRENT_SETTINGS, channel, settings.to_bytes())
