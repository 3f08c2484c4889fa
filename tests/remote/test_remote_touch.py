"""Touch on the network: asked for once, and as it comes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import anyio
import numpy as np
import pytest

from rtee.actions.library import ActionLibrary
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.model import Hand
from rtee.remote.client import connect
from rtee.sample import ActuatorState
from rtee.touch import TouchReading, TouchSensor, TouchState

from .serving import serving

pytestmark = pytest.mark.anyio

PAD = TouchSensor("pad", 2, link="thumb_tip", position=np.zeros((2, 3)), normal=np.eye(3)[:2])


def feeling(driver: KinematicDriver) -> Callable[[list[float]], None]:
    """Give a driver that runs touch sensors; return what has them measure something."""
    sense = driver.sense
    driver.capabilities = replace(driver.capabilities, touch=(PAD,))
    reading: list[TouchReading | None] = [None]

    async def feel() -> ActuatorState:
        return replace(await sense(), touch=reading[0])

    driver.sense = feel  # type: ignore[method-assign]

    def press(values: list[float]) -> None:
        reading[0] = TouchReading(np.array(values), time.monotonic())

    return press


async def test_a_client_asks_for_touch_and_follows_it(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, connect(hand.name) as remote:
        assert await remote.touch_state() == {}
        press = feeling(served.driver)
        found: list[TouchState] = []

        async def follow() -> None:
            async for state in remote.touch_states():
                found.append(state)
                if len(found) == 5:
                    return

        async with anyio.create_task_group() as group:
            group.start_soon(follow)
            for count in range(2000):
                press([0.5, float(count)])
                await anyio.sleep(0.01)
                if len(found) == 5:
                    break
        assert [state.values[0] for state in found] == [0.5] * 5
        counts = [state.values[1] for state in found]
        assert counts == sorted(set(counts)), "each reading once, in order"
        assert found[-1].sensors[0].finger == "thumb", "where they are was asked for"
        assert found[-1].sensors[0].placed
        [state] = (await remote.touch_state()).values()
        assert state.of("pad")[0] == 0.5
        [felt] = (await remote.state()).channels.values()
        assert felt[1] >= 0.5, "the thumb feels it"
