"""Tests of an application, for `pytest examples/test_picking.py`; they need no device."""

import rtee
from rtee.testing.simulated import StartSimulatedHand


def test_it_holds(rtee_simulated_hand: StartSimulatedHand) -> None:
    hand = rtee_simulated_hand("robotiq_2f_85", object="50mm")
    assert hand.grasp("50mm").outcome is rtee.Outcome.HELD


def test_it_notices_that_nothing_is_there(rtee_simulated_hand: StartSimulatedHand) -> None:
    hand = rtee_simulated_hand("robotiq_2f_85")
    assert hand.grasp("50mm").outcome is rtee.Outcome.EMPTY


def test_it_notices_a_part_that_is_pulled_out(rtee_simulated_hand: StartSimulatedHand) -> None:
    hand = rtee_simulated_hand("robotiq_2f_85", object="50mm")
    hand.grasp("50mm")
    hand.take_away()
    hand.wait(1.0)
    assert "grasp_lost" in [event.kind for event in hand.events]
