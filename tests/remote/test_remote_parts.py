from __future__ import annotations

import ast
import fcntl
import json
import os
import re
import threading
from functools import partial
from graphlib import TopologicalSorter
from pathlib import Path

import anyio
import anyio.to_thread
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, GoalRejected, LeaseHeld, MessageError, UnknownActuator
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.kinematics import Kinematics
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.messages.requests import HERE, REQUESTS
from rtee.messages.schema import message_type
from rtee.remote import directory
from rtee.remote.actions import action_fields, action_of
from rtee.remote.call_queue import CallQueue, LoopThread
from rtee.remote.directory import hands_running, runtime_folder
from rtee.remote.hand_info import info_fields, info_of
from rtee.remote.identities import Identities
from rtee.remote.incoming_request import IncomingRequest
from rtee.remote.lease import IDLE, JOGGING, Lease

from .serving import announced

# --- lease


class Time:
    now = 0.0


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def lease(time: Time) -> Lease:
    return Lease(lambda: time.now)


def test_nobody_holds_the_hand_at_first(lease: Lease) -> None:
    assert lease.holder == ""
    lease.check("a")


def test_a_goal_holds_the_hand_until_it_ends(lease: Lease) -> None:
    lease.started("a", "1")
    lease.started("a", "2")
    lease.ended("1")
    lease.stream_ended("2")  # it is no stream
    assert lease.runs("2")
    with pytest.raises(LeaseHeld, match="'a'"):
        lease.check("b")
    lease.ended("2")
    lease.check("b")
    lease.ended("unknown")


def test_taking_lasts_until_released(lease: Lease) -> None:
    lease.acquire("a")
    with pytest.raises(LeaseHeld):
        lease.acquire("b")
    lease.release("b")
    assert lease.holder == "a"
    lease.release("a")
    lease.acquire("b")


def test_jogging_holds_the_hand_for_a_moment(lease: Lease, time: Time) -> None:
    lease.jogged("a")
    time.now = JOGGING - 0.01
    with pytest.raises(LeaseHeld):
        lease.check("b")
    time.now = JOGGING
    lease.check("b")
    lease.jogged("a")
    lease.release("b")
    assert lease.holder == "a"
    lease.release("a")
    lease.check("b")


def test_a_stream_without_samples_holds_the_hand_for_a_moment(lease: Lease, time: Time) -> None:
    lease.streams("a", "a.1", 0.1)
    for _ in range(20):
        time.now += IDLE
        with pytest.raises(LeaseHeld):
            lease.check("b")
        lease.sampled("a", "a.1")
    time.now += IDLE + 0.2
    lease.check("b")
    assert not lease.client_left("b")
    with pytest.raises(LeaseHeld):  # the lease is free, and the stream still its client's
        lease.sampled("b", "a.1")
    lease.sampled("a", "a.1")
    assert lease.holder == "a"
    time.now += IDLE + 0.2
    lease.started("b", "1")
    assert lease.holder == "b"
    lease.ended("a.1")  # pre-empted
    lease.ended("1")
    assert lease.holder == ""


@pytest.mark.parametrize("how", ["acquire", "goal", "jog"])
def test_who_is_gone_holds_nothing(lease: Lease, how: str) -> None:
    {
        "acquire": lambda: lease.acquire("a"),
        "goal": lambda: lease.started("a", "1"),
        "jog": lambda: lease.jogged("a"),
    }[how]()
    assert not lease.client_left("b")
    assert lease.client_left("a")
    assert not lease.client_left("a")
    lease.check("b")


# --- directory


def test_announced_hands_are_found(runtime: Path) -> None:
    assert hands_running() == {}
    with announced("svh", ["tcp/127.0.0.1:1"]), announced("left.2", ["a", "b"]):
        found = hands_running()
        assert list(found) == ["left.2", "svh"]
        assert found["svh"].endpoints == ("tcp/127.0.0.1:1",)
        assert found["svh"].pid == os.getpid()
        assert runtime.stat().st_mode & 0o777 == 0o700
    assert hands_running() == {}
    assert list(runtime.iterdir()) == []


def test_a_hand_is_announced_once(runtime: Path) -> None:
    with announced("svh", ["a"]):
        twice = pytest.raises(
            ConfigError, match=f"'svh' is already running, in process {os.getpid()}"
        )
        with twice, announced("svh", ["b"]):
            pass
        assert hands_running()["svh"].endpoints == ("a",)


