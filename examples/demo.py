"""The demo: extract, execute, record and replay, then three devices on emulated wires.

Everything it does is a command that can be typed; each is printed before it runs. What it makes is
in logs/demo/.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from rtee.log import read
from rtee.log.recording import Recording

REPOSITORY = Path(__file__).resolve().parents[1]
LOGS = REPOSITORY / "logs" / "demo"
RTEE = str(Path(sys.executable).with_name("rtee"))

GRIPPERS = (
    ("robotiq_2f_85", ("finger_1", "finger_2"), "50mm", "Modbus RTU, 115200 baud"),
    ("qb_softhand", ("thumb", "index"), "0.4", "its serial protocol, 2 Mbaud"),
    ("onrobot_3fg15", ("finger_1", "finger_2"), "50mm", "Modbus TCP"),
)
"""The three devices of the paper's Fig. 12, two fingers of each, what is between them (its width,
or where it is met on the way), and the wire it is emulated on."""

HELD = 3.1
"""How long objects are held at least [s]; the effort is eased off meanwhile."""


def title(text: str) -> None:
    """Print a heading."""
    print(f"\n\033[1m── {text} {'─' * max(0, 74 - len(text))}\033[0m", flush=True)


def rtee(*arguments: str) -> None:
    """Run an rtee command in a process of its own; leave the demo if it fails."""
    print(f"\033[2m$ rtee {' '.join(arguments)}\033[0m", flush=True)
    status = subprocess.run([RTEE, *arguments], cwd=REPOSITORY, check=False).returncode
    if status:
        sys.exit(f"rtee {arguments[0]} ended with status {status}")


@contextmanager
def running(hand: str, *options: str) -> Iterator[None]:
    """Run a hand in the background for as long as the context lasts; see `wait_for` it."""
    arguments = ("run", hand, "--log", str(LOGS.relative_to(REPOSITORY)), *options)
    print(f"\033[2m$ rtee {' '.join(arguments)} &\033[0m", flush=True)
    process = subprocess.Popen([RTEE, *arguments], cwd=REPOSITORY)
    try:
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(10)


def wait_for(hand: str) -> None:
    """Wait until a hand runs."""
    deadline = time.monotonic() + 20.0
    ask = [RTEE, "state", "--hand", hand, "--once"]
    while subprocess.run(ask, cwd=REPOSITORY, capture_output=True, check=False).returncode:
        if time.monotonic() > deadline:
            sys.exit(f"'{hand}' did not start")
        time.sleep(0.2)


def newest(hand: str) -> str:
    """Return the path of the hand's newest recording."""
    found = sorted(p for p in LOGS.glob(f"{hand}_*.mcap") if "flight" not in p.name)
    return str(found[-1].relative_to(REPOSITORY))


def offline() -> None:
    """From URDF and SRDF to grasping actions."""
    title("What can this hand do? The SCHUNK SVH, extracted from its model")
    report = str((LOGS / "schunk_svh.html").relative_to(REPOSITORY))
    rtee("extract", "schunk_svh", "--report", report)


def online() -> None:
    """Goals from another process, progress bars, a recording that replays."""
    title("Grasping actions, executed by the 1 kHz loop from another process")
    with running("schunk_svh"):
        wait_for("schunk_svh")
        hand = ("--hand", "schunk_svh")
        rtee("do", "PinchTight", "index", "thumb", "--intensity", "0.6", *hand)
        rtee("do", "Trig", "middle", *hand)
        rtee("do", "schunkGrasp", *hand)
        rtee("open", *hand)
        rtee("status", *hand)
    title("A timed action: each inner action has its own bar")
    with running("robotiq_3f"):
        wait_for("robotiq_3f")
        rtee("do", "timed_wide_grasp", "--hand", "robotiq_3f")
        rtee("open", "--hand", "robotiq_3f")
    title("The recording: what happened, replayed bit for bit, plotted")
    recording = newest("schunk_svh")
    rtee("log", "info", recording)
    rtee("log", "replay", "--check", recording)
    rtee("log", "plot", recording)


def emulated() -> None:
    """Real drivers, real bytes, emulated devices that hold something, the same primitive."""
    title("Three grippers on emulated wires, something between the fingers of each")
    for hand, _, obj, wire in GRIPPERS:
        print(f"  {hand:<14} on {wire}; between the fingers: {obj}")
    with ExitStack() as grippers:
        for hand, _, obj, _ in GRIPPERS:
            grippers.enter_context(running(hand, "--emulated", "--ideal", "--object", obj))
        for hand, fingers, *_ in GRIPPERS:
            wait_for(hand)
            rtee("do", "PinchTight", *fingers, "--hand", hand)
        print(f"(holding for {HELD:g} s)", flush=True)
        time.sleep(HELD)
        for hand, *_ in GRIPPERS:
            rtee("open", "--hand", hand)
    title("The same primitive on three devices, as their recordings tell")
    for hand, *_ in GRIPPERS:
        recording = read(REPOSITORY / newest(hand))
        grasp, opened = (entry.value for entry in recording.results[-2:])
        print(f"  {hand:<14} {newest(hand)}")
        print(
            f"    {grasp.action:<11}{grasp.outcome} by {', '.join(grasp.grasped_fingers)} "
            f"after {grasp.duration:.2f} s; {held(recording)}"
        )
        print(f"    {opened.action:<11}{opened.outcome} after {opened.duration:.2f} s")


def held(recording: Recording) -> str:
    """Tell how hard the device held the object, at first and in the end."""
    measured = recording.actuator_states
    closed, opening = recording.results[-2].t, recording.goals[-1].t
    what, values, unit = "effort", measured.effort, "N·m"
    if np.isnan(values).all():
        what, values, unit = "current", measured.current, "A"
    during = np.abs(values[(measured.t > closed) & (measured.t < opening), 0])
    lost = any(entry.value.kind == "grasp_lost" for entry in recording.events)
    still = "lost" if lost else "still held"
    return f"{what} {np.nanmax(during):.2f}, then {during[-1]:.2f} {unit}, {still}"


def main() -> None:
    """Run all three parts."""
    shutil.rmtree(LOGS, ignore_errors=True)
    LOGS.mkdir(parents=True)
    offline()
    online()
    emulated()
    title("Done")
    print(f"Pictures, plots and recordings are in {LOGS.relative_to(REPOSITORY)}/.")
    print("Next: `rtee run schunk_svh --gui`, then open the address it prints.")


if __name__ == "__main__":
    main()
