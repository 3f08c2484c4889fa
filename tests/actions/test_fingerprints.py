"""Words that tell whether a hand's files and actions are still what they were."""

from pathlib import Path

import pytest

from rtee.actions.build import StepPlan
from rtee.actions.fingerprints import Fingerprints
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference
from rtee.hand.catalog import fingerprint
from rtee.hand.load import load_configured
from rtee.hand.own_copy import copy_hand

FIST = ("Trig", ("index",))
PINCH = ("PinchTight", ("index", "thumb"))


@pytest.fixture
def folder(tmp_path: Path, repository: Path) -> Path:
    copy_hand(repository / "config/schunk_svh", tmp_path / "mine")
    return tmp_path / "mine"


def library_of(folder: Path) -> ActionLibrary:
    return ActionLibrary.load(load_configured(folder)[0], folder / "actions")


def now(folder: Path) -> Fingerprints:
    return Fingerprints.of(folder, library_of(folder))


def test_the_word_of_all_files_follows_them(tmp_path: Path) -> None:
    (tmp_path / "hand.yaml").write_text("name: a\n")
    first = fingerprint(tmp_path)
    assert fingerprint(tmp_path) == first
    (tmp_path / "hand.yaml").write_text("name: b\n")
    assert fingerprint(tmp_path) != first


@pytest.mark.parametrize("suffix", ["urdf", "srdf"])
def test_it_follows_a_model_in_a_folder_of_its_own(tmp_path: Path, suffix: str) -> None:
    model = tmp_path / "model" / f"a.{suffix}"
    model.parent.mkdir()
    model.write_text("<robot/>")
    first = fingerprint(tmp_path)
    model.write_text("<robot></robot>")
    assert fingerprint(tmp_path) != first


def test_a_new_action_changes_no_other_one(folder: Path) -> None:
    before = now(folder)
    library = library_of(folder)
    library.add(library.compose("fist", [ActionReference(*FIST)]), store=True)
    after = now(folder)
    assert after.files != before.files
    assert after.model == before.model
    assert after.actions == {**before.actions, "fist": after.actions["fist"]}


def test_words_of_an_action_do_not_matter(folder: Path) -> None:
    before = now(folder).actions
    file = folder / "actions/composed/Grasp.yaml"
    file.write_text(file.read_text().replace("Power grasp", "# Firm grasp"))
    assert now(folder).actions == before


def test_an_action_changes_with_its_parts(folder: Path) -> None:
    before = now(folder).actions
    file = folder / "actions/composed/schunkGrasp.yaml"
    file.write_text(file.read_text().replace("scale: 0.3", "scale: 0.4"))
    after = now(folder).actions
    assert {name for name in after if after[name] != before[name]} == {"schunkGrasp"}


def test_the_model_changes_with_the_configuration(folder: Path) -> None:
    words = {now(folder).model}
    for name in ("hand.yaml", "schunk_svh.urdf"):
        with (folder / name).open("a") as file:
            file.write("<!-- -->\n" if name.endswith("urdf") else "# another one\n")
        words.add(now(folder).model)
    assert len(words) == 3


def test_a_primitive_that_changes_leaves_results_of_others_valid(folder: Path) -> None:
    before = now(folder)
    file = folder / "actions" / "primitives" / "Trig.yaml"
    file.write_text(
        file.read_text().replace("Index_Finger_Distal: 1.334", "Index_Finger_Distal: 1.2")
    )
    after = now(folder)
    assert after.files != before.files
    assert after.model == before.model
    changed = {name for name in after.actions if after.actions[name] != before.actions[name]}
    assert "Trig index" in changed
    assert "Trig middle" not in changed


def test_margins_tell_timed_actions_apart(folder: Path) -> None:
    library = library_of(folder)
    for name, margin in (("slow", 0.5), ("quick", 0.0), ("brisk", 0.0)):
        steps = [
            StepPlan(ActionReference(*FIST), after=margin),
            StepPlan(ActionReference(*PINCH)),
        ]
        library.add(library.sequence(name, steps), store=True)
    words = now(folder).actions
    assert words["quick"] == words["brisk"] != words["slow"]


def test_what_is_the_same_is_judged_by_action() -> None:
    then = {"made_with": "0", "model": "m", "actions": {"fist": "f", "wave": "w"}}
    present = Fingerprints("1", "m", {"fist": "f", "wave": "x"})
    assert present.same("fist", then)
    assert not present.same("wave", then), "it does something else now"
    assert not present.same("Grasp", then), "nothing is known of it"
    assert not Fingerprints("1", "n", present.actions).same("fist", then), "another model"
    assert not Fingerprints("1", "m").same("fist", then), "the action is gone"


def test_files_of_older_versions_tell_all_actions_or_none() -> None:
    present = Fingerprints("1", "m", {"fist": "f"})
    assert present.same("fist", {"made_with": "1"})
    assert not present.same("fist", {"made_with": "0"})
