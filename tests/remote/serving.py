"""A small hand on the network, driven by the kinematic driver."""

from __future__ import annotations

import socket
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import anyio

from rtee.actions.build import StepPlan, full_posture, generic
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference, Evidence, Opposition, Primitive, PrimitiveKind
from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.config_schema import SecuritySettings
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.log.settings import RecorderStatus
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, drive
from rtee.loop.observer import Observer
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.remote.directory import claimed
from rtee.remote.server import Server
from rtee.sample import TickRecord
from rtee.types import DeviceSpec, Event, Goal, Result

RATE = 200.0
LASTING: dict[str, Any] = {"speed": 0.001, "timeout": 3600.0}
"""Options of a goal that goes on, whatever the computer's speed, until it is ended."""

BOX = '<collision><geometry><box size="0.01 0.01 0.03"/></geometry></collision>'
URDF = f"""<robot name="small">
  <link name="base"/>
  <link name="palm">{BOX}</link>
  <joint name="turn" type="fixed"><parent link="base"/><child link="palm"/>
    <origin xyz="0 0 0.05" rpy="0.1 -0.2 0.3"/></joint>
  <joint name="near" type="revolute"><parent link="palm"/><child link="middle"/>
    <origin xyz="0.02 0 0.01" rpy="0 0.4 0"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1.5" velocity="3" effort="2"/></joint>
  <link name="middle">{BOX}</link>
  <joint name="far" type="revolute"><parent link="middle"/><child link="index_tip"/>
    <origin xyz="0 0 0.03"/><axis xyz="0 0.6 0.8"/>
    <mimic joint="near" multiplier="0.5" offset="0.1"/>
    <limit lower="-1" upper="2" velocity="3" effort="2"/></joint>
  <link name="index_tip">{BOX}</link>
  <joint name="thumb" type="revolute"><parent link="palm"/><child link="slide"/>
    <origin xyz="-0.02 0 0.01" rpy="0 0 1"/><axis xyz="0 1 0"/>
    <limit lower="-0.5" upper="1" velocity="3" effort="3"/></joint>
  <link name="slide">{BOX}</link>
  <joint name="push" type="prismatic"><parent link="slide"/><child link="thumb_tip"/>
    <origin xyz="0 0 0.02"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.04" velocity="0.1" effort="40"/></joint>
  <link name="thumb_tip">{BOX}</link>
</robot>"""
SRDF = """<robot name="small">
  <group name="index"><chain base_link="base" tip_link="index_tip"/></group>
  <group name="thumb"><chain base_link="base" tip_link="thumb_tip"/></group>
</robot>"""


def make_hand(folder: Path, name: str = "small") -> Hand:
    (folder / "small.urdf").write_text(URDF)
    (folder / "small.srdf").write_text(SRDF)
    return load_model(folder / "small.urdf", folder / "small.srdf", name=name)


def make_library(hand: Hand, folder: Path | None = None) -> ActionLibrary:
    evidence = Evidence(
        depth=0.001,
        point=(0.1, 0.2, 0.3),
        normal=(1.0, 0.0, 0.0),
        clear=False,
        colliding=(("palm", "slide"),),
        contact_at=0.8,
        opposition=Opposition((0.1, 0.2), True),
        pairs=(("index", "thumb", 0.001),),
    )
    pinch = full_posture(hand, {"near": 1.0, "thumb": 0.8})
    library = ActionLibrary(
        hand,
        (
            Primitive(PrimitiveKind.TRIG, ("index",), (full_posture(hand, {"near": 1.5}),)),
            Primitive(PrimitiveKind.TRIG, ("thumb",), (full_posture(hand, {"thumb": 1.0}),)),
            Primitive(PrimitiveKind.PINCH_TIGHT, ("index", "thumb"), (pinch,), (evidence,)),
        ),
    )
    index, thumb = (ActionReference("Trig", (finger,)) for finger in ("index", "thumb"))
    library.add(library.compose("fist", [index, thumb], description="both"))
    library.add(generic(hand, "poke", {"push": 0.04}))
    library.add(
        library.sequence("wave", [StepPlan(index, "up", after=0.05), StepPlan(thumb, "side")])
    )
    if folder is not None:
        library.save(folder)
    return library


