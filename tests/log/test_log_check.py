"""A recording of a real loop gives the same references again, bit for bit."""

from __future__ import annotations

import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import fields, replace
from pathlib import Path

import anyio
import numpy as np
import pytest
from loop.hands import Rig, Watcher, device, make_hand, make_library

from log.samples import RATE, recorded, settings
from rtee.actions.library import ActionLibrary
from rtee.buses.pool import BusPool
from rtee.commands import (
    BeginStream,
    Command,
    CommandRecord,
    Jog,
    SetAcceptsEffort,
    StreamSample,
    StreamTargets,
)
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import LogError, UnknownActuator
from rtee.hand.config_schema import ActuatorDynamics, GraspSettings, ProfileKind, ProfileSettings
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.log import Entry, JointSeries, Recorder, Recording, read, reader
from rtee.log.check import TOPICS, check
from rtee.log.dataclass_json import from_json, to_json
from rtee.log.export import tables
from rtee.log.layout import STATE, Replayable, library_name
from rtee.loop import contact_rules
from rtee.loop.clock import ManualClock
from rtee.loop.handloop import HandLoop
from rtee.loop.observer import Observer
from rtee.loop.settings import LoopSettings
from rtee.loop.snapshot import Snapshot, capture, to_bytes
from rtee.messages.convert import plain
from rtee.sample import ActuatorState, TickRecord
from rtee.types import FirstContact, Goal, Intensity, Named, OnContact, Result

pytestmark = pytest.mark.anyio

RECORDED_BEFORE = Path(__file__).parents[1] / "data" / "every_command.mcap"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return make_hand(tmp_path_factory.mktemp("small"))


@asynccontextmanager
async def recording(
    hand: Hand,
    folder: Path,
    loop_settings: LoopSettings,
    recorder: Recorder | None = None,
    kind: type[KinematicDriver] = KinematicDriver,
    library: ActionLibrary | None = None,
    **options: object,
) -> AsyncIterator[Rig]:
    """Run and record a hand on the kinematic driver."""
    clock = ManualClock(loop_settings.rate)
    one = device(hand, rate=loop_settings.rate, **options)  # type: ignore[arg-type]
    driver = kind(one.spec, BusPool())
    driver.now = clock.now
    library = library or make_library(hand)
    loop = HandLoop(hand, library, loop_settings, [(one, driver)], now=clock.now)
    recorder = recorder or Recorder(
        hand, settings(folder), rate=loop_settings.rate, loop=loop_settings
    )
    watcher = Watcher()
    recorder.controller = loop.controller
    loop.add_observer(recorder)
    loop.add_observer(watcher)
    async with recorder, loop:
        await loop.ready()
        rig = Rig(loop, clock, watcher)
        await rig.run(5 / loop_settings.rate)
        yield rig


async def story(rig: Rig) -> None:
    """Goals that replace one another, a timed one, a cancelled one, jogging, a stop."""
    await rig.do("Trig", "index")
    rig.loop.submit(Goal(Named("PinchTight", ("index", "thumb")), Intensity(0.7), speed=0.6))
    await rig.run(0.2)
    rig.loop.submit(Goal(Named("fist"), effort={"thumb_base": 1.0}))
    await rig.run(0.15)
    rig.loop.cancel("")
    await rig.run(0.3)
    rig.loop.jog({"index_tip": 0.3, "thumb_slide": 0.01}, 0.4)
    await rig.run(0.2)
    rig.watcher.results.clear()
    await rig.do("drill")
    rig.loop.submit(Goal(Named("open")))
    await rig.run(0.1)
    await rig.loop.stop()
    await rig.run(0.1)


