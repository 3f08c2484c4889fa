"""Four variants of a planar-fingered hand: which primitives the extraction finds for each."""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path

from experiments.common import Outcome, main
from rtee.extract.extraction import extract
from rtee.hand.files import make_folder, write_atomically
from rtee.hand.load import load_model
from rtee.hand.model import Hand

EXPECTED = {
    1: {"SingleJointMultipleTips_2": 1, "PinchTight": 1},
    2: {"Trig": 2, "PinchTight": 1},
    3: {"Trig": 3},
    4: {"Trig": 3, "TipFlex": 1, "FingFlex": 1, "PinchTight": 2},
}
"""What the paper says of each variant, besides its flex primitives."""

_APART = 0.04


def _finger(name: str, side: int, y: float, parent: str = "base", mimic: str = "") -> str:
    x = side * _APART if parent == "base" else 0.0
    follows = f'<mimic joint="{mimic}"/>' if mimic else ""
    return (
        f'<link name="{name}"><collision><origin xyz="0 0 0.05"/><geometry>'
        '<box size="0.012 0.012 0.1"/></geometry></collision></link>'
        f'<joint name="{name}_flexion" type="revolute"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="{x} {y} 0"/><axis xyz="0 {-side} 0"/>'
        f'<limit lower="0" upper="1.2" velocity="1" effort="1"/>{follows}</joint>'
    )


def hand(variant: int, folder: Path) -> Hand:
    """Return one of the four hands; its files are written into a folder."""
    if variant <= 2:
        fingers = ["thumb", "first"]
        mimic = "thumb_flexion" if variant == 1 else ""
        parts = [_finger("thumb", 1, 0.0), _finger("first", -1, 0.0, mimic=mimic)]
    else:
        fingers = ["first", "second", "thumb"]
        parts = [_finger("first", -1, -0.03), _finger("second", -1, 0.03)]
        parent = "base"
        if variant == 4:
            parent = "swivel"
            parts.append(
                '<link name="swivel"/><joint name="thumb_swivel" type="revolute">'
                f'<parent link="base"/><child link="swivel"/><origin xyz="{_APART} 0 0"/>'
                '<axis xyz="0 0 1"/><limit lower="-0.7" upper="0.7" velocity="1" effort="1"/>'
                "</joint>"
            )
        parts.append(_finger("thumb", 1, 0.0, parent))
    name = f"variant_{variant}"
    groups = "".join(
        f'<group name="{f}"><chain base_link="base" tip_link="{f}"/></group>' for f in fingers
    )
    members = "".join(f'<group name="{f}"/>' for f in fingers)
    urdf, srdf = folder / f"{name}.urdf", folder / f"{name}.srdf"
    body = f'<robot name="{name}"><link name="base"/>{"".join(parts)}</robot>'
    write_atomically(urdf, body)
    write_atomically(
        srdf, f'<robot name="{name}">{groups}<group name="fingers">{members}</group></robot>'
    )
    return load_model(urdf, srdf)


def run(folder: Path) -> Outcome:
    """Extract the primitives of all variants and write the table."""
    outcome = Outcome("each variant has exactly the stated primitives")
    rows = ["| variant | primitives found |", "| --- | --- |"]
    with tempfile.TemporaryDirectory() as scratch:
        for variant, expected in EXPECTED.items():
            found = Counter(p.name for p in extract(hand(variant, Path(scratch))).primitives)
            words = ", ".join(f"{count} {name}" for name, count in sorted(found.items()))
            stated = ", ".join(f"{count} {name}" for name, count in sorted(expected.items()))
            outcome.check(
                dict(found) == expected, f"primitives of variant {variant}", words, stated
            )
            rows.append(f"| {variant} | {words} |")
    table = make_folder(folder) / "variants.md"
    write_atomically(table, "\n".join(rows) + "\n")
    outcome.files.append(table)
    return outcome


if __name__ == "__main__":
    main(run, "variants")
