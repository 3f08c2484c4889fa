"""Lower bounds on the distances of links, at many postures at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtee.extract.envelopes import Envelopes
from rtee.extract.scene import Scene
from rtee.hand.halton import halton
from rtee.hand.load import load_hand

CONFIG = Path(__file__).resolve().parents[2] / "config"


@pytest.mark.parametrize("name", ["robotiq_3f", "wsg50", "ability_hand"])
def test_links_are_never_nearer_than_their_envelopes(name: str) -> None:
    hand = load_hand(CONFIG / name)
    scene = Scene(hand)
    pairs = list(scene.pairs.values())
    envelopes = Envelopes(scene)
    places = halton(len(hand.actuators), 4)
    postures = [hand.lower + y * (hand.upper - hand.lower) for y in places]
    bounds = envelopes.gaps(postures, envelopes.ends(pairs), 0.05)
    assert bounds.max() > 0.01
    for u, found in zip(postures, bounds, strict=True):
        scene.place(u)
        with scene.fine():
            apart = np.maximum(scene.distances(pairs), 0.0)
        assert (found <= apart).all()
        # By themselves, postures are placed otherwise.
        alone = envelopes.gaps([u], envelopes.ends(pairs), np.inf)[0]
        assert (alone <= apart).all()
        np.testing.assert_allclose(alone[apart < 0.05], found[apart < 0.05], atol=1e-9)
