from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.actions.action_files import custom_changes, primitive_changes
from rtee.actions.build import StepPlan, generic
from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference, Composed, Evidence, Primitive
from rtee.errors import ActionError, RteeError
from rtee.hand.model import Hand
from rtee.hand.yamlfile import emit, read_emitted

GENERIC = "name: point\nset_points:\n  middle_joint: 0.8\n"


def _stored(library: ActionLibrary, folder: Path) -> ActionLibrary:
    library.save(folder)
    return ActionLibrary.load(library.hand, folder)


def test_everything_round_trips(library: ActionLibrary, tmp_path: Path) -> None:
    assert list(_stored(library, tmp_path)) == list(library)


def test_text_is_deterministic(
    hand: Hand, primitives: tuple[Primitive, ...], tmp_path: Path
) -> None:
    first = primitive_changes(tmp_path, hand, primitives)
    second = primitive_changes(tmp_path, hand, reversed(primitives))
    assert len(first.files) == len({p.name for p in primitives})
    assert first.files == second.files


def test_numbers_are_stored_to_the_nanometre(library: ActionLibrary, tmp_path: Path) -> None:
    pinch = library.find("PinchTight", ("index", "thumb"))
    assert isinstance(pinch, Primitive)
    fine = replace(pinch, evidence=(Evidence(depth=0.12345678912), pinch.evidence[1]))
    library.add(fine, replace_same=True)
    stored = _stored(library, tmp_path).find("PinchTight", ("index", "thumb"))
    assert isinstance(stored, Primitive)
    assert stored.evidence[0].depth == 0.123456789


def test_primitive_kinds_that_are_gone_lose_their_file(
    hand: Hand, primitives: tuple[Primitive, ...], tmp_path: Path
) -> None:
    primitive_changes(tmp_path, hand, primitives).write()
    primitive_changes(tmp_path, hand, [p for p in primitives if p.name == "Trig"]).write()
    assert [p.name for p in (tmp_path / "primitives").iterdir()] == ["Trig.yaml"]


