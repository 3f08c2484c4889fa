"""A small hand, its actions, and a loop whose time is moved by hand."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from rtee.actions.library import ActionLibrary
from rtee.actions.types import (
    ActionReference,
    Evidence,
    Generic,
    Posture,
    Primitive,
    PrimitiveKind,
    Step,
    Timed,
)
from rtee.buses.pool import BusPool
from rtee.commands import CommandRecord
from rtee.drivers.base import Driver
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.loop.clock import ManualClock
from rtee.loop.handloop import HandLoop
from rtee.loop.observer import Observer
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.messages.goals import goal_of
from rtee.sample import TickRecord
from rtee.types import DeviceSpec, Event, Feedback, Goal, Result

_JOINT = """
  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 {length}"/>
    <limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="{effort}"/>
  </joint>
  <link name="{child}">
    <collision>
      <origin xyz="0 0 {length}"/><geometry><box size="0.01 0.01 0.03"/></geometry>
    </collision>
  </link>
"""
JOINTS = (
    ("index_base", "revolute", "palm", "index_1", 0.0, 1.5, 3.0, 2.0),
    ("index_tip", "revolute", "index_1", "index_2", 0.0, 1.2, 3.0, 2.0),
    ("thumb_base", "revolute", "palm", "thumb_1", -0.5, 1.0, 2.0, 3.0),
    ("thumb_slide", "prismatic", "thumb_1", "thumb_2", 0.0, 0.04, 0.1, 40.0),
)
NAMES = tuple(joint[0] for joint in JOINTS)


def make_hand(folder: Path, name: str = "small", length: float = 0.0) -> Hand:
    """Make the hand; its links, and fingertips on them, are so long [m]."""
    keys = ("name", "kind", "parent", "child", "lower", "upper", "velocity", "effort")
    joints = "".join(
        _JOINT.format(length=length, **dict(zip(keys, joint, strict=True))) for joint in JOINTS
    )
    urdf = folder / f"{name}.urdf"
    urdf.write_text(f'<robot name="{name}"><link name="palm"/>{joints}</robot>')
    srdf = folder / f"{name}.srdf"
    srdf.write_text(
        f'<robot name="{name}">'
        '<group name="index"><chain base_link="palm" tip_link="index_2"/></group>'
        '<group name="thumb"><chain base_link="palm" tip_link="thumb_2"/></group>'
        "</robot>"
    )
    return load_model(urdf, srdf, name=name)


def posture(hand: Hand, **positions: float) -> Posture:
    rest = dict(zip(hand.actuator_names, hand.rest.tolist(), strict=True))
    involved = tuple(name for name in hand.actuator_names if name in positions)
    return Posture(rest | positions, involved)


def make_library(hand: Hand) -> ActionLibrary:
    index = posture(hand, index_base=1.5, index_tip=1.2)
    thumb = posture(hand, thumb_base=1.0)
    slide = posture(hand, thumb_slide=0.04)
    pinch = posture(hand, index_base=1.0, thumb_base=0.8)
    trig_index = Primitive(PrimitiveKind.TRIG, ("index",), (index,), fingers=("index",))
    trig_thumb = Primitive(PrimitiveKind.TRIG, ("thumb",), (thumb,), fingers=("thumb",))
    tight = Primitive(
        PrimitiveKind.PINCH_TIGHT,
        ("index", "thumb"),
        (pinch,),
        (Evidence(depth=0.002, contact_at=0.8),),
        tips=2,
        fingers=("index", "thumb"),
    )
    use_index = ActionReference("Trig", ("index",))
    use_thumb = ActionReference("Trig", ("thumb",))
    drill = Timed(
        "drill",
        (
            Step(use_index, "close", 0.1, 0.2, index),
            Step(use_thumb, "press", 0.0, 0.0, thumb),
            Step(use_thumb, "let_go", 0.3, 0.1, posture(hand, thumb_base=0.0)),
        ),
    )
    everything = posture(hand, index_base=1.5, index_tip=1.2, thumb_base=1.0, thumb_slide=0.04)
    generic = (Generic("slide", slide), Generic("fist", everything))
    return ActionLibrary(hand, (trig_index, trig_thumb, tight, drill, *generic))


class Watcher(Observer):
    """Keeps everything that the loop tells."""

    def __init__(self) -> None:
        self.records: list[TickRecord] = []
        self.goals: list[tuple[Goal, float]] = []
        self.commands: list[CommandRecord] = []
        self.feedback: list[Feedback] = []
        self.results: list[Result] = []
        self.events: list[Event] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)

    def on_goal(self, goal: Goal, stamp: float) -> None:
        self.goals.append((goal, stamp))

    def on_command(self, record: CommandRecord) -> None:
        self.commands.append(record)

    def on_feedback(self, feedback: Feedback) -> None:
        self.feedback.append(feedback)

    def on_result(self, result: Result) -> None:
        self.results.append(result)

    def on_event(self, event: Event) -> None:
        self.events.append(event)

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def device(
    hand: Hand,
    name: str = "dummy",
    actuators: tuple[str, ...] | None = None,
    driver: str = "kinematic",
    *,
    rate: float = 1000.0,
    reconnect_active: bool = False,
    every: int | None = None,
    deadline: float | None = None,
    **options: object,
) -> DeviceSettings:
    chosen = hand.actuator_names if actuators is None else actuators
    spec = DeviceSpec(
        name=name,
        hand=hand.name,
        driver=driver,
        actuators=tuple(hand.actuator(a) for a in chosen),
        options=options,
        rate=rate,
        every=every,
        deadline=deadline,
    )
    return DeviceSettings(spec, reconnect_active)


class Rig:
    """A running hand whose ticks are made by the test."""

    def __init__(self, loop: HandLoop, clock: ManualClock, watcher: Watcher) -> None:
        self.loop = loop
        self.clock = clock
        self.watcher = watcher

    @property
    def driver(self) -> KinematicDriver:
        found = next(iter(self.loop.devices.values())).driver
        assert isinstance(found, KinematicDriver)
        return found

    async def run(self, seconds: float) -> None:
        for _ in range(round(seconds * self.clock.rate)):
            await self.clock.settle()
            self.loop.tick(self.clock.next())
        await self.clock.settle()

    async def result(self, within: float = 10.0) -> Result:
        """Tick until a result comes, and take it."""
        ticks = round(within * self.clock.rate)
        while not self.watcher.results:
            assert ticks, f"no result within {within} s"
            await self.clock.settle()
            self.loop.tick(self.clock.next())
            ticks -= 1
        return self.watcher.results.pop(0)

    async def do(self, action: str, *elements: str, **more: object) -> Result:
        self.loop.submit(goal_of(action, elements, **more))  # type: ignore[arg-type]
        return await self.result()


@asynccontextmanager
async def running(
    hand: Hand,
    settings: LoopSettings | None = None,
    devices: list[tuple[DeviceSettings, Driver]] | None = None,
    ticks: int = 5,
    **options: object,
) -> AsyncIterator[Rig]:
    """Run a hand on a kinematic device with these options, or on the given devices.

    Some ticks have been done when the context is entered.
    """
    settings = settings or LoopSettings()
    clock = ManualClock(settings.rate)
    if devices is None:
        one = device(hand, rate=settings.rate, **options)  # type: ignore[arg-type]
        devices = [(one, KinematicDriver(one.spec, BusPool()))]
    for _, driver in devices:
        if isinstance(driver, KinematicDriver):
            driver.now = clock.now
    watcher = Watcher()
    loop = HandLoop(hand, make_library(hand), settings, devices, now=clock.now)
    loop.add_observer(watcher)
    async with loop:
        await loop.ready()
        rig = Rig(loop, clock, watcher)
        await rig.run(ticks / settings.rate)
        yield rig
