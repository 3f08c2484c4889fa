"""The ament package that ``rtee ros2 messages`` writes."""

from __future__ import annotations

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
    with pytest.raises(ConfigError, match="is already there"):
        write_package(tmp_path)
