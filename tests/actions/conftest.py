"""A small hand: three fingers, the thumb resting away from zero, one actuator for two fingers."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from rtee.actions.build import StepPlan, full_posture, generic
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference, Evidence, Opposition, Primitive, PrimitiveKind
from rtee.hand.load import load_model
from rtee.hand.model import Hand

FINGERS = ("index", "middle", "thumb")
LIMITS = {"index_joint": (0.0, 1.2), "middle_joint": (-0.5, 1.0), "thumb_joint": (0.2, 1.0)}

BOX = '<collision><geometry><box size="0.01 0.01 0.03"/></geometry></collision>'


def _finger(name: str) -> str:
    lower, upper = LIMITS[f"{name}_joint"]
    return f"""
  <link name="{name}_tip">{BOX}</link>
  <joint name="{name}_joint" type="revolute"><parent link="palm"/><child link="{name}_tip"/>
    <axis xyz="1 0 0"/><limit lower="{lower}" upper="{upper}" velocity="1" effort="1"/></joint>"""


URDF = f"""<robot name="small">
  <link name="base"/>
  <link name="palm">{BOX}</link>
  <joint name="spread" type="prismatic"><parent link="base"/><child link="palm"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.05" velocity="1" effort="1"/></joint>
  {"".join(map(_finger, FINGERS))}
</robot>"""

GROUPS = "".join(
    f'<group name="{f}"><chain base_link="base" tip_link="{f}_tip"/></group>' for f in FINGERS
)
SRDF = f"""<robot name="small">{GROUPS}
  <group name="fingers">{"".join(f'<group name="{f}"/>' for f in FINGERS)}</group>
</robot>"""

EVIDENCE = Evidence(
    depth=0.001234568,
    distance=0.0,
    frame_distance=0.02,
    point=(1e-9, -0.2, 0.3),
    normal=(1.0, 0.0, 0.0),
    clear=False,
    path_clear=False,
    colliding=(("palm", "index_tip"), ("palm", "y")),
    contact_at=0.85,
    opposition=Opposition((0.1, 0.25), True, 0.5),
    pairs=(("index", "thumb", 0.001),),
)
LOOSE = Evidence(distance=0.004, frame_distance=0.01)


@pytest.fixture(scope="session")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    folder = tmp_path_factory.mktemp("small")
    (folder / "small.urdf").write_text(URDF)
    (folder / "small.srdf").write_text(SRDF)
    return load_model(folder / "small.urdf", folder / "small.srdf", name="small")


def primitive(
    hand: Hand,
    kind: PrimitiveKind,
    elements: tuple[str, ...],
    *set_points: Mapping[str, float],
    evidence: tuple[Evidence, ...] = (),
    fingers: tuple[str, ...] = (),
) -> Primitive:
    postures = tuple(full_posture(hand, points) for points in set_points)
    return Primitive(kind, elements, postures, evidence, fingers=fingers)


@pytest.fixture(scope="session")
def primitives(hand: Hand) -> tuple[Primitive, ...]:
    kind = PrimitiveKind
    pinch = {"index_joint": 0.5, "thumb_joint": 0.7}
    trigs = (
        primitive(hand, kind.TRIG, (finger,), {f"{finger}_joint": 1.0})
        for finger in ("thumb", "index", "middle")
    )
    return (
        *trigs,
        primitive(
            hand,
            kind.PINCH_TIGHT,
            ("index", "thumb"),
            pinch,
            {"index_joint": 0.4, "thumb_joint": 0.8, "spread": 0.01},
            evidence=(EVIDENCE, LOOSE),
        ),
        primitive(hand, kind.PINCH_TIGHT, ("middle", "thumb"), {"middle_joint": 0.3}),
        primitive(
            hand,
            kind.MULTI_PINCH_TIGHT,
            FINGERS,
            {"index_joint": 0.5, "middle_joint": 0.5, "thumb_joint": 0.7},
        ),
        primitive(
            hand,
            kind.SINGLE_JOINT_MULTIPLE_TIPS,
            ("spread",),
            {"spread": 0.05},
            fingers=FINGERS,
        ),
    )


@pytest.fixture
def library(hand: Hand, primitives: tuple[Primitive, ...]) -> ActionLibrary:
    """The primitives, a composed, a timed and a generic action, in memory."""
    made = ActionLibrary(hand, primitives)
    parts = [ActionReference("trig", ("index",)), ActionReference("trig", ("thumb",), 0.3)]
    made.add(made.compose("schunkGrasp", parts, description="close: index, and a bit of thumb"))
    made.add(generic(hand, "point", {"middle_joint": 0.8}))
    steps = [
        StepPlan(ActionReference("Schunk_Grasp"), before=0.5),
        StepPlan(ActionReference("pinch tight", ("thumb", "index"), 0.5), "pinch", 0.1, 0.2),
        StepPlan(ActionReference("point")),
    ]
    made.add(made.sequence("drill", steps))
    return made
