"""One hand as different people would describe it: the same primitives, as deep."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import pytest
from hand.robots import Robot, arm, box

from rtee.extract.extraction import extract
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.hand.subtree import Subtree

FINGERS = {"thumb": (-0.03, 0.0, 1.0), "index": (0.03, -0.02, -1.0), "middle": (0.03, 0.02, -1.0)}
"""Place on the palm [m] and sense of turning of each finger."""


def hand(
    robot: Robot | None = None,
    prefix: str = "",
    *,
    scale: float = 1.0,
    mirror: float = 1.0,
    axis: float = 1.0,
    order: tuple[str, ...] = tuple(FINGERS),
) -> Robot:
    """Return a palm with a thumb and two fingers of a joint each."""
    robot = robot or Robot("hand")
    s = scale
    robot.link(f"{prefix}palm", box(0.08 * s, 0.09 * s, 0.02 * s))
    for name in order:
        x, y, sense = FINGERS[name]
        width = 0.03 if name == "thumb" else 0.015
        robot.link(f"{prefix}{name}_distal", box(0.012 * s, width * s, 0.05 * s, (0, 0, 0.025 * s)))
        robot.joint(
            f"{prefix}{name}_joint", f"{prefix}palm", f"{prefix}{name}_distal",
            (x * s, y * s * mirror, 0.01 * s), (0, sense * axis, 0), (0.0, 1.2),
        )  # fmt: skip
    return robot


def on_arm() -> Robot:
    robot = Robot("robot").link("base", box(0.1, 0.1, 0.05))
    last = arm(robot, "base")
    return hand(robot).weld(last, "palm", (0.01, 0.02, 0.11), (0.3, 0.4, 0.5))


def two() -> Robot:
    robot = Robot("robot").link("torso")
    for side, y in (("left", 0.3), ("right", -0.3)):
        hand(robot, f"{side}_").weld("torso", f"{side}_palm", (0.1, y, 1.0), (0.1, 0.2, y))
    return robot


def turned(*rpy: float) -> Callable[[], Robot]:
    return lambda: hand(Robot("hand").link("world")).weld("world", "palm", (1.0, 2.0, 3.0), rpy)


def split() -> Robot:
    """Return a hand whose distal links carry a welded pad inside them, and a frame at their end."""
    robot = hand()
    for name in FINGERS:
        robot.link(f"{name}_pad", box(0.006, 0.006, 0.01)).link(f"{name}_frame")
        robot.weld(f"{name}_distal", f"{name}_pad", (0, 0, 0.03))
        robot.weld(f"{name}_pad", f"{name}_frame", (0, 0, 0.02))
    return robot


def renamed(change: Callable[[str], str]) -> Callable[[], str]:
    """Return the hand with all names of links and joints changed."""

    def text() -> str:
        pattern = r'((?:name|link)=")([a-z]+_(?:distal|joint)|palm)(")'
        return re.sub(pattern, lambda m: m[1] + change(m[2]) + m[3], hand().text)

    return text


def reversed_elements() -> str:
    robot = hand()
    robot.parts = [part.replace("<limit", "<dynamics/><limit") for part in robot.parts[::-1]]
    return robot.text


def limits_shifted() -> str:
    """Return the hand with joints that count from elsewhere: 0 is where the other has 0.4 rad."""
    text = hand().text.replace('lower="0" upper="1.2"', 'lower="-0.4" upper="0.8"')
    for sense in (1, -1):
        turn = f'rpy="0 {0.4 * sense} 0"/><axis xyz="0 {sense} 0"/>'
        text = text.replace(f'rpy="0 0 0"/><axis xyz="0 {sense} 0"/>', turn)
    return text.replace("</robot>", "") + "</robot>"


VARIATIONS: Mapping[str, Callable[[], Robot | str]] = {
    "mirrored": lambda: hand(mirror=-1.0),
    "twice as large": lambda: hand(scale=2.0),
    "half as large": lambda: hand(scale=0.5),
    "names with blanks": renamed(lambda name: name.replace("_", " ")),
    "names in other letters": renamed(lambda name: f"{name}_関節 é"),
    "names with a prefix": renamed(lambda name: f"left/robot0:{name}"),
    "on an arm": on_arm,
    "one of two, the left": two,
    "one of two, the right": two,
    "axes of another length": lambda: hand(axis=1.7),
    "axes of a small length": lambda: hand(axis=0.001),
    "elements reversed": reversed_elements,
    "fingers in another order": lambda: hand(order=("middle", "thumb", "index")),
    "base turned": turned(0.3, 0.7, 1.1),
    "base upside down": turned(math.pi, 0.0, 0.5),
    "base turned by a quarter": turned(0.0, math.pi / 2, 0.0),
    "tips of several links": split,
    "zeros elsewhere": limits_shifted,
}


ALIKE = (
    "half as large",
    "axes of a small length",
    "base turned by a quarter",
    "base upside down",
)
"""Variations of which another one is of the same kind."""


def primitives(model: Hand) -> dict[tuple[str, frozenset[str]], float]:
    """Return the depth of each pinch [m], and 0 for other primitives, by fingers."""
    found = {}
    for primitive in extract(model, jobs=1).primitives:
        fingers = frozenset(re.sub(r"^(left|right)_|_関節.*", "", f) for f in primitive.fingers)
        depth = primitive.evidence[0].depth if primitive.evidence else None
        found[primitive.name, fingers] = depth or 0.0
    return found


@cache
def plain() -> dict[tuple[str, frozenset[str]], float]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return primitives(load_model(hand().write(Path(folder))))


@pytest.mark.samples(*(name for name in VARIATIONS if name not in ALIKE))
@pytest.mark.parametrize("name", VARIATIONS)
def test_a_variation_has_the_same_primitives(name: str, tmp_path: Path) -> None:
    made = VARIATIONS[name]()
    path = tmp_path / "hand.urdf"
    path.write_text(made if isinstance(made, str) else made.text, encoding="utf-8")
    side = name.rpartition(" ")[2]
    edits = [Subtree(f"{side}_palm")] if side in ("left", "right") else []
    model = load_model(path, edits=edits)
    rest = dict.fromkeys(model.actuator_names, -0.4) if name == "zeros elsewhere" else {}
    found = primitives(load_model(path, edits=edits, rest=rest))
    size = {"twice as large": 2.0, "half as large": 0.5}.get(name, 1.0)
    assert found.keys() == plain().keys()
    assert len(found) == 6
    for key, depth in plain().items():
        assert found[key] == pytest.approx(size * depth, rel=0.02), key
