"""Common parts of the GUI's benchmarks: a hand, the GUI and its windows, as processes."""

from __future__ import annotations

import contextlib
import os
import re
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from gui_onlooker import Visit, admitted

import rtee
from tests.testing.browser import browser, find_browser

if TYPE_CHECKING:
    from playwright.sync_api import Page

COMMAND = (sys.executable, "-c", "from rtee.cli import main; main()")
MEGA = 2.0**20  # bytes of a MiB
_PAGE = os.sysconf("SC_PAGE_SIZE")  # bytes
_TICK = os.sysconf("SC_CLK_TCK")  # units of processor time per second


@contextlib.contextmanager
def program(folder: Path, pattern: str, *command: str) -> Iterator[tuple[int, str]]:
    """Run a command while the context lasts; yield its process and its first output."""
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if found := re.search(pattern, line):
                    # Read on, or the process would stop when the pipe is full.
                    threading.Thread(target=process.stdout.read, daemon=True).start()
                    yield process.pid, found[1] if found.groups() else line
                    return
            raise SystemExit(f"{' '.join(command[3:])} ended")
        finally:
            process.terminate()
            process.wait(30)


@contextlib.contextmanager
def gui_of(
    folder: Path, hand: str, command: tuple[str, ...] = COMMAND
) -> Iterator[tuple[int, Visit]]:
    """Run the GUI of a hand while the context lasts; yield its process and a browser in it."""
    with program(folder, r"GUI at (\S+)", *command, "gui", hand, "--port", "0") as (gui, address):
        yield gui, admitted(address)


def resident(pid: int) -> float:
    """Return the resident memory of a process [bytes]."""
    return float(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE


def used(pid: int) -> float:
    """Return the processor time used by a process [s]."""
    # Behind the name in parentheses, which may contain blanks.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICK


def family(pid: int) -> list[int]:
    """Return a process and all its descendants."""
    found = [pid]
    # The list grows while it is iterated over: children of children, too.
    for each in found:
        for task in Path(f"/proc/{each}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return found


async def moving(hand: str) -> None:
    """Open and close a hand without end."""
    async with rtee.connect(hand, wait=10.0) as remote:
        while True:
            await remote.do("Grasp")
            await remote.open()


@contextlib.contextmanager
def mover(hand: str) -> Iterator[None]:
    """Keep a hand opening and closing while the context lasts."""
    code = f"import anyio, {Path(__file__).stem} as b; anyio.run(b.moving, '{hand}')"
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def remote_window(visit: Visit, folder: Path) -> Iterator[Path]:
    """Open a window that receives everything and draws nothing; gives what it says every second."""
    output_file = folder / "onlooker.txt"
    onlooker = Path(__file__).with_name("gui_onlooker.py")
    command = (sys.executable, onlooker, visit.origin, "--cookie", visit.cookie, "--tell")
    with output_file.open("w") as output, subprocess.Popen(command, stdout=output) as process:
        try:
            yield output_file
        finally:
            process.kill()


@contextlib.contextmanager
def chromium(folder: Path, nice: int) -> Iterator[Page]:
    """Open a browser's window, at a priority of its own."""
    wrapper = folder / "browser"
    # Run by root it would raise its threads above the loop, which no user's browser may.
    humbly = "" if os.geteuid() else "setpriv --bounding-set=-sys_nice --inh-caps=-sys_nice "
    wrapper.write_text(f'#!/bin/sh\nexec {humbly}nice -n {nice} {find_browser()} "$@"\n')
    wrapper.chmod(wrapper.stat().st_mode | stat.S_IXUSR)
    os.environ["RTEE_BROWSER"] = str(wrapper)
    with browser(1280, 800) as context:
        yield context.pages[0]


@contextlib.contextmanager
def shown(page: Page, visit: Visit) -> Iterator[None]:
    """Show the GUI in a browser's window while the context lasts, once it is there."""
    page.context.add_cookies(visit.cookies())  # type: ignore[arg-type]
    page.goto(visit.origin)
    page.get_by_role("button", name="Run", exact=True).first.wait_for()
    try:
        yield
    finally:
        page.goto("about:blank")
