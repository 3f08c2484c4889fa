from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import anyio.from_thread
import pytest
from rtee_process import RTEE
from typer.testing import CliRunner

from rtee.actions.library import ActionLibrary
from rtee.cli import _common
from rtee.cli._common import app_of
from rtee.cli.define import compose
from rtee.cli.do import do, touch
from rtee.cli.do import open_ as open
from rtee.cli.hands import hands
from rtee.cli.log import mark
from rtee.cli.state import state
from rtee.cli.status import status
from rtee.cli.stop import recover, stop
from rtee.drivers.capabilities import Capabilities
from rtee.errors import ConfigError, GoalRejected, NoHand, RequestRejected
from rtee.hand.model import Hand
from rtee.types import Fingers, FirstContact, Intensity, Lifecycle, Named

from .serving import (
    Config,
    Remote,
    Served,
    Told,
    announced,
    free_endpoint,
    make_hand,
    make_library,
    serving,
)


@pytest.fixture
def served(hand: Hand, library: ActionLibrary) -> Iterator[Served]:
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, library, recorder=Told())) as served,
    ):
        yield served


def run(command: Callable[..., None], *words: str, status: int = 0) -> str:
    result = CliRunner().invoke(app_of(command), words, catch_exceptions=False)
    assert result.exit_code == status, result.output
    return result.output


def test_do(served: Served) -> None:
    done = run(do, "pinchTight", "thumb", "index", "--intensity", "0.3")
    assert "PinchTight thumb index: reached" in done
    goal = served.watcher.goals[0]
    assert (goal.what, goal.to) == (Named("pinchTight", ("thumb", "index")), Intensity(0.3))
    assert goal.client.startswith("rtee-do-")


def test_do_with_everything_said(served: Served) -> None:
    words = "fist --intensity 20% --effort near=1.5 --effort push=30 --speed 50% --timeout 5"
    more = "--tolerance 0.02 --kind composed --hand small --json"
    found = json.loads(run(do, *words.split(), *more.split()))
    assert found["succeeded"]
    assert set(found["position"]) == {"near", "thumb", "push"}
    goal = served.watcher.goals[0]
    assert goal.effort == {"near": 1.5, "push": 30.0}
    assert (goal.speed, goal.timeout) == (0.5, 5.0)
    assert (goal.what, goal.to) == (Named("fist", kind="composed"), Intensity(0.2, tolerance=0.02))


def test_do_says_what_fingers_do_on_contact(served: Served) -> None:
    run(do, *["fist", "--intensity", "0.2", "--on-contact", "hold", "--on-contact", "thumb=stop"])
    assert served.watcher.goals[0].on_contact == {"": "hold", "thumb": "stop"}
    with pytest.raises(GoalRejected, match="unknown on_contact 'push'"):
        run(do, "fist", "--on-contact", "push")


def test_a_mark_goes_into_the_recording(served: Served) -> None:
    assert served.recorder is not None
    served.recorder.start()
    assert run(mark, "the cup slipped", "--hand", "small") == ""
    assert served.recorder.calls == ["start", "the cup slipped"]


def test_touching_nothing_has_exit_status_1(served: Served) -> None:
    said = run(touch, "thumb", "--timeout", "0.2", status=1)
    assert "Trig thumb: timed out" in said
    assert said.endswith("\nnothing was touched\n")
    [goal] = served.watcher.goals
    assert (goal.what, goal.to) == (Fingers(("thumb",)), FirstContact())
    with pytest.raises(RequestRejected, match="unknown finger 'ring'"):
        run(touch, "ring")


def test_do_that_fails_has_exit_status_1(served: Served) -> None:
    assert "timed out" in run(do, "fist", "--timeout", "0.1", "--speed", "0.05", status=1)


def test_do_that_is_refused(served: Served) -> None:
    with pytest.raises(RequestRejected, match="unknown action") as caught:
        run(do, "dance")
    assert caught.value.exit_status == 2


