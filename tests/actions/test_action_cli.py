from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from rtee_process import RTEE
from typer.testing import CliRunner

from rtee.actions.library import ActionLibrary
from rtee.cli._common import app_of, hand_folder
from rtee.cli.actions import actions
from rtee.cli.define import complete_part, complete_set_point, compose, generic, time
from rtee.cli.import_ import import_
from rtee.errors import ActionError, ConfigError, UserError
from rtee.hand.load import load_hand
from rtee.hand.model import Hand


@pytest.fixture
def home(
    hand: Hand, library: ActionLibrary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A configuration of one hand, in the working directory."""
    folder = tmp_path / "config" / "small"
    folder.mkdir(parents=True)
    urdf = Path(hand.urdf.path)
    for suffix in (".urdf", ".srdf"):
        (folder / f"small{suffix}").write_bytes(urdf.with_suffix(suffix).read_bytes())
    (folder / "hand.yaml").write_text("name: small\nurdf: small.urdf\nsrdf: small.srdf\n")
    library.save(folder / "actions")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RTEE_HAND", raising=False)
    return folder


def run(command: Callable[..., None], *words: str) -> str:
    result = CliRunner().invoke(app_of(command), words, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def stored(home: Path) -> ActionLibrary:
    return ActionLibrary.load(load_hand(home), home / "actions")


def test_actions_as_json(home: Path) -> None:
    found = json.loads(run(actions, "small", "--json"))
    assert list(found) == [
        "hand", "fingers", "actuators", "primitives", "composed", "timed", "generic", "seconds",
    ]  # fmt: skip
    assert found["fingers"]["index"] == {"tip": "index_tip", "actuators": ["spread", "index_joint"]}
    assert found["actuators"]["thumb_joint"] == {"lower": 0.2, "upper": 1.0, "rest": 0.2}
    kinds = [primitive["kind"] for primitive in found["primitives"]]
    assert kinds.count("PinchTight") == 2
    assert "MultiPinchTight_3" in kinds
    pinch = found["primitives"][kinds.index("PinchTight")]
    assert pinch["elements"] == ["index", "thumb"]
    assert pinch["involved"] == ["index_joint", "thumb_joint"]
    assert set(pinch["posture"]) == set(found["actuators"])
    assert pinch["evidence"]["contact_at"] == 0.85
    assert found["composed"][0]["parts"][1]["scale"] == 0.3
    assert found["timed"][0]["steps"][1]["alias"] == "pinch"


def test_actions_as_a_table(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    shown = run(actions, "small")
    assert "depth 1.23 mm" in shown
    assert "Trig (thumb) × 0.3" in shown


def test_compose(home: Path) -> None:
    words = ("fist", "trig:index", "trig:middle*0.5", "--hand", "small", "--description", "a fist")
    assert "'fist' is now an action of small" in run(compose, *words)
    fist = stored(home).find("fist")
    assert fist.posture.position["middle_joint"] == pytest.approx(0.5)
    assert fist.description == "a fist"
    with pytest.raises(ActionError, match="already is"):
        run(compose, *words)
    run(compose, *words, "--replace")


def test_what_replaces_an_action_keeps_its_description_unless_it_brings_one(home: Path) -> None:
    words = ("fist", "trig:index", "--hand", "small")
    run(compose, *words, "--description", "a fist")
    run(compose, "fist", "trig:middle", "--hand", "small", "--replace")
    assert stored(home).find("fist").description == "a fist"
    assert stored(home).find("fist").posture.involved == ("middle_joint",)
    run(compose, *words, "--replace", "--description", "another")
    assert stored(home).find("fist").description == "another"


def test_compose_warns_of_a_scale_above_one(home: Path) -> None:
    result = CliRunner().invoke(app_of(compose), ["hard", "trig:index*1.5", "--hand", "small"])
    said = "rtee: warning: 'hard' scales Trig (index) by 1.5"
    assert said in result.stderr
    later = subprocess.run([*RTEE, "actions", "small"], capture_output=True, text=True)
    assert later.stderr.startswith(said)


def test_time(home: Path) -> None:
    run(time, "two", "schunkGrasp:after=0.5", "trig:index*0.5:before=0.2,alias=on", "--hand=small")
    first, second = stored(home).find("two").steps
    assert (first.alias, first.after) == ("schunkGrasp", 0.5)
    assert (second.alias, second.before, second.use.scale) == ("on", 0.2, 0.5)


def test_generic(home: Path) -> None:
    run(generic, "low", "middle_joint=-0.25", "spread=0.01", "--hand", "small")
    posture = stored(home).find("low").posture
    assert posture.involved == ("spread", "middle_joint")
    assert posture.position["middle_joint"] == -0.25


@pytest.mark.parametrize(
    ("module", "words", "message"),
    [
        (compose, ["x", "trig:"], "is not an action"),
        (compose, ["x", "trig:index*much"], "must be a number"),
        (compose, ["a/b", "trig:index"], "not allowed"),
        (compose, ["x", "trig:index", "trig:index", "--independent"], "twice"),
        (time, ["x", "schunkGrasp:while=2"], "not a margin"),
        (time, ["x", "schunkGrasp:after=-2"], "margin after"),
        (generic, ["x", "middle_joint"], "ACTUATOR=VALUE"),
        (generic, ["x", "spread=0.01", "spread=0.02"], "given twice"),
        (generic, ["x", "spread=1"], "upper limit 0.05 m"),
    ],
)
def test_mistakes_change_nothing(
    home: Path, module: object, words: list[str], message: str
) -> None:
    before = {p: p.read_bytes() for p in home.rglob("*") if p.is_file()}
    with pytest.raises(UserError, match=message):
        run(module, *words, "--hand", "small")
    assert {p: p.read_bytes() for p in home.rglob("*") if p.is_file()} == before


def test_import(home: Path, tmp_path: Path) -> None:
    peers = tmp_path / "peers"
    peers.mkdir()
    joints = "{spread: [0.02], index_joint: [0], middle_joint: [0], thumb_joint: [0]}"
    (peers / "wide.yaml").write_text(
        f"wide:\n  Type: 1\n  JointsInvolvedCount: {{spread: 1}}\n  JointPos: {joints}\n"
        f"point:\n  Type: 1\n  JointsInvolvedCount: {{spread: 1}}\n  JointPos: {joints}\n"
    )
    shown = run(import_, str(peers), "--hand", "small")
    assert "point already exists and is kept" in shown
    assert "1 actions from 1 files" in shown
    library = stored(home)
    assert library.find("wide").posture.position["spread"] == 0.02
    assert library.find("point").posture.position["middle_joint"] == 0.8
    out = tmp_path / "out"
    assert "2 actions" in run(import_, str(peers), "--hand", "small", "--out", str(out))
    assert sorted(p.name for p in out.rglob("*.yaml")) == ["point.yaml", "wide.yaml"]


def test_hand_by_name_or_path(home: Path) -> None:
    assert hand_folder("small").resolve() == home
    assert hand_folder(str(home)) == home
    assert hand_folder(str(home / "hand.yaml")) == home
    with pytest.raises(ConfigError, match="has no hand"):
        hand_folder("./none")
    with pytest.raises(ConfigError, match="unknown hand 'smal'"):
        hand_folder("smal")


def test_parts_and_set_points_are_completed(home: Path) -> None:
    class Context:
        def __init__(self, **params: object) -> None:
            self.params = params

    assert complete_part(Context(hand="small"), "trig:i") == ["trig:index"]
    assert complete_part(Context(hand="small"), "Pinch")[0] == "PinchTight:index,thumb"
    assert "schunkGrasp" in complete_part(Context(hand="small"), "sch")
    assert complete_part(Context(hand="none"), "") == []
    assert complete_set_point(Context(hand="small"), "middle") == ["middle_joint="]
    assert complete_set_point(Context(hand="none"), "") == []