class Watcher(Observer):
    """Keeps what the loop tells."""

    def __init__(self) -> None:
        self.goals: list[Goal] = []
        self.results: list[Result] = []
        self.events: list[Event] = []

        self.ticks = 0

    def on_tick(self, record: TickRecord) -> None:
        self.ticks += 1

    def on_goal(self, goal: Goal, stamp: float) -> None:
        self.goals.append(goal)

    def on_result(self, result: Result) -> None:
        self.results.append(result)

    def on_event(self, event: Event) -> None:
        self.events.append(event)


class Told:
    """Keeps what a recorder is told, and writes nothing."""

    def __init__(self, path: Path | None = None) -> None:
        self.calls: list[str] = []
        self.path = path
        self.lost = 0
        self.problem = ""

    def start(self) -> None:
        self.calls.append("start")
        self.path = Path("/logs/small.mcap")

    def stop(self) -> None:
        self.calls.append("stop")
        self.path = None

    def mark(self, text: str) -> None:
        self.calls.append(text)

    def status(self) -> RecorderStatus:
        wanted = self.path is not None or bool(self.problem)
        return RecorderStatus(wanted, self.path, lost=self.lost, problem=self.problem)


@dataclass
class Remote:
    listen: list[str] = field(default_factory=list)
    connect: list[str] = field(default_factory=list)
    state_rate: float = 100.0
    security: SecuritySettings = field(default_factory=SecuritySettings)


@dataclass
class Config:
    remote: Remote = field(default_factory=Remote)


@dataclass
class Served:
    """A hand that runs and is on the network."""

    loop: HandLoop
    server: Server
    driver: KinematicDriver
    watcher: Watcher
    config: Config
    recorder: Told | None

    async def event(self, kind: str) -> Event:
        """Wait for an event of a kind."""
        await until(lambda: kind in [event.kind for event in self.watcher.events])
        return next(event for event in self.watcher.events if event.kind == kind)


def free_endpoint() -> str:
    """Return a loopback endpoint with a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


async def until(condition: Callable[[], bool]) -> None:
    """Wait until something is true; the test's timeout ends it."""
    while not condition():  # noqa: ASYNC110
        await anyio.sleep(0.005)


@asynccontextmanager
async def serving(
    hand: Hand,
    library: ActionLibrary,
    *,
    settings: LoopSettings | None = None,
    config: Config | None = None,
    recorder: Told | None = None,
) -> AsyncIterator[Served]:
    """Run a hand on the network for as long as the context lasts."""
    settings, config = settings or LoopSettings(rate=RATE), config or Config()
    spec = DeviceSpec("sim", hand.name, "kinematic", hand.actuators, rate=settings.rate)
    watcher = Watcher()
    async with BusPool() as pool:
        driver = KinematicDriver(spec, pool)
        loop = HandLoop(hand, library, settings, [(DeviceSettings(spec), driver)])
        loop.add_observer(watcher)
        opened = Server.open(loop, config.remote, recorder)
        async with loop, opened as server, anyio.create_task_group() as group:
            await loop.ready()
            group.start_soon(drive, [loop], Clock(settings.rate))
            await until(lambda: watcher.ticks > 0 and all(loop.controller.active))
            yield Served(loop, server, driver, watcher, config, recorder)
            group.cancel_scope.cancel()


@contextmanager
def announced(hand: str, endpoints: Sequence[str]) -> Iterator[Path]:
    """Announce a hand as its server does, for as long as the context lasts; yield its file."""
    with claimed(hand) as place:
        place.write(endpoints)
        yield place.path
