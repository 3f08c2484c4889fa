"""The driver in the documentation works, and is as short as it says."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtee.actions.library import ActionLibrary
from rtee.buses.pool import BusPool
from rtee.drivers.registry import driver_names, find_driver
from rtee.errors import CommandRejected, ConfigError, DeviceFault
from rtee.hand.load import load_model
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, drive
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.testing import actuator
from rtee.types import DeviceSpec, Goal, Lifecycle, Named, Reference

pytestmark = pytest.mark.anyio

URDF = """<robot name="jaw">
  <link name="palm"/>
  <link name="tip"><collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision></link>
  <joint name="slide" type="prismatic">
    <parent link="palm"/><child link="tip"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.05" velocity="0.2" effort="20"/>
  </joint>
</robot>
"""


class Gripper:
    """The other end: a TCP server that speaks the example's protocol."""

    def __init__(self) -> None:
        self.opening = 20.0
        self.wanted: list[float] = []
        self.connections = 0
        self._writers: list[asyncio.StreamWriter] = []

    async def __aenter__(self) -> Gripper:
        self.server = await asyncio.start_server(self._talk, "127.0.0.1", 0)
        self.port = self.server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self.server.close()
        self.hang_up()

    def hang_up(self) -> None:
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._writers.append(writer)
        while line := await reader.readline():
            if line == b"?\n":
                writer.write(b"%.1f\n" % self.opening)
            else:
                self.wanted.append(float(line[1:]))
                self.opening = self.wanted[-1]


async def until(condition: Callable[[], bool]) -> None:
    while True:
        if condition():
            return
        await asyncio.sleep(0.01)


@pytest.fixture
def examples(repository: Path) -> dict[str, Any]:
    page = (repository / "docs" / "how-to" / "write-a-driver.md").read_text()
    code = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(code[0].splitlines()) < 30
    assert len(code[1].splitlines()) < 120
    names: dict[str, object] = {}
    for part in code[:3]:
        exec(compile(part, "write-a-driver.md", "exec", dont_inherit=True), names)
    return {name: names[name] for name in ("JawDriver", "ModbusJawDriver", "LineJawDriver")}


@pytest.mark.parametrize("port", ["/dev/jaw", "tcp://192.168.1.5"])
async def test_the_example_on_modbus_drives_its_gripper(
    port: str, examples: dict[str, Any]
) -> None:
    spec = DeviceSpec(
        "jaw", "jaw", "jaw", (actuator("slide", 0.0, 0.085),), {"port": port}, emulated=True
    )
    async with BusPool() as pool:
        jaw = examples["ModbusJawDriver"](spec, pool)
        await jaw.configure()
        assert (await jaw.sense()).position == pytest.approx([0.02])
        while abs((await jaw.sense()).position[0] - 0.05) > 1e-4:
            await jaw.move(Reference.at([0.05]))
            await asyncio.sleep(0.01)  # a network takes no time
        await jaw.stop()
        pool.played("jaw/jaw").faults.add("overload")
        with pytest.raises(DeviceFault, match="overload"):
            await jaw.sense()
        await jaw.close()


@pytest.mark.parametrize("name", ["ModbusJawDriver", "LineJawDriver"])
async def test_the_examples_know_a_worn_gripper(name: str, examples: dict[str, Any]) -> None:
    """Its first answer comes late, with a damaged byte."""
    actuators = (actuator("slide", 0.0, 0.04),)
    options = {"port": "/dev/jaw"}
    spec = DeviceSpec("jaw", "jaw", "jaw", actuators, options, emulated=True, worn=True)
    async with BusPool() as pool:
        jaw = examples[name](spec, pool)
        await jaw.configure()
        assert math.isfinite((await jaw.sense()).position[0])
        await jaw.close()


async def test_the_example_in_lines_of_text_is_homed_and_drives_its_gripper(
    examples: dict[str, Any],
) -> None:
    spec = DeviceSpec(
        "jaw", "jaw", "jaw", (actuator("slide", 0.0, 0.04),), {"port": "/dev/jaw"}, emulated=True
    )
    async with BusPool() as pool:
        jaw = examples["LineJawDriver"](spec, pool)
        await jaw.configure()
        with pytest.raises(DeviceFault, match="not homed"):
            await jaw.activate()
        with pytest.raises(CommandRejected, match="ERR 1"):
            await jaw.move(Reference.at([0.02]))
        await jaw.recover()
        await jaw.activate()
        await jaw.move(Reference.at([0.02]))
        while abs((await jaw.sense()).position[0] - 0.02) > 1e-4:
            pass
        await jaw.move(Reference.at([0.0]))
        await jaw.stop()
        assert not pool.played("jaw/jaw").axes[0].moving
        await jaw.close()
        await jaw.stop()


async def test_the_example_drives_its_gripper(examples: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "jaw.urdf").write_text(URDF)
    hand = load_model(tmp_path / "jaw.urdf")
    async with Gripper() as gripper:
        options = {"host": "127.0.0.1", "port": gripper.port}
        spec = DeviceSpec("jaw", "jaw", "jaw", hand.actuators, options=options, rate=200.0)
        settings = LoopSettings(rate=200.0)
        devices = [
            (DeviceSettings(spec, reconnect_active=True), examples["JawDriver"](spec, BusPool()))
        ]
        loop = HandLoop(hand, ActionLibrary(hand), settings, devices)
        async with loop:
            await loop.ready()
            ticking = asyncio.create_task(drive([loop], Clock(200.0)))
            await until(lambda: loop.controller.active[0])
            await asyncio.sleep(0.05)
            assert set(gripper.wanted) == {20.0}, "it starts where it was found"
            result = await loop.execute(Goal(Named("open")))
            assert result.reached
            assert gripper.opening < 3.0
            gripper.hang_up()
            await until(lambda: loop.statuses()[0].reconnects == 1)
            await until(lambda: loop.statuses()[0].lifecycle is Lifecycle.ACTIVE)
            assert gripper.connections == 2
            ticking.cancel()


def test_drivers_are_found_by_name_and_by_module() -> None:
    assert {"kinematic", "replay", "robotiq_2f", "dynamixel"} <= set(driver_names())
    kinematic = find_driver("kinematic")
    assert find_driver("rtee.drivers.kinematic.driver:KinematicDriver") is kinematic


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("kinmatic", "unknown driver 'kinmatic'; did you mean 'kinematic'"),
        ("no.such.module:Driver", "cannot be imported"),
        ("rtee.types:Driver", "cannot be imported"),
        ("rtee.types:Goal", "not a subclass of Driver"),
        ("", "unknown driver"),
        (":Driver", "cannot be imported"),
        ("..up:Driver", "cannot be imported"),
    ],
)
def test_what_is_no_driver_is_refused_with_file_and_line(name: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as caught:
        find_driver(name, source="hand.yaml:12")
    assert str(caught.value).startswith("hand.yaml:12: ")
