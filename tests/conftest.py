"""What every test may use."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

import by_file
import pytest
import pytest_timeout
from hypothesis import HealthCheck, settings

from rtee import monotonic

if TYPE_CHECKING:
    from xdist.remote import Producer
    from xdist.scheduler import Scheduling


# The tests must not find, stop or move the hands that a developer runs at the same time.
for _name in ("RTEE_RUNTIME_DIR", "RTEE_CONNECT", "RTEE_HAND"):
    os.environ.pop(_name, None)
for _name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
    os.environ[_name] = tempfile.mkdtemp(prefix="rtee-tests-")
    atexit.register(shutil.rmtree, os.environ[_name], ignore_errors=True)

# Where a shell started the tests in the background, Ctrl-C is ignored here, and in every process
# that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).resolve().parents[1]


HEAVY, QUICK = "RTEE_HEAVY", "RTEE_QUICK"
"""Variables of the environment: run the tests marked as heavy, too; leave out `LONG` files."""

# No test asserts times, and a busy computer must not fail one. A run has the same verdict each
# time; heavy ones look elsewhere each time.
settings.register_profile(
    "rtee",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=not os.environ.get(HEAVY),
    max_examples=300 if os.environ.get(HEAVY) else 40,
)
settings.load_profile("rtee")

_LINES = Path(__file__).with_name("long_files.txt").read_text().splitlines()
LONG = {name: float(seconds) for seconds, name in map(str.split, _LINES)}
"""How long the tests of a file take [s], where it is more than a moment (`make times`)."""


AGAIN = {
    "tests/agent/": "Zenoh's threads and timers are in real time",
    "tests/buses/": "real ports, whose threads wait for a processor",
    "tests/cli/test_calibrate_opening.py": "a process on a real port",
    "tests/deploy/test_unprivileged.py": "a process that asks for real-time priority",
    "tests/docs/test_programs.py": "hands in processes of their own, one on a real port",
    "tests/docs/test_six_motors.py": "a hand on a real port",
    "tests/drivers/dynamixel/test_dynamixel_identity.py": "a process on a real port",
    "tests/gui/": "a page drawn by the processor loses a click",
    "tests/hand/test_own_copy.py": "a process on a real port",
    "tests/loop/test_service.py": "processes and their signals in real time",
    "tests/remote/": "Zenoh's threads and timers are in real time",
    "tests/ros2/": "Zenoh's threads and timers are in real time, with other implementations",
    "tests/test_run.py": "processes and their signals in real time",
    "tests/testing/test_hand_fixture.py": "a process on a real port",
}
"""Tests of what is in real time, each with the reason: they are run once more when they fail, which
the report says at its end (RERUN). All others have the same verdict each time."""


BROWSER = "tests/gui/browser/"
"""Where tests need a browser."""


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out, in a quick run, what takes long; files are not even imported then."""
    quick = os.environ.get(QUICK) and collection_path.is_relative_to(REPOSITORY)
    return True if quick and _name(collection_path) in LONG else None


