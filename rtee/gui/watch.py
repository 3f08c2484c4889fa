"""One watch of a running hand for all windows: states, status, events, touch, and history."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import anyio
import numpy as np

from rtee.errors import RteeError, first_error
from rtee.gui.history import LONGEST, StateHistory, TouchHistory
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.objects.description import OBJECT_POSE, ObjectDescription
from rtee.remote.client import RemoteHand, connect
from rtee.remote.model import model_of
from rtee.remote.truth import Truth

_STATE_RATE: Final = 100.0
"""Rate of received states [Hz]: enough for smooth lines in the plots."""

_PERIOD: Final = 1 / 30
"""Time between two polls for states while a window is open [s]: looks smooth."""

_UNWATCHED_PERIOD: Final = 0.25
"""Time between two polls without an open window [s]: states only fill the plots' history."""

_UNWATCHED_STEP: Final = 5
"""While no window is open, every fifth state goes into the history."""

_STATUS_PERIOD: Final = 0.5
"""Time between two requests for the status [s]."""

AGAIN: Final = 0.5
"""Time between two attempts to connect [s]: short enough to look immediate."""


def first_message(errors: BaseExceptionGroup[BaseException]) -> str:
    """Return the message of the first `RteeError`; raise ``errors`` if it has other exceptions."""
    if (error := first_error(errors)) is None:
        raise errors
    return str(error)


class Watch:
    """Watches one hand until cancelled, and searches for it again after its loss.

    Attributes:
        name: The hand's name; ``None`` for the only one at the endpoint.
        truth: The known state of the hand.
        hand: The hand's model, once connected.
        history: The newest states.
        touched: The newest readings of the touch sensors.
        described: The simulated object in the hand.
        watched: Number of windows that show the hand.
    """

    def __init__(self, name: str | None, endpoint: str | None) -> None:
        self.name, self._endpoint = name, endpoint
        self.truth = Truth(name or "")
        self.hand: Hand | None = None
        self.history: StateHistory | None = None
        self.touched = TouchHistory()
        self.described: ObjectDescription | None = None
        self.watched = 0
        self._connected = anyio.Event()

    async def model(self) -> Hand:
        """Wait for the connection and return the hand's model."""
        await self._connected.wait()
        assert self.hand is not None  # noqa: S101 - set before the event
        return self.hand

    async def run(self) -> None:
        """Watch the hand until cancelled."""
        while True:
            try:
                async with connect(
                    self.name, endpoint=self._endpoint, client="gui-watch"
                ) as remote:
                    await self._follow(remote)
            except RteeError as error:
                self.truth.on_gone(str(error))
            except BaseExceptionGroup as errors:  # from the tasks below
                self.truth.on_gone(first_message(errors))
            if self._connected.is_set():  # otherwise, windows wait for this one
                self._connected = anyio.Event()
            await anyio.sleep(AGAIN)

    async def _follow(self, remote: RemoteHand) -> None:
        hand = await model_of(remote)
        if (
            self.history is None
            or self.hand is None
            or (self.hand.actuator_names, self.hand.joint_names)
            != (hand.actuator_names, hand.joint_names)
        ):
            self.history = StateHistory(len(hand.actuators), len(hand.joints))
        self.hand, self.described, self.touched = hand, None, TouchHistory()
        self.truth.hand, self.truth.state = remote.name, None
        self.truth.on_status(await remote.status())
        async with anyio.create_task_group() as tasks:
            for work in (self._states, self._results, self._events, self._touch, self._object):
                tasks.start_soon(work, remote)
            self._connected.set()
            while True:
                status = await remote.status()
                self.truth.on_status(status)
                self.history.on_goal(status.goal_id, status.action)
                await anyio.sleep(_STATUS_PERIOD)

    async def _results(self, remote: RemoteHand) -> None:
        async for result in remote.results():
            self.truth.on_result(result)
            if self.history is not None:
                self.history.on_result(result)

    async def _events(self, remote: RemoteHand) -> None:
        async for event in remote.events():
            self.truth.on_event(event)

    async def _object(self, remote: RemoteHand) -> None:
        """Request the simulated object once its pose is among the channels of the states."""
        while self.described is None:
            await anyio.sleep(_STATUS_PERIOD)
            channels: Sequence[str] = list(getattr(self.truth.state, "channels", ()))
            if any(name.endswith(f"/{OBJECT_POSE}") for name in channels):
                self.described = await remote.object_description()

    async def _touch(self, remote: RemoteHand) -> None:
        async for state in remote.touch_states():
            self.touched.add(state)

    async def _states(self, remote: RemoteHand) -> None:
        # Keep as many states as the plots show, even if drawing is delayed for that long.
        most = round(_STATE_RATE * LONGEST)
        async with remote.collected_states(_STATE_RATE, most) as states:
            while True:
                await anyio.sleep(_PERIOD if self.watched else _UNWATCHED_PERIOD)
                for state in states.drain(1 if self.watched else _UNWATCHED_STEP):
                    self._receive(state)

    def _receive(self, state: State) -> None:
        assert self.hand is not None  # noqa: S101 - set before states are requested
        assert self.history is not None  # noqa: S101
        names = self.hand.joint_names
        if state.joint_names != names:  # the hand may order them differently from the model here
            by_name = state.joints
            position = np.array([by_name.get(name, math.nan) for name in names])
            state = replace(state, joint_names=names, joint_position=position)
        self.truth.on_state(state)
        self.history.add(state, self.hand.transmission.velocities(state.position, state.velocity))
