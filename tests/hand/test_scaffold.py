from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from hand.models import GRIPPER, SRDF
from rtee.errors import ConfigError, ModelError
from rtee.hand.config import HandConfig
from rtee.hand.load import load_hand, load_model
from rtee.hand.meshes import check_meshes
from rtee.hand.model import Hand
from rtee.hand.scaffold import make_hand
from rtee.hand.schema import SCHEMA_FILE, field_tables, schema_text
from rtee.hand.srdf import read_srdf
from rtee.hand.yamlfile import parse_yaml


def facts(hand: Hand) -> object:
    return (
        hand.actuators,
        [(f.name, f.tip, f.actuators, f.own) for f in hand.fingers],
        list(hand.rest),
    )


@pytest.mark.parametrize("name", ["schunk", "robotiq_3f", "heri_II", "onrobot_3fg15"])
def test_new_hand_from_a_urdf_alone(shared: Path, tmp_path: Path, name: str) -> None:
    urdf = shared / "hands" / name / f"{name}.urdf"
    made = make_hand("mine", urdf, into=tmp_path / "config")
    assert made.folder == tmp_path / "config" / "mine"
    assert made.hand.name == "mine"
    assert facts(made.hand) == facts(load_model(urdf))
    assert len(made.reasons) == len(made.hand.fingers)
    check_meshes(made.hand.urdf)
    meshes = {s.mesh for link in made.hand.urdf.links.values() for s in link.collisions}
    assert all((made.folder / mesh).is_file() for mesh in meshes if mesh)
    disabled = read_srdf(made.folder / "mine.srdf").disabled
    assert {(d.link1, d.link2, d.reason) for d in disabled} == {
        (p.link1, p.link2, p.reason) for p in made.pairs
    }
    assert made.hand.disabled_collisions


def test_linkages_stay_out_of_the_srdf(shared: Path, tmp_path: Path) -> None:
    urdf = shared / "hands" / "robotiq_2f_85" / "robotiq_2f_85.urdf"
    made = make_hand("gripper", urdf, into=tmp_path)
    assert made.hand.finger_names == ("left", "right")
    assert [note for note in made.notes if "part of a linkage" in note]


def test_a_given_srdf_is_kept_and_completed(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER)
    (tmp_path / "g.srdf").write_text(SRDF)
    made = make_hand("g", tmp_path / "g.urdf", tmp_path / "g.srdf", into=tmp_path / "config")
    text = (made.folder / "g.srdf").read_text()
    assert made.hand.finger_names == ("left_finger", "right_finger")
    assert 'link1="palm" link2="left_jaw" reason="adjacent"' in text
    own = SRDF.replace(
        "</robot>", '<disable_collisions link1="palm" link2="left_jaw" reason="mine"/></robot>'
    )
    (tmp_path / "g.srdf").write_text(own)
    made = make_hand("h", tmp_path / "g.urdf", tmp_path / "g.srdf", into=tmp_path / "config")
    assert made.hand.disabled_collisions == (("palm", "left_jaw", "mine"),)