@pytest.mark.samples("100.0-*")
@pytest.mark.parametrize("profile", list(ProfileKind))
@pytest.mark.parametrize("rate", [100.0, 1000.0])
async def test_references_come_out_again(
    small: Hand, tmp_path: Path, profile: ProfileKind, rate: float
) -> None:
    if profile is ProfileKind.JERK_LIMITED:
        pytest.importorskip("ruckig")
    chosen = LoopSettings(rate=rate, profile=ProfileSettings(profile))
    recorder = Recorder(small, settings(tmp_path), rate=rate, loop=chosen)
    async with recording(small, tmp_path, chosen, recorder, objects={"index": 0.6}) as rig:
        await story(rig)
        rig.loop.submit(Goal(Named("fist"), goal_id="on its way"))
        await rig.run(0.2)
        first = recorder.status().path
        recorder.stop()
        recorder.start()
        while recorder.status().path in (None, first):  # noqa: ASYNC110 - its thread tells nobody
            await anyio.sleep(0.001)
        await rig.run(0.3)
        rig.watcher.results.clear()
        await rig.do("Trig", "thumb")
        await rig.run(0.1)
    first, second = recorded(tmp_path)
    later = read(second)
    again = check(later)
    assert again.same, again.first
    assert again.ticks >= len(later.reference) - 1
    assert not again.differing
    assert later.results[0].value.goal_id == "on its way"
    # A field that this version needs, and one that a new controller has, too.
    with pytest.raises(
        LogError, match=r"differs in _Run\.plan: recompute it with that version, or "
    ):
        check(without(later, "rtee.loop.executor:_Run", "plan"))
    fewer = check(without(later, "rtee.loop.thermal:Thermal", "_again"))
    assert fewer.differing == ("Thermal._again",)
    assert "differs in Thermal._again" in fewer.note
    more = check(altered(later, "rtee.loop.executor:_Run", lambda given: given.update(gone=1.0)))
    assert more.same
    assert more.differing == ("_Run.gone",)
    unknown = {"attachments": {k: v for k, v in later.attachments.items() if k != STATE}}
    with pytest.raises(LogError, match="only what was recorded from the loop's start"):
        check(replace(later, **unknown))
    nonsense = json.loads(later.attachments[STATE])
    nonsense["nodes"][0] = ["object", "rtee.loop.plan:make_plan", {}]
    changed = later.attachments | {STATE: json.dumps(nonsense).encode()}
    with pytest.raises(LogError, match="contains an invalid state"):
        check(replace(later, attachments=changed))
    found = read(first)
    assert len(found.goals) == len(found.plans) == 6
    report = check(found)
    assert report.first is None
    assert report.same
    assert report.different == report.missing == 0
    assert report.goals == 6
    assert report.ticks == len(found.reference) > rate
    assert report.values == report.ticks * 4 * 3


@pytest.mark.samples("s_curve", "step")
@pytest.mark.parametrize("profile", list(ProfileKind))
async def test_streams_come_out_again(small: Hand, tmp_path: Path, profile: ProfileKind) -> None:
    """With jitter, loss, duplicates, spikes, velocities, efforts, a pause, goals, two streams."""
    if profile is ProfileKind.JERK_LIMITED:
        pytest.importorskip("ruckig")
    chosen = LoopSettings(rate=250.0, profile=ProfileSettings(profile))
    random = np.random.default_rng(4)
    async with recording(small, tmp_path, chosen) as rig:
        streams, most = rig.loop.streams, small.actuator("thumb_slide").effort
        rig.loop.submit(Goal(Named("fist"), speed=0.5))
        await rig.run(0.2)
        sent = 0
        for number, (targets, rate) in enumerate(
            (({"Trig index": 1.0, "thumb_slide": 0.03}, 50.0), ({"fist": 1.0}, 120.0))
        ):
            name = f"s{number}"
            streams.begin(name, rate, effort={"thumb_slide": 0.5 * most} if number else None)
            for k in range(60):
                if k == 30:
                    await rig.run(0.15)
                share = 0.5 - 0.5 * math.cos(k / 8.0) if k != 20 else 1.0
                values = {what: share * most for what, most in targets.items()}
                velocity = {"Trig index": 0.5} if k % 3 == 0 and number == 0 else {}
                if random.random() > 0.05:
                    stamp = 70.0 - k // 25 * 1e-4 + k / rate
                    one = StreamTargets(name, stamp, values, velocity, "someone")
                    for _ in range(2 if k % 10 == 7 else 1):
                        streams.sample(one)
                        sent += 1
                await rig.run(max(0.0, 1.0 / rate + random.normal(0.0, 0.004)))
        rig.watcher.results.clear()
        await rig.do("Trig", "thumb")
        await rig.run(0.1)
    found = read(recorded(tmp_path)[0])
    assert len(found.stream_samples) == sent
    first = found.stream_samples[0].value.command
    assert isinstance(first, StreamSample)
    assert first.stream == "s0"
    assert (first.stamp, dict(first.targets)) == (70.0, {"Trig index": 0.0, "thumb_slide": 0.0})
    assert dict(first.velocity) == {"Trig index": 0.5}
    assert set(first.positions) == {"index_base", "index_tip", "thumb_slide"}
    assert math.isnan(first.velocities["thumb_slide"])
    kinds = [type(entry.value.command) for entry in found.commands]
    assert kinds.count(BeginStream) == 2
    begun = [c for e in found.commands if isinstance(c := e.value.command, BeginStream)]
    assert [dict(each.effort) for each in begun] == [{}, {"thumb_slide": 0.5 * most}]
    report = check(found)
    assert report.first is None
    assert report.same
    # What steers it makes a difference: without the samples other references come out.
    assert not check(replace(found, stream_samples=())).same


