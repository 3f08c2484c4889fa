"""A new driver package passes the suite, and a package elsewhere may use it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rtee.drivers.emulators import find_emulator
from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError
from rtee.testing.scaffold import write_package


def test_a_new_package_passes_its_tests(tmp_path: Path) -> None:
    write_package("my_gripper", tmp_path)
    folder = tmp_path / "my_gripper"
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider", "tests"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder), "RTEE_CONTRACT_CYCLES": "20"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "skipped" not in run.stdout


def test_its_classes_are_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_package("other_gripper", tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path / "other_gripper"))
    assert find_driver("other_gripper.driver:OtherGripperDriver").__name__ == "OtherGripperDriver"
    assert {"overload"} <= find_emulator("other_gripper.emulator:OtherGripperEmulator").FAULTS


@pytest.mark.parametrize("name", ["My", "2f", "a-b", "class", "robotiq_2f", "rtee", "../x", "ä"])
def test_names_that_cannot_be(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError):
        write_package(name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    write_package("mine", tmp_path)
    with pytest.raises(ConfigError, match="is not empty"):
        write_package("mine", tmp_path)
