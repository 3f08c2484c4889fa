from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtee.actions.library import ActionLibrary
from rtee.actions.ros_end_effector import import_folder
from rtee.actions.types import ActionReference, Composed, Generic, Primitive, Timed
from rtee.errors import ActionError, RteeError
from rtee.hand.model import Hand

ACTUATORS = ("spread", "index_joint", "middle_joint", "thumb_joint")


def joints(indent: int, **values: float) -> str:
    lines = (f"{name}: [{values.get(name, 0)}]" for name in ACTUATORS)
    return "\n".join(" " * indent + line for line in lines)


def counts(indent: int, *involved: str) -> str:
    lines = (f"{name}: {int(name in involved)}" for name in ACTUATORS)
    return "\n".join(" " * indent + line for line in lines)


def trig(finger: str, value: float) -> str:
    joint = f"{finger}_joint"
    return f"""[{finger}]:
  PrimitiveType: 3
  ActionName: trig
  JointsInvolvedCount:
{counts(4, joint)}
  ActionState_1:
    JointPos:
{joints(6, **{joint: value})}
"""


PINCH = f"""[index, thumb]:
  PrimitiveType: 0
  ActionName: pinchTight
  JointsInvolvedCount:
{counts(4, "index_joint", "thumb_joint")}
  ActionState_10:
    JointPos:
{joints(6, index_joint=0.3, thumb_joint=0.6)}
  ActionState_2:
    JointStates:
{joints(6, index_joint=0.5, thumb_joint=0.7)}
    Optional:
      MoveItContact:
        depth: 0.002
"""

SPREAD = f"""spread:
  PrimitiveType: 6
  ActionName: singleJointMultipleTips_3
  FingersInvolved: [index, middle, thumb]
  JointPosFurther:
{joints(4, spread=0.05)}
  JointPosNearer:
{joints(4)}
"""

MULTI = f"""[index, middle, thumb]:
  PrimitiveType: 2
  ActionName: multiplePinchTight_3
  JointsInvolvedCount:
{counts(4, "index_joint", "middle_joint", "thumb_joint")}
  ActionState_1:
    JointPos:
{joints(6, index_joint=0.5, middle_joint=0.5, thumb_joint=0.7)}
    Optional:
      DepthSum: 0.001
"""


def composed(name: str, names: str, index: float, middle: float) -> str:
    return f"""{name}:
  Type: 2
  Independent: true
  NInnerActions: 2
  InnerActionsNames: [{names}]
  FingersInvolved: [index, middle]
  JointsInvolvedCount:
{counts(4, "index_joint", "middle_joint")}
  JointPos:
{joints(4, index_joint=index, middle_joint=middle)}
"""


MIXED = f"""mixed:
  Type: 2
  Independent: true
  NInnerActions: 3
  InnerActionsNames: [singleJointMultipleTips_3, pinchTight, trig]
  FingersInvolved: [index, middle, thumb]
  JointsInvolvedCount:
{counts(4, *ACTUATORS)}
  JointPos:
{joints(4, spread=0.025, index_joint=0.25, thumb_joint=0.45, middle_joint=1.0)}
"""

GENERIC = f"""casual:
  Type: 1
  FingersInvolved: []
  JointsInvolvedCount:
{counts(4, "middle_joint")}
  JointPos:
{joints(4, middle_joint=2.5)}
"""

TIMED = f"""sequence:
# a comment of the original
  Type: 3
  FingersInvolved: [index, thumb]
  JointsInvolvedCount:
{counts(4, "index_joint", "spread", "thumb_joint")}
  ActionsJointPosFinal:
{joints(4, index_joint=0.6, spread=0.02, thumb_joint=0.9)}
  ActionsNamesOrdered: [HALF, other]
  ActionsTimeMargins:
    HALF:
      marginBefore: 0
      marginAfter: 0.2
    other:
      marginBefore: 0.5
      marginAfter: 0
  ActionsJointPos:
    HALF:
{joints(6, index_joint=0.6)}
    other:
{joints(6, spread=0.02, thumb_joint=0.9)}
  ActionsJointCount:
    HALF:
{counts(6, "index_joint")}
    other:
{counts(6, "spread", "thumb_joint")}
"""