def _name(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


def _mark_as_heavy(items: list[pytest.Item], *, one: bool) -> None:
    """Mark as heavy the cases of a test that its ``samples`` do not name.

    Args:
        items: The tests.
        one: Whether single cases were asked for by their names.

    Raises:
        pytest.UsageError: if samples name no case, or all.
    """
    seen: dict[str, set[bool]] = {}
    for item in items:
        for marker in item.iter_markers("samples"):
            assert isinstance(item, pytest.Function)
            sample = any(fnmatchcase(item.callspec.id, pattern) for pattern in marker.args)
            seen.setdefault(item.nodeid.partition("[")[0], set()).add(sample)
            if not sample:
                item.add_marker(pytest.mark.heavy)
    useless = [test for test, both in seen.items() if len(both) == 1]
    if useless and not one:
        raise pytest.UsageError(f"samples name all cases or none: {', '.join(useless)}")


def pytest_configure(config: pytest.Config) -> None:
    """Let the processes of ``-n`` share out files, unless an option chooses or orders tests."""
    names = ("markexpr", "keyword", "deselect", "lf", "failedfirst", "newfirst", "stepwise")
    chosen = any(getattr(config.option, name, None) for name in names)
    if hasattr(config, "workerinput") and not chosen and not any("::" in w for w in config.args):
        config.pluginmanager.register(by_file)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    with by_file.collecting():
        return (yield)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put files that take long first, and those in a browser before them; leave out some."""
    _mark_as_heavy(items, one=any("::" in word for word in config.args))
    cost = {item: LONG.get(_name(item.path), 0.0) for item in items}
    items.sort(key=lambda item: (not _name(item.path).startswith(BROWSER), -cost[item]))
    for item in items:
        if _name(item.path).startswith(tuple(AGAIN)):
            item.add_marker(pytest.mark.flaky(reruns=1))
    wanted = os.environ.get(HEAVY) or "heavy" in config.option.markexpr
    left = [] if wanted else [item for item in items if item.get_closest_marker("heavy")]
    if os.environ.get(QUICK):
        left += [item for item in items if item.get_closest_marker("browser")]
    if left:
        gone = set(left)
        items[:] = [item for item in items if item not in gone]
        config.hook.pytest_deselected(items=left)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give a test that runs once more the time that it had: both timers ended with its failure."""
    if getattr(item, "execution_count", 1) > 1:
        pytest_timeout.pytest_timeout_set_timer(item, pytest_timeout._get_item_settings(item))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """Start the process that runs commands, before those that use it (``-n 2``): one for all."""
    import rtee_process  # noqa: F401


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling:
    """Share the tests out to processes (``-n 2``) by files, whose tests share fixtures.

    Those in a browser go to one process, which has the browser, its GUI and their hands.
    """
    from xdist.scheduler import LoadFileScheduling

    class Files(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return BROWSER if nodeid.startswith(BROWSER) else super()._split_scope(nodeid)

    config.option.loadscopereorder = False
    return Files(config, log)


@pytest.fixture(autouse=True)
def priority() -> Iterator[None]:
    """Fail a test that changes the priority of the process in which others run after it."""
    before = _priority()
    yield
    assert _priority() == before, "the test has changed the priority of the tests' own process"


@pytest.fixture(autouse=True)
def the_time() -> Iterator[None]:
    """Fail a test that leaves a clock of its own to all that run after it, in which time stands."""
    before = monotonic.now, monotonic.now_ns, monotonic.sleep
    yield
    after = monotonic.now, monotonic.now_ns, monotonic.sleep
    # Put right first, so that this test alone fails.
    monotonic.now, monotonic.now_ns, monotonic.sleep = before
    assert after == before, "the test has left the tests' own process another clock"


@pytest.fixture
def largest_file(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int | None], None]]:
    """Sets the size [bytes] beyond which files cannot grow, as on a full disk; none: as before."""
    resource = pytest.importorskip("resource")
    present = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python would leave it cut

    def limit(size: int | None) -> None:
        soft = present[0] if size is None else size
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, present[1]))

    yield limit
    limit(None)
    signal.signal(signal.SIGXFSZ, before)


def _priority() -> tuple[int, int]:
    return os.nice(0), os.sched_getscheduler(0) if hasattr(os, "sched_getscheduler") else 0


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="session")
def repository() -> Path:
    return REPOSITORY


@pytest.fixture(scope="session")
def shared() -> Path:
    """Real models of hands and fact sheets for tests; not part of the project."""
    folder = Path(os.environ.get("RTEE_SHARED", REPOSITORY.parent / "shared"))
    if not folder.is_dir():
        pytest.skip("no folder 'shared' with real models beside the checkout")
    return folder


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say why tests had to run once more."""
    for report in terminalreporter.stats.get("rerun", ()):
        terminalreporter.write_sep("_", report.nodeid)
        terminalreporter.write_line(report.longreprtext[-3000:])
        for title, text in report.sections:
            terminalreporter.write_line(f"{title}:\n{text[-1500:]}")
