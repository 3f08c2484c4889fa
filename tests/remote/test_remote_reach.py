"""Grasps of planners, reached and done by a running hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import anyio.from_thread
import numpy as np
import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, RequestRejected
from rtee.hand.load import load_hand
from rtee.hand.own_copy import copy_hand
from rtee.planning.grasp_solution import WantedContact
from rtee.remote.blocking import BlockingHand

from .serving import serving

POSE = np.eye(4)


@pytest.fixture
def remote(tmp_path: Path, repository: Path) -> Iterator[BlockingHand]:
    """A gripper that runs, seen by a client."""
    copy_hand(repository / "config/robotiq_2f_85", tmp_path / "mine")
    hand = load_hand(tmp_path / "mine")
    library = ActionLibrary.load(hand, tmp_path / "mine" / "actions")
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, library)),
        rtee.connect_blocking("mine") as remote,
    ):
        yield remote


def test_a_pose_and_a_width_are_done_in_two_stages(remote: BlockingHand) -> None:
    reached = remote.reach(width=0.03, pose=POSE)
    assert (reached.hand, reached.action) == ("mine", "PinchTight")
    opened = remote.grasp_at(reached, stage="pre_grasp")
    assert opened.reached
    assert opened.position == pytest.approx(reached.pre_grasp, abs=0.01)
    closed = remote.grasp_at(reached, stage="grasp")
    assert closed.opening is not None
    assert closed.opening < 0.03, "nothing is between the fingers"


def test_contacts_are_done_without_leaving_an_action(remote: BlockingHand) -> None:
    before = [action.name for action in remote.actions()]
    reached = remote.reach(width=0.03, pose=POSE)
    palm = np.linalg.inv(np.array(reached.palm_pose))
    points = [(palm @ [-0.005, y, 0.0, 1.0])[:3] for y in (0.015, -0.015)]
    contacts = [WantedContact(tuple(map(float, point))) for point in points]
    found = remote.reach(contacts)
    assert max(abs(r.distance) for r in found.residuals) < 1e-3
    assert found.posture == pytest.approx(reached.posture, abs=0.02)
    with pytest.raises(ConfigError, match="a force needs a width"):
        remote.grasp_at(found, force=10.0)
    result = remote.grasp_at(np.array(points))
    assert result.reached
    assert result.position == pytest.approx(found.posture, abs=0.01)
    assert [action.name for action in remote.actions()] == before


@pytest.mark.heavy
def test_a_grasp_that_meets_the_object_is_refused(remote: BlockingHand) -> None:
    before = remote.state().position
    clear = remote.reach(width=0.03, pose=POSE, object="box:0.03x0.03x0.06")
    assert clear.collisions == ()
    met = remote.reach(width=0.03, pose=POSE, object="box:0.4x0.02x0.02", object_pose=POSE)
    assert {each.links[1] for each in met.collisions} == {"object"}
    with pytest.raises(ConfigError, match=r"has collisions: .* mm inside of object"):
        remote.grasp_at(met)
    assert remote.state().position == pytest.approx(before)
    assert remote.grasp_at(met, stage="pre_grasp", despite_collisions=True).reached
    with pytest.raises(RequestRejected, match="is not an object; write"):
        remote.reach(width=0.03, pose=POSE, object="../secret.stl")
    with pytest.raises(ConfigError, match="the object's pose is 4 by 4"):
        remote.reach(width=0.03, pose=POSE, object="sphere:0.01", object_pose=np.eye(3))


def test_what_cannot_be_reached_is_refused_with_the_reason(remote: BlockingHand) -> None:
    with pytest.raises(RequestRejected, match=r"grasps 300\.0 mm; the nearest"):
        remote.reach(width=0.3, pose=POSE)
    with pytest.raises(RequestRejected, match="cannot be reached"):
        remote.grasp_at([[0.5, 0.1, 0.0], [0.5, -0.1, 0.0]])
    with pytest.raises(ConfigError, match="give contacts, or a gripper's pose and a width"):
        remote.reach()
    with pytest.raises(ConfigError, match="contacts already name their fingers"):
        remote.reach([[0, 0, 0], [0, 0, 1]], width=0.1)
    with pytest.raises(ConfigError, match="three numbers each"):
        remote.reach([[0, 0], [0, 1]])
    with pytest.raises(ConfigError, match="a pose is 4 by 4"):
        remote.reach(width=0.03, pose=np.eye(3))
    with pytest.raises(RequestRejected, match="not a rigid transform"):
        remote.reach(width=0.03, pose=np.ones((4, 4)))
    contacts = [WantedContact((0.0, 0.0, 0.1), (1.0, 0.0, 0.0)), WantedContact((0.0, 0.05, 0.1))]
    with pytest.raises(ConfigError, match="give a normal for each contact"):
        remote.reach(contacts)
