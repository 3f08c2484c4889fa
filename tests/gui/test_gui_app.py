"""The GUI without a browser: its server, its panels and hands that come and go."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import io
import math
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import anyio
import anyio.lowlevel
import anyio.to_thread
import numpy as np
import pytest
import viser
from remote.serving import URDF, Config, Remote, free_endpoint, make_hand, make_library, serving
from remote.test_truth import ACTIVE, STATE, status
from rtee_process import PYTHON

import rtee
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionKind, PrimitiveKind
from rtee.errors import LeaseHeld, RequestRejected
from rtee.extract.kinematic import kinematic_primitives
from rtee.gui.access import Access
from rtee.gui.access import PageRole as AccessRole
from rtee.gui.app import App
from rtee.gui.bridge import Bridge
from rtee.gui.history import StateHistory
from rtee.gui.panels import trying
from rtee.gui.panels.action_editor import JogPanel, TuningPanel
from rtee.gui.panels.execution import Execution
from rtee.gui.panels.header import HeaderPanel
from rtee.gui.panels.plots import PlotsPanel
from rtee.gui.panels.table import TablePanel
from rtee.gui.session import HandSession
from rtee.gui.visitors import Buffer, Visitors
from rtee.gui.watch import Watch
from rtee.gui.wording import NOTHING, Angles, number, units
from rtee.hand.files import write_together
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.messages.requests import Role
from rtee.messages.state import State
from rtee.remote import credentials
from rtee.remote.client import RemoteHand
from rtee.remote.goal import RunningGoal
from rtee.remote.truth import Truth
from rtee.types import Event, Goal, Lifecycle, Named, Result

pytestmark = pytest.mark.anyio


@pytest.fixture(autouse=True)
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep other hands of this computer out."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RTEE_RUNTIME_DIR", raising=False)


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        yield server
        server.stop()


async def shows(app: App, text: str) -> None:
    """Wait until the bar of a page for all windows says something; the test's timeout ends it."""
    while app._group is None:
        await anyio.lowlevel.checkpoint()
    if 0 not in app.pages:
        app.open(app.server)
    while text not in str(app.words(app.pages[0].key)["link"]):  # noqa: ASYNC110
        await anyio.sleep(0.02)
    while "connected" in text and "not" not in text and app.pages[0].session is None:  # noqa: ASYNC110
        await anyio.sleep(0.02)


async def says(app: App, part: str, text: str, window: int = 0) -> None:
    """Wait until a part of a window's bar says something."""
    while text not in str(app.words(app.pages[window].key)[part]):  # noqa: ASYNC110
        await anyio.sleep(0.02)


async def entered(control: viser.GuiInputHandle[Any], value: object) -> None:
    """Let a person enter a value, as viser does."""
    control._impl.value = value
    for callback in control._impl.update_cb:
        await cast("Any", callback)(viser.GuiEvent(client=None, client_id=1, target=control))


def session_of(app: App) -> HandSession:
    """Return the panels of that page."""
    session = app.pages[0].session
    assert session is not None
    return session


async def has(app: App, kind: ActionKind, name: str, *, there: bool = True) -> None:
    """Wait until an action has a card, or none."""
    await shows(app, "connected")
    while ((kind, name) in session_of(app).cards) is not there:  # noqa: ASYNC110
        await anyio.sleep(0.02)


async def labelled(server: viser.ViserServer, fingers: int) -> None:
    """Wait until the fingers of a hand have their names, which its first states draw."""
    while sum(name.endswith("/label") for name in server.scene._handle_from_node_name) < fingers:  # noqa: ASYNC110
        await anyio.sleep(0.02)


@pytest.mark.heavy
async def test_ten_hands_one_after_the_other(server: viser.ViserServer, tmp_path: Path) -> None:
    controls, nodes, commands = [], [], []
    async with anyio.create_task_group() as group:
        app = App(server, None, None)
        group.start_soon(app.run)
        await shows(app, "no hand is running")
        for name in (f"small{number}" for number in range(10)):
            hand = make_hand(tmp_path, name)
            async with serving(hand, make_library(hand)):
                app.pages[0].choose(name)
                await shows(app, f"{name}: connected")
                await has(app, ActionKind.TIMED, "wave")
                await labelled(server, len(hand.fingers))
                controls.append(len(server.gui._gui_input_handle_from_uuid))
                nodes.append(len(server.scene._handle_from_node_name))
                commands.append(len(server.gui._command_handle_from_uuid))
            await shows(app, "not connected")
        group.cancel_scope.cancel()
    for counts in (controls, nodes, commands):
        assert counts[0] > 3
        assert set(counts) == {counts[0]}, f"something of the hands before is left: {counts}"