def test_open_stop_and_recover(served: Served) -> None:
    assert "open: reached" in run(open)
    assert "small: sim has stopped" in run(stop)
    assert "small: sim is active" in run(recover)
    assert "small: sim is active" in run(recover, "sim")


def test_open_stop_and_recover_as_json(served: Served) -> None:
    opened = json.loads(run(open, "--json"))
    assert (opened["action"], opened["reached"], opened["succeeded"]) == ("open", True, True)
    assert json.loads(run(stop, "--json")) == {"small": {"sim": True}}
    assert json.loads(run(recover, "--json")) == {"small": {"sim": "active"}}


def test_state(served: Served, hand: Hand) -> None:
    shown = run(state, "--once")
    assert all(name in shown for name in hand.actuator_names)
    assert "current" not in shown
    found = json.loads(run(state, "--once", "--json"))
    assert list(found["actuators"]) == list(hand.actuator_names)
    assert found["actuators"]["near"]["current"] is None
    assert set(found["joints"]) == set(hand.joint_names)


def test_status(served: Served) -> None:
    shown = run(status)
    assert "small:" in shown
    assert "kinematic" in shown
    assert "held by:  nobody" in shown
    assert "log:      off\n" in shown
    assert served.recorder is not None
    served.recorder.problem = "No space left on device"
    assert "log:      not written: No space left on device\n" in run(status)
    found = json.loads(run(status, "--json"))
    assert found["devices"][0]["lifecycle"] == "active"
    assert "not active" not in shown


def test_what_is_not_active_is_brought_back_by_the_line_said(served: Served) -> None:
    [device] = served.loop.devices.values()
    device.connection.lifecycle = Lifecycle.INACTIVE
    assert run(status).endswith(
        "\nnot active: sim; bring them back with: rtee recover --hand small\n"
    )


def test_what_takes_no_set_points_says_why(served: Served) -> None:
    [device] = served.loop.devices.values()
    device.driver.capabilities = Capabilities(
        accepts=frozenset(), refuses={"position": "it plays x.mcap"}
    )
    with pytest.raises(RequestRejected, match="'sim' does not accept set-points: it plays"):
        run(do, "fist")


def test_no_hand_runs() -> None:
    for module, words in (
        (do, ["fist"]),
        (state, ["--once"]),
        (status, []),
        (stop, []),
        (open, []),
        (hands, ["--running"]),
    ):
        with pytest.raises(NoHand, match="no hand is running on this computer"):
            run(module, *words)


def test_stop_stops_all_hands(served: Served, tmp_path_factory: pytest.TempPathFactory) -> None:
    other = make_hand(tmp_path_factory.mktemp("other"), "other")
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(other, make_library(other))) as second,
    ):
        with pytest.raises(ConfigError, match="several hands"):
            run(do, "fist")
        shown = run(stop)
        assert "small: sim has stopped" in shown
        assert "other: sim has stopped" in shown
        assert [e.kind for e in second.watcher.events] == ["stop"]


def test_a_hand_that_does_not_answer_is_named_and_the_others_stop(served: Served) -> None:
    with announced("ghost", ["tcp/127.0.0.1:1"]):
        reason = f"'ghost' does not answer; it runs in process {os.getpid()}"
        with pytest.raises(NoHand, match=reason):
            run(stop)
    assert "stop" in [event.kind for event in served.watcher.events]


def test_ctrl_c_cancels_the_goal(served: Served) -> None:
    words = ["do", "fist", "--speed", "0.05", "--timeout", "60"]
    process = subprocess.Popen([*RTEE, *words], stdout=subprocess.PIPE, text=True)
    while not served.watcher.goals:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate()
    assert process.returncode == 1
    assert "cancelled" in output
    assert served.watcher.results[0].cancelled


def test_a_running_hand_knows_a_new_action_at_once(
    served: Served, hand: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = configured(hand, tmp_path)
    (folder / "actions").symlink_to(tmp_path / "actions")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RequestRejected, match="unknown action 'hook'"):
        run(do, "hook")
    assert "'hook' is now an action" in run(compose, "hook", "trig:index*0.3", "--hand", "small")
    assert "hook: reached" in run(do, "hook")


