from __future__ import annotations

from pathlib import Path

import numpy as np

from rtee.extract.couplings import Couplings
from rtee.extract.space import widened_limits
from rtee.hand.load import load_hand, load_model


def test_tables_agree_with_the_expressions_kinks_and_all() -> None:
    hand = load_hand("heri_ii")
    assert not hand.transmission.linear
    couplings = Couplings(hand)
    for lower, upper in ((hand.lower, hand.upper), widened_limits(hand)):
        for u in np.random.default_rng(3).uniform(lower, upper, (40, len(lower))):
            np.testing.assert_allclose(couplings.joints(u), hand.transmission.joints(u), atol=3e-5)


def test_tables_of_smooth_expressions_are_accurate(shared: Path) -> None:
    folder = shared / "hands" / "heri_II"
    hand = load_model(folder / "heri_II.urdf", folder / "heri_II.srdf")
    couplings = Couplings(hand)
    for u in np.random.default_rng(3).uniform(hand.lower, hand.upper, (40, len(hand.lower))):
        np.testing.assert_allclose(couplings.joints(u), hand.transmission.joints(u), atol=1e-8)
        np.testing.assert_allclose(couplings.slope(u), hand.transmission.jacobian(u), atol=1e-5)


def test_linear_couplings_are_exact() -> None:
    hand = load_hand("schunk_svh")
    couplings = Couplings(hand)
    u = np.random.default_rng(4).uniform(hand.lower, hand.upper)
    np.testing.assert_array_equal(couplings.joints(u), hand.transmission.joints(u))
    np.testing.assert_array_equal(couplings.slope(u), hand.transmission.jacobian(u))