async def test_what_goals_and_streams_do_are_tables(repository: Path, tmp_path: Path) -> None:
    folder = repository / "config" / "robotiq_2f_85"
    gripper = load_hand(folder)
    library = ActionLibrary.load(gripper, folder / "actions")
    async with recording(gripper, tmp_path, LoopSettings(), library=library) as rig:
        await rig.do("Grasp", opening=0.04)
        streams = rig.loop.streams
        streams.begin("glove", 50.0)
        for k, values in enumerate(({"Grasp": 0.5}, {"finger_joint": 0.4}, {"Grasp": 0.6})):
            streams.sample(StreamTargets("glove", 70.0 + k / 50.0, values, {}, "someone"))
            await rig.run(0.02)
    found = tables(read(recorded(tmp_path)[0]))
    assert found["plans"]["action"].tolist() == ["Grasp"]
    assert found["plans"]["target.finger_joint"][0] == pytest.approx(
        found["actuator_states"]["position.finger_joint"].max(), abs=0.01
    )
    assert found["grip"]["opening"][-1] == pytest.approx(0.04, abs=1e-3)
    samples = found["stream_samples"]
    assert samples["stream"].tolist() == ["glove"] * 3
    np.testing.assert_array_equal(samples["targets.Grasp"], [0.5, np.nan, 0.6])
    np.testing.assert_array_equal(samples["targets.finger_joint"], [np.nan, 0.4, np.nan])
    assert np.isfinite(samples["positions.finger_joint"]).all()


class FeelingTips(KinematicDriver):
    """Feels something at the thumb's tip alone."""

    async def sense(self) -> ActuatorState:
        forces = np.array([0.0, 2.0 if self.plants[2].position > 0.2 else 0.0])
        return replace(await super().sense(), extras={"contact_force": forces})


async def test_results_that_tips_decided_come_out_again(small: Hand, tmp_path: Path) -> None:
    chosen = LoopSettings(rate=RATE)
    objects = {"index": 0.4, "thumb_base": 0.5}
    async with recording(small, tmp_path, chosen, kind=FeelingTips, objects=objects) as rig:
        result = await rig.do("PinchTight", "index", "thumb")
        assert result.grasped_fingers == ("thumb",)
        assert (await rig.do("open")).reached
    found = read(recorded(tmp_path)[0])
    assert check(found).same
    assert not check(replace(found, channels={})).results, "without forces, the effort decides"


@pytest.mark.parametrize("word", list(OnContact))
@pytest.mark.parametrize("kind", [KinematicDriver, FeelingTips])
async def test_reflexes_come_out_again(
    small: Hand, tmp_path: Path, word: OnContact, kind: type[KinematicDriver]
) -> None:
    grasp = GraspSettings(on_contact=OnContact.HOLD, grip_after=0.3)
    chosen = LoopSettings(rate=RATE, grasp=grasp)
    objects = {"index": 0.4, "thumb_base": 0.5}
    async with recording(small, tmp_path, chosen, kind=kind, objects=objects) as rig:
        rig.loop.submit(
            Goal(Named("PinchTight", ("index", "thumb")), speed=0.5, on_contact={"thumb": word})
        )
        await rig.run(1.5)
        rig.loop.submit(Goal(Named("PinchTight", ("index", "thumb")), Intensity(0.1)))
        await rig.run(0.5)
        rig.loop.submit(Goal(Named("PinchTight", ("index", "thumb")), FirstContact()))
        await rig.run(1.5)
        assert "thumb" in {finger for r in rig.watcher.results for finger in r.touched}
        assert "contact" in rig.watcher.kinds()
    found = read(recorded(tmp_path)[0])
    report = check(found)
    assert report.first is None
    assert report.same
    assert found.goals[0].value.on_contact == {"thumb": word}
    forgotten = [replace(e, value=replace(e.value, on_contact={})) for e in found.goals]
    plans = [
        replace(e, value=replace(e.value, on_contact=goal.value.on_contact))
        for e, goal in zip(found.plans, forgotten, strict=True)
    ]
    without = check(replace(found, goals=tuple(forgotten), plans=tuple(plans)))
    assert without.same is (word is OnContact.HOLD), "the word makes the difference"