@pytest.fixture
def peers(tmp_path: Path) -> Path:
    files = {
        "primitives/trig.yaml": trig("index", 1.2) + "\n" + trig("middle", 1.0),
        "primitives/pinchTight.yaml": PINCH,
        "primitives/singleJointMultipleTips_3.yaml": SPREAD,
        "primitives/multiplePinchTight_3.yaml": MULTI,
        "generics/grasp.yaml": composed("grasp", "trig, trig", 1.2, 0.3),
        "generics/odd.yaml": composed("odd", "trig, pinchTight", 0.1, 0.2),
        "generics/casual.yaml": GENERIC,
        "generics/mixed.yaml": MIXED,
        "timeds/sequence.yaml": TIMED,
        "rviz.yaml": "Panels: [a, b]\nFar: .inf\n",
        "list.yaml": "- &one {a: .nan}\n- *one\n",
    }
    for name, text in files.items():
        path = tmp_path / "peers" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "peers"


@pytest.fixture
def imported(hand: Hand, peers: Path) -> ActionLibrary:
    return ActionLibrary(hand, import_folder(hand, peers).actions)


def test_primitives_with_their_ranked_postures(imported: ActionLibrary) -> None:
    pinch = imported.find("PinchTight", ("thumb", "index"))
    assert isinstance(pinch, Primitive)
    assert [p.position["index_joint"] for p in pinch.postures] == [0.5, 0.3]
    assert pinch.posture.involved == ("index_joint", "thumb_joint")
    spread = imported.find("SingleJointMultipleTips_3", ("spread",))
    assert isinstance(spread, Primitive)
    assert spread.fingers == ("index", "middle", "thumb")
    assert spread.posture.involved == ("spread",)
    assert imported.find("MultiPinchTight_3", ("index", "middle", "thumb"))
    assert len(imported.all(name="Trig")) == 2


def test_parts_of_a_composed_action_are_found_again(imported: ActionLibrary) -> None:
    grasp = imported.find("grasp")
    assert isinstance(grasp, Composed)
    assert grasp.independent
    assert grasp.parts == (
        ActionReference("Trig", ("index",), 1.0),
        ActionReference("Trig", ("middle",), 0.3),
    )


def test_parts_of_several_kinds_are_found_again(imported: ActionLibrary) -> None:
    mixed = imported.find("mixed")
    assert isinstance(mixed, Composed)
    assert mixed.independent
    assert mixed.parts == (
        ActionReference("SingleJointMultipleTips_3", ("spread",), 0.5),
        ActionReference("PinchTight", ("index", "thumb"), 0.5),
        ActionReference("Trig", ("middle",), 1.0),
    )


def test_older_files_name_fingertips_and_kinds_otherwise(hand: Hand, peers: Path) -> None:
    new = import_folder(hand, peers)
    words = {"pinchTight": "pinchStrong", "multiplePinchTight_": "multiplePinchStrong_"}
    words |= {"singleJointMultipleTips_": "moreTips_"}
    for path in peers.rglob("*.yaml"):
        text = path.read_text()
        for old, new_word in words.items():
            text = text.replace(old, new_word)
        path.write_text(re.sub(r"\b(index|middle|thumb)(?=[],])", r"\1_tip", text))
    assert "[index_tip, thumb_tip]:" in (peers / "primitives" / "pinchTight.yaml").read_text()
    old = import_folder(hand, peers)
    assert [a for a in old.actions if a.name != "odd"] == [
        a
        for a in new.actions
        if a.name != "odd"  # its description has the names in the file
    ]


def test_the_oldest_files_are_left_out_with_a_note(hand: Hand, peers: Path) -> None:
    early = "[index_tip]:\n  JointsInvolved: [false, true]\n  ActionState_1:\n    JointStates: {}\n"
    (peers / "early.yaml").write_text(early)
    found = import_folder(hand, peers)
    assert found.actions
    assert any("early.yaml is left out: the files of early versions" in n for n in found.notes)
    for path in peers.rglob("*.yaml"):
        if path.name != "early.yaml":
            path.unlink()
    with pytest.raises(ActionError, match=r"holds no action files .*; the files of early versions"):
        import_folder(hand, peers)


def test_what_cannot_be_found_again_becomes_generic(hand: Hand, peers: Path) -> None:
    found = import_folder(hand, peers)
    odd = ActionLibrary(hand, found.actions).find("odd")
    assert isinstance(odd, Generic)
    assert odd.posture.position["middle_joint"] == 0.2
    assert any("'odd' is imported as a generic" in note for note in found.notes)


def test_inner_actions_of_a_timed_one(hand: Hand, imported: ActionLibrary) -> None:
    timed = imported.find("sequence")
    assert isinstance(timed, Timed)
    first, second = timed.steps
    assert (first.alias, first.use) == ("HALF", ActionReference("Trig", ("index",), 0.5))
    assert (first.after, second.before) == (0.2, 0.5)
    assert second.use == ActionReference("sequence_other")
    assert second.posture.position["thumb_joint"] == pytest.approx(0.9)


