"""The same goal ends at the same place in kinematics, in dynamics, and on the emulated wire."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import anyio
import numpy as np
import pytest

pytest.importorskip("mujoco")

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from experiments.kinematic import KinematicPlay
from experiments.wires import on_the_wire, wired
from rtee.actions.build import generic
from rtee.actions.library import ActionLibrary
from rtee.drivers.emulators import emulator_names
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.hand.catalog import hand_names
from rtee.hand.model import Hand
from rtee.running.run import PreparedHand
from rtee.testing import simulated_time
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Named

TOLERANCE = 0.02
RATE = 100.0
HANDS = hand_names()


def add_goal(hand: Hand, library: ActionLibrary, share: float = 0.2) -> None:
    """Add a posture on the way to which nothing touches, as an action."""
    upper = np.where(np.isfinite(hand.upper), hand.upper, 1.0)
    goal = hand.rest + share * (upper - hand.rest)
    values = dict(zip(hand.actuator_names, goal.tolist(), strict=True))
    library.add(generic(hand, "a_little", values))


def hasty(prepared: PreparedHand) -> PreparedHand:
    """Let the emulated device home quickly: nine fingers, one after the other."""
    (device,) = prepared.devices
    options = {**device.spec.options, "emulator": {"haste": 20.0}}
    return replace(prepared, devices=(replace(device, spec=replace(device.spec, options=options)),))


@pytest.fixture(scope="module")
def hands() -> dict[str, PreparedHand]:
    found = {name: wired(name, RATE) for name in HANDS}
    found["schunk_svh"] = hasty(found["schunk_svh"])
    for prepared in found.values():
        add_goal(prepared.hand, prepared.library)
    return found


async def wired_end(prepared: PreparedHand) -> np.ndarray:
    async with on_the_wire(prepared, None) as hand:
        result = await hand.do(Goal(Named("a_little"), goal_id="a_little"))
        return np.array([result.position[name] for name in prepared.hand.actuator_names])


def end_of(headless: HeadlessHand) -> np.ndarray:
    result = headless.do(Goal(Named("a_little")))
    assert result.reached, result
    headless.wait(0.3)
    return np.array(headless.simulation.position)


def test_every_hand_has_emulated_devices(hands: dict[str, PreparedHand]) -> None:
    for prepared in hands.values():
        assert {device.spec.driver for device in prepared.devices} <= set(emulator_names())


@pytest.mark.samples("robotiq_2f_85", "schunk_svh", "qb_softhand", "wsg50", "robotiq_3f")
@pytest.mark.timeout(150)
@pytest.mark.parametrize("name", HANDS)
def test_the_same_goal_ends_at_the_same_place(name: str, hands: dict[str, PreparedHand]) -> None:
    prepared = hands[name]
    hand, library, settings = prepared.hand, prepared.library, prepared.settings
    play = KinematicPlay(hand, settings.period)
    kinematic = end_of(HeadlessHand(hand, library, settings, play))
    simulation = make_simulation(hand, SimOptions(), hand.actuator_names, settings.period)
    dynamic = end_of(HeadlessHand(hand, library, settings, simulation))
    assert dynamic == pytest.approx(kinematic, abs=TOLERANCE)
    # On simulated time: a busy computer would miss deadlines of its devices.
    backend, options = simulated_time()
    emulated = anyio.run(wired_end, prepared, backend=backend, backend_options=options)
    assert emulated == pytest.approx(kinematic, abs=TOLERANCE)
    assert emulated == pytest.approx(dynamic, abs=TOLERANCE)
