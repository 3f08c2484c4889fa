"""One GUI, one browser and several hands for all tests in a browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from patient import lease  # noqa: F401 - for this folder

import rtee
from rtee.actions.build import StepPlan
from rtee.actions.fingerprints import Fingerprints
from rtee.actions.types import ActionReference
from rtee.remote.blocking import BlockingHand
from rtee.trials.result import Trial, TrialResult
from rtee.trials.store import write_results
from tests.testing.browser import browser

from .many import make_many
from .running import GRIPPER, MANY, PATIENCE, SQUEEZER, Program, copy_of, free_port
from .window import Window

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

REBOUND = "rebound.test"
"""A foreign name that the browser takes for this computer."""

PROXIED = "hand.example.org"
"""The name of the docs' proxies; the browser finds them at `proxy_port`."""

BALL = ("--object", "sphere:0.03", "--option", "support=floating", "--option", "touch=4x4")
"""It stays between the fingers when they open, so that each test finds it as the others did."""

_SPARING = """
window.drawing = false;
const open = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, attributes) {
  if (kind.startsWith("webgl")) attributes = {...attributes, antialias: false};
  return open.call(this, kind, attributes);
};
const kinds = ["Arrays", "Elements", "ArraysInstanced", "ElementsInstanced", "RangeElements"];
for (const name of ["clear", ...kinds.map((kind) => `draw${kind}`)]) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    if (window.drawing) draw.apply(this, given);
  };
}
const frame = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (seen) =>
  window.drawing ? frame(seen) : -setTimeout(() => seen(performance.now()), 100);
const cancel = window.cancelAnimationFrame.bind(window);
window.cancelAnimationFrame = (number) => (number < 0 ? clearTimeout(-number) : cancel(number));
"""
"""Draws the 3D view, in which the processor draws each frame for 0.4 s, only while somebody looks
at it; and prepares ten frames a second at other times, not sixty. Numbers of timers are negated:
one may be that of a frame, too, which nobody has cancelled."""

_NOTE_WHAT_IS_TOLD = """
window.told = [];
new MutationObserver((changes) => {
  for (const change of changes)
    for (const node of change.addedNodes) {
      if (node.nodeType !== Node.ELEMENT_NODE) continue;
      const one = ".mantine-Notification-root";
      for (const each of node.matches(one) ? [node] : node.querySelectorAll(one))
        window.told.push(each.textContent);
    }
}).observe(document, {childList: true, subtree: true});
"""
"""Keeps what notifications say, which close by themselves."""

GATE = "gate"
"""While a file of this name is in the hands' folder, trials and plans of the page wait to begin."""

DRIVERS = {
    GRIPPER: ("--driver", "kinematic", "--rate", "50"),
    SQUEEZER: ("--driver", "mujoco", *BALL, "--rate", "100", "--no-log"),
    MANY: ("--driver", "kinematic", "--rate", "50", "--no-log"),
}


