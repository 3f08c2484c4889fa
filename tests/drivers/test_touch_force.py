"""How hard emulated devices press on what a touch finds: lightly, whatever they measure."""

from __future__ import annotations

import pytest

from rtee.drivers.objects import Closing, Grasps
from rtee.loop.observer import Observer
from rtee.sample import TickRecord
from rtee.testing.simulated import SimulatedHand, simulated


class Presses(Observer):
    """Keeps the largest force on the object, as a share of the device's greatest effort."""

    def __init__(self, made: SimulatedHand) -> None:
        self.most = 0.0
        self._closings: list[Closing] = []
        for device in made._loop.devices.values():
            for emulator in made._pool.simulation(device.spec.owner).emulators:
                assert isinstance(emulator, Grasps)
                self._closings += emulator.closings()
        made._loop.add_observer(self)

    def on_tick(self, record: TickRecord) -> None:
        for one in self._closings:
            if (found := one.motor.obstacle) is not None:
                deep = (one.motor.position - found.contact) * found.closing
                self.most = max(self.most, deep * found.stiffness / one.effort)


@pytest.mark.samples("schunk_egu-*", "wsg50-*", "onrobot_*", "linkerhand_o6-*")
@pytest.mark.parametrize(
    ("hand", "share"),
    [
        ("schunk_egu", 0.05),
        ("wsg50", 0.1),
        ("onrobot_3fg15", 0.25),
        ("onrobot_rg2", 0.1),
        ("linkerhand_o6", 0.1),
        ("linkerhand_l10", 0.1),
    ],
)
def test_a_touch_presses_lightly_on_what_it_finds(hand: str, share: float) -> None:
    """These devices lag behind a slow reference, by steps or coarse positions, in the air too."""
    with simulated(hand, object="0.4") as made:
        presses = Presses(made)
        made.touch(tip_speed=0.02)
        assert "contact" in [event.kind for event in made.events]
        assert 0.0 < presses.most <= share
    with simulated(hand) as made:
        result = made.touch(tip_speed=0.02)
        assert (result.touched, result.reached) == ((), True)