async def test_a_window_that_waits_for_a_hand_gets_it_however_late_it_comes(tmp_path: Path) -> None:
    watch, hand, found = Watch("small", None), make_hand(tmp_path), anyio.Event()

    async def wait() -> None:
        await watch.model()
        found.set()

    async with anyio.create_task_group() as group:
        group.start_soon(wait)
        group.start_soon(watch.run)
        while "is not running" not in watch.truth.trouble:  # noqa: ASYNC110 - an attempt has failed
            await anyio.sleep(0.02)
        async with serving(hand, make_library(hand)):
            await found.wait()
        group.cancel_scope.cancel()


async def test_a_hand_may_return_with_another_joint(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    """Neither its history nor its panels are those of the hand before."""
    lid = """<link name="cover"/><joint name="lid" type="revolute"><parent link="palm"/>
      <child link="cover"/><axis xyz="0 1 0"/><mimic joint="near"/>
      <limit lower="0" upper="1.5" velocity="3" effort="2"/></joint></robot>"""
    file, before = make_hand(tmp_path).urdf.path, None
    async with anyio.create_task_group() as group:
        app = App(server, None, None)
        group.start_soon(app.run)
        for text in (URDF, URDF.replace("</robot>", lid)):
            file.write_text(text)
            hand = load_model(file, file.with_suffix(".srdf"), name="small")
            async with serving(hand, make_library(hand)):
                await shows(app, "small: connected")
                assert session_of(app) is not before
                await has(app, ActionKind.TIMED, "wave")
                history = app.pages[0].watch.history
                assert history is not None
                while not history.measured("joint_position").all():  # noqa: ASYNC110
                    await anyio.sleep(0.02)
                before = session_of(app)
                assert len(history.measured("joint_position")) == len(hand.joints)
            await shows(app, "not connected")
        group.cancel_scope.cancel()


@pytest.mark.parametrize("role", list(Role))
async def test_what_its_certificate_does_not_allow_cannot_be_used(
    server: viser.ViserServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, role: Role
) -> None:
    authority = pytest.importorskip("rtee.remote.authority", exc_type=ImportError)
    secure = tmp_path / "secure" / "small"
    authority.make_authority(secure, "small")
    identity = tmp_path / "one.pem"
    write_together({identity: authority.add_client(secure, "one", role)[1]}, private=True)
    monkeypatch.setenv(credentials.FOLDER_VARIABLE, str(tmp_path / "secure"))
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(identity))
    endpoint = free_endpoint().replace("tcp/", "tls/")
    hand = make_hand(tmp_path)
    async with (
        serving(hand, make_library(hand), config=Config(Remote(listen=[endpoint]))) as served,
        anyio.create_task_group() as group,
    ):
        app = App(server, None, endpoint)
        group.start_soon(app.run)
        await shows(app, "small: connected")
        await has(app, ActionKind.TIMED, "wave")
        controls = [c for c in server.gui._gui_input_handle_from_uuid.values() if c.visible]
        # Other panels have buttons of these names, too.
        chosen = {word for c in controls for word in getattr(c, "options", ())} - {"Cancel"}
        words = chosen | {str(c.label) for c in controls if not getattr(c, "disabled", True)}
        words |= {c.label for c in server.gui._command_handle_from_uuid.values() if not c.disabled}
        assert {"Search", "Preview", "Effort"} <= words
        moving = {"Open hand", "Open the hand", "Cancel", "Run", "Run wave", "Grasp"}
        moving.add("Jog (holds the hand)")
        changing = {"Save pose", "Rename", "Compose", "Start", "Set mark"}
        changing.add("Holding effort [%]")
        assert words & moving == (moving if role >= Role.OPERATOR else set())
        assert words & changing == (changing if role >= Role.MAINTAINER else set())
        app.press("stop", app.pages[0].key)
        assert "stopped by one" in (await served.event("stop")).text
        await says(app, "doing", "stopped")
        group.cancel_scope.cancel()


