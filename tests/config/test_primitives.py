"""The primitives in config/: found again they are the same, and measured hands have them too."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest
from extract.test_real_hands import extracted

from rtee.actions.store import primitive_changes, read_actions
from rtee.actions.types import Primitive
from rtee.extract.extraction import extract
from rtee.hand.load import load_hand

CONFIG = Path(__file__).resolve().parents[2] / "config"
STORED = [file.parent.name for file in CONFIG.glob("*/hand.yaml")]

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


def kinds(primitives: Iterable[Primitive]) -> set[tuple[str, tuple[str, ...]]]:
    return {(p.name, tuple(sorted(p.elements))) for p in primitives}


@pytest.mark.parametrize(
    ("name", "jobs"), [(name, 1 + i % 2) for i, name in enumerate(sorted(STORED))]
)
def test_found_again_they_are_the_same_files(name: str, jobs: int, tmp_path: Path) -> None:
    hand = load_hand(CONFIG / name)
    changes = primitive_changes(tmp_path, hand, extract(hand, jobs=jobs).primitives)
    stored = CONFIG / name / "actions" / "primitives"
    found = {path.name: text for path, text in changes.files.items()}
    assert found == {path.name: path.read_text() for path in stored.glob("*.yaml")}


@pytest.mark.parametrize(("name", "measured"), MEASURED.items())
def test_the_measured_hand_has_the_same(name: str, measured: str, shared: Path) -> None:
    stored = read_actions(load_hand(CONFIG / name), CONFIG / name / "actions")
    primitives = [action for action in stored if isinstance(action, Primitive)]
    assert kinds(primitives) == kinds(extracted(shared, measured).primitives)
