from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.errors import MessageError
from rtee.messages.requests import REQUESTS
from rtee.messages.state import STATE, State, StateEncoder, decode_state, encode_state
from rtee.types import FloatArray


def state(n: int, m: int, channels: Mapping[str, FloatArray], seed: int = 0) -> State:
    random = np.random.default_rng(seed)
    return State(
        tick=7,
        stamp=12.5,
        wall_ns=1_700_000_000_123_456_789,
        names=tuple(f"actuator_{i}" for i in range(n)),
        position=random.random(n),
        velocity=random.random(n),
        effort=np.full(n, np.nan),
        current=random.random(n),
        temperature=random.random(n),
        grasped=np.full(n, -1, dtype=np.int8),
        fresh=random.random(n) > 0.5,
        reference_position=random.random(n),
        reference_velocity=random.random(n),
        reference_effort=np.full(n, np.inf),
        joint_names=tuple(f"joint_{i}" for i in range(m)),
        joint_position=random.random(m),
        channels=channels,
    )


_CHANNELS = st.dictionaries(
    st.sampled_from(["a/p", "b", "longer/name"]),
    st.lists(st.floats(allow_nan=False), max_size=4).map(np.array),
)


@given(n=st.integers(0, 5), m=st.integers(0, 6), channels=_CHANNELS)
def test_both_encoders_agree_and_round_trip(
    n: int, m: int, channels: Mapping[str, FloatArray]
) -> None:
    given_state = state(n, m, channels)
    data = encode_state(given_state)
    encoder = StateEncoder(given_state.names, given_state.joint_names)
    assert encoder.encode(given_state) == data
    assert encoder.encode(given_state) == data
    back = decode_state(data)
    assert encode_state(back) == data
    assert back.joints == given_state.joints
    assert back.positions == given_state.positions


def test_arrays_of_different_lengths_are_refused() -> None:
    fields = STATE.decode(encode_state(state(2, 1, {"a": np.zeros(2)})))
    with pytest.raises(MessageError, match="different lengths"):
        decode_state(STATE.encode(fields | {"effort": [1.0]}))
    with pytest.raises(MessageError, match="channels"):
        decode_state(STATE.encode(fields | {"channel_length": [7]}))


def test_every_request_has_a_key_of_its_own() -> None:
    keys = {request.key("svh") for request in REQUESTS.values()}
    assert len(keys) == len(REQUESTS)
    assert REQUESTS["stop"].key("*") == "rtee/*/stop/stop"
