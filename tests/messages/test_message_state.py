from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.errors import MessageError
from rtee.messages.codec import channel_fields, header
from rtee.messages.layout import stamp_bytes
from rtee.messages.requests import REQUESTS
from rtee.messages.state import (
    ACTUATOR_STATE,
    STATE,
    State,
    StateEncoder,
    actuator_state_fields,
    actuator_state_pieces,
    actuator_state_template,
    decode_state,
)
from rtee.sample import COLUMNS, FloatArray


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


def encode_state(given: State) -> bytes:
    """Encode a state field by field, as its definition says."""
    names, lengths, values = channel_fields(given.channels)
    return STATE.encode(
        {
            "header": header(given.wall_ns),
            "tick": given.tick,
            "time": given.stamp,
            "name": given.names,
            "joint": given.joint_names,
            "joint_position": given.joint_position,
            "opening": math.nan if given.opening is None else given.opening,
            "force": math.nan if given.force is None else given.force,
            "force_error": math.nan if given.force_error is None else given.force_error,
            "force_source": given.force_source,
            "channel": names,
            "channel_length": lengths,
            "channel_value": values,
            **{name: getattr(given, name) for name in COLUMNS},
        }
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
    assert encoder.encode(given_state, given_state.joint_position) == data
    assert encoder.encode(given_state, given_state.joint_position) == data
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


@pytest.mark.parametrize("count", [0, 1, 2, 3, 9, 20])
def test_actuator_states_are_the_encoded_message(count: int) -> None:
    names = [f"joint_{i}" for i in range(count)]
    record = state(count, 0, {}, seed=count)
    fields = actuator_state_fields(names)
    for name in fields.keys() - {"header", "tick", "time", "name"}:
        fields[name] = getattr(record, name)
    fields |= {"tick": record.tick, "time": record.stamp, "header": header(5_000_000_007)}
    pieces = (stamp_bytes(5_000_000_007), *actuator_state_pieces(record))
    encoded = actuator_state_template(names).filled(pieces)
    assert encoded == ACTUATOR_STATE.encode(fields)
