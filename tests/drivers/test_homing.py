"""Homing on the user's word."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.registry import find_driver
from rtee.errors import DeviceFault
from rtee.hand.load import hand_folder
from rtee.running.prepare import homing_allowed
from rtee.running.run import RunOptions, prepare
from rtee.types import DeviceSpec


def svh(tmp_path: Path, *, home: bool) -> DeviceSpec:
    """Return the SVH of the hand as shipped, as `rtee run` would make it."""
    folder = tmp_path / "schunk_svh"
    shutil.copytree(hand_folder("schunk_svh")[0], folder)
    file = folder / "hand.yaml"
    text = file.read_text()
    assert "      home: on_demand" in text
    file.write_text(text + "      emulator: {start: 0.05}\n")
    options = RunOptions(driver="devices", emulated=True, home=home)
    [device] = prepare(str(folder), options).devices
    return device.spec


@pytest.mark.anyio
@pytest.mark.parametrize("home", [False, True])
async def test_a_hand_is_homed_when_the_user_says_so(tmp_path: Path, home: bool) -> None:
    spec = svh(tmp_path, home=home)
    assert spec.options["home"] == ("on_connect" if home else "on_demand")
    async with BusPool() as pool:
        driver = find_driver(spec.driver)(spec, pool)
        await driver.configure()
        if not home:
            with pytest.raises(DeviceFault, match="not homed") as caught:
                await driver.activate()
            assert "rtee run --home" in caught.value.hint
            assert "rtee recover" in caught.value.hint
        else:
            await driver.activate()
            hand, state = pool.played(spec.owner), await driver.sense()
            truth = [hand.closure(i) * hand.table[i].range for i in range(9)]
            by_name = {hand.table[i].name: truth[i] for i in range(9)}
            names = [a.name.removeprefix("left_hand_") for a in spec.actuators]
            assert state.position == pytest.approx([by_name[n] for n in names], abs=0.01)
        await driver.close()


@pytest.mark.parametrize(
    ("name", "driver"), [("qb_softhand", "devices"), ("schunk_svh", "kinematic")]
)
def test_hands_that_are_never_homed_may_be_told_to(name: str, driver: str) -> None:
    plain, homed = (
        prepare(name, RunOptions(driver=driver, emulated=driver == "devices", home=home))
        for home in (False, True)
    )
    assert [d.spec for d in homed.devices] == [d.spec for d in plain.devices]


def test_other_devices_keep_their_options(tmp_path: Path) -> None:
    homing, still = svh(tmp_path, home=False), DeviceSpec("q", "h", "qb_softhand", ())
    found = homing_allowed([homing, still])
    assert found[0].options == {**homing.options, "home": "on_connect"}
    assert found[1] is still
