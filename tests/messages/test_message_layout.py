from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtee.messages.layout import (
    ACTUATOR_STATE,
    JointStateEncoder,
    Parts,
    actuator_state_fields,
    stamp_bytes,
)
from rtee.messages.typestore import typestore

STORE = typestore()
NAMES = st.lists(st.text("abcxyz_", min_size=1, max_size=12), max_size=12, unique=True)


@settings(max_examples=60, deadline=None)
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


@pytest.mark.parametrize("count", [0, 1, 2, 3, 9, 20])
def test_the_joined_parts_are_the_encoded_message(count: int) -> None:
    names = [f"joint_{i}" for i in range(count)]
    fields = actuator_state_fields(names)
    cut = Parts(ACTUATOR_STATE, ACTUATOR_STATE.encode(fields))
    source = np.random.default_rng(count)
    for name in ("position", "velocity", "effort", "current", "temperature"):
        fields[name] = source.normal(size=count)
    fields["grasped"] = np.arange(count, dtype=np.int8) % 3 - 1
    fields["fresh"] = np.arange(count) % 2 == 0
    for name in ("position", "velocity", "effort", "current", "temperature", "grasped", "fresh"):
        cut.parts[cut.slots[name]] = fields[name].tobytes()
    fields["tick"] = 2**63 + count
    cut.parts[cut.slots["tick"]] = struct.pack("<Q", fields["tick"])
    fields["time"] = 12.5
    cut.parts[cut.slots["time"]] = struct.pack("<d", 12.5)
    fields["header"] = {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": ""}
    cut.parts[cut.slots["stamp"]] = stamp_bytes(5_000_000_007)
    assert b"".join(cut.parts) == ACTUATOR_STATE.encode(fields)
