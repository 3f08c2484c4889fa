"""A comparison asks what tells most first, and names the hands that hold all objects."""

from __future__ import annotations

import json
import sys
from concurrent.futures import Future
from dataclasses import asdict, replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from rtee.cli.main import main
from rtee.planning.plan import grasp_plan
from rtee.trials.answers import Answers
from rtee.trials.comparison import Cell, Comparison
from rtee.trials.sweep import Local, Sweep
from rtee.trials.trial import Trial, TrialResult
from rtee.trials.work import Answer, MadeWith, Picture, Planned, Planning, Portrait, Task

LEFT, RIGHT = "robotiq_2f_85", "wsg50"
THIN, WIDE = "sphere:0.01", "sphere:0.02"
HELD = {(LEFT, THIN): 9, (RIGHT, THIN): 2, (RIGHT, WIDE): 9, (LEFT, WIDE): 0}
"""Of ten variations; of no variation where none is held."""


class Told(Local):
    """Answers from a table instead of physics."""

    def __init__(self) -> None:
        super().__init__(1)
        self.asked: list[str] = []
        self.ranking = grasp_plan(LEFT, THIN)

    def submit(self, hand: str, task: Task) -> Future[str]:
        self.asked.append(type(task).__name__ + str(getattr(task, "variations", "")))
        done: Future[str] = Future()
        said = {"worker": "here", "made_with": asdict(MadeWith.of(hand, task))}
        done.set_result(json.dumps({**said, "answer": asdict(self.answer(hand, task))}))
        return done

    def answer(self, hand: str, task: Task) -> Answer:
        match task:
            case Planning():
                return Planned(self.ranking)
            case Portrait():
                return Picture("cGljdHVyZQ==")
            case Trial():
                count = HELD[hand, task.object]
                survived = count if task.variations else 0
                return TrialResult(task, count > 0, "" if count else "it fell", survived=survived)


def test_first_answers_come_first_and_the_pair_that_holds_all_is_told(tmp_path: Path) -> None:
    like = Trial("", variations=10, wanted=0.7)
    found = Comparison((LEFT, RIGHT), (THIN, WIDE), like, pictures=True)
    workers = Told()
    plans = workers.ranking.plans
    assert plans
    workers.ranking = replace(workers.ranking, plans=plans[:1])
    known = Answers(tmp_path)
    sweep = Sweep(workers, known)
    found.begin(sweep)
    assert found.sentence() == "so far: no hand holds any of the objects"
    for hand, task, answer in sweep.run():
        found.take(sweep, hand, task, answer)
    assert workers.asked == ["Planning"] * 4 + ["Trial0"] * 4 + ["Trial10"] * 3 + ["Portrait"] * 3
    assert found.covering() == ([(LEFT, RIGHT)], ())
    assert found.sentence() == f"{LEFT} and {RIGHT}: hold all 2 objects"
    cells = {(cell["hand"], cell["object"]): cell for cell in found.document()["cells"]}
    assert cells[LEFT, WIDE]["why"].endswith(": it fell")
    assert cells[RIGHT, THIN]["why"] == "held in 2 of 10 variations"
    # Held once, and then in no variation.
    cell = Cell(LEFT, THIN, TrialResult(Trial("Grasp", (), THIN), held=True), "Grasp: it fell")
    found.cells[LEFT, WIDE] = cell
    found._end(sweep, cell)
    assert (cell.rated, cell.missing) == ("held once, not varied", "Grasp: it fell")
    page = found.page()
    assert page.count("data:image/png;base64,cGljdHVyZQ==") == 3
    assert "9 of 10 (60 to 98 %)" in page
    known.write()
    again = Sweep(workers, Answers(tmp_path))
    found = Comparison((LEFT, RIGHT), (THIN,), like, pictures=True)
    found.begin(again)
    for hand, task, answer in again.run():
        found.take(again, hand, task, answer)
    assert len(workers.asked) == 14, "all of it is known"
    assert found.sentence() == f"{LEFT}: holds it"


def test_parts_that_fit_nowhere_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "parts").mkdir()
    trimesh.creation.box((0.2, 0.2, 0.2)).export(tmp_path / "parts/cube.stl")
    (tmp_path / "parts/cup.ply").touch()
    words = ["--objects", str(tmp_path / "parts"), "--out", str(tmp_path / "out"), "--jobs", "1"]
    monkeypatch.setattr(sys, "argv", ["rtee", "compare", LEFT, *words, "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    output, notes = capsys.readouterr()
    said = json.loads(output)
    assert "no meshes that are read here (.stl, .obj): cup.ply" in notes
    assert ended.value.code == 1
    assert said["missing"] == [str(tmp_path / "parts/cube.stl")]
    assert "the hand opens to 86 mm" in said["cells"][0]["why"]
    assert "no hand holds any of the objects" in (tmp_path / "out/index.html").read_text()