def configured(hand: Hand, tmp_path: Path) -> Path:
    folder = tmp_path / "config" / "small"
    folder.mkdir(parents=True)
    for suffix in (".urdf", ".srdf"):
        (folder / f"small{suffix}").write_bytes(hand.urdf.path.with_suffix(suffix).read_bytes())
    (folder / "hand.yaml").write_text("name: small\nurdf: small.urdf\nsrdf: small.srdf\n")
    return folder


def test_completion(
    served: Served, hand: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = configured(hand, tmp_path)
    (tmp_path / "actions").rename(folder / "actions")
    monkeypatch.chdir(tmp_path)
    assert _common.complete_running("sm") == ["small"]
    assert "small" in _common.complete_hand("sm")

    class Context:
        def __init__(self, **params: object) -> None:
            self.params = params

    assert _common.complete_action(Context(), "pinch_t") == ["pinch_tight"]
    assert _common.complete_action(Context(), "Pi") == ["PinchTight"]
    assert _common.complete_action(Context(), "PINCH") == []
    assert set(_common.complete_action(Context(hand="small"), "")) >= {"Trig", "fist", "wave"}
    assert _common.complete_element(Context(action="trig"), "") == ["index", "thumb"]
    chosen = Context(action="pinch_tight", elements=["thumb"])
    assert _common.complete_element(chosen, "") == ["index"]
    assert _common.complete_element(Context(action="fist"), "") == []
    assert _common.complete_action(Context(hand="none"), "") == []


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (stop, ["small"]),
        (stop, ["--hand", "small"]),
        (stop, ["--json", "small"]),
        (open, ["small"]),
        (state, ["--rate", "5", "small", "--once"]),
        (status, ["small", "--json"]),
        (recover, ["small"]),
        (recover, ["small", "sim"]),
        (recover, ["sim", "--hand", "small"]),
        (do, ["small", "Trig", "index", "--intensity", "0.1"]),
        (do, ["--intensity", "0.1", "small", "fist"]),
    ],
)
def test_a_hand_is_an_argument_or_an_option(
    served: Served,
    tmp_path_factory: pytest.TempPathFactory,
    command: Callable[..., None],
    words: list[str],
) -> None:
    other = make_hand(tmp_path_factory.mktemp("other"), "other")
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(other, make_library(other))) as second,
    ):
        run(command, *words)
        assert not second.watcher.events
        assert not second.watcher.goals


@pytest.mark.parametrize("by_variable", [False, True])
def test_the_first_word_is_a_hand_of_another_computer_that_is_not_configured_here(
    hand: Hand,
    library: ActionLibrary,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    by_variable: bool,
) -> None:
    endpoint = free_endpoint()
    config = Config(Remote(listen=[endpoint]))
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, library, config=config)) as served,
    ):
        monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "elsewhere"))
        monkeypatch.chdir(tmp_path)  # no hand is configured here
        where = () if by_variable else ("--connect", endpoint)
        if by_variable:
            monkeypatch.setenv("RTEE_CONNECT", endpoint)
        assert "fist: reached" in run(do, "small", "fist", *where)
        run(recover, *where, "small", "sim")
        with pytest.raises(RequestRejected, match="unknown action 'smal'"):
            run(do, "smal", "fist", *where)
    assert [goal.what for goal in served.watcher.goals] == [Named("fist", ())]


def test_a_hand_here_is_not_meant_by_the_first_word_of_a_command_for_another_computer(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NoHand, match="nothing answers at"):
        run(do, "small", "--connect", free_endpoint())


def test_a_hand_that_does_not_run_is_named(served: Served) -> None:
    for command in (stop, open, state, status):
        with pytest.raises(NoHand, match=r"'smal' is not running .* did you mean 'small'"):
            run(command, "smal")
    with pytest.raises(RequestRejected, match="unknown action 'smal'"):
        run(do, "smal", "fist")
