"""Hands as environments of Gymnasium."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the extra gym is not installed")

import contextlib
import io

from gymnasium.utils.env_checker import check_env

from rtee.errors import ConfigError
from rtee.gym import HandEnv, Task

PAGE = Path(__file__).parents[1] / "docs" / "tutorials" / "train.md"


def test_gymnasium_finds_nothing_wrong() -> None:
    # Warnings are errors here.
    check_env(HandEnv("robotiq_2f_85", Task.REORIENT), skip_render_check=True)


def test_a_seed_gives_the_same_episode_bit_for_bit() -> None:
    env, random = HandEnv("schunk_svh", "lift"), np.random.default_rng(0)
    actions = random.uniform(-0.5, 0.5, (12, *env.action_space.shape))

    def episode(seed: int) -> list[dict[str, Any]]:
        seen = [env.reset(seed=seed)[0]]
        return seen + [env.step(action)[0] for action in actions]

    first, other, again = episode(5), episode(6), episode(5)
    for one, two in zip(first, again, strict=True):
        assert all(np.array_equal(one[key], two[key]) for key in one)
    assert not np.array_equal(first[-1]["object"], other[-1]["object"])


def test_what_is_not_grasped_falls() -> None:
    env = HandEnv("wsg50", "hold")
    env.reset(seed=1)
    steps, lost = 0, False
    while not lost:
        steps += 1
        _, reward, lost, _, info = env.step(np.array([-1.0]))
    assert 55 < steps < 90  # after two seconds
    assert reward == 0.0
    assert not info["success"]


def test_an_object_for_which_the_hand_has_no_room_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    HandEnv("wsg50", object="sphere:0.03")
    assert "overlaps" not in caplog.text
    HandEnv("wsg50", object="sphere:0.1")
    assert "wsg50: 'sphere:0.1' overlaps the open hand wherever it is put" in caplog.text


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"mass": np.nan}, "the mass of the object should be a finite number, not nan"),
        ({"mass": -1}, "the mass of the object should be greater than 0, not -1"),
        ({"mass": "100g"}, "the mass of the object should be a valid number, not '100g'"),
        ({"object": None}, "an object is a shape, such as sphere:0.03, not None"),
        ({"object": ""}, "'' is not an object"),
        ({"render_mode": "human"}, "draws nothing: render_mode is 'human'"),
    ],
)
def test_an_environment_that_makes_no_sense_is_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        HandEnv("wsg50", **given)


def test_numbers_of_numpy_are_masses() -> None:
    assert HandEnv("wsg50", mass=np.float32(0.2)).reset(seed=1)[1] == {"success": False}


@pytest.mark.parametrize("action", [[0.0, 0.0], [np.nan], 0.0, ["a"], None, [None], {}])
def test_an_action_without_sense_is_refused(action: Any) -> None:
    env = HandEnv("wsg50")
    with pytest.raises(ConfigError, match="reset"):
        env.step(np.array([0.0]))
    env.reset(seed=1)
    with pytest.raises(ConfigError, match="1 finite numbers"):
        env.step(action)


def test_there_are_three_tasks() -> None:
    with pytest.raises(ConfigError, match="hold, lift, reorient"):
        HandEnv("wsg50", "juggle")


def test_the_tutorial_is_as_written() -> None:
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    # Processes would import everything anew: the same in this one.
    code = "".join(text for kind, text in blocks if kind == "python").replace('"async"', '"sync"')
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(code, {})
    assert said.getvalue() == "".join(text for kind, text in blocks if not kind)