async def test_a_grip_whose_dynamics_hand_yaml_gives_comes_out_again(
    small: Hand, tmp_path: Path
) -> None:
    """Their friction is part of the effort with which a finger waits for the others."""
    dynamics = {name: ActuatorDynamics(dry_friction=0.3) for name in small.actuator_names}
    hand = replace(small, dynamics=dynamics)
    chosen = LoopSettings(rate=RATE, grasp=GraspSettings(on_contact=OnContact.SQUEEZE))
    recorder = Recorder(hand, settings(tmp_path), rate=RATE, loop=chosen)
    objects = {"index": 0.4, "thumb_base": 0.5}
    async with recording(hand, tmp_path, chosen, recorder, objects=objects) as rig:
        rig.loop.submit(Goal(Named("PinchTight", ("index", "thumb"))))
        await rig.run(1.5)
        # The second recording begins while the grip is held.
        first = recorder.status().path
        recorder.stop()
        recorder.start()
        while recorder.status().path in (None, first):  # noqa: ASYNC110 - its thread tells nobody
            await anyio.sleep(0.001)
        await rig.run(0.2)
        rig.loop.submit(Goal(Named("open")))
        await rig.run(0.5)
        rig.loop.submit(Goal(Named("PinchTight", ("index", "thumb"))))
        await rig.run(1.5)
    for path in recorded(tmp_path):
        again = check(read(path))
        assert again.same, (path.name, again.first)


@pytest.mark.heavy
async def test_rotated_files_are_checked_as_one(small: Hand, tmp_path: Path) -> None:
    chosen = LoopSettings(rate=1000.0)
    recorder = Recorder(
        small, settings(tmp_path, max_file_size=30_000, chunk_time=0.02), rate=1000.0, loop=chosen
    )
    async with recording(small, tmp_path, chosen, recorder) as rig:
        await rig.do("Trig", "index")
        await rig.do("drill")
    paths = recorded(tmp_path)
    assert len(paths) > 1
    assert check(read(paths)).same
    assert check(reader.windows(paths, only=TOPICS)) == check(read(paths))


