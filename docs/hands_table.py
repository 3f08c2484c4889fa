"""The tables of hands and their devices in ``docs/hands/index.md``, made from ``config/``.

``python docs/hands_table.py`` rewrites them; a test keeps them current. What a device measures
and accepts is what its driver says once it has connected to the device's emulator.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import anyio

from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.servos import servo_of
from rtee.drivers.registry import find_driver
from rtee.running.prepare import PreparedHand, RunOptions, prepare
from rtee.testing.session import simulated_time
from rtee.types import JointKind

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
PAGE = ROOT / "docs" / "hands" / "index.md"
BEGIN = "<!-- Made by `python docs/hands_table.py`; a test keeps it current. -->"
END = "<!-- End of what is made. -->"

_QUANTITIES = ("position", "velocity", "effort", "current", "temperature", "pressure", "grasped")
_LIMITS = ("position", "max_effort", "max_velocity")
_BUSES = {
    "SerialBus": "serial",
    "ModbusBus": "Modbus",
    "CanBus": "CAN",
    "CanopenBus": "CANopen",
    "DynamixelBus": "Dynamixel",
    "EthercatBus": "EtherCAT",
    "ZmqBus": "ZeroMQ",
}
_FEW = 3
"""With at most so many fingers and fewer actuators, it is called a gripper."""


@dataclass(frozen=True)
class Connected:
    """A device of a hand as its driver knows it once connected to the emulator.

    Attributes:
        driver: The driver's name.
        bus: What it hangs on.
        capabilities: What it measures and accepts.
    """

    driver: str
    bus: str
    capabilities: Capabilities


@cache
def hands() -> list[PreparedHand]:
    """Return the hands in ``config/`` with their devices, those with most fingers first."""
    folders = sorted(path.parent for path in (ROOT / "config").glob("*/hand.yaml"))
    found = [prepare(str(folder), RunOptions(emulated=True, ideal=True)) for folder in folders]
    return sorted(found, key=lambda one: (-len(one.hand.fingers), one.hand.name))


async def _connected(one: PreparedHand) -> list[Connected]:
    found = []
    async with BusPool(wire_time=False) as pool:
        for device in one.devices:
            driver = find_driver(device.spec.driver)(device.spec, pool)
            try:
                await driver.configure()
                (bus,) = pool.buses
                words = _BUSES[type(bus).__name__]
                found.append(Connected(device.spec.driver, words, driver.capabilities))
            finally:
                await driver.close()
    return found


def connected(one: PreparedHand) -> list[Connected]:
    """Connect to the emulators of a hand's devices."""
    # In simulated time, in which a busy computer answers as soon as an idle one.
    backend, options = simulated_time()
    return anyio.run(_connected, one, backend=backend, backend_options=options)


def kind_of(one: PreparedHand) -> str:
    """Return what kind of hand it is, in words."""
    hand = one.hand
    fingers, actuators = len(hand.fingers), len(hand.actuators)
    word = "gripper" if fingers <= _FEW and actuators < fingers else "hand"
    how = "coupled" if len(hand.joints) > actuators else "every joint driven"
    return f"{word}, {how}"


def _named(one: PreparedHand) -> str:
    return f"[{one.config.title}]({one.hand.name}.md)"