async def test_closing_it_after_a_jog_is_no_loss(server: viser.ViserServer, tmp_path: Path) -> None:
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)) as served:
        async with anyio.create_task_group() as group:
            app = App(server, "small", None)
            group.start_soon(app.run)
            await shows(app, "small: connected")
            await session_of(app)._remote.jog({"near": 1.0}, 0.5)
            group.cancel_scope.cancel()
        async with rtee.connect("small") as remote:
            assert (await remote.status()).holder == ""
            assert (await remote.do("Trig", "index", intensity=0.1)).reached
        assert "client_lost" not in [event.kind for event in served.watcher.events]


@pytest.mark.parametrize("moved", [False, True])
async def test_nothing_follows_the_sliders_of_a_hand_that_has_gone(
    server: viser.ViserServer,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    moved: bool,
) -> None:
    async with anyio.create_task_group() as group:
        app = App(server, "small", None)
        hand = make_hand(tmp_path)
        async with serving(hand, make_library(hand)):
            group.start_soon(app.run)
            await shows(app, "small: connected")
            jog, remote = session_of(app)._making.jog, session_of(app)._remote
            jog._hold.value = jog._follow.value = True
            while not (await remote.status()).stream.stream:  # noqa: ASYNC110
                await anyio.sleep(0.02)
            if moved:
                jog._sliders[0].value = 0.3
        await shows(app, "not connected")
        while not all(task.done() for task in app.pages[0].bridge._working):  # noqa: ASYNC110
            await anyio.sleep(0.02)
        group.cancel_scope.cancel()
    assert "a click failed" not in caplog.text


async def test_one_trial_runs_at_a_time_in_all_windows(
    server: viser.ViserServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lasting = 'print(\'{"text": "begun"}\', flush=True); input(); input()'
    monkeypatch.setattr(trying, "command", lambda: ([sys.executable, "-c", lasting], {}))
    monkeypatch.setattr(trying, "check_installed", lambda *, planning: None)
    monkeypatch.setattr(trying, "folder_of", lambda *_: tmp_path)
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)), anyio.create_task_group() as group:
        app = App(server, "small", None)
        group.start_soon(app.run)
        await shows(app, "small: connected")
        trials, first = session_of(app)._trying, app.pages.pop(0)
        await shows(app, "small: connected")
        others = session_of(app)._trying
        trials._clicked("Try")
        while "begun" not in trials._report.content:  # noqa: ASYNC110
            await anyio.sleep(0.02)
        with pytest.raises(RequestRejected, match="a trial is still running, here or in another"):
            await others._start(planning=True)
        with pytest.raises(RequestRejected, match="this window runs no trial"):
            await others._cancel()
        others.remove()
        assert app.jobs.running == "a trial"
        await first.close()  # which ends its trial, since nobody would see the result
        assert app.jobs.running == ""
        group.cancel_scope.cancel()


async def test_ending_it_while_jog_is_ticked_is_no_loss(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)) as served:
        async with anyio.create_task_group() as group:
            app = App(server, "small", None)
            group.start_soon(app.run)
            await shows(app, "small: connected")
            session_of(app)._making.jog._hold.value = True
            while not (await session_of(app)._remote.status()).holder:  # noqa: ASYNC110
                await anyio.sleep(0.02)
            group.cancel_scope.cancel()
        async with rtee.connect("small") as remote:
            assert (await remote.status()).holder == ""
            assert (await remote.do("Trig", "index", intensity=0.1)).reached
        assert "client_lost" not in [event.kind for event in served.watcher.events]


