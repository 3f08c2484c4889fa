from __future__ import annotations

import json
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest

from extract.models import figure_3
from rtee.actions.fingerprints import Fingerprints
from rtee.actions.library import ActionLibrary
from rtee.cli.main import main
from rtee.extract import report as report_room
from rtee.hand.catalog import find_hand
from rtee.hand.load import load_configured
from rtee.trials.result import Trial, TrialResult
from rtee.trials.store import write_results

Run = tuple[int, str, str]


def rtee(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: object
) -> Run:
    """Return exit status, output and errors of a command."""
    monkeypatch.setattr(sys, "argv", ["rtee", *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        main()
    output = capsys.readouterr()
    return int(left.value.code or 0), output.out, output.err


@pytest.fixture
def model(tmp_path: Path) -> list[object]:
    """Options that name the hand of figure 3, variant 4."""
    figure_3(4).load(tmp_path)
    return ["--urdf", tmp_path / "figure_3_4.urdf", "--srdf", tmp_path / "figure_3_4.srdf"]


def test_json_prints_one_object(
    model: list[object], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    status, out, err = rtee(capsys, monkeypatch, "extract", *model, "--json")
    found = json.loads(out)
    assert status == 0
    assert err == ""
    assert found["hand"] == "figure_3_4"
    assert found["fingers"]["thumb"] == {
        "tip": "thumb",
        "actuators": ["thumb_swivel", "thumb_flexion"],
    }
    assert found["actuators"]["thumb_swivel"] == {"lower": -0.7, "upper": 0.7, "rest": 0.0}
    assert found["seconds"] > 0
    pinch = next(p for p in found["primitives"] if p["kind"] == "PinchTight")
    assert pinch["elements"] == ["first", "thumb"]
    assert set(pinch["posture"]) == set(found["actuators"])
    assert set(pinch["involved"]) == {"first_flexion", "thumb_swivel", "thumb_flexion"}
    assert pinch["evidence"]["depth"] > 0
    assert pinch["evidence"]["clear"] is True
    assert set(pinch["evidence"]["opposition"]) == {"angles", "force_closure", "friction"}


def test_two_runs_write_identical_files_that_the_library_reads(
    model: list[object],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for out, jobs in (("one", 1), ("two", 2)):
        command = ["extract", *model, "--out", tmp_path / out, "--jobs", jobs]
        assert rtee(capsys, monkeypatch, *command)[0] == 0
    one, two = (
        {p.name: p.read_bytes() for p in (tmp_path / out / "primitives").iterdir()}
        for out in ("one", "two")
    )
    assert one == two
    assert {"PinchTight.yaml", "Trig.yaml", "TipFlex.yaml", "FingFlex.yaml"} == set(one)
    hand = figure_3(4).load(tmp_path)
    library = ActionLibrary.load(hand, tmp_path / "one")
    assert len(library.all(kind="primitive")) == 7


def test_the_table_shows_every_primitive(
    model: list[object], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    status, out, _ = rtee(capsys, monkeypatch, "extract", *model)
    assert status == 0
    assert out.count("PinchTight") == 2
    assert out.count("Trig") == 3
    assert "thumb_swivel" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give a hand, --urdf or --mjcf, and only one of them"),
        (["--urdf", "missing.urdf"], "missing.urdf"),
        (["dagana", "--srdf", "a.srdf"], "--srdf needs --urdf or --mjcf"),
        (["dagana", "--urdf", "a.urdf"], "give a hand, --urdf or --mjcf, and only one of them"),
        (["no_such_hand"], "unknown hand 'no_such_hand'"),
    ],
)
def test_mistakes_are_one_sentence_and_status_2(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    status, out, err = rtee(capsys, monkeypatch, "extract", *arguments)
    assert status == 2
    assert out == ""
    assert message in err
    assert err.count("\n") == 1


def test_save_needs_a_hand_of_the_configuration(
    model: list[object], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    status, _, err = rtee(capsys, monkeypatch, "extract", *model, "--save")
    assert status == 2
    assert "--save needs a configured hand" in err


def test_a_missing_mesh_leaves_nothing_behind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    urdf = tmp_path / "hand.urdf"
    urdf.write_text(
        """<robot name="hand"><link name="base"/><link name="tip">
        <collision><geometry><mesh filename="gone.stl"/></geometry></collision></link>
        <joint name="bend" type="revolute"><parent link="base"/><child link="tip"/>
        <axis xyz="0 1 0"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint></robot>"""
    )
    out = tmp_path / "out"
    status, _, err = rtee(capsys, monkeypatch, "extract", "--urdf", urdf, "--out", out)
    assert status == 2
    assert f"{urdf}:2: mesh 'gone.stl' does not exist" in err
    assert not out.exists()


ON_A_WRIST = """<robot name="g"><link name="arm"/><link name="palm"/>
<joint name="wrist" type="revolute"><parent link="arm"/><child link="palm"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="5"/></joint>
<link name="left"><collision><geometry><box size="0.01 0.02 0.03"/></geometry></collision></link>
<link name="right"><collision><geometry><box size="0.01 0.02 0.03"/></geometry></collision></link>
<joint name="slide" type="prismatic"><parent link="palm"/><child link="left"/>
<origin xyz="-0.005 0 0.05"/><axis xyz="-1 0 0"/>
<limit lower="0" upper="0.03" velocity="0.1" effort="10"/></joint>
<joint name="other" type="prismatic"><parent link="palm"/><child link="right"/>
<origin xyz="0.005 0 0.05"/><axis xyz="1 0 0"/><mimic joint="slide"/>
<limit lower="0" upper="0.03" velocity="0.1" effort="10"/></joint></robot>"""


def test_a_model_is_the_hand_that_rtee_new_makes_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both ignore a wrist, and let a gripper that is closed at zero rest open."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "g.urdf").write_text(ON_A_WRIST)
    command = ("extract", "--json", "--jobs", "1")
    alone = rtee(capsys, monkeypatch, *command, "--urdf", "g.urdf")
    assert rtee(capsys, monkeypatch, "new", "g", "--urdf", "g.urdf")[0] == 0
    made = rtee(capsys, monkeypatch, *command, "g")
    first, second = json.loads(alone[1]), json.loads(made[1])
    assert first | {"seconds": 0} == second | {"seconds": 0}
    assert first["actuators"] == {"slide": {"lower": 0.0, "upper": 0.03, "rest": 0.03}}
    assert [each["kind"] for each in first["primitives"]] == [
        "PinchTight",
        "SingleJointMultipleTips_2",
    ]
    assert "'wrist' moves all fingers as one body" in alone[2]
    assert "'rest: {slide: 0.03}' in hand.yaml" in alone[2]


HAND_WITHOUT_FINGER = """<robot name="bare">
<link name="palm"><collision><geometry><box size="0.1 0.1 0.02"/></geometry></collision></link>
<link name="jaw"/><joint name="slide" type="prismatic"><parent link="palm"/><child link="jaw"/>
<axis xyz="1 0 0"/><limit lower="0" upper="0.05" velocity="0.1" effort="10"/></joint></robot>"""


def test_a_hand_without_a_finger_has_no_primitives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    urdf = tmp_path / "bare.urdf"
    urdf.write_text(HAND_WITHOUT_FINGER)
    status, out, err = rtee(capsys, monkeypatch, "extract", "--urdf", urdf, "--jobs", "1")
    assert status == 0
    assert out.split() == ["primitive", "elements", "posture", "evidence"]
    assert "link 'jaw' moves, but it has no collision geometry" in err


def test_a_hand_without_openings_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bare.urdf").write_text(HAND_WITHOUT_FINGER)
    assert rtee(capsys, monkeypatch, "new", "bare", "--urdf", "bare.urdf")[0] == 0
    assert rtee(capsys, monkeypatch, "extract", "bare", "--save", "--jobs", "1")[0] == 0
    said = "note: no action of 'bare' has an opening\n"
    assert rtee(capsys, monkeypatch, "openings", "bare") == (1, "", said)


def test_report_says_that_trials_are_of_other_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, report = tmp_path / "robotiq_2f_85", tmp_path / "report.html"
    shutil.copytree(find_hand("robotiq_2f_85"), folder)
    held = TrialResult(Trial("Grasp", (), "sphere:0.03"), True)
    hand, _ = load_configured(folder)
    present = Fingerprints.of(folder, ActionLibrary.load(hand, folder / "actions"))
    write_results(folder / "trials.yaml", present, [held])
    small = partial(report_room.make_report, size=(60, 56))  # pictures take most of the time
    monkeypatch.setattr(report_room, "make_report", small)
    command = ["extract", folder, "--report", report, "--jobs", "1"]
    assert rtee(capsys, monkeypatch, *command)[0] == 0
    assert "are outdated, made with" not in report.read_text()
    with (folder / "hand.yaml").open("a") as file:
        file.write("# another one\n")
    assert rtee(capsys, monkeypatch, *command)[0] == 0
    assert "are outdated, made with other files of this hand" in report.read_text()