def test_values_outside_limits_are_clamped_with_a_note(hand: Hand, peers: Path) -> None:
    found = import_folder(hand, peers)
    casual = ActionLibrary(hand, found.actions).find("casual")
    assert casual.posture.position["middle_joint"] == 1.0
    assert any("casual: the set-point 2.5 of 'middle_joint'" in note for note in found.notes)


def test_what_was_imported_can_be_stored(
    hand: Hand, imported: ActionLibrary, tmp_path: Path
) -> None:
    imported.save(tmp_path / "ours")
    assert ActionLibrary.load(hand, tmp_path / "ours").names == imported.names


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("primitives/trig.yaml", "[middle]:", "[ring]:", r"trig.yaml:\d+: unknown finger 'ring'"),
        ("primitives/trig.yaml", "ActionName: trig", "ActionName: trip", r"trig.yaml:.* 'trig'"),
        ("primitives/pinchTight.yaml", "ActionState_", "State_", "has no ActionState_1"),
        ("primitives/pinchTight.yaml", "[0.5]", "[0.5, 0.6]", r":18: .* at most 1 items"),
        ("primitives/pinchTight.yaml", "  thumb_joint", "  pollex", "has no actuator 'pollex'"),
        (
            "primitives/singleJointMultipleTips_3.yaml",
            "    spread: [0.05]",
            "    palm: [0]",
            "actuator 'spread'",
        ),
        ("generics/grasp.yaml", "  index_joint: [1.2]\n", "\n", "actuator 'index_joint'"),
        ("generics/grasp.yaml", "Type: 2", "Type: 9", "type 9 is unknown"),
        ("timeds/sequence.yaml", "[HALF, other]", "[HALF, third]", "'third' has no margins"),
        ("timeds/sequence.yaml", "marginAfter: 0.2", "marginAfter: -2", "should be .* 0, not -2"),
    ],
)
def test_mistakes_name_the_file(
    hand: Hand, peers: Path, file: str, old: str, new: str, message: str
) -> None:
    path = peers / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ActionError, match=message):
        import_folder(hand, peers)


def test_folder_without_actions(hand: Hand, tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("a: 1\n")
    with pytest.raises(ActionError, match="holds no action files"):
        import_folder(hand, tmp_path)


@pytest.mark.parametrize("key", ["{index: thumb}", "[{index: thumb}]", "? [[index], thumb]\n"])
def test_a_key_that_is_a_mapping_or_nested_is_refused(hand: Hand, tmp_path: Path, key: str) -> None:
    (tmp_path / "primitives").mkdir()
    (tmp_path / "primitives" / "pinchTight.yaml").write_text(f"{key}:\n  a: 1\n")
    with pytest.raises(ActionError):
        import_folder(hand, tmp_path)


_PIECES = (
    ": ",
    "- ",
    "\t",
    "[",
    "]",
    "{}",
    "~",
    "0.5",
    "-1",
    ".nan",
    "1e999",
    "index",
    "x",
    "2",
    "\n",
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_end_in_an_error_of_ours_or_none(
    hand: Hand, peers: Path, data: st.DataObject
) -> None:
    path = data.draw(st.sampled_from(sorted(peers.rglob("*.yaml"))))
    whole = text = path.read_text()
    for _ in range(data.draw(st.integers(1, 3))):
        words = list(re.finditer(r"[\w.]+|\n *", text))
        word = data.draw(st.sampled_from(words))
        text = text[: word.start()] + data.draw(st.sampled_from(_PIECES)) + text[word.end() :]
    path.write_text(text)
    try:
        for action in import_folder(hand, peers).actions:
            postures = [s.posture for s in action.steps] if isinstance(action, Timed) else []
            for posture in postures or [action.posture]:
                for spec in hand.actuators:
                    assert spec.lower <= posture.position[spec.name] <= spec.upper
    except RteeError as error:
        assert "\n" not in str(error)  # noqa: PT017
    finally:
        path.write_text(whole)


def test_numbers_of_states_may_have_leading_zeros(hand: Hand, tmp_path: Path) -> None:
    (tmp_path / "trig.yaml").write_text(trig("index", 0.5).replace("State_1:", "State_01:"))
    assert [action.name for action in import_folder(hand, tmp_path).actions] == ["Trig"]


def test_a_folder_that_cannot_be_searched_is_named(
    hand: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(self: Path, pattern: str) -> list[Path]:
        raise OSError(22, "Invalid argument")

    monkeypatch.setattr(Path, "rglob", failing)
    with pytest.raises(ActionError, match="cannot be searched: invalid argument"):
        import_folder(hand, tmp_path)
