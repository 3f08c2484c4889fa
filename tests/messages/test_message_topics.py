from __future__ import annotations

import pytest

from rtee.messages import message_type
from rtee.messages.topics import ROBOT_DESCRIPTION, TYPES, log_topic, network_key


def test_names() -> None:
    assert log_topic("svh", "joint_states") == "/svh/joint_states"
    assert log_topic("svh", ROBOT_DESCRIPTION) == "/robot_description"
    assert network_key("svh", "goals") == "rtee/svh/goals"


@pytest.mark.parametrize("name", sorted(TYPES))
def test_every_topic_has_a_type(name: str) -> None:
    assert message_type(TYPES[name]).name == TYPES[name]
