"""Values that programs keep: they compare, pickle, print in a line, and become JSON."""

from __future__ import annotations

import copy
import json
import math
import pickle
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rtee import errors
from rtee.actions.library import load_actions
from rtee.commands import CommandRecord, StreamSample
from rtee.messages.state import State
from rtee.sample import COLUMNS
from rtee.types import DeviceStatus, Event, Feedback, Lifecycle, Result
from rtee.values import Value


def a_state() -> State:
    columns = {name: np.array([0.5, math.nan]).astype(q.dtype) for name, q in COLUMNS.items()}
    return State(
        tick=7,
        stamp=1.0,
        wall_ns=3,
        names=("a", "b"),
        joint_names=("a", "b"),
        joint_position=np.zeros(2),
        channels={"d/pressure": np.ones(3)},
        **columns,
    )


VALUES = [
    a_state,
    lambda: Result("1", "Grasp", position={"a": 1.0}),
    lambda: Feedback("1", 0.5),
    lambda: Event("mark", "me", "here", 1.0),
    lambda: DeviceStatus("d", "kinematic", Lifecycle.ACTIVE),
    lambda: CommandRecord(3, 1.0, StreamSample("s", 1.0, 1.0, {}, {}, {"a": 1.0}, {"a": np.nan})),
    lambda: load_actions("schunk_svh").find("PinchTight", ("index", "thumb")),
]


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
@pytest.mark.parametrize(
    "make", VALUES, ids=["state", "result", "feedback", "event", "device", "command", "action"]
)
def test_a_value_can_be_kept(make: object) -> None:
    value = make()  # type: ignore[operator]
    assert isinstance(value, Value)
    assert value == make()  # type: ignore[operator]
    assert pickle.loads(pickle.dumps(value)) == value
    assert copy.deepcopy(value) == value
    assert len(repr(value)) <= 240
    assert "\n" not in repr(value)
    assert json.loads(json.dumps(value.to_dict(), allow_nan=False))


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
def test_another_value_differs() -> None:
    state = a_state()
    assert replace(state, position=np.array([0.5, 0.6])) != state
    assert replace(state, channels={}) != state
    assert Result("1", "Grasp") != Result("2", "Grasp")
    assert state.to_dict()["position"] == [0.5, None]
    assert Result("1", "Grasp", grasped=True).to_dict()["outcome"] == "held"


def every_error() -> Iterator[errors.RteeError]:
    texts = ("one", "two", "three")
    for kind in vars(errors).values():
        if not (isinstance(kind, type) and issubclass(kind, errors.RteeError)):
            continue
        for count in range(4):
            try:
                yield kind(*texts[:count])
            except TypeError:
                continue
            break
        else:
            raise AssertionError(kind)


def test_every_error_can_be_sent_to_another_process() -> None:
    for error in every_error():
        again = pickle.loads(pickle.dumps(error))
        assert again == error
        assert (str(again), vars(again)) == (str(error), vars(error))
    assert errors.NoHand("a") != errors.NoHand("b")
