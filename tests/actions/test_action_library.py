from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from rtee.actions.build import full_posture, generic
from rtee.actions.describe import deeper_text
from rtee.actions.documents import CUSTOM
from rtee.actions.library import ActionLibrary
from rtee.actions.types import (
    ActionKind,
    ActionReference,
    Composed,
    Primitive,
    PrimitiveKind,
    Timed,
    kind_of,
)
from rtee.errors import ActionError, ConfigError, UnknownAction
from rtee.hand.model import Hand

Use = ActionReference


@pytest.mark.parametrize("name", ["pinchTight", "PinchTight", "pinch_tight", "PINCH TIGHT"])
@pytest.mark.parametrize("elements", [("index", "thumb"), ("thumb", "index"), ("Thumb", "INDEX")])
def test_find_whatever_the_spelling_and_order(
    library: ActionLibrary, name: str, elements: tuple[str, ...]
) -> None:
    found = library.find(name, elements)
    assert isinstance(found, Primitive)
    assert (found.name, found.elements) == ("PinchTight", ("index", "thumb"))


def test_counted_kinds_resolve_without_their_count(library: ActionLibrary) -> None:
    assert library.find("MultiPinchTight", ("thumb", "middle", "index")).name == "MultiPinchTight_3"
    assert library.find("multipinchtight_3", ("thumb", "middle", "index"))
    assert library.find("singleJointMultipleTips", ("spread",)).name == "SingleJointMultipleTips_3"


def test_the_deepest_posture_of_a_pinch_is_asked_for_by_name(
    library: ActionLibrary, hand: Hand
) -> None:
    found = library.find("PinchTight", ("index", "thumb"))
    assert isinstance(found, Primitive)
    shallow = replace(found.evidence[0], depth=0.001, clear=True, path_clear=True)
    deep = replace(found.evidence[0], depth=0.003, clear=False)
    postures = (found.posture, full_posture(hand, {"index_joint": 1.1, "thumb_joint": 0.9}))
    both = replace(found, postures=postures, evidence=(shallow, deep))
    actions = [both if action is found else action for action in library]
    other = ActionLibrary(hand, actions)
    for name in ("PinchTight@deepest", "pinch_tight@Deepest"):
        deepest = other.find(name, ("thumb", "index"))
        assert isinstance(deepest, Primitive)
        assert (deepest.posture, deepest.evidence[0]) == (postures[1], deep)
    assert other.find("PinchTight", ("index", "thumb")) is both
    assert both.deeper == deep
    assert deeper_text(both) == "deepest 3.0 mm, not clear: PinchTight@deepest"
    assert deeper_text(found) == ""
    with pytest.raises(ActionError, match="only 'PinchTight@deepest' asks for another posture"):
        other.find("PinchTight@second", ("index", "thumb"))
    with pytest.raises(ActionError, match="is not a pinch"):
        other.find("Trig@deepest", ("index",))


def test_elements_are_needed_only_where_there_is_a_choice(library: ActionLibrary) -> None:
    assert library.find("SingleJointMultipleTips_3").name == "SingleJointMultipleTips_3"
    with pytest.raises(ActionError, match="Trig needs elements; valid: index, middle, thumb"):
        library.find("trig")


def test_wrong_elements_name_the_possible_ones(library: ActionLibrary) -> None:
    with pytest.raises(ActionError, match="'index middle'; it does with: index thumb, middle th"):
        library.find("PinchTight", ("index", "middle"))
    with pytest.raises(ActionError, match="does not exist with 'index index thumb'"):
        library.find("PinchTight", ("index", "index", "thumb"))
    with pytest.raises(ActionError, match="takes no elements"):
        library.find("point", ("index",))


def test_kind_decides_where_given(library: ActionLibrary) -> None:
    assert kind_of(library.find("point", kind="generic")) is ActionKind.GENERIC
    with pytest.raises(UnknownAction):
        library.find("point", kind="timed")
    with pytest.raises(UnknownAction):
        library.find("trig", ("index",), kind="composed")
    with pytest.raises(ActionError, match="unknown kind 'tined'; did you mean 'timed'"):
        library.find("point", kind="tined")


def test_filters(library: ActionLibrary) -> None:
    assert len(library.all()) == len(library) == 10
    assert [a.name for a in library.all("timed")] == ["drill"]
    assert len(library.all(name="pinch_tight")) == 2
    assert [a.name for a in library.all(name="MultiPinchTight")] == ["MultiPinchTight_3"]
    with_thumb = library.all("primitive", elements=("thumb",))
    assert [a.name for a in with_thumb] == ["Trig", "PinchTight", "PinchTight", "MultiPinchTight_3"]
    assert library.all("generic", elements=("thumb",)) == []


