"""The devices for the benchmarks: those of the contract suite, and whole hands of them."""

from __future__ import annotations

import dataclasses
import gc
import importlib.util
import sys
from pathlib import Path

from rtee.buses.timing import ask_for_short_slices
from rtee.drivers.schunk_svh.channels import CHANNELS
from rtee.loop.realtime import share_the_interpreter
from rtee.testing import DeviceCase, DriverContract, actuator

TESTS = Path(__file__).resolve().parents[1] / "tests" / "drivers"
sys.path.insert(0, str(TESTS.parent))  # what tests share is imported by its name alone


def as_the_loop() -> None:
    """Set up this thread and its interpreter in the same way as the loop."""
    ask_for_short_slices()
    share_the_interpreter()
    gc.collect()
    gc.freeze()


def cases(only: str | None) -> dict[str, DeviceCase]:
    """Return the devices that the tests describe."""
    found: dict[str, DeviceCase] = {}
    for file in sorted(TESTS.glob("*/test_*_contract.py")):
        spec = importlib.util.spec_from_file_location(f"bench_{file.stem}", file)
        if spec is None or spec.loader is None:
            continue
        module = importlib.util.module_from_spec(spec)
        # Before executing: dataclasses look their module up there.
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        for name, value in vars(module).items():
            if isinstance(value, type) and issubclass(value, DriverContract):
                case = getattr(value, "case", None)
                if isinstance(case, DeviceCase) and case.wire:
                    found[f"{file.parent.name}: {name.removeprefix('Test')}"] = case
    return {name: case for name, case in found.items() if only is None or only in name}


def whole_hands(devices: dict[str, DeviceCase], only: str | None) -> dict[str, DeviceCase]:
    """Return the devices, and as whole hands those of which the tests drive only a part."""
    found = dict(devices)
    svh = found.get("schunk_svh: Svh")
    if svh is not None:
        every = tuple(actuator(f"hand_{c.name}", 0.0, c.range, effort=0.4) for c in CHANNELS)
        options = {**svh.options, "status_every": 50}
        nine = dataclasses.replace(svh, actuators=every, options=options)
        found["schunk_svh: nine channels"] = nine
        bare = {**options, "turnaround": 0.0}
        found["schunk_svh: the same, no turn-around"] = dataclasses.replace(nine, options=bare)
    three = found.get("onrobot_3fg: ThroughTheComputeBox")
    if three is not None:
        line = {**three.options, "port": "/dev/ttyUSB0"}
        del line["host"]
        found["onrobot_3fg: RTU"] = dataclasses.replace(three, options=line)
    small = found.get("dynamixel: Dynamixel")
    if small is not None:
        names = [f"joint_{i}" for i in range(16)]
        for baudrate in (1_000_000, 4_000_000):
            for fast in ("auto", "never"):
                what = f"dynamixel: 16 at {baudrate // 1_000_000} Mbaud, "
                what += "fast read" if fast == "auto" else "plain read"
                options = {
                    **small.options,
                    "servos": {n: {"id": i + 1} for i, n in enumerate(names)},
                    "baudrate": baudrate,
                    "fast": fast,
                    # Seldom, so that nearly all exchanges carry the same bytes.
                    "health_every": 200,
                }
                joints = tuple(actuator(n, -1.0, 1.5, effort=0.5, rest=0.0) for n in names)
                found[what] = dataclasses.replace(small, actuators=joints, options=options)
    return {name: case for name, case in found.items() if only is None or only in name}
