"""Asking the system for real time: in a process of its own, so that nothing of it stays."""

from __future__ import annotations

import asyncio
import gc
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import anyio
import pytest

from rtee.buses.timing import SLICE
from rtee.errors import ConfigError
from rtee.hand.config_schema import RealtimeSettings
from rtee.loop.realtime import EVENT_LOOP, Collector, backend_options, favoured_session

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")


def in_process(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout


def test_without_real_time_only_short_slices_are_asked_for() -> None:
    printed = in_process(
        "import ctypes, os, platform, struct\n"
        "from rtee.loop.realtime import set_up\n"
        "from rtee.hand.config_schema import RealtimeSettings\n"
        "before = os.sched_getaffinity(0), os.nice(0)\n"
        "print(set_up(RealtimeSettings(enabled=False, cpus=(0,))))\n"
        "print((os.sched_getaffinity(0), os.nice(0)) == before)\n"
        "attributes = ctypes.create_string_buffer(56)\n"
        "number = {'x86_64': 315, 'aarch64': 275}[platform.machine()]\n"
        "assert ctypes.CDLL(None).syscall(number, 0, attributes, 56, 0) == 0\n"
        "policy, runtime = struct.unpack_from('=4xI16xQ', attributes.raw)\n"
        "print(policy == os.SCHED_OTHER, runtime)\n"
    )
    nothing, same, policy = printed.splitlines()
    assert (nothing, same) == ("[]", "True")
    kernel = tuple(int(part) for part in re.findall(r"\d+", os.uname().release)[:2])
    assert policy == f"True {SLICE if kernel >= (6, 12) else 0}"


async def running_loop() -> str:
    return type(asyncio.get_running_loop()).__module__.partition(".")[0]


def test_a_run_uses_uvloop_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("uvloop")
    monkeypatch.delenv(EVENT_LOOP, raising=False)
    assert anyio.run(running_loop, backend_options=backend_options()) == "uvloop"
    monkeypatch.setenv(EVENT_LOOP, "asyncio")
    assert anyio.run(running_loop, backend_options=backend_options()) == "asyncio"


def test_without_uvloop_a_run_uses_asyncio(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(EVENT_LOOP, raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert anyio.run(running_loop, backend_options=backend_options()) == "asyncio"
    monkeypatch.setenv(EVENT_LOOP, "uvloop")
    with pytest.raises(ConfigError, match=r'uvloop is not installed: pip install .*\[fast\]"'):
        backend_options()


def test_other_event_loops_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(EVENT_LOOP, "trio")
    with pytest.raises(ConfigError, match="RTEE_EVENT_LOOP must be asyncio or uvloop, not 'trio'"):
        backend_options()


def test_what_is_not_permitted_is_a_warning_that_says_what_to_configure() -> None:
    output = in_process(
        "import os, resource\n"
        "from rtee.loop.realtime import set_up\n"
        "from rtee.hand.config_schema import RealtimeSettings\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (4096, 4096))\n"
        "if os.getuid() == 0:\n"
        "    os.setgid(65534)\n"
        "    os.setuid(65534)\n"
        "for line in set_up(RealtimeSettings(enabled=True, cpus=(4000,))): print(line)\n"
        "print(os.sched_getscheduler(0) == os.SCHED_OTHER)\n"
    )
    lines = output.splitlines()
    assert len(lines) == 4
    assert "memlock unlimited" in lines[0]
    assert "CPU 4000 cannot be used" in lines[1]
    assert "rtprio 80" in lines[2]
    assert "LimitRTPRIO=80" in lines[2]
    assert lines[3] == "True"


def test_what_is_used_stays_in_memory_and_what_is_only_reserved_takes_none() -> None:
    size = 256
    output = in_process(
        "import mmap, re, sys\n"
        "from pathlib import Path\n"
        "from rtee.loop.realtime import set_up\n"
        "from rtee.hand.config_schema import RealtimeSettings\n"
        "own = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS\n"
        f"reserved = mmap.mmap(-1, {size} << 20, own)\n"
        "notes = set_up(RealtimeSettings(enabled=True))\n"
        f"later = mmap.mmap(-1, {size} << 20, own)\n"
        "later[0] = 1\n"
        "print('memlock' in ' '.join(notes))\n"
        "status = Path('/proc/self/status').read_text()\n"
        "print(*(re.search(f'{key}:\\\\s+([0-9]+)', status)[1] for key in ('VmLck', 'VmRSS')))\n"
        "area = r'^[0-9a-f-]+ r-xp .* (/\\S+)\\n(?:\\w.*\\n)*?Size: +([0-9]+)'\n"
        "area += r'(?:.*\\n)*?Rss: +([0-9]+)'\n"
        "found = re.findall(area, Path('/proc/self/smaps').read_text(), re.M)\n"
        "print(len(found), *(file for file, size, rss in found if size != rss))\n"
    )
    refused, sizes, programs = output.splitlines()
    if refused == "True":
        pytest.skip("locking memory is not permitted here")
    locked, resident = (int(each) / 1024 for each in sizes.split())
    assert locked > 2 * size
    assert resident < size
    count, *absent = programs.split()
    assert int(count) > 3
    assert not absent, "parts of a program's file that a first use would wait for"


def test_the_session_goes_before_others_for_as_long_as_the_loop_runs() -> None:
    output = in_process(
        "import os\n"
        "from pathlib import Path\n"
        "from rtee.loop.realtime import favoured_session\n"
        "from rtee.hand.config_schema import RealtimeSettings\n"
        "os.setsid()\n"
        "file = Path('/proc/self/autogroup')\n"
        "nice = lambda: file.read_text().split()[-1] if file.exists() else '-'\n"
        "def permitted():\n"
        "    try: file.write_text('-1')\n"
        "    except OSError: return False\n"
        "    file.write_text('0')\n"
        "    return True\n"
        "print(permitted())\n"
        "for enabled in (True, False):\n"
        "    with favoured_session(RealtimeSettings(enabled=enabled)): print(nice())\n"
        "    print(nice())\n"
    )
    permitted, *found = output.splitlines()
    if permitted == "True":
        assert found == ["-15", "0", "0", "0"]
    else:
        assert len(set(found)) == 1


@pytest.mark.parametrize("text", ["", "/autogroup-7 nice 3\n", None])
def test_a_session_that_is_in_no_group_stays_as_it_is(
    text: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Linux leaves the file empty for what was started by the container's first process."""
    file = tmp_path / "autogroup"
    if text is not None:
        file.write_text(text)
    monkeypatch.setattr("rtee.loop.realtime._AUTOGROUP", file)
    with favoured_session(RealtimeSettings(enabled=True)):
        assert (file.read_text() if text is not None else None) == (text and "-15")
    assert (file.read_text() if text is not None else None) == (text and "3")


def test_only_the_loops_thread_becomes_real_time() -> None:
    output = in_process(
        "import os, threading\n"
        "from rtee.loop.realtime import set_up\n"
        "from rtee.hand.config_schema import RealtimeSettings\n"
        "print(set_up(RealtimeSettings(enabled=True, priority=10, lock_memory=False)))\n"
        "def look(): print(os.sched_getscheduler(0) == os.SCHED_OTHER)\n"
        "thread = threading.Thread(target=look)\n"
        "thread.start(); thread.join()\n"
        "print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)\n"
    )
    warnings, other_is_ordinary, own_is_fifo = output.splitlines()
    assert other_is_ordinary == "True"
    assert (own_is_fifo == "True") == (warnings == "[]")


@pytest.mark.parametrize("helpers", [0, 7, 50])
def test_helpers_that_run_already_stay_ordinary_unless_they_are_given_a_priority(
    helpers: int,
) -> None:
    output = in_process(
        "import os, threading\n"
        "from rtee.loop.realtime import set_up\n"
        "from rtee.hand.config_schema import RealtimeSettings\n"
        "over = threading.Event()\n"
        "helper = threading.Thread(target=over.wait)\n"
        "helper.start()\n"
        "settings = RealtimeSettings(True, 10, lock_memory=False, helper_priority="
        f"{helpers})\n"
        "print(set_up(settings))\n"
        "policy = os.sched_getscheduler(helper.native_id) & ~os.SCHED_RESET_ON_FORK\n"
        "print(policy == os.SCHED_FIFO, os.sched_getparam(helper.native_id).sched_priority,"
        " os.getpriority(os.PRIO_PROCESS, helper.native_id))\n"
        "over.set()\n"
    )
    warnings, found = output.splitlines()
    if warnings != "[]":
        pytest.skip("real-time scheduling is not permitted here")
    nice = os.nice(0)
    assert found == {0: "False 0 -15", 7: f"True 7 {nice}", 50: f"True 9 {nice}"}[helpers]


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="a single CPU")
def test_a_program_beside_runs_on_the_cpus_from_before_the_loop_was_pinned() -> None:
    child = (
        "import os, time\n"
        "while len(os.sched_getaffinity(0)) < 2: time.sleep(0.01)\n"
        "print(sorted(os.sched_getaffinity(0)))\n"
    )
    printed = in_process(
        "import anyio, os, sys\n"
        "from rtee.loop.shutdown_signals import companion\n"
        "from rtee.loop.realtime import affinity\n"
        "cpus = affinity()\n"
        "print(sorted(cpus), flush=True)\n"
        "os.sched_setaffinity(0, {min(cpus)})\n"
        f"anyio.run(companion, (sys.executable, '-c', {child!r}), cpus)\n"
    )
    before, beside = printed.splitlines()
    assert beside == before


class Cycle:
    made = 0

    def __init__(self) -> None:
        self.own = self
        Cycle.made += 1

    def __del__(self) -> None:
        Cycle.made -= 1


def test_garbage_is_collected_between_ticks_and_not_by_itself() -> None:
    collector = Collector(every=(1_000_000, 1_000_000, 1_000_000))
    collector.start()
    try:
        assert not gc.isenabled()
        for _ in range(2000):
            Cycle()
        assert Cycle.made == 2000
        collector.idle(time.monotonic_ns() + 10**10)
        time.sleep(0.002)
        collector.idle(time.monotonic_ns() + 10**10)
        assert Cycle.made == 0
    finally:
        collector.stop()
    assert gc.isenabled()


def test_there_must_be_time_for_a_collection_unless_it_is_overdue() -> None:
    collector = Collector(every=(10**10, 10**12, 10**12))
    collector.start()
    try:
        collector._cost = [10**9, 0, 0]
        Cycle()
        now = time.monotonic_ns()
        collector._due[0] = now
        collector.idle(now + 1000)
        assert Cycle.made == 1
        collector._due[0] = now - 10**10 - 1
        collector.idle(now + 1000)
        assert Cycle.made == 0
    finally:
        collector.stop()
