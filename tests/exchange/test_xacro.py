"""xacro files are expanded in a process of their own, with packages found without ROS."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

pytest.importorskip("xacro", reason="the extra xacro is not installed")

from hand.test_scaffold import stl
from rtee_process import RTEE

from rtee.errors import ConfigError, ModelError
from rtee.exchange import xacro_expand
from rtee.exchange.reading import as_urdf
from rtee.hand.load import load_hand, load_model

HAND = """<?xml version="1.0"?>
<robot name="claw" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="reach" default="0.06"/>
  <xacro:arg name="prefix" default=""/>
  <xacro:property name="reach" value="$(arg reach)"/>
  <xacro:include filename="$(find claw_parts)/urdf/jaw.xacro"/>
  <link name="palm">
    <collision><geometry><mesh filename="package://claw_parts/meshes/palm.stl"/></geometry></collision>
  </link>
  <xacro:jaw name="$(arg prefix)left" side="${-1}"/>
  <xacro:jaw name="$(arg prefix)right" side="1"/>
</robot>
"""

JAW = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="jaw" params="name side">
    <link name="${name}_jaw">
      <collision><origin xyz="0 0 ${reach/2}"/>
        <geometry><box size="0.01 0.02 ${reach}"/></geometry></collision>
    </link>
    <joint name="${name}" type="revolute">
      <parent link="palm"/><child link="${name}_jaw"/>
      <origin xyz="${side*0.04} 0 0.01"/><axis xyz="0 ${-side} 0"/>
      <limit lower="0" upper="${radians(45)}" velocity="2" effort="5"/>
    </joint>
  </xacro:macro>
</robot>
"""

GROUPS = """<robot name="claw" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="prefix" default=""/>
  <group name="one">
    <chain base_link="palm" tip_link="$(arg prefix)left_jaw"/>
  </group>
  <group name="two">
    <chain base_link="palm" tip_link="$(arg prefix)right_jaw"/>
  </group>
  <group name="end_effector_fingers"><group name="one"/><group name="two"/></group>
</robot>
"""


@pytest.fixture
def xacro(tmp_path: Path) -> Path:
    """Return a xacro file whose parts are in a package elsewhere."""
    parts = tmp_path / "ws" / "claw_parts"
    for place, content in (("urdf/jaw.xacro", JAW.encode()), ("meshes/palm.stl", stl())):
        (parts / place).parent.mkdir(parents=True)
        (parts / place).write_bytes(content)
    file = tmp_path / "model" / "claw.urdf.xacro"
    file.parent.mkdir()
    file.write_text(HAND)
    return file


def test_macros_arguments_and_packages(xacro: Path, tmp_path: Path) -> None:
    with as_urdf(xacro, None, ["reach:=0.08", "prefix:=my_"], [tmp_path / "ws"]) as model:
        hand = load_model(model.urdf, package_dirs=model.package_dirs)
        assert hand.actuator_names == ("my_left", "my_right")
        assert hand.urdf.links["my_left_jaw"].collisions[0].size == (0.01, 0.02, 0.08)
        assert hand.upper == pytest.approx([0.7853981633974483] * 2)


@pytest.mark.parametrize(
    "how", ["inside", "itself", "renamed", "renamed, inside", "ament", "ros", "beside"]
)
def test_packages_are_found_where_they_may_be(
    xacro: Path, tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = tmp_path / "ws" / "claw_parts"
    given: list[Path] = []
    match how:
        case "inside":
            given = [tmp_path / "ws"]
        case "itself":
            given = [parts]
        case "renamed" | "renamed, inside":
            (parts / "package.xml").write_text("<package><name> claw_parts </name></package>")
            renamed = parts.rename(tmp_path / "ws" / "checkout")
            given = [renamed if how == "renamed" else renamed.parent]
        case "ament":
            (tmp_path / "prefix").mkdir()
            (tmp_path / "ws").rename(tmp_path / "prefix" / "share")
            monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path / 'prefix'}")
        case "ros":
            monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ws"))
        case "beside":
            parts.rename(tmp_path / "claw_parts")
    with as_urdf(xacro, None, [], given) as model:
        hand = load_model(model.urdf, package_dirs=model.package_dirs)
        assert hand.actuator_names == ("left", "right")


