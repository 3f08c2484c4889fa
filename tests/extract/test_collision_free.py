from __future__ import annotations

from pathlib import Path

import numpy as np

from extract.models import box
from extract.test_collisions import gantry
from rtee.extract.collision_free import ClearSearch, SearchBudget
from rtee.extract.evidence import Inspector
from rtee.extract.goals import GoalFunction, PinchGoal
from rtee.extract.space import make_space, real_limits


def test_a_pose_goes_back_beyond_all_that_it_meets_there(tmp_path: Path) -> None:
    # A ball that touches a rail everywhere, at a post; just before it is another post.
    model = gantry(box((0.1, 0.2, 0.2), (0.545, 0, 0)))
    model.link("other", box((0.075, 0.2, 0.2), (0.4375, 0, 0)))
    model.joint("other_stands", "base", "other", kind="fixed")
    model.link("rail", box((2, 0.01, 0.01), (0, 0, -0.014)))
    model.joint("slide", "base", "rail", kind="prismatic", axis=(1, 0, 0))
    for post in ("posts", "other"):
        model.disable("rail", post)
    inspector = Inspector.of(model.finger("rail", "rail").load(tmp_path))
    scene, hand = inspector.scene, inspector.scene.hand
    checker = inspector.collisions.checker(range(3), [frozenset(("ball", "rail"))])
    space = make_space(hand, range(3), real_limits(hand))
    function = GoalFunction(scene, PinchGoal(scene, scene.tips["ball", "rail"]), space)
    search = ClearSearch(function, inspector.motion, checker, SearchBudget(pushes=1))
    start = hand.rest.copy()
    start[hand.actuator_index("x")] = 0.5
    assert [pair.links for pair in checker.at(start)] == [("posts", "ball")]
    found = search._push_out(space.coordinates(start))
    assert found is not None
    assert checker.at(function.stored(found)) == []
    assert function.touching(function.stored(found))
    assert np.isclose(function.stored(found)[hand.actuator_index("x")], 0.4 - 0.011, atol=0.002)