async def test_actions_made_elsewhere_come_and_go(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    hand = make_hand(tmp_path)
    async with (
        serving(hand, make_library(hand)),
        rtee.connect("small") as other,
        anyio.create_task_group() as group,
    ):
        app = App(server, "small", None)
        group.start_soon(app.run)
        await shows(app, "small: connected")
        await other.add_generic("nudge", {"push": 0.01})
        await has(app, ActionKind.GENERIC, "nudge")
        await other.remove_action("nudge")
        await has(app, ActionKind.GENERIC, "nudge", there=False)
        group.cancel_scope.cancel()


async def test_a_message_of_another_thread_wakes_the_sender_in_its_own(
    server: viser.ViserServer,
) -> None:
    assert isinstance(server._websock_server._broadcast_buffer, Buffer)
    buffer = Buffer(asyncio.get_running_loop(), persistent_messages=True)
    sender = asyncio.create_task(buffer.message_event.wait())
    await asyncio.sleep(0)
    await anyio.to_thread.run_sync(buffer.message_event.set)
    assert not buffer.message_event.is_set()
    await anyio.to_thread.run_sync(buffer.push, viser._messages.GuiRemoveMessage("it"))
    assert await sender


async def test_names_of_files_are_text(server: viser.ViserServer, tmp_path: Path) -> None:
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)), anyio.create_task_group() as group:
        app = App(server, "small", None)
        group.start_soon(app.run)
        await shows(app, "small: connected")
        async with rtee.connect("small") as remote:
            status = await remote.status()
        name = '<img src=x onerror="window.owned=1">.mcap'
        panel = session_of(app)._recordings
        panel.show_status(dataclasses.replace(status, recording=f"/nowhere/{name}"))
        assert "<img" not in panel._status.content
        assert "&lt;img src=x" in panel._status.content
        group.cancel_scope.cancel()


async def test_every_control_says_what_it_is_for(server: viser.ViserServer, tmp_path: Path) -> None:
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)), anyio.create_task_group() as group:
        app = App(server, "small", None)
        group.start_soon(app.run)
        await has(app, ActionKind.TIMED, "wave")
        handles = list(server.gui._gui_input_handle_from_uuid.values())
        group.cancel_scope.cancel()
    assert len(handles) > 50
    controls = [handle for handle in handles if hasattr(handle, "hint")]
    silent = [control.label for control in controls if not control.hint]
    assert silent == []
    quantities = [control for control in controls if "[" in (control.label or "")]
    unclear = [
        control.label
        for control in quantities
        if control.label[control.label.index("[") :] not in control.hint
    ]
    assert len(quantities) > 15
    assert unclear == [], "the tooltip does not say the unit"
    sliders = [c for c in controls if isinstance(c, viser.GuiSliderHandle | viser.GuiNumberHandle)]
    plain = {"Value", "Friction", "Variations"}  # of any unit, or of none
    assert [c.label for c in sliders if "[" not in c.label and c.label not in plain] == []


async def test_recover_is_offered_wherever_a_device_does_not_follow_and_asks_first(
    server: viser.ViserServer,
) -> None:
    """After a cable was out, devices are inactive, without a fault."""
    recovered: list[str] = []

    async def recover() -> None:
        recovered.append("all")

    hand = SimpleNamespace(open=recover, cancel=recover, admit_agents=recover, recover=recover)
    header = HeaderPanel(Bridge(server), cast("RemoteHand", hand))
    truth = Truth("svh")
    for lifecycle, offered in ((Lifecycle.INACTIVE, True), (Lifecycle.ACTIVE, False)):
        line = dataclasses.replace(ACTIVE, lifecycle=lifecycle, message="it was unplugged")
        truth.on_status(status(devices=(line,)))
        truth.on_state(STATE)
        header.show(truth)
        assert header._recover.visible is offered
    truth.on_status(status(devices=(dataclasses.replace(line, lifecycle=Lifecycle.FAULT),)))
    header.show(truth)
    assert "it was unplugged" in header._state.content
    await header._ask()
    assert header._sure.visible
    assert "keep clear" in header._moves.content
    assert not recovered
    await header._do_recover()
    assert recovered == ["all"]


