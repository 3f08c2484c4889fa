"""The suite of all drivers once more, each family against its worn device: as real ones are.

Motors follow late and more slowly than the sheet says, encoders have play, an offset and noise, the
first answer comes late and damaged, sensors are not zero at rest.
"""

from __future__ import annotations

import importlib
from dataclasses import replace

import pytest

from rtee.buses.wear import IDEAL
from rtee.testing import DeviceCase, DriverContract, cycles
from tests.drivers.suites import heavy

FAMILIES = {
    "ability_hand": "TestPositions",
    "allegro": "TestAllegro",
    "cia402": "TestProfilePosition",
    "dynamixel": "TestDynamixel",
    "feetech": "TestSts",
    "heri_ethercat": "TestHeriII",
    "inspire_rh56": "TestFrames",
    "linkerhand": "TestO6",
    "onrobot_3fg": "TestThroughTheComputeBox",
    "onrobot_rg": "TestOnALine",
    "orca_touch": "TestOrcaTouch",
    "qb_softhand": "TestSoftHand",
    "robotiq_2f": "TestRtu",
    "robotiq_3f": "TestFingersAndScissor",
    "schunk_egu": "TestOnTheLine",
    "schunk_svh": "TestSvh",
    "wsg50": "TestOnTheNetwork",
    "xbot2": "TestXBot2",
}

_SHARE = 0.02
"""How near a worn device comes to a posture: twice its play, offset and noise together, as a share
of the way, since where it stops depends on them as well."""

_FAULTS = frozenset({"delay", "drop"})


_HARDLY_WORN = (
    "test_a_cancelled_exchange_leaves_the_driver_usable",
    "test_a_slow_device_leaves_a_fast_one_its_rate",
    "test_a_wrong_device_is_refused",
    "test_close_is_idempotent_in_any_state",
    "test_no_device_is_a_clear_error",
)
"""Tests that move nothing, which each family passes beside its tidy device at each commit."""

_KINDS = ("cia402", "dynamixel", "heri_ethercat", "robotiq_2f", "schunk_svh", "wsg50")
"""One family of each kind of bus, which are tested at each commit."""


def suite_of(family: str) -> type[DriverContract]:
    """Return the suite of a family, with what it tests differently."""
    module = importlib.import_module(f"tests.drivers.{family}.test_{family}_contract")
    suite: type[DriverContract] = getattr(module, FAMILIES[family])
    return suite


def worn(case: DeviceCase) -> DeviceCase:
    """Return a case with a worn device."""
    ways = [actuator.upper - actuator.lower for actuator in case.actuators]
    return replace(
        case,
        worn=True,
        tolerance=max([case.tolerance, *(_SHARE * way for way in ways)]),
        within=2.0 * case.within,
        # The lag, during which a command to stop has not been taken yet.
        stopping=case.stopping + 0.1,
        # All faults of the wire are tested beside the tidy device; late and lost answers meet the
        # lag of a worn one.
        wire_faults=_FAULTS if case.wire_faults is None else _FAULTS & case.wire_faults,
        cycles=cycles(20),
    )


for _family in FAMILIES:
    _name = "Test" + "".join(word.capitalize() for word in _family.split("_"))
    _suite = suite_of(_family)
    # What belongs to the wire alone is tested beside the tidy device.
    _wire = dict.fromkeys(
        (
            "test_it_works_over_a_real_port_in_real_time",
            "test_unplugging_again_and_again_leaks_nothing",
        )
    )
    _mark = {} if _family in _KINDS else {"pytestmark": pytest.mark.heavy}
    globals()[_name] = heavy(
        type(_name, (_suite,), {"case": worn(_suite.case), **_wire, **_mark}), *_HARDLY_WORN
    )


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_a_worn_device_differs_from_its_sheet(family: str) -> None:
    from rtee.drivers.emulators import make_emulator

    ideal = make_emulator(family, {"port": "/dev/x"})
    used = make_emulator(family, {"port": "/dev/x", "emulator": {"wear": "worn"}})
    assert ideal.wear is IDEAL
    assert used.wear == type(used).WEAR
    assert used.wear.late > 0.0
    for motor in used.axes:
        assert motor.lag > 0.0
        assert motor.pace < 1.0
