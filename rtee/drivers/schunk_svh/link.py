"""The SVH's commands over a bus: one packet out, one packet back."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rtee.buses.serial import SerialBus
from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.codec import Command, ControllerState, Packet, Parser

T = TypeVar("T")

PATIENCE = 1.0
"""Longest time for an exchange outside the cycle [s]."""


class SvhLink:
    """Exchanges packets with one hand.

    Attributes:
        bus: The line to it.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        patient: Whether exchanges may take `PATIENCE` and twice the retries: set-up and homing have
            no cycle to keep, and must not fail because of a lost packet.
        echoes: Whether replies carry the index of their request, which identifies late replies.
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
        """Return a coroutine that sends one packet and returns the reply; it raises `BusError`."""
        # 0 to 254, as the vendor's library counts.
        self._index = (self._index + 1) % 255
        request = Packet(command, channel, data, self._index)

        def answers(reply: Packet) -> bool:
            same = reply.command is command and reply.channel == channel
            return same and (not self.echoes or reply.index == request.index)

        deadline = max(self.deadline, PATIENCE) if self.patient else self.deadline
        retries = 2 * self.retries + 1 if self.patient else self.retries
        return self.bus.transact(
            request.to_bytes(),
            self._parser,
            deadline,
            retries,
            accept=answers,
            encode=Packet.to_bytes,
        )

    async def _ask(
        self, read: Callable[[bytes], T], command: Command, channel: int = 0, data: bytes = b""
    ) -> T:
        """Send one packet and return the content of the reply; raises `BusError`."""
        return self.bus.decoded(read, (await self.exchange(command, channel, data)).data)

    async def firmware(self) -> codec.FirmwareInfo:
        """Return the hand's identification, and record whether it echoes indices."""
        # Until this is known, a reply with any index is accepted.
        self.echoes = False
        reply = await self.exchange(Command.GET_FIRMWARE_INFO)
        self.echoes = reply.index == self._index
        return self.bus.decoded(codec.FirmwareInfo.from_bytes, reply.data)

    async def state(self) -> ControllerState:
        """Return the controllers' state."""
        return await self._ask(ControllerState.from_bytes, Command.GET_CONTROLLER_STATE)

    async def set_state(self, state: ControllerState) -> ControllerState:
        """Set the controllers' state and return the resulting one."""
        set_state = Command.SET_CONTROLLER_STATE
        return await self._ask(ControllerState.from_bytes, set_state, 0, state.to_bytes())

    async def feedback(self, channel: int) -> codec.Feedback:
        """Return position and current of one channel."""
        return await self._ask(codec.Feedback.from_bytes, Command.GET_CONTROL_FEEDBACK, channel)

    async def set_target(self, channel: int, ticks: int) -> codec.Feedback:
        """Set the target of one channel; return its position and current."""
        command, data = Command.SET_CONTROL_COMMAND, codec.Target(ticks).to_bytes()
        return await self._ask(codec.Feedback.from_bytes, command, channel, data)

    async def feedback_all(self) -> codec.FeedbackAll:
        """Return positions and currents of all channels."""
        return await self._ask(codec.FeedbackAll.from_bytes, Command.GET_CONTROL_FEEDBACK_ALL)

    async def set_targets(self, ticks: list[int]) -> codec.FeedbackAll:
        """Set the targets of all channels; return their positions and currents."""
        command, data = Command.SET_CONTROL_COMMAND_ALL, codec.Targets(ticks).to_bytes()
        return await self._ask(codec.FeedbackAll.from_bytes, command, 0, data)

    async def position_settings(self, channel: int) -> codec.PositionSettings:
        """Return the position controller of a channel."""
        read = codec.PositionSettings.from_bytes
        return await self._ask(read, Command.GET_POSITION_SETTINGS, channel)

    async def current_settings(self, channel: int) -> codec.CurrentSettings:
        """Return the current controller of a channel."""
        read = codec.CurrentSettings.from_bytes
        return await self._ask(read, Command.GET_CURRENT_SETTINGS, channel)

    async def set_position_settings(self, channel: int, settings: codec.PositionSettings) -> None:
        """Set the position controller of a channel."""
        await self.exchange(Command.SET_POSITION_SETTINGS, channel, settings.to_bytes())

    async def set_current_settings(self, channel: int, settings: codec.CurrentSettings) -> None:
        """Set the current controller of a channel."""
        await self.exchange(Command.SET_CURRENT_SETTINGS, channel, settings.to_bytes())