def stl() -> bytes:
    """Return a tetrahedron."""
    import struct

    corners = [(0, 0, 0), (0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.01)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    data = b"\0" * 80 + struct.pack("<I", 4)
    for face in faces:
        data += struct.pack("<3f", 0, 0, 0)
        data += b"".join(struct.pack("<3f", *corners[i]) for i in face) + b"\0\0"
    return data


def test_meshes_of_packages_are_copied_and_found_again(tmp_path: Path) -> None:
    package = tmp_path / "ws" / "g_description"
    for place in ("meshes/a/jaw.stl", "meshes/b/jaw.stl", "jaw.stl"):
        (package / place).parent.mkdir(parents=True, exist_ok=True)
        (package / place).write_bytes(stl())
    box = '<box size="0.01 0.02 0.06"/>'
    text = GRIPPER.replace(
        box, "<mesh filename='package://g_description/meshes/a/jaw.stl'/>", 1
    ).replace(box, '<mesh filename="package://g_description/meshes/b/jaw.stl"/>')
    text = text.replace(
        '<box size="0.1 0.1 0.02"/>', f'<mesh filename="file://{package}/jaw.stl"/>'
    )
    (tmp_path / "g.urdf").write_text(text)
    with pytest.raises(ModelError, match="give its package's folder by --package-dir"):
        make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config")
    assert not (tmp_path / "config" / "g").exists()
    made = make_hand(
        "g", tmp_path / "g.urdf", package_dirs=[tmp_path / "ws"], into=tmp_path / "config"
    )
    found = {s.mesh for link in made.hand.urdf.links.values() for s in link.collisions}
    assert found == {"meshes/a/jaw.stl", "meshes/b/jaw.stl", "meshes/jaw.stl"}
    check_meshes(load_hand(made.folder).urdf)


def test_a_missing_visual_mesh_is_a_note(tmp_path: Path) -> None:
    visual = '<visual><geometry><mesh filename="none.stl"/></geometry></visual></link>'
    (tmp_path / "g.urdf").write_text(GRIPPER.replace("</link>", visual, 1))
    made = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config")
    assert any("visual mesh was left where it is" in note for note in made.notes)


def test_all_or_nothing(tmp_path: Path) -> None:
    config = tmp_path / "config"
    (tmp_path / "g.urdf").write_text(
        GRIPPER.replace('<box size="0.1 0.1 0.02"/>', '<mesh filename="none.stl"/>')
    )
    with pytest.raises(ModelError, match=r"mesh 'none\.stl' does not exist"):
        make_hand("g", tmp_path / "g.urdf", into=config)
    assert not config.exists()
    (tmp_path / "g.urdf").write_text(GRIPPER)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="folder cannot be made"):
        make_hand("g", tmp_path / "g.urdf", into=tmp_path / "file" / "config")
    with pytest.raises(ConfigError, match=r"hand name '\.\./g'"):
        make_hand("../g", tmp_path / "g.urdf", into=config)
    make_hand("g", tmp_path / "g.urdf", into=config)
    before = sorted(config.rglob("*"))
    with pytest.raises(ConfigError, match="hand 'g' is already there"):
        make_hand("g", tmp_path / "g.urdf", into=config)
    assert sorted(config.rglob("*")) == before
    assert {path.name for path in config.iterdir()} == {"g", SCHEMA_FILE}


def test_nothing_is_left_when_the_folder_cannot_be_filled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER)
    (tmp_path / "config" / SCHEMA_FILE).mkdir(parents=True)  # in the place of the schema's file
    with pytest.raises(ConfigError, match="cannot be written"):
        make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config")
    assert [path.name for path in (tmp_path / "config").iterdir()] == [SCHEMA_FILE]


def test_the_schema_in_the_repository_is_current(repository: Path) -> None:
    assert (repository / "config" / SCHEMA_FILE).read_text() == schema_text()


def test_the_documented_fields_are_current(repository: Path) -> None:
    page = (repository / "docs" / "reference" / "hand-yaml.md").read_text()
    assert page.endswith(field_tables())
    example = page.split("A fuller one:\n\n")[1].split("\n\nThe first line")[0]
    document = parse_yaml(textwrap.dedent(example), Path("hand.yaml"), "hand.yaml")
    assert HandConfig.model_validate(document.data).devices["hand"].driver == "schunk_svh"


def test_command_new(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER)
    command = [sys.executable, "-c", "from rtee.cli import main; main()", "new"]
    run = lambda *a: subprocess.run(  # noqa: E731
        [*command, *a], cwd=tmp_path, capture_output=True, text=True, env=dict(os.environ)
    )
    done = run("g", "--urdf", "g.urdf")
    assert done.returncode == 0, done.stderr
    assert "config/g is made." in done.stdout
    assert "moved by: left" in done.stdout
    first = (tmp_path / "config" / "g" / "hand.yaml").read_text().splitlines()[0]
    assert first == f"# yaml-language-server: $schema=../{SCHEMA_FILE}"
    done = run("g", "--urdf", "none.urdf")
    assert done.returncode == 2
    assert done.stderr.startswith("rtee: config/g: hand 'g' is already there")
    done = run("h", "--urdf", "none.urdf")
    assert done.returncode == 2
    assert done.stderr == "rtee: none.urdf: URDF does not exist\n"
