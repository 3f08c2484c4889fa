"""Grasps planned by a running hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import anyio.from_thread
import pytest

import rtee
import rtee.planning.question
from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, RequestRejected
from rtee.hand.load import load_hand
from rtee.hand.own_copy import copy_hand
from rtee.objects.shape import Table
from rtee.planning.plan import grasp_plan
from rtee.planning.question import LONGEST
from rtee.remote.blocking import BlockingHand

from .serving import serving


@pytest.fixture
def folder(tmp_path: Path, repository: Path) -> Path:
    copy_hand(repository / "config/robotiq_2f_85", tmp_path / "mine")
    return tmp_path / "mine"


@pytest.fixture
def remote(folder: Path) -> Iterator[BlockingHand]:
    """A gripper that runs, seen by a client."""
    hand = load_hand(folder)
    library = ActionLibrary.load(hand, folder / "actions")
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, library)),
        rtee.connect_blocking("mine") as remote,
    ):
        yield remote


def test_a_hand_plans_as_the_command_does(remote: BlockingHand, folder: Path) -> None:
    table = Table((0.0, 0.0, 1.0), -0.06)
    ranking = remote.grasp_plan("cylinder:0.02x0.1", mass=0.3, friction=0.7, top=2, table=table)
    here = grasp_plan(folder, "cylinder:0.02x0.1", mass=0.3, friction=0.7, table=table)
    assert ranking.plans == here.plans[:2]
    assert ranking.plans[0].table is not None
    assert ranking.plans[0].table[2][3] == pytest.approx(-0.06)
    assert (ranking.mass, ranking.friction, ranking.hand) == (0.3, 0.7, "mine")


@pytest.mark.heavy
def test_a_mesh_is_sent_to_the_hand(remote: BlockingHand, repository: Path) -> None:
    ranking = remote.grasp_plan(str(repository / "experiments/objects/wedge.stl"))
    assert ranking.object == "wedge.stl"
    assert ranking.plans


@pytest.mark.heavy
def test_the_hand_says_why_it_does_not_fit(remote: BlockingHand) -> None:
    with pytest.raises(RequestRejected, match="does not fit: width 140 mm"):
        remote.grasp_plan("sphere:0.07")


@pytest.mark.samples("cone*")
@pytest.mark.parametrize("obj", ["sphere:nan", "cone:1x1", "ball"])
def test_what_is_no_object_is_refused(remote: BlockingHand, obj: str) -> None:
    with pytest.raises(RequestRejected, match="is not an object"):
        remote.grasp_plan(obj)


def test_a_hand_reads_no_file_that_a_client_names(
    remote: BlockingHand, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = str(repository / "experiments/objects/wedge.stl")
    question = rtee.planning.question.Question(path)
    monkeypatch.setattr("rtee.remote.action_client.question_about", lambda *_, **__: question)
    with pytest.raises(RequestRejected, match="is not an object"):
        remote.grasp_plan(path)


def test_what_cannot_be_sent_is_said_before(remote: BlockingHand, tmp_path: Path) -> None:
    (tmp_path / "large.stl").write_bytes(bytes(LONGEST + 1))
    with pytest.raises(ConfigError, match="at most 60 kB"):
        remote.grasp_plan(str(tmp_path / "large.stl"))
    with pytest.raises(ConfigError, match="no such mesh"):
        remote.grasp_plan(str(tmp_path / "missing.stl"))
    with pytest.raises(ConfigError, match="finite and above 0"):
        remote.grasp_plan("sphere:0.02", mass=float("nan"))