def refused(file: Path, *package_dirs: Path) -> ModelError:
    with pytest.raises(ModelError) as found, as_urdf(file, None, [], package_dirs):
        pass
    assert "\n" not in str(found.value)
    return found.value


def test_what_is_wrong_is_said_with_its_file(xacro: Path, tmp_path: Path) -> None:
    error = refused(xacro)
    assert error.path == xacro.absolute()
    assert "package 'claw_parts' is not found" in error.message
    assert "--package-dir" in error.message
    for text, what in (
        (HAND.replace("</robot>", ""), "no element found"),
        (HAND.replace("$(find claw_parts)/urdf/jaw.xacro", "jaw.xacro"), "No such file"),
        (HAND.replace("$(find claw_parts)", "$(find ../../etc)"), "is not found"),
        (HAND.replace("$(arg reach)", "$(arg rich)"), "rich"),
        (HAND.replace("$(arg reach)", "${1/0}"), "division by zero"),
        ("", "no element found"),
    ):
        xacro.write_text(text)
        assert what in refused(xacro, tmp_path / "ws").message
    xacro.write_text(HAND.replace("</robot>", "<a></robot>"))
    assert refused(xacro, tmp_path / "ws").line == 12
    assert "xacro file does not exist" in refused(tmp_path / "none.xacro").message


def test_mistakes_of_the_urdf_name_the_xacro_file(xacro: Path, tmp_path: Path) -> None:
    xacro.write_text(HAND.replace('side="1"', 'side="x"').replace("${-side}", "${side}"))
    with (
        pytest.raises(ModelError) as found,
        as_urdf(xacro, None, [], [tmp_path / "ws"]) as model,
    ):
        load_model(model.urdf, package_dirs=model.package_dirs)
    assert found.value.path is not None
    assert found.value.path.name in ("claw.urdf.xacro", "jaw.xacro")


def test_an_endless_file_ends(xacro: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xacro_expand, "_TIME", 0.5)
    xacro.write_text(HAND.replace("<xacro:inc", "<a b='${python.sum(range(10**12))}'/><xacro:inc"))
    assert "did not end" in refused(xacro).message


def test_a_greedy_file_is_stopped(xacro: Path, tmp_path: Path) -> None:
    xacro.write_text(HAND.replace("$(arg reach)", "${len('a' * 10**11)}"))
    assert "needs more than 2000 MB" in refused(xacro, tmp_path / "ws").message


def test_only_files_called_so_are_run(xacro: Path, tmp_path: Path) -> None:
    plain = xacro.with_name("claw.urdf")
    plain.write_text(HAND)
    with (
        as_urdf(plain, None, [], []) as model,
        pytest.raises(ModelError, match=r"rename it to end with \.xacro"),
    ):
        load_model(model.urdf)
    with pytest.raises(ConfigError, match="should be an argument of a xacro file"):
        as_urdf(plain, None, ["a:=1"], [])
    for words, what in ((["a=1"], "NAME:=VALUE"), (["a:=1", "a:=2"], "given twice")):
        with pytest.raises(ConfigError, match=what):
            as_urdf(xacro, None, words, [])


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*RTEE, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_commands_take_xacro(xacro: Path, tmp_path: Path) -> None:
    packages = ("--package-dir", tmp_path / "ws")
    ran = run(
        "new", "mine", "prefix:=a_", "--urdf", xacro, *packages, "--into", tmp_path / "config"
    )
    assert ran.returncode == 0, ran.stderr
    hand = load_hand(tmp_path / "config" / "mine")
    assert hand.actuator_names == ("a_left", "a_right")
    assert (tmp_path / "config/mine/meshes/palm.stl").is_file()
    ran = run("extract", "--urdf", xacro, "reach:=0.07", *packages, "--jobs", 1)
    assert ran.returncode == 0, ran.stderr
    assert "PinchTight" in ran.stdout
    srdf = tmp_path / "claw.srdf.xacro"
    srdf.write_text(GROUPS)
    ran = run("extract", "--urdf", xacro, "--srdf", srdf, "prefix:=a_", *packages, "--jobs", 1)
    assert ran.returncode == 0, ran.stderr
    assert "PinchTight  one, two" in ran.stdout
    ran = run("extract", "mine", "reach:=0.07")
    assert ran.returncode == 2
    assert "NAME:=VALUE needs --urdf or --mjcf" in ran.stderr