def test_aggregated_view(library: ActionLibrary) -> None:
    groups = {group.name: group for group in library.primitives()}
    assert list(groups) == ["Trig", "PinchTight", "MultiPinchTight_3", "SingleJointMultipleTips_3"]
    pinch = groups["PinchTight"]
    assert (pinch.selectable, pinch.count) == (("index", "middle", "thumb"), 2)
    assert pinch.combinations == (("index", "thumb"), ("middle", "thumb"))


def test_partners_never_contain_the_element_itself(library: ActionLibrary) -> None:
    assert library.partners("pinch_tight", "thumb") == ("index", "middle")
    assert library.partners("PinchTight", "index") == ("thumb",)
    assert library.partners("Trig", "index") == ()
    with pytest.raises(ActionError, match="PinchTight does not exist with 'ring'"):
        library.partners("PinchTight", "ring")
    with pytest.raises(UnknownAction):
        library.partners("drill", "index")


def test_order_does_not_depend_on_the_order_given(
    hand: Hand, primitives: tuple[Primitive, ...]
) -> None:
    forward, backward = ActionLibrary(hand, primitives), ActionLibrary(hand, primitives[::-1])
    assert list(forward) == list(backward)


def test_same_names_are_refused(library: ActionLibrary) -> None:
    with pytest.raises(ActionError, match="already is an action 'schunkGrasp'; replace it"):
        library.add(generic(library.hand, "Schunk_Grasp", {"spread": 0.01}))
    assert isinstance(library.find("schunkGrasp"), Composed)


def test_replacing_brings_users_up_to_date(library: ActionLibrary) -> None:
    library.add(library.compose("schunkGrasp", [Use("trig", ("index",), 0.5)]), replace_same=True)
    drill = library.find("drill")
    assert isinstance(drill, Timed)
    assert drill.steps[0].posture.position["index_joint"] == pytest.approx(0.5)


def test_an_action_cannot_come_to_contain_itself(library: ActionLibrary) -> None:
    library.add(library.compose("outer", [Use("schunkGrasp")]))
    with pytest.raises(ActionError, match="would contain itself"):
        library.add(library.compose("schunkGrasp", [Use("outer")]), replace_same=True)
    with pytest.raises(ActionError, match="would contain itself"):
        library.add(library.compose("outer", [Use("outer")]), replace_same=True)
    assert library.users("schunkGrasp") == ("outer", "drill")


def test_remove_is_refused_while_used(library: ActionLibrary) -> None:
    with pytest.raises(ActionError, match="'point' is used by drill"):
        library.remove("point")
    library.remove("drill")
    library.remove("point")
    with pytest.raises(UnknownAction):
        library.find("point")
    with pytest.raises(ActionError, match="is a primitive"):
        library.remove("SingleJointMultipleTips")


def test_save_and_load(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.yaml")) == [
        "composed/schunkGrasp.yaml",
        "generic/point.yaml",
        "primitives/MultiPinchTight_3.yaml",
        "primitives/PinchTight.yaml",
        "primitives/SingleJointMultipleTips_3.yaml",
        "primitives/Trig.yaml",
        "timed/drill.yaml",
    ]
    again = ActionLibrary.load(library.hand, tmp_path)
    assert [a.name for a in again] == [a.name for a in library]
    again.save()
    assert list(ActionLibrary.load(library.hand, tmp_path)) == list(again)


def test_missing_folder_holds_no_actions(hand: Hand, tmp_path: Path) -> None:
    assert len(ActionLibrary.load(hand, tmp_path / "none")) == 0