def test_files_of_killed_processes_count_for_nothing(runtime: Path) -> None:
    runtime.mkdir(mode=0o700)
    (runtime / "svh.json").write_text(json.dumps({"pid": 1, "endpoints": ["a"]}))
    assert hands_running() == {}
    with announced("svh", ["b"]):
        assert hands_running()["svh"].endpoints == ("b",)


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"pid": "x"}', '{"pid": 1, "endpoints": 7}', "\xff"]
)
def test_other_files_count_for_nothing(runtime: Path, text: str) -> None:
    runtime.mkdir(mode=0o700)
    path = runtime / "svh.json"
    path.write_text(text, encoding="latin-1")
    with path.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert hands_running() == {}


def test_a_folder_that_others_may_write_to_is_refused(runtime: Path) -> None:
    runtime.mkdir()
    runtime.chmod(0o777)
    with pytest.raises(ConfigError, match="only you can write"), announced("svh", []):
        pass


def test_names_do_not_become_paths(runtime: Path) -> None:
    with pytest.raises(ConfigError, match="name"), announced("../svh", []):
        pass
    assert not runtime.parent.joinpath("svh.json").exists()


def test_services_are_found_beside_the_own_hands(
    runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.umask(umask := os.umask(0o022))
    services = tmp_path / "services"
    services.mkdir(mode=0o750)
    monkeypatch.setattr(directory, "SERVICES", services)
    monkeypatch.setenv(directory.VARIABLE, str(services))
    with announced("svh", ["tcp/127.0.0.1:1"]) as path:
        assert path.parent == services
        assert path.stat().st_mode & 0o777 == 0o640 & ~umask
        monkeypatch.delenv(directory.VARIABLE)
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "own"))
        with announced("gripper", ["a"]):
            assert set(hands_running()) == {"svh", "gripper"}
        monkeypatch.setenv(directory.VARIABLE, str(runtime))
        assert not hands_running(), "a folder that was named is the only one"


def test_where_the_folder_is(monkeypatch: pytest.MonkeyPatch, runtime: Path) -> None:
    assert runtime_folder() == runtime
    monkeypatch.delenv("RTEE_RUNTIME_DIR")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert runtime_folder() == Path("/run/user/7/rtee")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert runtime_folder().name == f"rtee-{os.getuid()}"


# --- hand information


def _by_pinocchio(kinematics: Kinematics, link: str, u: np.ndarray) -> np.ndarray:
    hand, model, data = kinematics.hand, kinematics.model, kinematics.data
    body, placement = kinematics.bodies[link]
    pin.computeJointJacobians(model, data, hand.transmission.joints(u))
    frame = data.oMi[body] * placement
    joints = pin.getJointJacobian(model, data, body, pin.WORLD)
    about_tip = pin.SE3(np.eye(3), -frame.translation).toActionMatrix()
    return about_tip @ joints @ hand.transmission.jacobian(u)


def _compare(hand: Hand, u: np.ndarray) -> None:
    kinematics = Kinematics(hand)
    for finger in hand.fingers:
        if finger.tip is None:
            continue
        pose, jacobian = tip_pose_and_jacobian(hand, finger.tip, u)
        np.testing.assert_allclose(pose, kinematics.link_pose(finger.tip, u), atol=1e-12)
        np.testing.assert_allclose(jacobian, _by_pinocchio(kinematics, finger.tip, u), atol=1e-12)


@given(fractions=st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3))
def test_poses_and_jacobians_equal_those_of_pinocchio(hand: Hand, fractions: list[float]) -> None:
    _compare(hand, hand.lower + np.array(fractions) * (hand.upper - hand.lower))


@pytest.mark.parametrize("name", ["schunk", "heri_II", "qbhand", "robotiq_3f"])
def test_poses_and_jacobians_of_real_hands(shared: Path, name: str) -> None:
    folder = shared / "hands" / name
    hand = load_model(folder / f"{name}.urdf", folder / f"{name}.srdf")
    _compare(hand, 0.7 * hand.lower + 0.3 * hand.upper)


def test_hand_information_survives_the_network(hand: Hand) -> None:
    kind = message_type("rtee_msgs/msg/HandInfo")
    info = info_of(kind.decode(kind.encode(info_fields(hand, {"near": 0.5}))))
    assert info.actuator_names == hand.actuator_names
    assert info.actuators[0].lower == hand.actuators[0].lower
    assert info.joints == hand.joint_names
    assert info.posture[hand.actuator_index("near")] == 0.5
    assert info.urdf == hand.urdf.text
    np.testing.assert_allclose(info.transmission, hand.transmission.matrix)
    np.testing.assert_allclose(info.joint_positions, hand.transmission.joints(info.posture))
    index = info.fingers[0]
    assert (index.name, index.tip, index.actuators) == ("index", "index_tip", ("near",))
    assert index.jacobian is not None
    assert index.jacobian.shape == (6, 3)
    with pytest.raises(UnknownActuator):
        info_fields(hand, {"pollex": 0.5})
    for value in (9.0, float("nan")):
        with pytest.raises(GoalRejected, match="outside its limits"):
            info_fields(hand, {"near": value})


