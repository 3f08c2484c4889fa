"""A whole hand on the kinematic driver, its time moved by hand."""

from __future__ import annotations

import pytest

from rtee.hand.model import Hand
from rtee.types import Goal, Lifecycle, Named

from .hands import NAMES, running

pytestmark = pytest.mark.anyio


async def test_first_reference_is_the_measured_pose(hand: Hand) -> None:
    start = {"index_base": 0.7, "thumb_base": -0.3, "thumb_slide": 0.02}
    async with running(hand, start=start) as rig:
        await rig.run(0.1)
        sent = [plant.target for plant in rig.driver.plants]
        assert sent == [0.7, 0.0, -0.3, 0.02]
        assert [plant.position for plant in rig.driver.plants] == [0.7, 0.0, -0.3, 0.02]
        assert rig.loop.devices["dummy"].lifecycle is Lifecycle.ACTIVE


async def test_a_goal_may_come_before_the_first_tick(hand: Hand) -> None:
    async with running(hand, ticks=0) as rig:
        assert (await rig.do("Trig", "index")).reached


async def test_goal_is_reached(hand: Hand) -> None:
    async with running(hand) as rig:
        result = await rig.do("Trig", "index")
        assert result.reached
        assert not any((result.stalled, result.grasped, result.aborted, result.timed_out))
        assert result.position["index_base"] == pytest.approx(1.5, abs=0.01)
        progress = [f.progress for f in rig.watcher.feedback]
        assert progress == sorted(progress)
        assert progress[0] == 0.0
        assert progress[-1] == 1.0
        assert set(result.position) == set(NAMES)
        assert rig.watcher.goals[0][0] == Goal(Named("Trig", ("index",)), goal_id=result.goal_id)
