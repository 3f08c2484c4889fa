"""Whole runs: from hand.yaml to the end, in this process and as a process of its own."""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import anyio
import pytest
from rtee_process import RTEE

from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import ConfigError, LoopError, UserError
from rtee.hand.config_schema import Behaviour, Lines
from rtee.log import read
from rtee.loop.controller import Controller
from rtee.loop.free_motion import LearnedMotion
from rtee.loop.measured import Measured
from rtee.remote.directory import claimed
from rtee.running import free_motion, run
from rtee.running.event_lines import EventLines, Fields, entry, line
from rtee.running.run import RunOptions, prepare, run_hands
from rtee.types import Event, Goal, Named, Reference, Result

pytestmark = pytest.mark.anyio

URDF = """<robot name="{name}">
  <link name="palm"/>
  <link name="jaw"><collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision></link>
  <joint name="drive" type="revolute">
    <parent link="palm"/><child link="jaw"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="10"/>
  </joint>
</robot>
"""


class Recalling(KinematicDriver):
    """A driver of one's own that writes down what it is told, for tests of whole processes."""

    def _write(self, word: str) -> None:
        with Path(os.environ["RTEE_TEST_CALLS"]).open("a") as file:
            file.write(f"{time.monotonic()} {word}\n")

    async def activate(self) -> None:
        await super().activate()
        self._write("activate")

    async def stop(self) -> None:
        self._write("stop")
        await super().stop()

    async def disable(self) -> None:
        self._write("disable")
        await super().disable()

    async def close(self) -> None:
        self._write("close")
        await super().close()


def write_hand(folder: Path, name: str = "jaw", extra: str = "") -> Path:
    hand = folder / name
    hand.mkdir(parents=True)
    (hand / f"{name}.urdf").write_text(URDF.format(name=name))
    (hand / "hand.yaml").write_text(
        f"name: {name}\nurdf: {name}.urdf\nloop: {{rate: 200}}\n"
        f"log: {{directory: {folder / 'logs'}}}\n{extra}"
    )
    return hand