def test_equal_files_are_not_written_again(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    before = {p: p.stat().st_ino for p in tmp_path.rglob("*.yaml")}
    library.save()
    assert {p: p.stat().st_ino for p in tmp_path.rglob("*.yaml")} == before


def test_comments_survive_a_rewrite(library: ActionLibrary, tmp_path: Path) -> None:
    custom_changes(tmp_path, [library.find("schunkGrasp")]).write()
    path = tmp_path / "composed" / "schunkGrasp.yaml"
    text = path.read_text()
    text = "# ours, made on Monday\n" + text.replace(
        "- action: Trig\n  elements: [thumb]",
        "# gently\n- action: Trig   # thumb\n  elements: [thumb]",
    )
    path.write_text(text)
    grasp = library.find("schunkGrasp")
    assert isinstance(grasp, Composed)
    more = (replace(grasp.parts[0], scale=0.75), *grasp.parts[1:])
    custom_changes(tmp_path, [replace(grasp, parts=more)]).write()
    expected = text.replace("scale: 1.0", "scale: 0.75", 1)
    assert path.read_text() == expected


def test_comments_in_primitives_survive_new_evidence(
    hand: Hand, primitives: tuple[Primitive, ...], tmp_path: Path
) -> None:
    primitive_changes(tmp_path, hand, primitives).write()
    path = tmp_path / "primitives" / "PinchTight.yaml"
    path.write_text(path.read_text().replace("index_joint: 0.5", "index_joint: 0.5  # the best"))
    changed = [
        replace(p, evidence=(replace(p.evidence[0], depth=0.5), p.evidence[1])) if p.evidence else p
        for p in primitives
        if p.elements != ("middle", "thumb")
    ]
    primitive_changes(tmp_path, hand, changed).write()
    text = path.read_text()
    assert "index_joint: 0.5  # the best" in text
    assert "depth: 0.5" in text
    loaded = ActionLibrary.load(hand, tmp_path).all(name="PinchTight")
    assert loaded == [p for p in changed if p.name == "PinchTight"]


def test_comments_survive_beside_letters_of_any_alphabet(
    library: ActionLibrary, tmp_path: Path
) -> None:
    grasp = library.find("schunkGrasp")
    assert isinstance(grasp, Composed)
    custom_changes(tmp_path, [grasp]).write()
    path = tmp_path / "composed" / "schunkGrasp.yaml"
    path.write_text("# ours\n" + path.read_text())
    custom_changes(tmp_path, [replace(grasp, description="schließen 🤏")]).write()
    assert path.read_text().startswith("# ours\n")
    assert "schließen" in path.read_text()


def test_a_file_may_use_aliases(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    (tmp_path / "composed" / "both.yaml").write_text(
        "name: both\nparts:\n"
        "- {action: trig, elements: [index], scale: &some 0.25}\n"
        "- {action: trig, elements: [thumb], scale: *some}\n"
    )
    both = ActionLibrary.load(library.hand, tmp_path).find("both")
    assert isinstance(both, Composed)
    assert [part.scale for part in both.parts] == [0.25, 0.25]
    (tmp_path / "composed" / "both.yaml").write_text("name: both\nparts: &parts\n- *parts\n")
    with pytest.raises(ActionError, match=r"both.yaml:2: an alias"):
        ActionLibrary.load(library.hand, tmp_path)


def test_added_parts_keep_the_style(library: ActionLibrary, tmp_path: Path) -> None:
    grasp = library.find("schunkGrasp")
    assert isinstance(grasp, Composed)
    custom_changes(tmp_path, [replace(grasp, parts=grasp.parts[:1])]).write()
    path = tmp_path / "composed" / "schunkGrasp.yaml"
    path.write_text(path.read_text() + "# the end\n")
    custom_changes(tmp_path, [grasp]).write()
    assert "  elements: [thumb]\n  scale: 0.3\n" in path.read_text()
    assert "# the end" in path.read_text()


def test_hand_written_files_may_leave_out_the_defaults(
    library: ActionLibrary, tmp_path: Path
) -> None:
    library.save(tmp_path)
    (tmp_path / "timed" / "Wave.yml").write_text(
        "# up and down\nname: wave\nsteps:\n"
        "  - {action: trig, elements: [index], alias: 'up'}\n"
        "  - {action: trig, elements: [index], scale: 0, after: 1}\n"
    )
    wave = ActionLibrary.load(library.hand, tmp_path).find("wave")
    assert [step.alias for step in wave.steps] == ["up", "Trig_index"]
    assert wave.steps[1].posture.position["index_joint"] == 0.0


def test_stored_limit_may_be_rounded(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    path = tmp_path / "generic" / "point.yaml"
    path.write_text(GENERIC.replace("0.8", "1.0000004"))
    found = ActionLibrary.load(library.hand, tmp_path).find("point")
    assert found.posture.position["middle_joint"] == 1.0


BAD = {
    "tab": ("name: point\nset_points:\n\tmiddle_joint: 0.8\n", 3, "tab"),
    "unknown key": (GENERIC + "colour: red\n", 4, "colour: unknown key; valid"),
    "misspelled key": (GENERIC.replace("set_points", "set_point"), 2, "did you mean 'set_points'"),
    "NaN": (GENERIC.replace("0.8", ".nan"), 3, "finite"),
    "infinite": (GENERIC.replace("0.8", ".inf"), 3, "finite"),
    "huge": (GENERIC.replace("0.8", "1" + "0" * 400), 3, "64 bits"),
    "unknown actuator": (GENERIC.replace("middle_joint", "midle_joint"), 3, "'middle_joint'"),
    "beyond a limit": (GENERIC.replace("0.8", "1.1"), 3, "upper limit 1 rad"),
    "text for a number": (GENERIC.replace("0.8", "much"), 3, "be a valid number, not 'much'"),
    "truth for a number": (GENERIC.replace("0.8", "true"), 3, "should be a valid number, not True"),
    "slash in the name": (GENERIC.replace(": point", ": a/point"), 1, "not allowed"),
    "dots in the name": (GENERIC.replace(": point", ": po..int"), 1, "'..'"),
    "another name": (GENERIC.replace(": point", ": pointer"), 1, "differ"),
    "name of a primitive": (GENERIC.replace(": point", ": trig"), 1, "primitive"),
    "no name": (GENERIC.replace("name: point\n", ""), 1, "name: is missing"),
    "twice the same key": (GENERIC + "name: point\n", 4, "'name' occurs twice, first in line 1"),
    "empty set-points": ("name: point\nset_points: {}\n", 2, "should have at least 1 items"),
    "list for a mapping": ("- a\n- b\n", 1, "should be a mapping, such as"),
    "broken": ("name: [point\n", 2, "is not YAML"),
    "python object": (
        "!!python/object/apply:os.system [ls]\n",
        1,
        "the tag 'python/object/apply:os.system' is refused",
    ),
    "number as key": (GENERIC.replace("middle_joint", "7"), 3, "unknown actuator '7'"),
    "empty": ("", None, "is empty"),
    "only a comment": ("# nothing\n", None, "is empty"),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_name_file_and_line(library: ActionLibrary, tmp_path: Path, case: str) -> None:
    text, line, message = BAD[case]
    library.save(tmp_path)
    path = tmp_path / "generic" / "point.yaml"
    path.write_text(text)
    with pytest.raises(ActionError) as caught:
        ActionLibrary.load(library.hand, tmp_path)
    where = str(path) if line is None else f"{path}:{line}"
    assert str(caught.value).startswith(f"{where}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("composed/schunkGrasp", "action: Trig", "action: Trik", r":5: unknown action 'Trik'"),
        ("composed/schunkGrasp", "[thumb]", "[ring]", r":8: Trig does not exist with 'ring'"),
        ("composed/schunkGrasp", "0.3", "-0.3", r":10: .*scale: should be .*, not -0.3"),
        ("timed/drill", "after: 0.2", "after: -1", r":13: .*after: should be .*, not -1"),
        ("timed/drill", "alias: pinch", "alias: schunkgrasp", r"two inner actions"),
        ("primitives/Trig", "[index]", "[ring]", r":4: unknown finger 'ring'"),
        ("primitives/Trig", "[index]", "[middle]", r"Trig of middle occurs twice"),
        ("primitives/Trig", "kind: Trig", "kind: Trigger", r":2: unknown kind 'Trigger'"),
        ("primitives/PinchTight", "[index, thumb]", "[index]", r"takes 2 different elements"),
        ("primitives/PinchTight", "depth: 0.001234568", "depth: -1", r"depth: .*, not -1"),
        ("primitives/PinchTight", "deep: 1", "", None),
        ("primitives/MultiPinchTight_3", "Tight_3", "Tight_4", r"takes 4 different elements"),
        ("primitives/SingleJointMultipleTips_3", "[spread]", "[sprat]", r":4: unknown actuator"),
    ],
)
def test_mistakes_in_other_files(
    library: ActionLibrary, tmp_path: Path, file: str, old: str, new: str, message: str | None
) -> None:
    library.save(tmp_path)
    path = tmp_path / f"{file}.yaml"
    path.write_text(re.sub(r"^#.*\n", "#\n", path.read_text()).replace(old, new))
    if message is None:
        assert len(ActionLibrary.load(library.hand, tmp_path)) == len(library)
        return
    with pytest.raises(ActionError, match=f"{file}.*{message}"):
        ActionLibrary.load(library.hand, tmp_path)


def test_cycles_are_refused_with_their_chain(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    for name, other in (("a", "b"), ("b", "c"), ("c", "a")):
        text = f"name: {name}\nparts:\n- action: {other}\n"
        (tmp_path / "composed" / f"{name}.yaml").write_text(text)
    with pytest.raises(ActionError, match=r"c\.yaml:3: .* would contain itself: a > b > c > a"):
        ActionLibrary.load(library.hand, tmp_path)


def test_one_name_in_two_files_is_refused(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    text = "name: Point\nparts:\n- action: trig\n  elements: [index]\n"
    (tmp_path / "composed" / "Point.yaml").write_text(text)
    with pytest.raises(ActionError, match=r"Point.yaml:1: the name 'Point' is already taken by"):
        ActionLibrary.load(library.hand, tmp_path)


def test_unreadable_text_is_refused(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    path = tmp_path / "generic" / "point.yaml"
    path.write_bytes(b"name: point\nx: \xff\xfe\n")
    with pytest.raises(ActionError, match=r"point.yaml:2: .* is not UTF-8"):
        ActionLibrary.load(library.hand, tmp_path)


_PIECES = (
    ":",
    "- ",
    "  ",
    "\t",
    "[",
    "]",
    "{",
    "}",
    "&a ",
    "*a",
    "!!",
    "? ",
    "|",
    ">",
    "'",
    '"',
    "~",
)
_VALUES = (
    "1e999",
    ".nan",
    "2001-99-99",
    "0o9",
    "<<",
    "\x00",
    "\ud7ff",
    "-",
    "#",
    "name",
    "\n",
    "%",
)


@pytest.fixture(scope="session")
def folder(
    hand: Hand, primitives: tuple[Primitive, ...], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp("damaged")
    made = ActionLibrary(hand, primitives[3:6])
    made.add(made.compose("fist", [ActionReference("PinchTight", ("index", "thumb"), 0.5)]))
    made.add(made.sequence("wave", [StepPlan(ActionReference("fist"), after=0.5)]))
    made.add(generic(hand, "point", {"middle_joint": 0.8}))
    made.save(folder)
    return folder


@given(data=st.data())
def test_damaged_files_end_in_an_error_of_ours_or_none(
    hand: Hand, folder: Path, data: st.DataObject
) -> None:
    path = data.draw(st.sampled_from(sorted(folder.rglob("*.yaml"))))
    whole = text = path.read_text()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        cut = data.draw(st.integers(0, 6))
        piece = data.draw(st.sampled_from(_PIECES + _VALUES) | st.text(max_size=5))
        text = text[:at] + piece + text[at + cut :]
    path.write_bytes(text.encode("utf-8", "replace"))
    try:
        loaded = ActionLibrary.load(hand, folder)
        assert len(loaded) <= 6
    except RteeError as error:
        assert "\n" not in str(error)  # noqa: PT017
    finally:
        path.write_text(whole)


_NAMES = st.text(min_size=1, max_size=8)
_NUMBERS = st.floats(allow_nan=False, allow_infinity=False).map(lambda x: round(x, 9) + 0.0)
_SCALARS = st.none() | st.booleans() | st.integers() | _NUMBERS | _NAMES
_LISTS = st.lists(_SCALARS | st.lists(_SCALARS, max_size=3), max_size=3)
_MAPS = st.recursive(
    st.dictionaries(_NAMES, _SCALARS | _LISTS, min_size=1, max_size=3),
    lambda inner: st.dictionaries(
        _NAMES, inner | st.lists(inner, min_size=1, max_size=2), min_size=1, max_size=3
    ),
    max_leaves=6,
)


@given(data=_MAPS)
def test_the_fast_reader_reads_what_a_full_one_does(data: dict[str, object]) -> None:
    from ruamel.yaml import YAML

    text = emit(data)
    assert YAML(typ="safe", pure=True).load(text) == data
    assert read_emitted(text) in (data, None)


def test_the_fast_reader_reads_files_of_actions(library: ActionLibrary, tmp_path: Path) -> None:
    library.save(tmp_path)
    assert all(read_emitted(path.read_text()) for path in tmp_path.rglob("*.yaml"))


@pytest.mark.parametrize(
    "text",
    [
        "a: 1 # one\n",
        "a:  1\n",
        "a: 'x'\n",
        "a: 1",
        "a: 0x10\n",
        "a: &b 1\n",
        "a: 1\na: 2\n",
        "a: [{}]\n",
        "a: {}\n",
        "a: {b: 1}\n",
        "a: yes\n",
        "a:\n    b: 1\n",
        "  a: 1\n",
        "a: 1\n\nb: 2\n",
        "# \x0b\na: 1\n",
        "",
        "a:\n",
    ],
)
def test_the_fast_reader_leaves_other_text_alone(text: str) -> None:
    assert read_emitted(text) is None
