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
from contextlib import contextmanager
from pathlib import Path

from rtee.log import read

REPOSITORY = Path(__file__).resolve().parents[1]
LOGS = REPOSITORY / "logs" / "demo"
RTEE = str(Path(sys.executable).with_name("rtee"))

GRIPPERS = (
    ("robotiq_2f_85", ("finger_1", "finger_2"), "Modbus RTU, 115200 baud"),
    ("qb_softhand", ("thumb", "index"), "its serial protocol, 2 Mbaud"),
    ("onrobot_3fg15", ("finger_1", "finger_2"), "Modbus TCP"),
)
"""The three devices of the paper's Fig. 12, two fingers of each, and the wire it is emulated on."""


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
    """Run a hand in the background for as long as the context lasts."""
    arguments = ("run", hand, "--log", str(LOGS.relative_to(REPOSITORY)), *options)
    print(f"\033[2m$ rtee {' '.join(arguments)} &\033[0m", flush=True)
    process = subprocess.Popen([RTEE, *arguments], cwd=REPOSITORY)
    try:
        _wait_until_up(hand, process)
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(10)


def _wait_until_up(hand: str, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 20.0
    ask = [RTEE, "state", "--hand", hand, "--once"]
    while subprocess.run(ask, cwd=REPOSITORY, capture_output=True, check=False).returncode:
        if process.poll() is not None or time.monotonic() > deadline:
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
        hand = ("--hand", "schunk_svh")
        rtee("do", "PinchTight", "index", "thumb", "--intensity", "0.6", *hand)
        rtee("do", "Trig", "middle", *hand)
        rtee("do", "schunkGrasp", *hand)
        rtee("open", *hand)
        rtee("status", *hand)
    title("A timed action: each inner action has its own bar")
    with running("robotiq_3f"):
        rtee("do", "timed_wide_grasp", "--hand", "robotiq_3f")
        rtee("open", "--hand", "robotiq_3f")
    title("The recording: what happened, replayed bit for bit, plotted")
    recording = newest("schunk_svh")
    rtee("log", "info", recording)
    rtee("log", "replay", "--check", recording)
    rtee("log", "plot", recording)


def emulated() -> None:
    """Real drivers, real bytes, emulated devices, the same actions."""
    for hand, fingers, wire in GRIPPERS:
        title(f"{hand}: the real driver against its emulator ({wire})")
        with running(hand, "--driver", "devices", "--emulated"):
            # Activating a real gripper closes and opens it once, so that is always asked for.
            rtee("recover", "--hand", hand)
            rtee("do", "PinchTight", *fingers, "--intensity", "0.6", "--hand", hand)
            rtee("do", "Grasp", "--hand", hand)
            rtee("open", "--hand", hand)
    title("The same actions on three devices, as their recordings tell")
    for hand, *_ in GRIPPERS:
        recording = read(REPOSITORY / newest(hand))
        print(f"  {hand:<14} {newest(hand)}")
        for entry in recording.results:
            result = entry.value
            how = [name for name in ("reached", "stalled", "grasped") if getattr(result, name)]
            print(f"    {result.action:<12} {' and '.join(how):<20} {result.duration:5.2f} s")


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
