from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.messages.layout import JOINT_STATE, STAMP, JointStateEncoder, Template, joint_state_fields
from rtee.messages.typestore import typestore

STORE = typestore()
NAMES = st.lists(st.text("abcxyz_", min_size=1, max_size=12), max_size=12, unique=True)


@given(
    names=NAMES, frame=st.text("ab", max_size=5), wall=st.integers(0, 2**60), seed=st.integers(0)
)
def test_joint_states_are_the_bytes_of_rosbags(
    names: list[str], frame: str, wall: int, seed: int
) -> None:
    position, velocity, effort = np.random.default_rng(seed).normal(size=(3, len(names)))
    encoded = JointStateEncoder(names, frame).encode(wall, position, velocity, effort)
    store = STORE
    message = store.types["sensor_msgs/msg/JointState"](
        header=store.types["std_msgs/msg/Header"](
            stamp=store.types["builtin_interfaces/msg/Time"](
                sec=wall // 10**9, nanosec=wall % 10**9
            ),
            frame_id=frame,
        ),
        name=names,
        position=position,
        velocity=velocity,
        effort=effort,
    )
    assert encoded == bytes(store.serialize_cdr(message, "sensor_msgs/msg/JointState"))


def test_arrays_of_another_length_or_type_are_refused() -> None:
    encoder = JointStateEncoder(["a", "b"])
    with pytest.raises(ValueError, match="2 values"):
        encoder.encode(0, np.zeros(2), np.zeros(2), np.zeros(3))
    with pytest.raises(ValueError, match="2 values"):
        encoder.encode(0, np.zeros(2), np.zeros(2), np.zeros(2, dtype=np.float32))


def test_what_changes_must_be_given_in_order_and_with_its_length() -> None:
    fields = joint_state_fields(["a", "b"])
    with pytest.raises(ValueError, match="'position' is not in the order"):
        Template(JOINT_STATE, fields, ("velocity", "position"))
    template = Template(JOINT_STATE, fields, (STAMP, "velocity"))
    with pytest.raises(ValueError, match="bytes expected"):
        template.filled((bytes(8), bytes(17)))
