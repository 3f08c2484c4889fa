"""A made-up hand with 24 actuators: six fingers of four joints."""

from __future__ import annotations

from pathlib import Path

from rtee.actions.build import full_posture, generic
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference, Primitive, PrimitiveKind
from rtee.hand.load import load_hand

from .running import MANY

FINGERS = 6
JOINTS = 4


def _box(name: str, length: float) -> str:
    shape = f'<box size="0.012 0.012 {length}"/>'
    at = f'<origin xyz="0 0 {length / 2}"/>'
    return f'<link name="{name}"><collision>{at}<geometry>{shape}</geometry></collision></link>\n'


def _urdf() -> str:
    parts = ['<link name="palm"><collision><geometry><box size="0.1 0.1 0.02"/></geometry>']
    parts.append("</collision></link>\n")
    for finger in range(FINGERS):
        parent, place = "palm", f"{0.03 * (finger % 3) - 0.03} {0.06 * (finger // 3) - 0.03} 0.01"
        turn = 0.0 if finger < FINGERS // 2 else 3.14159
        for joint in range(JOINTS):
            child = f"f{finger}_link{joint}"
            parts.append(_box(child, 0.03))
            parts.append(
                f'<joint name="f{finger}_joint{joint}" type="revolute"><parent link="{parent}"/>'
                f'<child link="{child}"/><origin xyz="{place}" rpy="0 0 {turn}"/>'
                f'<axis xyz="-1 0 0"/><limit lower="0" upper="1" velocity="4" effort="2"/>'
                "</joint>\n"
            )
            parent, place, turn = child, "0 0 0.032", 0.0
    return f'<robot name="{MANY}">\n{"".join(parts)}</robot>\n'


def make_many(folder: Path) -> None:
    """Write the hand's folder, with a Trig per finger and a composed and a generic action."""
    folder.mkdir(parents=True)
    (folder / f"{MANY}.urdf").write_text(_urdf())
    groups = "".join(
        f'<group name="finger_{n}"><chain base_link="palm" tip_link="f{n}_link{JOINTS - 1}"/>'
        "</group>"
        for n in range(FINGERS)
    )
    (folder / f"{MANY}.srdf").write_text(f'<robot name="{MANY}">{groups}</robot>')
    (folder / "hand.yaml").write_text(f"name: {MANY}\nurdf: {MANY}.urdf\nsrdf: {MANY}.srdf\n")
    hand = load_hand(folder)
    trigs = [
        Primitive(
            PrimitiveKind.TRIG,
            (f"finger_{n}",),
            (full_posture(hand, {f"f{n}_joint{j}": 0.8 for j in range(JOINTS)}),),
        )
        for n in range(FINGERS)
    ]
    library = ActionLibrary(hand, trigs)
    library.add(library.compose("fist", [ActionReference("Trig", t.elements) for t in trigs]))
    library.add(generic(hand, "wave", {"f0_joint0": 0.5}))
    library.save(folder / "actions")
