"""The same hand, written in other ways, gives the same pinches."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtee.extract.canonical import canonical
from rtee.hand.kinematics import Kinematics
from rtee.hand.load import load_hand
from rtee.hand.model import Hand

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config"

WAYS = (
    "all shuffled",
    "all renamed",
    "on a slack joint",
    "mirrored in y",
    "twice the size",
    "all at once",
)


@pytest.fixture(scope="module")
def benchmark() -> Mapping[str, Any]:
    """The benchmark, which writes the models and compares what is found."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return runpy.run_path(str(ROOT / "benchmarks" / "invariance.py"))
    finally:
        sys.path.remove(str(ROOT / "benchmarks"))


@pytest.mark.samples("wsg50")
@pytest.mark.parametrize("name", ["robotiq_3f", "heri_ii", "wsg50", "linkerhand_o6"])
def test_however_it_is_written_the_pinches_are_the_same(
    name: str, benchmark: Mapping[str, Any], tmp_path: Path
) -> None:
    hand, srdf = benchmark["loaded"](str(CONFIG / name))
    original = benchmark["pinches"](hand, 1)
    assert original
    for way in WAYS:
        model, changed = benchmark["variation"](hand, srdf, way, tmp_path)
        found = benchmark["pinches"](changed, 1, model.fingers)
        assert benchmark["differences"](original, found, model.scale) == {}, way


def test_the_comparison_sees_what_differs(benchmark: Mapping[str, Any]) -> None:
    hand, _ = benchmark["loaded"](str(CONFIG / "robotiq_3f"))
    original = benchmark["pinches"](hand, 1)
    assert benchmark["differences"](original, original, 1.02)
    assert set(benchmark["differences"](original, {}, 1.0).values()) == {"missing"}


@pytest.mark.parametrize("way", WAYS)
def test_the_canonical_form_moves_as_the_hand_does(
    way: str, benchmark: Mapping[str, Any], tmp_path: Path
) -> None:
    hand, srdf = benchmark["loaded"](str(CONFIG / "schunk_svh"))
    for given in (hand, benchmark["variation"](hand, srdf, way, tmp_path)[1]):
        form = canonical(given)
        random = np.random.default_rng(0)
        at = [form.hand.actuator_index(name) for name in given.actuator_names]
        for _ in range(3):
            u = random.uniform(given.lower, given.upper)
            there = np.empty(len(u))
            there[at] = u
            np.testing.assert_allclose(form.posture(there), u, atol=1e-6)
            one, other = between(given, u), between(form.hand, there)
            assert one.keys() == other.keys()
            for pair, length in one.items():
                assert other[pair] == pytest.approx(length * form.unit, abs=1e-9)


def between(hand: Hand, u: np.ndarray[Any, Any]) -> dict[frozenset[str], float]:
    """Return the distances of the origins of the fingers' last links [m], by their names."""
    poses = Kinematics(hand).placements(u)
    ends = {finger.links[-1]: poses[finger.links[-1]][:3, 3] for finger in hand.fingers}
    return {
        frozenset((a, b)): float(np.linalg.norm(ends[a] - ends[b]))
        for a in ends
        for b in ends
        if a != b
    }


def test_two_images_of_one_hand_have_one_canonical_form(
    benchmark: Mapping[str, Any], tmp_path: Path
) -> None:
    hand, srdf = benchmark["loaded"](str(CONFIG / "schunk_svh"))
    first = canonical(hand)
    changed = benchmark["variation"](hand, srdf, "mirrored in y", tmp_path)[1]
    second = canonical(changed)
    assert first.mirrored is not second.mirrored
    assert first.hand.actuator_names == second.hand.actuator_names
    assert first.hand.finger_names == second.hand.finger_names
    assert [*first.hand.urdf.joints] == [*second.hand.urdf.joints]


def test_symmetric_fingers_need_no_names() -> None:
    form = canonical(load_hand(CONFIG / "onrobot_3fg15"))
    assert sorted(form.hand.finger_names) == sorted(form.source.finger_names)
