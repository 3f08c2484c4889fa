"""The primitives in config/: found again they are the same, and measured hands have them too."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest
from extract.test_real_hands import extracted

from rtee.actions.store import read_actions, write_primitives
from rtee.actions.types import Primitive
from rtee.extract.extraction import extract
from rtee.hand.load import load_hand

CONFIG = Path(__file__).resolve().parents[2] / "config"

MEASURED = {
    "dagana": "dagana",
    "heri_ii": "heri_II",
    "onrobot_3fg15": "onrobot_3fg15",
    "qb_softhand": "qbhand",
    "robotiq_2f_140": "robotiq_2f_140",
    "robotiq_2f_85": "robotiq_2f_85",
    "robotiq_3f": "robotiq_3f",
    "schunk_svh": "schunk",
}


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*.yaml"))}


def kinds(primitives: Iterable[Primitive]) -> set[tuple[str, tuple[str, ...]]]:
    return {(p.name, tuple(sorted(p.elements))) for p in primitives}


@pytest.mark.parametrize("name", ["dagana", "robotiq_2f_85", "robotiq_2f_140"])
def test_found_again_they_are_the_same_files(name: str, tmp_path: Path) -> None:
    hand = load_hand(CONFIG / name)
    write_primitives(tmp_path, hand, extract(hand).primitives)
    assert files(tmp_path / "primitives") == files(CONFIG / name / "actions" / "primitives")


@pytest.mark.parametrize(("name", "measured"), MEASURED.items())
def test_the_measured_hand_has_the_same(name: str, measured: str, shared: Path) -> None:
    stored = read_actions(load_hand(CONFIG / name), CONFIG / name / "actions")
    primitives = [action for action in stored if isinstance(action, Primitive)]
    assert kinds(primitives) == kinds(extracted(shared, measured).primitives)