def words_in(calls: Path) -> list[str]:
    return [line.split()[1] for line in calls.read_text().splitlines()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_hand(tmp_path)
    return tmp_path


def options(folder: Path, **more: object) -> RunOptions:
    return RunOptions(config_dirs=(folder,), **more)  # type: ignore[arg-type]


async def test_a_run_tells_how_it_starts_and_how_it_went(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said: list[str] = []
    chosen = options(folder, duration=0.3, events=Lines.STDOUT)
    status = await run_hands(["jaw"], chosen, serve=None, say=said.append)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {line["hand"] for line in lines} == {"jaw"}
    assert status == 0
    assert said[0].startswith("jaw: 1 actuator, 1 joints, 0 actions; 200 Hz; kinematic: ")
    assert "active" in said[0]
    assert "network off" in said[0]
    assert any("ticks at 200 Hz" in line and "lateness p50" in line for line in said)
    assert said[-1] == "jaw: 0 goals"


def test_goals_and_results_are_events_with_the_goal() -> None:
    found: list[Fields] = []
    lines = EventLines("jaw", ("drive",), found.append)
    goal = Goal(Named("Trig", ("index",)), client="ann.rtee-do")
    lines.on_goal(goal, 12.0)
    lines.on_event(Event("device_fault", "drive", "too hot\nto hold", 13.0, "error"))
    lines.on_result(Result(goal.goal_id, "Trig", reached=True))
    assert [fields["kind"] for fields in found] == ["goal", "device_fault", "result"]
    assert {fields["goal"] for fields in found} == {goal.goal_id}
    assert found[1]["device"] == "drive"
    assert json.loads(line(found[0]))["text"] == "ann.rtee-do begins Trig index"
    # A name, a line, the length in 8 bytes, the value, a line.
    assert b"MESSAGE\n\x14\0\0\0\0\0\0\0jaw: too hot\nto hold\nPRIORITY\n" in entry(found[1])


async def test_everything_is_recorded(folder: Path) -> None:
    await run_hands(["jaw"], options(folder, duration=0.3), serve=None, say=lambda _: None)
    (file,) = (folder / "logs").glob("*_000.mcap")
    recording = read(file)
    assert recording.hand == "jaw"
    assert {"hand.yaml", "jaw.urdf"} <= set(recording.attachments)
    assert len(recording.reference) >= 20


def test_what_was_learned_of_free_motion_is_kept_for_each_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    (real,) = prepare(str(write_hand(tmp_path)), RunOptions()).devices
    emulated = replace(real, spec=replace(real.spec, emulated=True))
    learned = {
        "drive": LearnedMotion((0.1, 0.0, 0.0), (1.0,) * 9, 20, 0.01, 0.02, 0.1, 0.001, 0.05)
    }
    assert free_motion.recall("jaw", [real]) == {}
    free_motion.keep("jaw", [real], learned)
    free_motion.keep(
        "jaw", [emulated], {"drive": replace(learned["drive"], parameters=(math.nan,) * 3)}
    )
    assert free_motion.recall("jaw", [real]) == learned
    assert free_motion.recall("jaw", [emulated]) == {}, "numbers that cannot be"
    (file,) = tmp_path.rglob("jaw.json")
    file.write_text("{")
    assert free_motion.recall("jaw", [real]) == {}
    assert "is learned again" in caplog.text


async def test_recordings_go_where_they_are_told_or_nowhere(folder: Path) -> None:
    other = folder / "elsewhere"
    for more in ({"log": other}, {"record": False}):
        await run_hands(["jaw"], options(folder, duration=0.1, **more), serve=None, say=str)
    assert len(list(other.glob("*.mcap"))) == 1
    assert not list((folder / "logs").glob("*_000.mcap"))


async def test_what_a_full_disk_loses_is_counted_and_told(
    folder: Path, largest_file: Callable[[int | None], None]
) -> None:
    import rtee

    said: list[str] = []
    over = anyio.Event()

    async def main() -> None:
        await run_hands(["jaw"], options(folder), say=said.append, until=over)

    async with anyio.create_task_group() as group:
        group.start_soon(main)
        try:
            async with rtee.connect("jaw", wait=300.0) as hand:
                events = hand.events()
                largest_file(1000)
                with anyio.fail_after(300):
                    async for event in events:
                        if event.kind == "log_failed":
                            break
                status = await hand.status()
        finally:
            largest_file(None)
            over.set()
    assert "not written: file too large" in status.recording_trouble
    assert any("recording: " in line and "ticks lost" in line for line in said)


async def test_several_hands_share_a_clock_or_have_their_own(folder: Path) -> None:
    write_hand(folder, "left")
    write_hand(folder, "right", "realtime: {enabled: false}\n")
    (folder / "right" / "hand.yaml").write_text(
        (folder / "right" / "hand.yaml").read_text().replace("200", "100")
    )
    said: list[str] = []
    names = ["jaw", "left", "right"]
    await run_hands(names, options(folder, duration=0.3), serve=None, say=said.append)
    clocks = [line for line in said if "ticks at" in line]
    assert clocks[0].startswith("jaw, left: ")
    assert clocks[1].startswith("right: ")
    assert "100 Hz" in clocks[1]
    assert len(list((folder / "logs").glob("*_000.mcap"))) == 3


async def test_a_hand_is_commanded_over_the_network(folder: Path) -> None:
    import rtee

    over = anyio.Event()
    said: list[str] = []

    async def main() -> None:
        await run_hands(["jaw"], options(folder), say=said.append, until=over)

    async with anyio.create_task_group() as group:
        group.start_soon(main)
        with anyio.fail_after(300):
            while True:
                try:
                    async with rtee.connect("jaw") as hand:
                        result = await hand.do("open")
                        await hand.add_generic("close", {"drive": 0.8})
                        running = await hand.start("close", speed=0.05, timeout=60.0)
                        over.set()
                        last = await running.result()
                    break
                except (rtee.errors.NoHand, rtee.errors.RequestRejected):
                    assert not over.is_set(), "it hears how its goal ended though the run does"
                    await anyio.sleep(0.1)
    assert result.reached
    assert last.cancelled
    assert said[-1] == "jaw: 2 goals (1 reached, 1 cancelled)"


@pytest.mark.parametrize(
    ("names", "more", "reason"),
    [
        (["jav"], {}, "unknown hand 'jav'; did you mean 'jaw'"),
        (["jaw", "jaw"], {}, "'jaw' is given twice"),
        (["jaw"], {"rate": 3000.0}, "1 to 2000 Hz, not 3000"),
        (["jaw"], {"driver": "kinmatic"}, "^--driver kinmatic: .* did you mean 'kinematic'"),
        (["jaw"], {"driver": "devices"}, "has no devices"),
        (["jaw"], {"emulated": True}, "has no devices"),
        (["jaw"], {"driver_options": {"time_constan": 1}}, "did you mean 'time_constant'"),
        (["jaw"], {"driver": "rtee.types:Goal"}, "not a subclass of Driver"),
        (["jaw"], {"driver": "replay", "driver_options": {"file": "no.mcap"}}, "cannot be opened"),
    ],
)
async def test_mistakes_end_it_before_anything_moves(
    folder: Path, names: list[str], more: dict[str, object], reason: str
) -> None:
    said: list[str] = []
    with pytest.raises(UserError, match=reason):
        await run_hands(names, options(folder, **more), serve=None, say=said.append)
    assert said == []
    assert not any(files for *_, files in os.walk(folder / "logs"))


async def test_a_hand_that_runs_already_keeps_its_devices_to_itself(
    folder: Path, calls: Path
) -> None:
    more = options(folder, driver=f"{__name__}:Recalling")
    with claimed("jaw"), pytest.raises(ConfigError, match="'jaw' is already running, in process"):
        await run_hands(["jaw"], more, say=str)
    assert calls.name not in os.listdir(folder)


async def test_a_mistake_in_a_devices_options_has_file_and_line(folder: Path) -> None:
    extra = (
        "devices:\n  jaw:\n    driver: kinematic\n    options:\n      time_constan: 1.0\n"
        "driver: devices\n"
    )
    hand = write_hand(folder, "wrong", extra)
    with pytest.raises(ConfigError, match=r"hand\.yaml:6: .*did you mean 'time_constant'"):
        await run_hands([str(hand)], RunOptions(duration=0.1), serve=None, say=str)


@pytest.mark.parametrize("behaviour", list(Behaviour))
async def test_a_loop_that_fails_does_what_is_configured_and_says_why(
    folder: Path,
    calls: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    behaviour: Behaviour,
) -> None:
    write_hand(folder, "failing", f"safety: {{on_error: {behaviour}}}\n")
    said: list[str] = []
    more = {"driver": f"{__name__}:Recalling", "duration": 5.0}
    step = Controller.step

    def fail_in_time(self: Controller, stamp: float, measured: Measured) -> None:
        # Not before it has a reference: without one, "hold" stops the device.
        if len(said) > 0 and self.active[0] and not self.starts.unplaced:
            raise ZeroDivisionError("a bug")
        step(self, stamp, measured)

    monkeypatch.setattr(Controller, "step", fail_in_time)
    with (
        caplog.at_level(logging.CRITICAL),
        pytest.raises(LoopError, match="ZeroDivisionError: a bug"),
    ):
        await run_hands(["failing"], options(folder, **more), serve=None, say=said.append)
    # A loop that does not tick any more cannot open the hand: it stops it.
    done = {Behaviour.HOLD: [], Behaviour.DISABLE: ["disable"]}.get(behaviour, ["stop"])
    assert words_in(calls) == ["activate", *done, "close"]
    (file,) = (folder / "logs").glob("*_000.mcap")
    told = [
        entry.value.text for entry in read(file).events if "the loop failed" in entry.value.text
    ]
    assert any("confirmed" in text and "not confirmed" not in text for text in told)
    assert any("ticks at" in line for line in said), "the statistics are told all the same"
    assert list((folder / "logs").glob("*flight*.mcap"))


@pytest.mark.parametrize("configured", [True, False])
async def test_without_recordings_a_fault_goes_to_a_folder_that_was_asked_for_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch, configured: bool
) -> None:
    said: list[str] = []
    step = Controller.step

    def fail_in_time(self: Controller, stamp: float, measured: Measured) -> None:
        if said and self.active[0]:
            raise ZeroDivisionError("a bug")
        step(self, stamp, measured)

    monkeypatch.setattr(Controller, "step", fail_in_time)
    monkeypatch.chdir(folder)
    config = folder / "jaw" / "hand.yaml"
    if not configured:
        config.write_text(config.read_text().partition("log:")[0])
    with pytest.raises(LoopError, match="a bug"):
        await run_hands(["jaw"], options(folder, record=False), serve=None, say=said.append)
    written = os.listdir(folder / "logs") if configured else []
    assert len(written) == configured
    assert all("flight" in name for name in written)
    assert configured or not (folder / "logs").exists()
    assert (f"log off, but faults go to {folder / 'logs'};" in said[0]) == configured
    assert ("log off;" in said[0]) != configured


async def test_being_cancelled_brings_the_hand_to_rest(folder: Path) -> None:
    told: list[Reference] = []

    class Listening(KinematicDriver):
        async def move(self, reference: Reference) -> None:
            told.append(reference)
            await super().move(reference)
            scope.cancel()

    globals()["Listening"] = Listening
    with anyio.CancelScope() as scope:
        more = {"driver": f"{__name__}:Listening"}
        await run_hands(["jaw"], options(folder, **more), serve=None, say=str)
    assert told
    assert told[-1].position.tolist() == [0.0]


def test_what_is_prepared_is_not_opened(folder: Path) -> None:
    prepared = prepare("jaw", options(folder, rate=500.0, driver="replay"))
    assert prepared.settings.rate == 500.0
    assert prepared.devices[0].spec.driver == "replay"
    assert prepared.devices[0].spec.source == "--driver replay"
    assert len(prepared.library) == 0
    assert not (folder / "logs").exists()


# --- processes -----------------------------------------------------------------------------------


@pytest.fixture
def calls(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = folder / "calls"
    monkeypatch.setenv("RTEE_TEST_CALLS", str(path))
    return path


def start(
    folder: Path, *arguments: str, hand: str = "jaw", program: Sequence[str] = RTEE
) -> subprocess.Popen[str]:
    environment = os.environ | {
        "RTEE_CONFIG_PATH": str(folder),
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
        "PYTHONUNBUFFERED": "1",
    }
    return subprocess.Popen(
        [*program, "run", hand, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=folder,
    )


def test_the_gui_of_a_run_that_is_killed_ends_with_it(folder: Path) -> None:
    pytest.importorskip("viser")
    process = start(folder, "--no-log", "--gui")
    assert process.stdout is not None
    while "rtee: GUI at" not in (line := process.stdout.readline()):
        assert line, process.stderr
    process.kill()
    # Read to its end: the GUI has ended, too, or it would hold the pipe open.
    _, errors = process.communicate()
    assert "Traceback" not in errors


@pytest.mark.samples("2", "15")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGQUIT])
def test_a_signal_does_what_is_configured_and_closes_the_log(
    folder: Path, calls: Path, number: signal.Signals
) -> None:
    write_hand(folder, "stopping", "safety: {on_exit: stop}\n")
    process = start(folder, "--driver", "test_run:Recalling", hand="stopping")
    assert process.stdout is not None
    assert process.stdout.readline().startswith("stopping: 1 actuator")
    time.sleep(0.3)
    process.send_signal(number)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "ticks at 200 Hz" in output
    assert words_in(calls) == ["activate", "stop", "close"]
    (file,) = (folder / "logs").glob("*_000.mcap")
    events = [entry.value for entry in read(file).events]
    assert any(number.name in event.text and event.kind == "stop" for event in events)


@pytest.mark.heavy
def test_a_hand_that_everybody_can_change_is_warned_of(folder: Path) -> None:
    write_hand(folder, "public", "")
    home = next(folder.rglob("public"))
    for path, mode in ((home / "hand.yaml", 0o666), (home, 0o777)):
        path.chmod(mode)
        process = start(folder, "--duration", "0.1", hand="public")
        _, errors = process.communicate()
        assert process.returncode == 0, errors
        (line,) = [line for line in errors.splitlines() if "changed by everybody" in line]
        assert f"{path} can be changed by everybody; 'chmod -R o-w {home}' prevents it" in line


def test_a_users_mistake_is_one_sentence_and_status_2(folder: Path) -> None:
    process = start(folder, "--rate", "5000")
    output, errors = process.communicate()
    assert process.returncode == 2
    assert output == ""
    assert errors.count("\n") == 1
    assert "1 to 2000 Hz, not 5000" in errors


def test_options_of_a_driver_are_read_like_yaml(folder: Path) -> None:
    options = ["--option", "time_constant=0.2", "--option", "start={drive: 1}"]
    # A real process: ruckig's binding says "leaked" if its objects outlive the interpreter.
    real = (sys.executable, "-m", "rtee")
    process = start(folder, "--duration", "0.2", *options, program=real)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert output.startswith("jaw: ")
    assert "leaked" not in errors
    process = start(folder, "--option", "time_constant")
    _, errors = process.communicate()
    assert process.returncode == 2
    assert "should be NAME=VALUE" in errors


def test_what_is_not_permitted_is_told_once(folder: Path) -> None:
    write_hand(folder, "pinned", "realtime: {enabled: true, cpus: [4000], lock_memory: false}\n")
    process = start(folder, "--duration", "0.1", hand="pinned")
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert (output + errors).count("CPU 4000 cannot be used") == 1


def test_hands_of_a_run_are_told_whose_realtime_counts(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_hand(folder, "left", "realtime: {enabled: true, priority: 70}\n")
    write_hand(folder, "right", "realtime: {enabled: true, priority: 60}\n")
    made = {name: prepare(name, options(folder)) for name in ("jaw", "left", "right")}
    assert run._realtime([made["jaw"], made["right"]], enabled=False).priority == 60
    assert not run._realtime([made["jaw"]], enabled=False).enabled
    assert caplog.text == ""
    assert run._realtime(list(made.values()), enabled=False).priority == 70
    assert "right: `realtime` in its hand.yaml is ignored: that of left holds" in caplog.text
    assert "jaw" not in caplog.text, "it wants none"
