"""The ament package ``rtee_msgs``, for programs that are compiled against rtee's interfaces."""

from __future__ import annotations

from pathlib import Path

from rtee.hand.files import new_tree
from rtee.ros2.types import definitions

NAME = "rtee_msgs"
"""Name of the package."""


def interface_files() -> dict[str, str]:
    """Return the definitions of the package by path: ``msg/Goal.msg``, ``action/Grasp.action``."""
    paths = {}
    for name, text in definitions().items():
        package, kind, last = name.split("/")
        if package == NAME:
            paths[f"{kind}/{last}.{kind}"] = text
    return dict(sorted(paths.items()))


def _needed(files: dict[str, str]) -> list[str]:
    """Return the other packages that the definitions refer to."""
    codes = (
        line.partition("#")[0].split() for text in files.values() for line in text.splitlines()
    )
    words = {code[0] for code in codes if code}
    return sorted({word.partition("/")[0] for word in words if "/" in word} - {NAME})


def _package_xml(needed: list[str]) -> str:
    # No definition names action_msgs, but the generated code of actions needs it.
    depends = "".join(f"  <depend>{name}</depend>\n" for name in needed)
    return f"""\
<?xml version="1.0"?>
<package format="3">
  <name>{NAME}</name>
  <version>0.1.0</version>
  <description>Messages, services and actions of rtee, for robotic hands.</description>
  <maintainer email="rtee@example.org">rtee</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
{depends}  <depend>action_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export>
    <build_type>ament_cmake</build_type>
  </export>
</package>
"""


def _cmake(files: dict[str, str], needed: list[str]) -> str:
    find = "".join(f"find_package({name} REQUIRED)\n" for name in needed)
    listed = "".join(f'  "{path}"\n' for path in files)
    return f"""\
cmake_minimum_required(VERSION 3.8)
project({NAME})

find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{find}
rosidl_generate_interfaces(${{PROJECT_NAME}}
{listed}  DEPENDENCIES {" ".join(needed)}
)

ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""


def write_package(parent: Path) -> Path:
    """Write the package into a new folder in a parent such as ``src``, and return that folder.

    Raises `ConfigError` if it exists already or cannot be written.
    """
    folder = parent / NAME
    files = interface_files()
    needed = _needed(files)
    files |= {"CMakeLists.txt": _cmake(files, needed), "package.xml": _package_xml(needed)}
    with new_tree(folder) as place:
        for name, text in files.items():
            path = place / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, "utf-8")
    return folder
