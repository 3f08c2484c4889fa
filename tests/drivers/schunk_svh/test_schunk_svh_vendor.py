"""The emulated SVH homed as the vendor's library does it: it sends on and never waits for a reply.

Simulated time: bytes pass the modelled wire, no clock is asked.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import pytest

from rtee.buses.line_model import Wire
from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import CHANNELS, Channel, current_settings, position_settings
from rtee.drivers.schunk_svh.codec import Command, ControllerState, Feedback, Packet, Parser
from rtee.drivers.schunk_svh.emulator import SchunkSvhEmulator, SvhOptions

PERIOD = 0.9e-3
"""Between two packets of the library: 72 bytes at 921600 baud, a pause and a little more [s]."""
ORDER = (3, 5, 1, 0, 8, 4, 2, 6, 7)
HITS = 10
NEAR = 1000
"""Distance at which the library takes its home position as reached [ticks]."""
IDLE = {3: -8000, 5: -8000}
"""Idle positions of SCHUNK's parameters where they differ from those built in [ticks]."""


class Library:
    """Sends a packet every `PERIOD`, hears what has come until then."""

    def __init__(self, hand: SchunkSvhEmulator) -> None:
        self.wire = Wire([hand], baudrate=codec.BAUDRATE)
        self.now = 0.0
        self.sent = self.received = self.behind = 0
        self.feedback: dict[int, Feedback] = {}
        self._parser = Parser()

    def send(self, command: Command, channel: int = 0, data: bytes = b"") -> None:
        packet = Packet(command, channel, data, self.sent % 255)
        self.sent += 1
        self.wire.receive(packet.to_bytes(), self.now)
        self.now += PERIOD
        for reply in self._parser.feed(b"".join(self.wire.step(self.now))):
            self.received += 1
            if reply.command is Command.SET_CONTROL_COMMAND:
                self.feedback[reply.channel] = Feedback.from_bytes(reply.data)
        self.behind = max(self.behind, self.sent - self.received)

    def state(self, enabled: int, running: bool) -> None:
        bits = (ControllerState.SUPPLY | enabled) if enabled else 0
        state = ControllerState(0x1F, 0x1F, bits, bits, int(running), int(running))
        self.send(Command.SET_CONTROLLER_STATE, 0, state.to_bytes())

    def target(self, channel: int, ticks: float) -> Feedback | None:
        self.send(Command.SET_CONTROL_COMMAND, channel, codec.Target(round(ticks)).to_bytes())
        return self.feedback.get(channel)

    def home(self, channel: Channel) -> int:
        """Drive a channel against its stop and back to where it idles; return the stop [ticks]."""
        index = channel.index
        normal, limit = position_settings(index), current_settings(index).maximum
        slow = replace(normal, max_rate=0.2 * normal.max_rate)
        self.send(Command.SET_POSITION_SETTINGS, index, slow.to_bytes())
        self.feedback.pop(index, None)
        self.state(1 << index, running=True)
        beyond = normal.maximum if channel.direction > 0 else normal.minimum
        recent: deque[int] = deque(maxlen=round(10.0 / PERIOD))
        hits = 0
        while hits < HITS:
            told = self.target(index, beyond)
            if told is None:
                continue
            hit = abs(told.current_ma) >= channel.reset_factor * limit
            hits = hits + 1 if hit else max(0, hits - 1)
            recent.append(told.position)
            stands = len(recent) == recent.maxlen and len(set(recent)) == 1
            assert not stands, f"{channel.name}: the homing timeout of the library"
        stop = self.feedback[index].position
        home = stop + channel.direction * IDLE.get(index, channel.idle_offset)
        until = self.now + 10.0
        while abs(self.feedback[index].position - home) >= NEAR:
            self.target(index, home)
            assert self.now < until, f"{channel.name}: does not come home"
        self.state(0, running=False)
        self.send(Command.SET_POSITION_SETTINGS, index, normal.to_bytes())
        return stop


def test_replies_keep_up_with_a_library_that_does_not_wait() -> None:
    library = Library(SchunkSvhEmulator())
    for _ in range(5000):
        library.send(Command.GET_CONTROL_FEEDBACK_ALL, 0, bytes(40))
    # A reply takes two times of a packet and the turn-around: at most three are under way.
    assert library.behind <= 3
    assert library.received >= library.sent - 3


@pytest.mark.heavy
def test_the_vendors_library_homes_all_channels() -> None:
    hand = SchunkSvhEmulator(SvhOptions(start=0.2))
    library = Library(hand)
    found = {index: library.home(CHANNELS[index]) for index in ORDER}
    assert found == {index: hand.stop_of(index) for index in ORDER}
    assert library.behind <= 3
