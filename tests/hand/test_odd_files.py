"""Files as other programs write and accept them: odd XML heads, xacro SRDFs, units, lost paths."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hand.robots import Robot, jaws
from rtee.cli.main import main
from rtee.errors import ModelError
from rtee.exchange.mjcf_import import import_mjcf
from rtee.gui.scene import link_triangles
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_model
from rtee.hand.srdf import read_srdf
from rtee.hand.urdfread import read_urdf
from rtee.hand.xmlfile import read_xml

HEAD = b'<?xml version="1.0"?>\n'


@pytest.mark.parametrize(
    "head",
    [
        b"\n" + HEAD,
        b"  \n\n" + HEAD,
        b"<!-- made by hand -->\n" + HEAD,
        b"\n<!-- one\n line -->\n<!-- two -->\n" + HEAD,
        "<!-- größer -->\n".encode("latin-1") + HEAD,
        HEAD + "<!-- größer -->\n".encode("latin-1"),
        b'<?xml version="1.0" encoding="utf-8"?>\n' + "<!-- größer -->\n".encode("latin-1"),
        b'<?xml version="1.0" encoding="ISO-8859-1"?>\n' + "<!-- ö -->\n".encode("latin-1"),
        b"\xef\xbb\xbf" + HEAD,
    ],
)
def test_what_stands_before_the_declaration_does_not_matter(tmp_path: Path, head: bytes) -> None:
    path = tmp_path / "r.urdf"
    path.write_bytes(head + jaws().text.encode())
    root, text = read_xml(path, "URDF")
    assert root.line == head.count(b"\n") + 1
    assert set(read_urdf(path).links) == {"base", "left_distal", "right_distal"}
    path.write_text(text, encoding="utf-8")  # as it is copied into a hand's folder
    assert set(read_urdf(path).links) == {"base", "left_distal", "right_distal"}


def test_comments_without_a_declaration_are_read_at_once(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    # Each further comment once doubled the time: a hundred would never end.
    path.write_text("<!-- a licence -->\n" * 100 + jaws().text)
    assert read_xml(path, "URDF")[0].line == 101


def test_names_in_latin_1_without_a_declaration_are_read(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_bytes(jaws().text.replace("left_distal", "linker_größer").encode("latin-1"))
    assert "linker_größer" in read_urdf(path).links


XACRO_SRDF = """<robot xmlns:xacro="http://wiki.ros.org/xacro" name="jaws">
<xacro:macro name="finger" params="side"><group name="f_${side}">
<chain base_link="base" tip_link="${side}_distal"/></group></xacro:macro>
<xacro:finger side="left"/><xacro:finger side="right"/></robot>"""


def test_an_srdf_that_is_a_xacro_file_is_expanded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("xacro")
    monkeypatch.chdir(tmp_path)
    jaws().write(tmp_path)
    (tmp_path / "jaws.srdf.xacro").write_text(XACRO_SRDF)
    for words in (
        ["extract", "--urdf", "jaws.urdf", "--srdf", "jaws.srdf.xacro", "--jobs", "1"],
        ["new", "jaws", "--urdf", "jaws.urdf", "--srdf", "jaws.srdf.xacro"],
    ):
        monkeypatch.setattr(sys, "argv", ["rtee", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 0
        assert "f_left" in capsys.readouterr().out
    assert set(read_srdf(tmp_path / "config" / "jaws" / "jaws.srdf").groups) == {
        "f_left",
        "f_right",
    }


def test_one_that_is_not_called_so_is_refused_as_a_urdf_is(tmp_path: Path) -> None:
    path = tmp_path / "jaws.srdf"
    path.write_text(XACRO_SRDF)
    with pytest.raises(ModelError, match="rename it to end with") as refused:
        read_srdf(path)
    assert refused.value.line == 2


DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema"
version="1.4.1"><asset><created>2024-01-01</created><modified>2024-01-01</modified>{unit}
<up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="12">
0 0 0 2 0 0 0 3 0 0 0 4</float_array><technique_common><accessor source="#a" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor>
</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.mark.parametrize(
    ("unit", "size"),
    [
        ("", 1.0),
        ('<unit name="meter" meter="1"/>', 1.0),
        ('<unit name="centimeter" meter="0.01"/>', 0.01),
        ("<unit meter='0.001' name='millimeter'/>", 0.001),
    ],
)
def test_the_unit_of_a_collada_file_is_applied(tmp_path: Path, unit: str, size: float) -> None:
    (tmp_path / "m.dae").write_text(DAE.format(unit=unit))
    mesh = '<geometry><mesh filename="m.dae" scale="0.5 1 1"/></geometry>'
    robot = Robot("r").link("base", mesh).link("tip", mesh).joint("j", "base", "tip")
    hand = load_model(robot.write(tmp_path))
    for points in (HandGeometry(hand).triangles("tip")[0], link_triangles(hand)("tip")[0]):
        assert np.ptp(points, axis=0) == pytest.approx(np.array([1.0, 3.0, 4.0]) * size)


@pytest.mark.parametrize("scheme", ["", "file://"])
def test_an_absolute_path_of_another_computer(tmp_path: Path, scheme: str) -> None:
    (tmp_path / "ws" / "meshes").mkdir(parents=True)
    (tmp_path / "ws" / "meshes" / "m.dae").write_text(DAE.format(unit=""))
    mesh = f'<geometry><mesh filename="{scheme}/home/me/src/hand/meshes/m.dae"/></geometry>'
    robot = Robot("r").link("base", mesh).link("tip", mesh).joint("j", "base", "tip")
    path = robot.write(tmp_path)
    with pytest.raises(ModelError, match="give the folder that has it here by --package-dir"):
        HandGeometry(load_model(path))
    for folder in ("ws", "ws/meshes"):
        HandGeometry(load_model(path, package_dirs=[tmp_path / folder]))


@pytest.mark.parametrize("compiler", ["", '<compiler meshdir="assets"/>'])
def test_a_mesh_that_an_mjcf_lacks_is_told_with_the_places(tmp_path: Path, compiler: str) -> None:
    path = tmp_path / "m.xml"
    path.write_text(
        f"<mujoco>{compiler}\n<asset>\n<mesh name='m' file='m.stl'/></asset><worldbody><body>"
        "<joint name='j' range='0 1'/><geom type='mesh' mesh='m'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ModelError) as refused:
        import_mjcf(path, tmp_path)
    message = str(refused.value)
    assert "(line 3) does not exist; looked in" in message
    assert str(tmp_path) in message
    assert ("assets" in message) == bool(compiler)
    assert ("no meshdir" in message) == (not compiler)