@pytest.fixture(scope="package")
def place(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the hands, of their configuration and recordings."""
    folder = tmp_path_factory.mktemp("gui")
    copy_of(repository, folder, "robotiq_2f_85")
    squeezer = copy_of(repository, folder, "robotiq_2f_85", SQUEEZER)
    make_many(folder / "config" / MANY)
    results = [
        TrialResult(Trial("Grasp", (), "sphere:0.03"), True),
        TrialResult(Trial("Grasp", (), "sphere:0.05"), False, reason="too wide for it"),
    ]
    write_results(squeezer / "trials.yaml", Fingerprints("0"), results)
    return folder


class Hands:
    """The running hands; each is started when it is first asked for."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.programs: list[Program] = []
        self._running: dict[str, Program] = {}

    def __getitem__(self, hand: str) -> Program:
        """Return a hand's process."""
        if hand not in self._running:
            logs = () if "--no-log" in DRIVERS[hand] else ("--log", str(self.place / "logs"))
            program = Program(self.place, "run", hand, *DRIVERS[hand], *logs)
            self.programs.append(program)
            self._running[hand] = program
            program.line(rf"{hand}: .* active")
        return self._running[hand]

    def end(self, hand: str) -> None:
        """End a hand's process, which computes as long as it runs."""
        self._running.pop(hand).end()

    def kill(self, hand: str) -> None:
        """Kill a hand's process; the next one who asks gets a new one."""
        self._running.pop(hand).kill()


@pytest.fixture(scope="package")
def hands(place: Path) -> Iterator[Hands]:
    found = Hands(place)
    yield found
    for program in found.programs:
        program.end()


@pytest.fixture(scope="package")
def gui(place: Path, hands: Hands) -> Iterator[Program]:
    assert hands[GRIPPER].process.poll() is None
    gate = str(place / GATE)
    program = Program(place, "gui", GRIPPER, "--port", "0", "--observer", RTEE_TEST_GATE=gate)
    yield program
    program.end()
    said = program.rest()
    assert "Traceback" not in said, said
    assert "Error" not in said, said


@pytest.fixture(scope="package")
def proxy_port() -> int:
    """Where proxies listen, one after the other; the browser takes it for the port of HTTPS."""
    return free_port()


@pytest.fixture(scope="package")
def context(proxy_port: int) -> Iterator[BrowserContext]:
    rules = f"MAP {REBOUND} 127.0.0.1,MAP {PROXIED}:443 127.0.0.1:{proxy_port}"
    # Proxies have certificates of no authority that a browser knows.
    arguments = (f"--host-resolver-rules={rules}", "--ignore-certificate-errors")
    with browser(1010, 700, scale=0.5, arguments=arguments) as opened:
        for script in (_SPARING, _NOTE_WHAT_IS_TOLD):
            opened.add_init_script(script)
        opened.set_default_timeout(1000 * PATIENCE)
        yield opened


class Links:
    """The addresses that a GUI prints; each opens one browser, and then the next one is printed."""

    def __init__(self, gui: Program) -> None:
        self._gui = gui
        self._unused: dict[str, str] = {}

    def operator(self) -> str:
        """Return an address that was not used yet, and will be."""
        return self._next("GUI at")

    def observer(self) -> str:
        """Return such an address for people who watch."""
        return self._next("to watch and stop only:")

    def _next(self, kind: str) -> str:
        while kind not in self._unused:
            found = self._gui.line(r"(GUI at|to watch and stop only:) (http://\S+)")
            self._unused[found[1]] = found[2]
        return self._unused.pop(kind)


@pytest.fixture(scope="package")
def links(gui: Program) -> Links:
    return Links(gui)


@pytest.fixture(scope="package")
def only_window(context: BrowserContext, links: Links) -> Window:
    window = Window(context.pages[0], links.operator())
    window.open(GRIPPER)
    return window


_FAILED = pytest.StashKey[bool]()
"""Whether the test has failed, once it has run."""


def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    item.stash[_FAILED] = call.excinfo is not None


@pytest.fixture
def any_window(only_window: Window, request: pytest.FixtureRequest) -> Iterator[Window]:
    """The window, showing whichever hand; nothing goes wrong in the page.

    A test leaves the values in the page as it found them; one that fails could not, and the next
    one has a new page.
    """
    wrong: list[str] = []
    note = lambda error: wrong.append(str(error))  # noqa: E731
    only_window.page.on("pageerror", note)
    only_window.forget()
    yield only_window
    only_window.page.remove_listener("pageerror", note)
    if request.node.stash[_FAILED]:
        only_window.open(GRIPPER)
    assert wrong == []


@pytest.fixture
def window(any_window: Window) -> Window:
    """The window, showing the gripper's actions."""
    any_window.show(GRIPPER)
    return any_window


@pytest.fixture(scope="module")
def ball(hands: Hands, only_window: Window) -> Iterator[None]:
    """Runs a simulated gripper with a ball between its fingers."""
    pytest.importorskip("mujoco")
    assert hands[SQUEEZER].process.poll() is None
    yield
    only_window.show(GRIPPER)
    hands.end(SQUEEZER)


@pytest.fixture
def squeezer(any_window: Window, ball: None) -> Window:
    """The window, showing that gripper."""
    any_window.show(SQUEEZER)
    return any_window


@pytest.fixture
def lasting(other: BlockingHand) -> Iterator[str]:
    """An action that goes on until it is cancelled."""
    close = ActionReference("PinchTight", ("finger_1", "finger_2"))
    other.add_timed("lasting", [StepPlan(close, before=3600.0)])
    yield "lasting"
    other.remove_action("lasting")


@pytest.fixture
def other(place: Path, hands: Hands, monkeypatch: pytest.MonkeyPatch) -> Iterator[BlockingHand]:
    """Another client of the gripper, which nobody moves any more."""
    assert hands[GRIPPER].process.poll() is None
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place / "run"))
    with rtee.connect_blocking(GRIPPER, client="other") as hand:
        while hand.status().holder:  # what the test before has begun goes on
            time.sleep(0.02)
        yield hand
