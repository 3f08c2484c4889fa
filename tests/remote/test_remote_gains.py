"""`rtee gains` and `rtee info` on a running hand."""

from __future__ import annotations

import json
from collections.abc import Iterator

import anyio.from_thread
import pytest

from rtee.actions.library import ActionLibrary
from rtee.cli.status import gains, info
from rtee.errors import ConfigError
from rtee.hand.model import Hand

from .serving import Served, serving
from .test_remote_cli import run


@pytest.fixture
def served(hand: Hand, library: ActionLibrary) -> Iterator[Served]:
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, library)) as served,
    ):
        yield served


def test_gains_are_shown_with_their_values(served: Served) -> None:
    assert "time_constant" in run(gains)
    found = json.loads(run(gains, "--json"))
    (device,) = found["devices"].values()
    assert device["time_constant"] > 0.0


def test_what_has_no_such_gain_is_said(served: Served) -> None:
    with pytest.raises(ConfigError, match="has a gain kp; valid: time_constant"):
        run(gains, "--kp", "1")
    with pytest.raises(ConfigError, match="'near' has no gains; no device"):
        run(gains, "near", "--kp", "1")


def test_info_says_what_is_not_known(served: Served) -> None:
    said = run(info)
    assert "near" in said
    assert "unknown" in said
    assert "the stiffness of all actuators is not known" in said
    found = json.loads(run(info, "--json", "--at", "near=0.5"))
    assert found["actuators"][0]["stiffness"] is None
    assert found["posture"][0] == 0.5
    assert "expected" not in run(info, "--at", "near", status=2)
