"""Emulates an SVH on the wire.

Unknown behaviour of the real hand is a property here: the length of replies, and whether they echo
the request's index.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, replace

from rtee.buses.emulator import Duplex, Emulator
from rtee.buses.parser import CodecError
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Duration, Positive
from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import channels_for, current_settings, position_settings
from rtee.drivers.schunk_svh.codec import Command, ControllerState, Packet, Parser
from rtee.hand.validation import Section

_FRICTION = 40.0
"""Current of a channel that moves freely [mA]; no source gives it."""
_ASIDE = ("Thumb_Opposition", "Finger_Spread")  # channels that do not close on an object


class SvhOptions(Section, frozen=True):
    """Properties of the emulated hand.

    Attributes:
        name: Name in its firmware information; that of a genuine hand is ``SVH``.
        firmware: Major and minor version.
        text: Free text in its firmware information.
        start: Closure at power-up, 0 (open) to 1; encoders read 0 there.
        padded: Whether replies have 64 bytes of data like requests, or only those needed.
        echo_index: Whether replies carry the index of their request, or 0.
        turnaround: Time between a request and its reply [s]; not known of the real hand.
        hot: Temperature at which the over-temperature warning latches [°C].
        haste: Factor by which it moves and homes faster than a real one.
        latch_echo: Whether the state also returns the bits written to clear faults.
    """

    name: str = "SVH"
    firmware: tuple[int, int] = (1, 2)
    text: str = "emulated"
    start: float = 0.3
    padded: bool = True
    echo_index: bool = True
    turnaround: Duration = codec.TURNAROUND
    hot: float = 90.0
    haste: Positive = 1.0
    latch_echo: bool = False


@dataclass(slots=True)
class _Channel:
    axis: Axis
    position: codec.PositionSettings
    current: codec.CurrentSettings


class SchunkSvhEmulator(Emulator, Grasps):
    """The hand: nine axes behind cascaded controllers, and one reply to every packet.

    Attributes:
        options: Its properties.
        channels: Its nine channels.
        packets: Packets answered, by command.
        early: Packets that came sooner than `codec.GAP` after the previous one.
    """

    PROPERTIES = SvhOptions
    SHARED = ("turnaround",)
    FAULTS = Emulator.FAULTS | {"driver_fault", "over_temperature", "silent"}
    BAUDRATES = frozenset({codec.BAUDRATE})
    baudrate = codec.BAUDRATE
    duplex = Duplex.FULL  # RS-485 with a pair of wires for each direction, or USB

    def __init__(self, options: SvhOptions | None = None) -> None:
        super().__init__()
        self.options = options or SvhOptions()
        self.turnaround = self.options.turnaround
        self.table = channels_for(self.options.firmware)
        self.packets: dict[Command, int] = {}
        self.early = 0
        self._last = 0.0
        self.channels: list[_Channel] = []
        self.power_cycle(0.0)

    def power_cycle(self, now: float) -> None:
        """Restart: everything off, encoders at 0 where the fingers are."""
        closures, before = [self.options.start] * codec.CHANNELS, self.channels
        if before:
            closures = [self.closure(index) for index in range(codec.CHANNELS)]
        self.channels = [self._channel(index, closures[index]) for index in range(codec.CHANNELS)]
        self.axes = [channel.axis for channel in self.channels]
        for old, new in zip(before, self.channels, strict=False):
            obstacle = old.axis.obstacle
            if obstacle is not None:
                # The object stays in its place, but the encoders start again from 0.
                new.axis.obstacle = replace(obstacle, contact=obstacle.contact - old.axis.position)
        self._state = ControllerState()
        self._fault = 0
        self._hot = 0
        self._encoders = (1,) * codec.CHANNELS
        self.parser = Parser()

    def inject(self, fault: str) -> None:
        """Put a fault into the hand; driver faults and over-temperature stay latched."""
        super().inject(fault)
        if fault == "driver_fault":
            self._fault = 0x01
            self._state = ControllerState()
            self._apply()
        elif fault == "over_temperature":
            self._hot = 0x01

    def _channel(self, index: int, closure: float) -> _Channel:
        spec = self.table[index]
        span = spec.max_offset - spec.min_offset
        if spec.direction > 0:
            stop = round(-spec.max_offset + closure * span)
            # A little play beyond the soft limit at the far end: 2 % of the range.
            lower, upper = stop + spec.min_offset - span // 50, stop
        else:
            stop = round(-spec.min_offset - closure * span)
            lower, upper = stop, stop + spec.max_offset + span // 50
        position, current = position_settings(index), current_settings(index)
        axis = Axis(
            lower=lower,
            upper=upper,
            max_velocity=position.max_rate * self.options.haste,
            max_effort=current.maximum,
            friction=_FRICTION,
            resolution=1.0,
        )
        return _Channel(axis, position, current)

    def stop_of(self, channel: int) -> int:
        """Return the position of the stop that homing finds [ticks]."""
        axis = self.channels[channel].axis
        return round(axis.upper if self.table[channel].direction > 0 else axis.lower)

    def closure(self, channel: int) -> float:
        """Return the closure of a channel: 0 at the open soft limit, 1 at the other."""
        spec = self.table[channel]
        zero = spec.zero(self.stop_of(channel))
        return spec.to_rad(self.channels[channel].axis.position, zero) / spec.range

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions; spread and opposition do not close on an object."""
        return [
            Closing(
                channel.axis, self._at(index, 0.0), self._at(index, 1.0), channel.current.maximum
            )
            for index, channel in enumerate(self.channels)
            if self.table[index].name not in _ASIDE
        ]

    def _at(self, channel: int, closure: float) -> float:
        """Return the position of a channel at a closure [ticks]."""
        spec = self.table[channel]
        return spec.zero(self.stop_of(channel)) + closure * spec.range / spec.rad_per_tick

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        super().advance(now)
        for index, channel in enumerate(self.channels):
            if channel.axis.temperature > self.options.hot:
                self._hot |= 1 << index

    def answers(self, frame: Packet, now: float) -> Iterable[bytes]:
        """Obey a packet and return the reply."""
        self.early += now - self._last < codec.GAP
        self._last = now
        self.packets[frame.command] = self.packets.get(frame.command, 0) + 1
        with contextlib.suppress(CodecError):
            index = frame.index if self.options.echo_index else 0
            reply = Packet(frame.command, frame.channel, self._answer(frame), index)
            yield reply.to_bytes(pad=self.options.padded)

    def _feedback(self, index: int) -> codec.Feedback:
        axis = self.channels[index].axis
        return codec.Feedback(round(axis.measured), round(axis.effort))

    def _answer(self, packet: Packet) -> bytes:
        command = packet.command
        if command is Command.GET_FIRMWARE_INFO:
            options = self.options
            name = "XYZ" if "wrong_device" in self.faults else options.name
            return codec.FirmwareInfo(name, *options.firmware, options.text).to_bytes()
        if command in {Command.GET_CONTROLLER_STATE, Command.SET_CONTROLLER_STATE}:
            return self._controller(packet)
        if command in {Command.GET_ENCODER_VALUES, Command.SET_ENCODER_VALUES}:
            if command is Command.SET_ENCODER_VALUES:
                self._encoders = codec.Encoders.from_bytes(packet.data).scalings
            return codec.Encoders(self._encoders).to_bytes()
        if command in {Command.GET_CONTROL_FEEDBACK_ALL, Command.SET_CONTROL_COMMAND_ALL}:
            if command is Command.SET_CONTROL_COMMAND_ALL:
                for index, target in enumerate(codec.Targets.from_bytes(packet.data).ticks):
                    self._target(index, target)
            every = [self._feedback(index) for index in range(codec.CHANNELS)]
            return codec.FeedbackAll(
                tuple(f.position for f in every), tuple(f.current_ma for f in every)
            ).to_bytes()
        if packet.channel >= codec.CHANNELS:
            raise CodecError(f"there is no channel {packet.channel}")
        return self._single(packet)

    def _single(self, packet: Packet) -> bytes:
        channel = self.channels[packet.channel]
        command = packet.command
        if command is Command.SET_CONTROL_COMMAND:
            self._target(packet.channel, codec.Target.from_bytes(packet.data).ticks)
        elif command is Command.SET_POSITION_SETTINGS:
            position = codec.PositionSettings.from_bytes(packet.data)
            # Settings of NaN or infinity cannot drive a motor and are ignored.
            if all(map(math.isfinite, astuple(position))):
                channel.position = position
                channel.axis.max_velocity = position.max_rate * self.options.haste
        elif command is Command.SET_CURRENT_SETTINGS:
            current = codec.CurrentSettings.from_bytes(packet.data)
            if all(map(math.isfinite, astuple(current))):
                channel.current = current
                channel.axis.max_effort = max(current.maximum, 0.0)
        if command in {Command.GET_POSITION_SETTINGS, Command.SET_POSITION_SETTINGS}:
            return channel.position.to_bytes()
        if command in {Command.GET_CURRENT_SETTINGS, Command.SET_CURRENT_SETTINGS}:
            return channel.current.to_bytes()
        return self._feedback(packet.channel).to_bytes()

    def _target(self, index: int, target: int) -> None:
        settings = self.channels[index].position
        clipped = min(max(float(target), settings.minimum), settings.maximum)
        self.channels[index].axis.target = clipped

    def _controller(self, packet: Packet) -> bytes:
        if packet.command is Command.SET_CONTROLLER_STATE:
            state = ControllerState.from_bytes(packet.data)
            self._fault &= ~state.pwm_fault
            if "driver_fault" in self.faults:
                self._fault |= 0x01
            self._hot &= ~state.pwm_otw
            # A driver fault keeps everything off until it is cleared.
            self._state = ControllerState() if self._fault else state
            self._apply()
        state = self._state
        echo = self.options.latch_echo
        return ControllerState(
            self._fault | (state.pwm_fault if echo else 0),
            self._hot | (state.pwm_otw if echo else 0),
            state.pwm_reset,
            state.pwm_active,
            state.position_control,
            state.current_control,
        ).to_bytes()

    def _apply(self) -> None:
        state = self._state
        running = bool(state.position_control and state.current_control)
        supplied = bool(state.pwm_reset & state.pwm_active & ControllerState.SUPPLY)
        for index, channel in enumerate(self.channels):
            channel.axis.enabled = bool(running and supplied and state.enabled >> index & 1)
