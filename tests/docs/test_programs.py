"""The programs in examples/ and on the pages of the Python API run."""

from __future__ import annotations

import re
import runpy
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from patient import patient_gripper

import rtee
from rtee.remote.directory import VARIABLE
from rtee.testing.running import running_hand

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs/reference/api"

MOST_LINES = 25
"""Longest program [lines]: what takes more is a fault of the API."""

HANDS = ["pick_and_act", "two_hands", "teleoperate", "compose", "live_plot", "to_pandas"]
"""Programs that need a running hand, or its recordings, in this order."""

ALONE = ["notebook", "offline", "jaw_driver"]

SLOW = ["batch"]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the recordings of two hands that run: one emulated, one kinematic."""
    folder = tmp_path_factory.mktemp("hands")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, str(folder / "run"))
        patch.setenv("MPLBACKEND", "agg")
        patch.setenv("RTEE_CONFIG_PATH", str(folder / "config"))
        gripper = patient_gripper(folder / "config", ROOT)
        shutil.copytree(ROOT / "config/schunk_svh", folder / "config/schunk_svh")
        slow(gripper)
        slow(folder / "config/schunk_svh/hand.yaml")
        patch.chdir(folder)
        with (
            running_hand("robotiq_2f_85", folder=folder, object="50mm"),
            running_hand("schunk_svh", folder=folder, driver="kinematic"),
        ):
            yield folder


def slow(file: Path) -> None:
    """Let the loop of a hand.yaml run at 200 Hz, which takes less of the processor than 1 kHz."""
    text = file.read_text()
    assert "\n  rate:" not in text
    file.write_text(text.replace("\nloop:\n", "\nloop:\n  rate: 200\n"))


def shortened(program: Path, folder: Path) -> str:
    """Copy a program that lasts for some seconds as one that ends at once."""
    copy = folder / program.name
    copy.write_text(program.read_text().replace("SECONDS = 2.0", "SECONDS = 0.2"))
    return str(copy)


@pytest.mark.parametrize(
    "name", [*ALONE, *(pytest.param(n, marks=pytest.mark.heavy) for n in SLOW)]
)
def test_a_program_needs_no_hand(name: str) -> None:
    runpy.run_path(str(ROOT / f"examples/{name}.py"), run_name="__main__")


# From here on hands run.


@pytest.mark.parametrize("name", HANDS)
def test_a_program_does_something_with_a_hand(
    name: str, place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "to_pandas":
        pytest.importorskip("pandas")
    monkeypatch.setattr(sys, "argv", [name])
    runpy.run_path(shortened(ROOT / f"examples/{name}.py", place), run_name="__main__")
    said = capsys.readouterr().out
    assert said or name == "live_plot"
    if name == "pick_and_act":
        assert 0.045 < float(said.split()[1]) < 0.055


def test_the_limits_of_a_gripper_are_known_before_its_first_goal(place: Path) -> None:
    with rtee.connect_blocking("robotiq_2f_85") as hand:
        limits = hand.limits()
    assert limits.width == pytest.approx((0.0, 0.086), abs=1e-3)
    assert limits.force == pytest.approx((20.0, 235.0))
    assert 0.1 < limits.speed < 0.2


def test_programs_are_short() -> None:
    names = [*HANDS, *ALONE, *SLOW, "test_picking"]
    lengths = {n: len((ROOT / f"examples/{n}.py").read_text().splitlines()) for n in names}
    assert {name: length for name, length in lengths.items() if length > MOST_LINES} == {}


LONG = ("extract", "log", "planning", "trials")


def blocks() -> list[tuple[str, str]]:
    found = []
    for page in sorted(PAGES.glob("*.md")):
        found += [
            (page.stem, code) for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.S)
        ]
    return found


@pytest.mark.parametrize(
    ("page", "code"),
    [
        pytest.param(
            p,
            c,
            id=p,
            marks=[pytest.mark.heavy]
            if p in ("trials", "extract", "planning", "log", "retarget")
            else [],
        )
        for p, c in blocks()
    ],
)
def test_the_program_of_a_page_runs(page: str, code: str, place: Path) -> None:
    if page == "log":
        pytest.importorskip("pandas")
    exec(compile(code, page, "exec"), {"__name__": "__main__"})