def test_added_actions_are_stored_when_asked(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    library.add(generic(library.hand, "volatile", {"spread": 0.01}))
    library.add(generic(library.hand, "kept", {"spread": 0.02}), store=True)
    names = ActionLibrary.load(library.hand, tmp_path).names
    assert "kept" in names
    assert "volatile" not in names
    with pytest.raises(ActionError, match="uses 'volatile', which is not stored"):
        library.add(library.compose("on", [Use("volatile")]), store=True)
    library.store("volatile")
    assert "volatile" in ActionLibrary.load(library.hand, tmp_path).names


def test_removed_actions_lose_their_file(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    library.remove("drill")
    assert not (tmp_path / "timed" / "drill.yaml").exists()
    assert not library.changed()


def test_storing_without_a_folder_is_refused(library: ActionLibrary) -> None:
    with pytest.raises(ActionError, match="no folder"):
        library.save()
    with pytest.raises(ActionError, match="no folder"):
        library.add(generic(library.hand, "x", {"spread": 0.01}), store=True)
    assert "x" not in library.names


def test_rename_everywhere(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    library.rename("schunkGrasp", "fist")
    assert not (tmp_path / "composed" / "schunkGrasp.yaml").exists()
    again = ActionLibrary.load(library.hand, tmp_path)
    assert again.users("fist") == ("drill",)
    assert list(again) == list(library)
    with pytest.raises(ActionError, match="already is"):
        library.rename("fist", "Point")
    with pytest.raises(ActionError, match="primitive"):
        library.rename("SingleJointMultipleTips", "all")
    with pytest.raises(ConfigError):
        library.rename("fist", "../fist")


def test_an_action_that_replaces_one_of_another_kind_takes_its_file(
    library: ActionLibrary, tmp_path: Path
) -> None:
    library.save(tmp_path)
    library.add(generic(library.hand, "same", {"spread": 0.01}), store=True)
    library.add(library.compose("same", [Use("Point")]), store=True, replace_same=True)
    again = ActionLibrary.load(library.hand, tmp_path)
    assert isinstance(again.find("same"), Composed)
    library.add(generic(library.hand, "same", {"spread": 0.02}), replace_same=True)
    library.save(tmp_path)
    assert not isinstance(ActionLibrary.load(library.hand, tmp_path).find("same"), Composed)
    library.remove("same")
    assert "same" not in ActionLibrary.load(library.hand, tmp_path).names


def test_comments_stay_when_an_action_is_renamed(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    before = tmp_path / "composed" / "schunkGrasp.yaml"
    before.write_text("# Mine.\n" + before.read_text())
    library.reload()
    library.rename("schunkGrasp", "fist")
    assert not before.exists()
    assert "# Mine." in (tmp_path / "composed" / "fist.yaml").read_text()


def test_rename_to_another_spelling(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    library.rename("schunkGrasp", "schunk_grasp")
    assert "schunk_grasp" in ActionLibrary.load(library.hand, tmp_path).names


def test_reload_when_files_changed(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    library.add(generic(library.hand, "volatile", {"spread": 0.01}))
    assert not library.reload()
    path = tmp_path / "generic" / "point.yaml"
    path.write_text(path.read_text().replace("0.8", "0.25"))
    os.utime(path, ns=(1, 1))
    assert library.changed()
    assert library.reload()
    drill = library.find("drill")
    assert isinstance(drill, Timed)
    assert drill.steps[2].posture.position["middle_joint"] == 0.25
    assert "volatile" in library.names


def test_a_folder_that_is_gone_empties_nothing(
    library: ActionLibrary, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    library.save(tmp_path / "actions")
    before = [*library]
    assert before
    shutil.rmtree(tmp_path / "actions")
    assert not library.reload()
    assert not library.reload()
    assert [*library] == before
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path / 'actions'} is gone; the actions stay as they were last read"
    ]


def test_failed_reload_leaves_the_library_as_it_was(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    (tmp_path / "generic" / "point.yaml").write_text("name: point\n")
    before = list(library)
    with pytest.raises(ActionError, match="set_points: is missing"):
        library.reload()
    assert list(library) == before


@pytest.mark.parametrize("name", ["actions", "actions/composed"])
def test_a_file_in_the_place_of_a_folder(name: str, hand: Hand, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("a file, not a folder")
    with pytest.raises(ActionError, match=f"{name}: is not a folder"):
        ActionLibrary.load(hand, tmp_path / "actions")


def test_unwritable_folder_is_one_sentence(library: ActionLibrary, tmp_path: Path) -> None:
    (tmp_path / "generic").write_text("a file, not a folder")
    with pytest.raises(ConfigError, match="cannot be"):
        library.save(tmp_path)


def test_a_kind_of_primitive_says_what_its_elements_are(library: ActionLibrary) -> None:
    assert PrimitiveKind("PinchTight") is PrimitiveKind.PINCH_TIGHT
    assert all(kind.label for kind in PrimitiveKind)
    for action in library.all("primitive"):
        assert isinstance(action, Primitive)
        assert len(action.elements) == (action.kind.elements or action.tips)
        known = library.hand.actuator_names if action.kind.of_actuators else action.fingers
        assert set(action.elements) <= set(known)


def test_all_actions_answer_alike(library: ActionLibrary) -> None:
    assert {*CUSTOM, ActionKind.PRIMITIVE} == set(ActionKind)
    for action in library:
        last = action.steps[-1].posture if isinstance(action, Timed) else action.posture
        assert action.waypoints[-1] == last
        assert bool(action.elements) is bool(action.fingers) is isinstance(action, Primitive)
        assert all(library.find(use.action, use.elements) for use in action.uses)
        assert action.with_uses(lambda use: use) == action
    drill = library.find("drill").with_uses(lambda use: Use("point"))
    assert {use.action for use in drill.uses} == {"point"}
