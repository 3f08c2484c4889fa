"""The primitives in config/: found again they are the same, and measured hands have them too."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from extract.test_real_hands import extracted

from rtee.actions.action_files import primitive_changes, read_actions
from rtee.actions.types import Primitive
from rtee.extract.extraction import extract
from rtee.hand.load import load_hand
from rtee.hand.model import Hand

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


LARGE = (
    *("ability_hand", "allegro", "amazing_hand", "inspire_rh56", "leap_hand", "linkerhand_l10"),
    *("qb_softhand", "schunk_svh"),
)
"""Hands that take five seconds and more; `linkerhand_o6` and `robotiq_3f` stand for them."""


def kinds(primitives: Iterable[Primitive]) -> set[tuple[str, tuple[str, ...]]]:
    return {(p.name, tuple(sorted(p.elements))) for p in primitives}


SAME_BYTES = platform.machine() in ("x86_64", "AMD64")
"""Whether this architecture is the one on which files are the same to the byte."""

LEAST = 0.99
"""Elsewhere, depths are at least this share of the stored ones."""


DEAR = ("dagana", "heri_ii")
"""Hands, measured ones with meshes, of which `robotiq_3f` is another."""


def marks(name: str) -> list[pytest.MarkDecorator]:
    return [pytest.mark.heavy] if name in LARGE or name in DEAR else []


@pytest.mark.parametrize(
    ("name", "jobs"),
    [pytest.param(name, 1 + i % 2, marks=marks(name)) for i, name in enumerate(sorted(STORED))],
)
def test_found_again_they_are_the_same(
    name: str, jobs: int, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    hand = load_hand(CONFIG / name)
    found = extract(hand, jobs=jobs).primitives
    rule = "the same bytes" if SAME_BYTES else f"{LEAST:.0%} of each depth"
    record_property("rule", f"{rule}, on {platform.machine()}")
    if SAME_BYTES:
        changes = primitive_changes(tmp_path, hand, found)
        stored = CONFIG / name / "actions" / "primitives"
        written = {path.name: text for path, text in changes.files.items()}
        assert written == {path.name: path.read_text() for path in stored.glob("*.yaml")}, rule
    else:
        assert_as_deep(hand, found, rule)


@pytest.mark.heavy
def test_the_rule_of_other_architectures_holds_here_too() -> None:
    hand = load_hand(CONFIG / "robotiq_3f")
    assert_as_deep(hand, extract(hand).primitives, "both rules")


def assert_as_deep(hand: Hand, found: Iterable[Primitive], rule: str) -> None:
    """Check that the stored primitives are found, and as deep."""
    stored = {
        (a.name, a.elements): a
        for a in read_actions(hand, CONFIG / hand.name / "actions")
        if isinstance(a, Primitive)
    }
    again = {(p.name, p.elements): p for p in found}
    assert again.keys() == stored.keys(), rule
    for key, primitive in stored.items():
        for before, after in zip(primitive.evidence, again[key].evidence, strict=False):
            assert after.depth >= LEAST * before.depth, (rule, key)


@pytest.mark.parametrize(
    ("name", "measured"),
    [pytest.param(name, measured, marks=marks(name)) for name, measured in MEASURED.items()],
)
def test_the_measured_hand_has_the_same(name: str, measured: str, shared: Path) -> None:
    stored = read_actions(load_hand(CONFIG / name), CONFIG / name / "actions")
    primitives = [action for action in stored if isinstance(action, Primitive)]
    assert kinds(primitives) == kinds(extracted(shared, measured).primitives)