# --- threads


def test_a_worker_drops_what_there_is_no_room_for() -> None:
    busy, go = threading.Event(), threading.Event()
    done: list[int] = []
    worker = CallQueue("test", most=2)
    worker.put(lambda: (busy.set(), go.wait()))
    assert busy.wait(300)
    assert [worker.put(partial(done.append, number)) for number in range(4)] == [
        True,
        True,
        False,
        False,
    ]
    assert worker.dropped == 2
    go.set()
    worker.close()
    assert done == [0, 1]


@pytest.mark.anyio
async def test_other_threads_reach_that_of_the_loop() -> None:
    thread, here = LoopThread(), threading.get_ident()
    assert await anyio.to_thread.run_sync(thread.call, threading.get_ident) == here
    with pytest.raises(GoalRejected, match="no"):
        await anyio.to_thread.run_sync(thread.call, _refuse)


def _refuse() -> None:
    raise GoalRejected("no")


@pytest.mark.anyio
async def test_what_runs_in_the_background_ends_with_the_server() -> None:
    begun = anyio.Event()
    ended: list[str] = []

    async def work() -> None:
        begun.set()
        try:
            await anyio.sleep_forever()
        finally:
            ended.append("cancelled")

    thread = LoopThread()
    await anyio.to_thread.run_sync(thread.start, work)
    await begun.wait()
    await thread.close()
    assert ended == ["cancelled"]


# --- modules


def test_no_modules_import_each_other_in_a_circle(repository: Path) -> None:
    """Not even for type checkers only."""
    imports = {
        f"rtee.remote.{path.stem}": _imported(path)
        for path in (repository / "rtee" / "remote").glob("*.py")
    }
    assert len(imports) > 10
    TopologicalSorter(imports).prepare()  # raises CycleError


def _imported(path: Path) -> set[str]:
    found = ast.walk(ast.parse(path.read_text()))
    return {node.module for node in found if isinstance(node, ast.ImportFrom) and node.module}


# --- actions as messages


def test_actions_survive_the_network(library: ActionLibrary) -> None:
    kind = message_type("rtee_msgs/msg/Action")
    for action in library:
        assert action_of(kind.decode(kind.encode(action_fields(action)))) == action


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("fist", {"kind": "dance"}),
        ("fist", {"postures": []}),
        ("wave", {"postures": []}),
        ("Trig", {"name": "Trick"}),
        ("Trig", {"postures": []}),
        ("poke", {"postures": [{"name": ["a"], "position": np.zeros(2), "involved": []}]}),
        ("poke", {"postures": [{"name": ["a"], "position": np.zeros(1), "involved": ["b"]}]}),
    ],
)
def test_fields_that_are_no_action_are_refused(
    library: ActionLibrary, name: str, change: dict[str, object]
) -> None:
    action = library.find(name, ("index",) if name == "Trig" else ())
    kind = message_type("rtee_msgs/msg/Action")
    fields = kind.decode(kind.encode(action_fields(action)))
    with pytest.raises(MessageError):
        action_of(fields | change)


def test_requests_are_complete() -> None:
    assert {request.group for request in REQUESTS.values()} == {"hello", "stop", "control", "ask"}
    assert all(request.text.endswith(".") for request in REQUESTS.values())


def test_the_page_of_the_network_names_what_needs_no_payload(repository: Path) -> None:
    page = (repository / "docs/reference/network.md").read_text("utf-8")
    (sentence,) = re.findall(r"Only ([^.]*) may have no payload\.", page)
    empty = {
        f"{request.group}/{request.name}"
        for request in REQUESTS.values()
        if request.question.name.endswith("/Empty")
    }
    assert set(re.findall(r"`([^`]*)`", sentence)) == empty


def test_the_page_of_the_network_tells_what_hello_is_answered(repository: Path) -> None:
    page = " ".join((repository / "docs/reference/network.md").read_text("utf-8").split())
    answers: list[tuple[bytes, bool]] = []
    identities, token = Identities(), "0" * 32
    hello = REQUESTS["hello"]
    question = hello.question.encode({"client": "me", "what": token})
    asked = IncomingRequest(hello, question, lambda *answer: answers.append(answer), "")
    identities.came(token)
    identities.hello(asked, HERE)
    ((data, _),) = answers
    secret, role = hello.answer.decode(data)["text"].split(" ")
    assert len(bytes.fromhex(secret)) == 32
    assert "secret, in 64 hexadecimal digits, a blank, and the client's role" in page
    assert f"`{role}`" in page