async def test_sliders_say_what_is_measured_and_go_there_after_a_stop(
    server: viser.ViserServer,
) -> None:
    hand, bridge, sent = load_hand("robotiq_2f_85"), Bridge(server), list[float]()

    async def acquire_lease() -> None:
        pass

    async def jog(positions: dict[str, float], speed: float) -> None:
        sent.extend(positions.values())

    remote = SimpleNamespace(acquire_lease=acquire_lease, jog=jog)
    panel = JogPanel(bridge, cast("RemoteHand", remote), hand)
    (slider,) = panel._sliders
    measured = dataclasses.replace(STATE, names=hand.actuator_names, position=np.array([0.3]))
    panel.follow(measured)
    assert slider.value == pytest.approx(0.3)
    panel._hold.value = True
    await entered(slider, 0.7)
    panel.follow(measured)
    assert slider.value == 0.7
    assert [(mark.value, mark.label) for mark in slider._marks] == [(0.3, "measured")]
    bridge.truth.on_event(Event("stop", hand.name, "stopped", 0.0, "info"))
    panel.follow(measured)
    assert slider.value == pytest.approx(0.3)
    assert slider._marks is None
    panel._step(1.0)
    await anyio.wait_all_tasks_blocked()
    assert sent == [pytest.approx(0.7), pytest.approx(0.32)]


async def test_an_entered_effort_stays_until_the_hand_says_another_one(
    server: viser.ViserServer,
) -> None:
    bridge, sent = Bridge(server), list[float]()

    async def set_gains(gains: dict[str, float]) -> None:
        sent.extend(gains.values())
        if len(sent) > 1:
            raise LeaseHeld("another client holds the hand")

    panel = TuningPanel(bridge, cast("RemoteHand", SimpleNamespace(set_gains=set_gains)))

    def says(percent: float) -> float:
        panel.show(status(grip_effort=percent / 100.0, devices=()))
        return float(panel._holding.value)

    assert says(30.0) == 30.0
    assert not sent, "what is shown is not sent back"
    await entered(panel._holding, 70.0)
    assert says(30.0) == 70.0, "an older status must not take its place"
    await anyio.wait_all_tasks_blocked()
    assert sent == [0.7]
    assert says(70.0) == 70.0
    await entered(panel._holding, 90.0)
    await anyio.wait_all_tasks_blocked()
    assert says(70.0) == 70.0, "the hand has refused it"
    bridge.refused = "an observer only looks"
    await entered(panel._holding, 10.0)
    await anyio.wait_all_tasks_blocked()
    assert says(70.0) == 70.0
    assert sent == [0.7, 0.9]


async def test_the_card_of_trig_names_abduction(server: viser.ViserServer) -> None:
    hand = load_hand("allegro")
    trigs = [p for p in kinematic_primitives(hand) if p.kind is PrimitiveKind.TRIG]
    async with serving(hand, ActionLibrary(hand, trigs)), anyio.create_task_group() as group:
        app = App(server, "allegro", None)
        group.start_soon(app.run)
        await has(app, ActionKind.PRIMITIVE, "Trig")
        card = session_of(app).cards[ActionKind.PRIMITIVE, "Trig"]
        assert card.action.fingers == ("index",)
        assert "also swings sideways (abduction): joint_0" in card._remark_line.content
        assert card._remark_line.visible
        assert card._choice is not None
        card._choice.value = "thumb"
        assert not card._remark_line.visible
        group.cancel_scope.cancel()