def _of_hands(found: list[PreparedHand]) -> list[str]:
    rows = [
        "| hand | name | kind | fingers | actuators | joints | primitives |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in found:
        hand = one.hand
        numbers = (hand.fingers, hand.actuators, hand.joints, one.library.all("primitive"))
        counts = " | ".join(str(len(each)) for each in numbers)
        rows.append(f"| {_named(one)} | `{hand.name}` | {kind_of(one)} | {counts} |")
    return rows


def _of_devices(found: list[PreparedHand]) -> list[str]:
    rows = [
        "| hand | driver | bus | measures | accepts | exchanges at best [Hz] | loop [Hz] | homes |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in found:
        for device in connected(one):
            can = device.capabilities
            best = "the loop's" if math.isinf(can.best_rate) else f"{can.best_rate:.0f}"
            cells = (
                _named(one),
                f"[`{device.driver}`](../devices/{device.driver}.md)",
                device.bus,
                ", ".join(
                    [name for name in _QUANTITIES if name in can.measures]
                    + (["touch"] if can.touch else [])
                ),
                ", ".join(name for name in _LIMITS if name in can.accepts),
                best,
                f"{one.config.loop.rate:g}",
                "yes" if can.homing else "",
            )
            rows.append(f"| {' | '.join(cells)} |")
    return rows


def _of_motors(found: list[PreparedHand]) -> list[str]:
    """Return the table of what moves with the fingers in simulation, besides their links."""
    rows = [
        "| hand | inertia of motors and gears, seen at the joints | from |",
        "| --- | --- | --- |",
    ]
    options = SimOptions()
    for one in found:
        servos = [servo_of(one.hand, actuator, options) for actuator in one.hand.actuators]
        for unit, slides in (("kg·m²", False), ("kg", True)):
            kind = [
                (servo.armature, "armature" in servo.derived)
                for servo, actuator in zip(servos, one.hand.actuators, strict=True)
                if (actuator.kind is JointKind.PRISMATIC) is slides
            ]
            if kind:
                least, most = min(kind)[0], max(kind)[0]
                size = f"{least:.2g}" if least == most else f"{least:.2g} to {most:.2g}"
                source = "derived" if all(made for _, made in kind) else "hand.yaml"
                rows.append(f"| {one.config.title} | {size} {unit} | {source} |")
    return rows


def _of_judges(found: list[PreparedHand]) -> list[str]:
    from tests.drivers.peers.running import peers
    from tests.drivers.recorded.table import recorded

    rows = [
        "| hand | driver | sheet | maker's software | software by others | recorded bytes "
        "| hardware |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    bytes_of, software = recorded(), peers()
    for one in found:
        for driver in dict.fromkeys(device.spec.driver for device in one.devices):
            by = {
                who: ", ".join(
                    f"`{peer['package']}`"
                    for peer in software
                    if peer["by"] == who and driver in peer["drivers"]
                )
                for who in ("maker", "others")
            }
            many = f"{len(bytes_of[driver].frames)}" if driver in bytes_of else ""
            cells = (_named(one), f"`{driver}`", "yes", by["maker"], by["others"], many, "none yet")
            rows.append(f"| {' | '.join(cells)} |")
    return rows


def tables() -> str:
    """Return the tables as Markdown."""
    found = hands()
    page = "../concepts/simulation.md#motors"
    motors = [
        "",
        f"What moves with the fingers in [simulation]({page}), besides their links:",
        "",
        *_of_motors(found),
    ]
    judged = ["", *_trust(), "", *_of_judges(found)]
    devices = [*_of_devices(found), *judged]
    return "\n".join([*_of_hands(found), "", *_between(), "", *devices, *motors])


def _trust() -> list[str]:
    return [
        "What each driver and emulator was tested against. *Sheet*: facts from the maker's",
        "documents and from programs for the device. *Software* by the maker or by others drives",
        "the emulator in the tests (`make heavy`). *Recorded bytes* are frames of real devices",
        "that the tests decode. The authors have tried no driver on hardware; to try one yourself,",
        "see [the first hour with a device](../how-to/first-contact.md).",
    ]


def _between() -> list[str]:
    return [
        "Coupled: fewer actuators than joints; springs, tendons or linkages move the others.",
        "",
        "Their devices, as the drivers describe them:",
    ]


def page() -> str:
    """Return the page with its tables made again."""
    head, begin, rest = PAGE.read_text().partition(BEGIN)
    _, end, tail = rest.partition(END)
    assert begin, f"{PAGE} has lost its marks"
    assert end, f"{PAGE} has lost its marks"
    return f"{head}{BEGIN}\n\n{tables()}\n\n{END}{tail}"


if __name__ == "__main__":
    PAGE.write_text(page())
