"""Clear poses keep a clearance from everything that they are not to touch."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise, product
from pathlib import Path

import numpy as np
import pytest

from extract.models import Model, box, sphere
from rtee.actions.action_files import read_actions
from rtee.actions.types import FARTHEST_CLEARANCE, Primitive
from rtee.extract.evidence import Inspector
from rtee.extract.extraction import extract
from rtee.extract.goals import TipEdge
from rtee.hand.load import load_hand
from rtee.hand.model import Hand

CONFIG = Path(__file__).resolve().parents[2] / "config"
HANDS = sorted(file.parent.name for file in CONFIG.glob("*/hand.yaml"))
STEPS = 60


def stored(hand: Hand) -> list[Primitive]:
    actions = read_actions(hand, CONFIG / hand.name / "actions")
    return [a for a in actions if isinstance(a, Primitive) and a.evidence]


@pytest.mark.samples("dagana", "linkerhand_o6", "robotiq_3f")
@pytest.mark.parametrize("name", HANDS)
def test_clear_poses_of_shipped_hands_keep_what_their_evidence_says(name: str) -> None:
    hand = load_hand(CONFIG / name)
    inspector = Inspector.of(hand)
    scene = inspector.scene
    for primitive in stored(hand):
        fingers = [hand.finger(f) for f in primitive.fingers]
        edges = [
            TipEdge((i, j), scene.tips[str(a.tip), str(b.tip)])
            for (i, a), (j, b) in combinations(enumerate(fingers), 2)
            if (str(a.tip), str(b.tip)) in scene.tips
        ]
        checker = inspector.checker(fingers, edges)
        parts = [finger.tip_links for finger in fingers]
        tips = {frozenset(p) for e in edges for p in product(*(parts[i] for i in e.ends))}
        moving = {hand.actuator_index(a) for finger in fingers for a in finger.actuators}
        asked = {pair.number for pair in checker.pairs}
        until_closed = [
            pair
            for pair in inspector.collisions.checker(moving, tips).pairs
            if pair.number not in asked
        ]
        for posture, evidence in zip(primitive.postures, primitive.evidence, strict=True):
            if not evidence.clear or not evidence.path_clear:
                continue
            assert evidence.clearance is not None
            u = np.array([posture.position[a] for a in hand.actuator_names])
            for t in np.linspace(0.0, 1.0, STEPS):
                scene.place(hand.rest + t * (u - hand.rest))
                for pair in checker.pairs:
                    if scene.distance(pair) < evidence.clearance:
                        gap = scene.exact_distance(pair)
                        margin = min(evidence.clearance, checker.margin(pair))
                        assert gap >= 0.9 * margin, (primitive.elements, pair.links, t)
                # What would touch first in reality: nothing before any two tips are near.
                if min(scene.exact_distance(edge.tips) for edge in edges) <= hand.clearance:
                    continue
                for pair in until_closed:
                    margin = 0.25 * checker.margin(pair)
                    if scene.distance(pair) < margin:
                        gap = scene.exact_distance(pair)
                        assert gap >= 0.9 * margin, (primitive.elements, pair.links, t)


@pytest.mark.samples("robotiq_*", "linkerhand_o6", "schunk_svh")
@pytest.mark.parametrize("name", HANDS)
def test_what_comes_first_keeps_a_millimetre_or_says_why_not(name: str) -> None:
    hand = load_hand(CONFIG / name)
    narrow = Inspector.of(hand).collisions.narrow
    for primitive in stored(hand):
        first = primitive.evidence[0]
        if first.clear and first.path_clear and not narrow:
            assert first.clearance is not None
            assert 0.25e-3 <= first.clearance <= FARTHEST_CLEARANCE


def test_clear_ones_with_their_full_room_come_first(tmp_path: Path) -> None:
    hand = narrowed(tmp_path)
    for before, after in pairwise(extract(hand).primitives[-1].evidence):
        assert (before.clearance or 0.0) >= (after.clearance or 0.0)


def narrowed(tmp_path: Path) -> Hand:
    """Return two balls on rails that meet between a wall and a post."""
    model = Model().link("post", box((0.01, 0.01, 0.01), (0.0165, 0.2, 0)))
    model.joint("stand", "base", "post", kind="fixed")
    for side, sign in (("left", 1.0), ("right", -1.0)):
        model.link(side, sphere(0.01), box((0.002, 0.2, 0.002), (sign * 0.01, 0.1, 0)))
        model.joint(
            f"{side}_x",
            "base",
            side,
            kind="prismatic",
            axis=(1, 0, 0),
            xyz=(-0.03 * sign, 0, 0),
            limits=(-0.04, 0.04),
        )
        model.finger(side, side)
    return model.load(tmp_path)


@pytest.mark.parametrize("clearance", [0.0, 0.001, 0.003])
def test_the_clearance_is_settable(tmp_path: Path, clearance: float) -> None:
    hand = replace(narrowed(tmp_path), clearance=clearance)
    pinch = next(p for p in extract(hand).primitives if p.evidence)
    first = pinch.evidence[0]
    assert first.clear
    assert first.path_clear
    assert first.clearance is not None
    assert first.clearance >= clearance - 1e-5