def test_what_is_not_measured_leaves_the_other_lines_their_scale(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    """The browser takes a line with NaN into a scale that holds nothing."""
    hand, history = _past(make_hand(tmp_path))
    panel = PlotsPanel(server.gui, hand, history, Angles())
    panel.draw()
    assert not panel._plots
    state = _measured(hand, 0.25, 0.5)
    effort = state.effort.copy()
    effort[0] = math.nan
    history.add(dataclasses.replace(state, effort=effort), np.zeros(len(hand.joints)))
    panel.draw()
    assert set(panel._plots) == {"position", "velocity", "effort"}
    labels = [[s["label"] for s in plot.series] for plot in panel._plots.values()]
    assert len(labels[2]) == len(labels[1]) - 1
    for plot in panel._plots.values():
        _, *lines, low, high = plot.series
        assert lines
        assert [line.get("auto") for line in lines] == [False] * len(lines)
        assert [end.get("auto", True) for end in (low, high)] == [True, True]


def test_joints_have_plots_of_their_own_with_their_units(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    hand = make_hand(tmp_path)
    _, history = _past(hand)
    panel = PlotsPanel(server.gui, hand, history, Angles())
    panel._chosen_joints[-1].value = True
    for box in panel._chosen:
        box.value = False
    state = _measured(hand, 0.25, 0.5)
    history.add(state, hand.transmission.velocities(state.position, state.velocity))
    panel.draw()
    assert set(panel._plots) == {"joint_position", "joint_velocity"}
    titles = [plot.title for plot in panel._plots.values()]
    assert titles == ["joint position [rad | m]", "joint velocity [rad/s | m/s]"]
    values = [plot.data[1][-1] for plot in panel._plots.values()]
    assert values == pytest.approx(
        [
            hand.transmission.joints(state.position)[-1],
            hand.transmission.velocities(state.position, state.velocity)[-1],
        ],
        rel=1e-6,
    )


def test_the_table_tells_how_fast_every_joint_moves(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    hand = make_hand(tmp_path)
    angles = Angles()
    panel = TablePanel(server.gui, hand, angles)
    state = _measured(hand, 0.25, 0.5)
    panel.show_state(state)
    shown = panel._joints.content
    assert "vel [rad/s | m/s]" in shown
    speeds = hand.transmission.velocities(state.position, state.velocity)
    rows = re.findall(r"<tr><td>.*?</tr>", shown)
    assert [re.findall(r">([^<>]*)</td>", row)[2] for row in rows] == [
        number(v, units("velocity", [joint.kind]))
        for v, joint in zip(speeds.tolist(), hand.joints, strict=True)
    ]
    angles.degrees = True
    panel.show_state(state)
    assert "joint [° | m]" in panel._joints.content
    assert f">{math.degrees(0.25):.1f}<" in panel._actuators.content
    lost = dataclasses.replace(state, velocity=np.full(len(hand.actuators), np.nan))
    panel.show_state(lost)
    assert panel._joints.content.count("<td") == shown.count("<td")
    assert "nan" not in panel._joints.content


async def test_what_is_done_again_is_not_called_replaced(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    bridge = Bridge(server)
    truth = bridge.truth
    truth.on_status(status())
    truth.on_state(STATE)
    execution = Execution(bridge, cast("RemoteHand", None))

    async def nothing() -> None:
        pass

    first, second = (RunningGoal(Goal(Named("Trig"), goal_id=name), nothing) for name in "12")
    answered = anyio.Event()

    async def start(goal: RunningGoal) -> RunningGoal:
        if goal is second:
            await answered.wait()
        return goal

    replaced = anyio.Event()

    async def first_time() -> None:
        await execution.follow(start(first))
        replaced.set()

    async with anyio.create_task_group() as group:
        group.start_soon(first_time)
        await anyio.wait_all_tasks_blocked()
        group.start_soon(execution.follow, start(second))
        await anyio.wait_all_tasks_blocked()
        # As the hand tells it: the end of the first goal before the answer to the second.
        first.deliver(Result("1", "Trig", preempted=True))
        await replaced.wait()
        assert "replaced" not in execution._word.content
        answered.set()
        await anyio.wait_all_tasks_blocked()
        second.deliver(Result("2", "Trig", reached=True))
    assert "reached" in execution._word.content
    execution.fade()
    assert "old" not in execution._word.content
    truth.on_event(Event("stop", "small", "stopped", 0.0, "info"))
    execution.fade()
    assert re.search("old, then .* stopped: reached", execution._word.content)


async def test_an_action_may_be_renamed_while_it_runs(
    server: viser.ViserServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)) as served, anyio.create_task_group() as group:
        app = App(server, "small", None)
        group.start_soon(app.run)
        await has(app, ActionKind.TIMED, "wave")
        key, remote = (ActionKind.GENERIC, "slow"), session_of(app)._remote
        await remote.add_generic("slow", {"near": 1.0}, store=False)
        await has(app, *key)
        before = session_of(app).cards[key]
        before._speed.value = 10
        before._begin()
        while (await remote.status()).action != "slow":  # noqa: ASYNC110
            await anyio.sleep(0.02)
        await remote.rename_action("slow", "slower")
        await has(app, *key, there=False)
        await remote.stop()
        await served.event("stop")
        while app.pages[0].bridge._working:  # noqa: ASYNC110
            await anyio.sleep(0.02)
        group.cancel_scope.cancel()
    assert "a click failed" not in caplog.text


def _past(hand: Hand) -> tuple[Hand, StateHistory]:
    return hand, StateHistory(len(hand.actuators), len(hand.joints))


def _measured(hand: Hand, position: float, velocity: float) -> State:
    n = len(hand.actuators)
    at, zeros = np.full(n, position), np.zeros(n)
    return State(
        tick=0,
        stamp=1.0,
        wall_ns=0,
        names=hand.actuator_names,
        position=at,
        velocity=np.full(n, velocity),
        effort=zeros,
        current=zeros,
        temperature=zeros,
        grasped=np.zeros(n, dtype=np.int8),
        fresh=np.ones(n, dtype=bool),
        reference_position=at,
        reference_velocity=zeros,
        reference_effort=zeros,
        joint_names=hand.joint_names,
        joint_position=hand.transmission.joints(at),
        channels={},
    )


@pytest.mark.parametrize("typed", ["~nobody-of-this-name/logs", "/" + 300 * "x"])
async def test_a_folder_that_cannot_be_looked_into_ends_nothing(
    server: viser.ViserServer, tmp_path: Path, typed: str
) -> None:
    hand = make_hand(tmp_path)
    async with serving(hand, make_library(hand)), anyio.create_task_group() as group:
        app = App(server, "small", None)
        group.start_soon(app.run)
        await shows(app, "small: connected")
        await has(app, ActionKind.TIMED, "wave")
        status = await session_of(app)._remote.status()
        panel = session_of(app)._recordings
        panel._folder.value = typed
        # The loop of another user records where this one may not look, too: as hard to tell.
        for recording in ("", f"/{300 * 'y'}/small.mcap"):
            panel.show_status(dataclasses.replace(status, recording=recording))
        assert panel._folder.value == typed
        assert panel._file.options == (NOTHING,)
        group.cancel_scope.cancel()


WINDOW = """
import sys
from benchmarks.gui_onlooker import admitted, window
with window(admitted(sys.argv[1])) as connection:
    print("there", flush=True)
    for _ in connection:
        pass
"""


@pytest.mark.samples("9")
@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")  # as `serve` does
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTSTP])
async def test_jogging_ends_when_the_last_operator_has_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, repository: Path, end: signal.Signals
) -> None:
    """A window that was closed, or whose computer slept, with Jog ticked kept the hand for ever."""
    monkeypatch.setattr("rtee.gui.visitors.PING_PERIOD", 0.1)
    monkeypatch.setattr("rtee.gui.visitors.PONG_WITHIN", 3.0)
    access = Access(observers=True)
    visitors = Visitors(access)
    server = visitors.open_server(0)
    links = access.links(server.get_port())
    hand = make_hand(tmp_path)
    with contextlib.ExitStack() as stack:
        stack.callback(server.stop)

        def window(role: AccessRole) -> subprocess.Popen[str]:
            process = stack.enter_context(
                subprocess.Popen(
                    [*PYTHON, "-c", WINDOW, links[role]],
                    stdout=subprocess.PIPE,
                    text=True,
                    cwd=repository,
                )
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            assert process.stdout.readline() == "there\n"
            return process

        async with serving(hand, make_library(hand)), anyio.create_task_group() as group:
            app = App(server, "small", None, visitors)
            group.start_soon(app.run)
            await anyio.to_thread.run_sync(window, AccessRole.OBSERVER)
            process = await anyio.to_thread.run_sync(window, AccessRole.OPERATOR)
            while len(app.pages) < 2 or app.pages[1].session is None:  # noqa: ASYNC110
                await anyio.sleep(0.02)
            jog, header = app.pages[1].session._making.jog, app.pages[1].session._header
            jog._hold.value = jog._follow.value = True
            while "Jog is on" not in header._state.content:  # noqa: ASYNC110
                await anyio.sleep(0.02)
            async with rtee.connect("small") as other:
                while "gui" not in (await other.status()).holder:  # noqa: ASYNC110
                    await anyio.sleep(0.02)
                await says(app, "mode", "another window")
                await says(app, "mode", "this window", window=1)
                with pytest.raises(LeaseHeld):
                    await other.do("Trig", "index")
                process.send_signal(end)
                while (await other.status()).holder:  # noqa: ASYNC110
                    await anyio.sleep(0.02)
                assert (await other.do("Trig", "index", intensity=0.1)).reached
            assert server.get_clients(), "the observer is still there"
            group.cancel_scope.cancel()
