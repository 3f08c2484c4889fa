"""The ament package that ``rtee ros2 messages`` writes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from catkin_pkg.package import parse_package

from rtee.errors import ConfigError
from rtee.ros2.package import NAME, write_package
from rtee.ros2.types import Interfaces, interfaces


def test_what_is_written_has_the_hashes_of_the_wire(tmp_path: Path) -> None:
    folder = write_package(tmp_path)
    written = Interfaces("jazzy")
    written.texts = {
        name: text for name, text in written.texts.items() if not name.startswith(NAME)
    }
    for path in folder.glob("*/*"):
        written.texts[f"{NAME}/{path.parent.name}/{path.stem}"] = path.read_text("utf-8")
    names = [name for name in interfaces().texts if name.startswith(NAME)]
    assert len(names) > 40
    assert {name: written.hash(name) for name in names} == {
        name: interfaces().hash(name) for name in names
    }
    send = f"{NAME}/action/Grasp_SendGoal"
    assert written.hash(send) == interfaces().hash(send)


def test_the_package_names_its_files_and_what_they_need(tmp_path: Path) -> None:
    folder = write_package(tmp_path)
    cmake = (folder / "CMakeLists.txt").read_text()
    files = sorted(str(path.relative_to(folder)) for path in folder.glob("*/*"))
    assert [line.strip().strip('"') for line in cmake.splitlines() if line.startswith('  "')] == (
        files
    )
    root = ElementTree.parse(folder / "package.xml").getroot()
    depends = {one.text for one in root.findall("depend")}
    assert depends == {"action_msgs", "std_msgs"}
    assert "DEPENDENCIES std_msgs" in cmake
    # The parser of ROS' build tools, which checks more than XML.
    warnings: list[str] = []
    package = parse_package(folder / "package.xml", warnings=warnings)
    assert (package.name, warnings) == (NAME, [])


def test_what_exists_is_not_overwritten(tmp_path: Path) -> None:
    write_package(tmp_path)
    with pytest.raises(ConfigError, match="already exists"):
        write_package(tmp_path)


JUDGE = Path(__file__).parents[2] / ".rosidl"


@pytest.mark.heavy
@pytest.mark.skipif(not (JUDGE / ".ready").exists(), reason="rosidl is not installed: make heavy")
def test_rosidl_itself_judges_every_interface(tmp_path: Path) -> None:
    known, own = interfaces("jazzy"), write_package(tmp_path / "definitions")
    for name, text in known.texts.items():
        package, kind, last = name.split("/")
        if package != NAME:  # that one as it is written for users
            path = own.parent / package / kind / f"{last}.{kind}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    for extra in ("CMakeLists.txt", "package.xml"):
        (own / extra).unlink()
    (folder,) = JUDGE.glob("lib/python*/site-packages")
    script = Path(__file__).parent / "peers" / "rosidl_judge.py"
    words = [sys.executable, str(script), str(own.parent), str(tmp_path / "judged")]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    judged: dict[str, str] = json.loads(done.stdout.splitlines()[-1])  # it says what it writes
    assert {name: known.hash(name) for name in judged} == judged
    assert set(known.texts) <= set(judged)
