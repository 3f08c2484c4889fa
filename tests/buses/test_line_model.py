"""The modelled wire, in simulated time: what a host finds that does not wait for answers."""

from __future__ import annotations

import pytest

from rtee.buses.emulator import Duplex, Emulator
from rtee.buses.line_model import Wire
from rtee.drivers.emulators import EMULATORS, find_emulator

BAUD = 10_000.0
"""A byte takes a millisecond."""


class Answering(Emulator):
    """Answers whatever it hears with as many bytes, at once."""

    def feed(self, data: bytes, now: float) -> list[bytes]:
        return [bytes(len(data))]

    def power_cycle(self, now: float) -> None:
        pass


class TwoPairs(Answering):
    duplex = Duplex.FULL


def lags(wire: Wire) -> list[float]:
    """Send ten bytes every 11 ms without waiting; return how late each answer is complete [s]."""
    for number in range(50):
        now = 0.011 * number
        wire.step(now)
        wire.receive(bytes(10), now)
    found = []
    while (due := wire.next_due()) is not None:
        found += [due] * len(wire.step(due))
    return found


def test_both_directions_of_a_full_duplex_line_are_used_at_once() -> None:
    wire = Wire([TwoPairs()], baudrate=BAUD)
    assert wire.duplex is Duplex.FULL
    # The last request leaves at 539 ms; 10 ms for itself, 10 ms for its answer.
    assert lags(wire)[-1] == pytest.approx(0.559)
    assert wire.busy == pytest.approx(0.559), "no moment counts twice"


def test_on_a_half_duplex_line_messages_queue() -> None:
    wire = Wire([Answering()], baudrate=BAUD)
    assert wire.duplex is Duplex.HALF
    assert lags(wire)[-1] == pytest.approx(50 * 0.02)
    assert wire.busy == pytest.approx(50 * 0.02)


def test_one_half_duplex_device_makes_the_line_half_duplex() -> None:
    wire = Wire([TwoPairs(), Answering()], baudrate=BAUD)
    assert wire.duplex is Duplex.HALF
    assert Wire([Answering()], duplex=Duplex.FULL).duplex is Duplex.FULL


def test_only_devices_with_a_pair_of_wires_for_each_direction_are_full_duplex() -> None:
    full = {name for name in EMULATORS if find_emulator(name).duplex is Duplex.FULL}
    assert full == {"schunk_svh", "orca_touch", "ability_hand"}