@pytest.fixture(scope="module")
async def moved(small: Hand, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("moved")
    async with recording(small, folder, LoopSettings(rate=RATE)) as rig:
        await rig.do("Trig", "thumb")
    return read(recorded(folder)[0])


async def test_a_reference_that_is_off_by_one_bit_is_found(moved: Recording) -> None:
    position = moved.reference.position.copy()
    position[17, 2] = np.nextafter(position[17, 2], np.inf)
    report = check(replace(moved, reference=replace(moved.reference, position=position)))
    assert not report.same
    assert report.different == 1
    assert report.first is not None
    assert (report.first.tick, report.first.actuator) == (17, "thumb_base")
    assert report.first.quantity == "position"
    assert report.first.recorded != report.first.computed
    assert 0 < report.largest < 1e-15


async def test_a_state_that_was_another_gives_other_references(moved: Recording) -> None:
    states = moved.actuator_states
    position = states.position.copy()
    position[:5] += 0.1
    report = check(replace(moved, actuator_states=replace(states, position=position)))
    assert report.different > 0


async def test_a_goal_that_ended_otherwise_is_found(moved: Recording) -> None:
    entry = moved.results[0]
    other = replace(entry, value=replace(entry.value, stalled=True))
    assert not check(replace(moved, results=[other])).same


async def test_a_part_may_begin_and_end_between_a_tick_and_its_result(
    small: Hand, tmp_path: Path
) -> None:
    ends: list[tuple[int, Snapshot]] = []
    async with recording(small, tmp_path, LoopSettings(rate=RATE)) as rig:
        controller = rig.loop.controller

        class Keeping(Observer):
            def on_tick(self, record: TickRecord) -> None:
                if any(isinstance(each, Result) for each in controller.outbox.items):
                    ends.append((record.tick, capture(controller)))

        rig.loop.add_observer(Keeping())
        await rig.do("Trig", "index")
        await rig.do("open")
    found = read(recorded(tmp_path)[0])
    (tick, state), _ = ends
    first = {name: getattr(found, name)[:1] for name in ("goals", "plans")} | {"results": ()}
    assert check(replace(between(found, 0, tick + 1), **first)).same
    assert not check(replace(between(found, 0, tick + 2), **first)).same
    wall = int(found.actuator_states.wall[tick])
    begin = to_bytes(state, library=library_name(), tick=tick, wall=wall)
    assert check(
        replace(between(found, 1, None), attachments={**found.attachments, STATE: begin})
    ).same


def without(recorded: Recording, kind: str, name: str) -> Recording:
    """Return a recording whose controller state is that of a version without a field."""
    return altered(recorded, kind, lambda given: given.pop(name))


def altered(
    recorded: Recording, kind: str, change: Callable[[dict[str, object]], object]
) -> Recording:
    """Return a recording with a change to the fields of some objects of the controller's state."""
    state = json.loads(recorded.attachments[STATE])
    for node in state["nodes"]:
        if node[:2] == ["object", kind]:
            change(node[2])
    return replace(recorded, attachments=recorded.attachments | {STATE: json.dumps(state).encode()})


def between(whole: Recording, first: int, end: int | None) -> Recording:
    """Return a recording with some of its ticks alone."""

    def part(series: JointSeries) -> JointSeries:
        names = (each.name for each in fields(series) if each.name != "names")
        return replace(series, **{name: getattr(series, name)[first:end] for name in names})

    return replace(
        whole, actuator_states=part(whole.actuator_states), reference=part(whole.reference)
    )


async def test_what_cannot_be_recomputed_is_said(moved: Recording) -> None:
    with pytest.raises(LogError, match="no settings of the loop"):
        check(replace(moved, attachments={}))
    with pytest.raises(LogError, match="lacks some ticks"):
        check(replace(moved, metadata={"decimation": "10"}))
    with pytest.raises(LogError, match="no states and references"):
        check(replace(moved, reference=replace(moved.reference, t=moved.reference.t[:3])))
    broken = {"replay.json": b'{"settings": 3}'}
    with pytest.raises(LogError, match="Replayable cannot be read"):
        check(replace(moved, attachments=broken))


def test_fields_that_no_longer_exist_are_passed_over() -> None:
    dynamics = {"first": ActuatorDynamics(dry_friction=0.3), "second": ActuatorDynamics(kp=2.0)}
    whole = Replayable(LoopSettings(), (), dynamics=dynamics)
    old = json.loads(to_json(whole))
    for section in (old, old["settings"], *old["dynamics"].values()):
        section["gone"] = 1
    assert from_json(json.dumps(old), Replayable) == whole
    old["dynamics"]["first"] = {"gone` - at `$.settings": 1}  # named as if it were elsewhere
    with pytest.raises(LogError, match="Replayable cannot be read"):
        from_json(json.dumps(old), Replayable)


async def test_nonsense_in_a_recording_is_said(moved: Recording) -> None:
    def with_command(command: Command) -> Recording:
        record = CommandRecord(5, float(moved.actuator_states.time[5]), command)
        entry = Entry(0.0, 0, record.stamp, record)
        return replace(moved, commands=[*moved.commands, entry])

    with pytest.raises(LogError, match="cannot be recomputed: '<' not supported"):
        check(with_command(Jog({"index_tip": 0.3}, "fast")))  # type: ignore[arg-type]
    with pytest.raises(UnknownActuator):
        check(with_command(SetAcceptsEffort({"third_thumb": True})))


KINDS = {"accepts", "active", "holding", "cancel", "jog", "hold", "fail", "freeze"}


def test_a_recording_of_before_commands_had_types_comes_out_again() -> None:
    """It holds every kind of command, as the version before wrote them."""
    found = read(RECORDED_BEFORE)
    assert found.notes == ()
    commands = [entry.value.command for entry in found.commands]
    assert {plain(command)[0] for command in commands} == KINDS
    jogs = [command for command in commands if isinstance(command, Jog)]
    assert [jog.max_velocity for jog in jogs] == [0.1 + 0.2, math.inf]
    report = check(found)
    assert (report.ticks, report.goals) == (332, 6)
    # At this tick a finger that something blocks is sent back. It used to press on its way, from
    # where its reference was; now it begins from where it is.
    assert report.first is not None
    assert (report.first.tick, report.first.actuator) == (102, "index_base")
    assert report.first.computed == pytest.approx(0.9, abs=1e-3)


def test_the_table_of_commands_is_as_before() -> None:
    table = tables(read(RECORDED_BEFORE), ["commands"])["commands"]
    assert list(table) == ["t", "wall_ns", "kind", "text", "values", "tick", "stamp"]
    row = list(table["kind"]).index("jog")
    assert table["text"][row] == "0.30000000000000004"
    assert table["values"][row] == "index_tip=0.3 thumb_slide=0.01"
    assert table["tick"][row] == 152


def test_a_recording_says_by_which_rules_of_contact_it_was_made() -> None:
    report = check(read(RECORDED_BEFORE))
    assert report.rules == 1  # from before it was written
    assert (report.note == "") == (contact_rules.VERSION == 1)
    assert "version 99" in replace(report, rules=99).note
    assert replace(report, rules=contact_rules.VERSION).note == ""
