from __future__ import annotations

import contextlib
import os
import pty
import subprocess
import textwrap
from pathlib import Path

import pytest
from rtee_process import RTEE

from hand.models import FRANKA, GRIPPER, SRDF, anthropomorphic, check_meshes
from hand.test_candidates import kinova
from rtee.errors import ConfigError, ModelError
from rtee.hand.config import HandConfig
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.hand.own_copy import copy_hand
from rtee.hand.scaffold import make_hand
from rtee.hand.schema import SCHEMA_FILE, schema_text
from rtee.hand.srdf import read_srdf
from rtee.hand.validation import validated
from rtee.hand.yamlfile import parse_yaml


def facts(hand: Hand) -> object:
    return (
        hand.actuators,
        [(f.name, f.tip, f.actuators, f.own) for f in hand.fingers],
        list(hand.rest),
    )


@pytest.mark.samples("robotiq_3f", "onrobot_3fg15")
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
    assert made.hand.finger("left").bars == ("left_inner_knuckle",)
    assert "in a linkage with" in made.reasons[0]


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


def test_efforts_that_the_urdf_lacks_are_noted(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER.replace('effort="5"', 'effort="0"'))
    made = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config")
    assert any(note.startswith("no effort limit for actuator 'left' and 1") for note in made.notes)


def test_lines_are_added_before_the_end_however_it_is_written(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER)
    (tmp_path / "g.srdf").write_text(SRDF.replace("</robot>", "</robot >\n<!-- of </robot> -->"))
    made = make_hand("g", tmp_path / "g.urdf", tmp_path / "g.srdf", into=tmp_path / "config")
    assert made.pairs
    assert made.hand.disabled_collisions == tuple(tuple(pair) for pair in made.pairs)
    assert (made.folder / "g.srdf").read_text().rstrip().endswith("<!-- of </robot> -->")


@pytest.mark.samples("1e5", "null", "-")
@pytest.mark.parametrize("name", ["1e5", "null", "-", "2", "0x1f", "yes", "3f"])
def test_a_hand_may_be_called_like_a_number_or_a_word_of_yaml(tmp_path: Path, name: str) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER)
    made = make_hand(name, tmp_path / "g.urdf", into=tmp_path / "config")
    assert load_hand(made.folder).name == name
    copy_hand(made.folder, tmp_path / "copies" / f"{name}9")
    assert load_hand(tmp_path / "copies" / f"{name}9").name == f"{name}9"
    copy_hand(tmp_path / "copies" / f"{name}9", tmp_path / "again" / name)
    assert load_hand(tmp_path / "again" / name).name == name


@pytest.mark.parametrize("hyphens", ["--", "---", "----"])
def test_hyphens_in_names_of_links_make_no_end_of_a_comment(tmp_path: Path, hyphens: str) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER.replace("left_jaw", f"left{hyphens}jaw"))
    made = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config")
    assert f"left{hyphens}jaw" in {finger.tip for finger in made.hand.fingers}


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


@pytest.mark.parametrize("name", ["手指", "jaw" * 40, "jaw.v2", "_jaw_"])
def test_copies_of_meshes_keep_their_ending(tmp_path: Path, name: str) -> None:
    (tmp_path / f"{name}.STL").write_bytes(stl())
    mesh = f'<mesh filename="{name}.STL"/>'
    (tmp_path / "g.urdf").write_text(GRIPPER.replace('<box size="0.01 0.02 0.06"/>', mesh))
    made = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config")
    check_meshes(load_hand(made.folder).urdf)
    assert [file.suffix for file in (made.folder / "meshes").iterdir()] == [".STL"]


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
    with pytest.raises(ConfigError, match="folder cannot be created"):
        make_hand("g", tmp_path / "g.urdf", into=tmp_path / "file" / "config")
    with pytest.raises(ConfigError, match=r"hand name '\.\./g'"):
        make_hand("../g", tmp_path / "g.urdf", into=config)
    make_hand("g", tmp_path / "g.urdf", into=config)
    before = sorted(config.rglob("*"))
    with pytest.raises(ConfigError, match="hand 'g' already exists"):
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


def test_the_documented_example_is_valid(repository: Path) -> None:
    page = (repository / "docs" / "reference" / "hand-yaml.md").read_text()
    example = page.split("A fuller one:\n\n")[1].split("\n\nThe first line")[0]
    document = parse_yaml(textwrap.dedent(example), Path("hand.yaml"), "hand.yaml")
    assert validated(HandConfig, document.data).devices["hand"].driver == "schunk_svh"


def test_a_closed_rest_is_opened_and_told(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(FRANKA)
    made = make_hand("g", tmp_path / "g.urdf", into=tmp_path / "config")
    line = "rest: {panda_finger_joint1: 0.04}"
    assert line in (made.folder / "hand.yaml").read_text().splitlines()
    assert list(made.hand.rest) == [0.04]
    (told,) = [note for note in made.notes if line in note]
    assert "the tips of 'leftfinger' and 'rightfinger' touch where the model rests" in told
    assert "rest where they are 80.0 mm apart" in told
    # What else touches is looked for where it rests now, and the rest is defined in one place.
    assert read_srdf(made.folder / "g.srdf").states == ()
    assert not [note for note in made.hand.notes if "group_state" in note]


def test_a_closed_rest_in_an_srdf_is_opened_in_hand_yaml(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(FRANKA)
    fingers = "".join(
        f'<group name="{n}"><chain base_link="panda_hand" tip_link="panda_{n}finger"/></group>'
        for n in ("left", "right")
    )
    home = '<group_state name="home" group="left"><joint name="panda_finger_joint1" value="0"/>'
    (tmp_path / "g.srdf").write_text(
        f'<robot name="franka_hand">{fingers}{home}</group_state></robot>'
    )
    made = make_hand("g", tmp_path / "g.urdf", tmp_path / "g.srdf", into=tmp_path / "config")
    assert list(made.hand.rest) == [0.04]
    assert not [note for note in made.hand.notes if "group_state" in note]


def test_the_wsg_50_is_made_open(shared: Path, tmp_path: Path) -> None:
    made = make_hand("wsg", shared / "more_hands" / "wsg50" / "wsg50.urdf", into=tmp_path)
    assert list(made.hand.rest) == [-0.055, 0.055]
    assert {(pair.link1, pair.link2) for pair in made.pairs} == {
        ("base_link", f"{part}_{side}")
        for part in ("gripper", "finger")
        for side in ("left", "right")
    }


def test_a_wrist_is_ignored_and_told(tmp_path: Path) -> None:
    (tmp_path / "h.urdf").write_text(anthropomorphic())
    made = make_hand("h", tmp_path / "h.urdf", into=tmp_path / "config")
    line = "ignore: [rh_WRJ2, rh_WRJ1]"
    assert line in (made.folder / "hand.yaml").read_text().splitlines()
    assert any(line in note and "all fingers as one body" in note for note in made.notes)
    assert len(made.hand.actuators) == 22
    assert made.hand.finger_names == ("index", "middle", "ring", "little", "thumb")


def test_candidates_for_passive_joints_are_named(tmp_path: Path) -> None:
    (tmp_path / "k.urdf").write_text(kinova())
    made = make_hand("k", tmp_path / "k.urdf", into=tmp_path / "config")
    assert len(made.hand.actuators) == 6
    said = [note for note in made.notes if "may have no motor" in note]
    assert len(said) == 3
    assert "--ask" in said[-1]


def test_what_is_asked_is_done(tmp_path: Path) -> None:
    (tmp_path / "k.urdf").write_text(kinova())
    asked: list[tuple[str, bool]] = []

    def ask(question: str, likelier: bool) -> bool:
        asked.append((question, likelier))
        return "finger_tip_2" in question

    made = make_hand("k", tmp_path / "k.urdf", into=tmp_path / "config", ask=ask)
    assert [likelier for _, likelier in asked] == [True] * 3
    assert set(read_srdf(made.folder / "k.srdf").passive) == {
        "joint_finger_tip_1",
        "joint_finger_tip_3",
    }
    assert len(made.hand.actuators) == 4
    (tmp_path / "h.urdf").write_text(anthropomorphic())
    made = make_hand(
        "h", tmp_path / "h.urdf", into=tmp_path / "config",
        ask=lambda question, _: "have a motor" in question,
    )  # fmt: skip
    assert len(made.hand.actuators) == 24


def test_command_new_asks_on_a_terminal(shared: Path, tmp_path: Path) -> None:
    urdf = shared / "hands" / "heri_II" / "heri_II.urdf"
    command = [*RTEE, "new", "heri", "--ask", "--urdf", str(urdf)]
    ours, theirs = pty.openpty()
    process = subprocess.Popen(command, cwd=tmp_path, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    said = b""
    for answer in (b"\n", b"n\n", b"y\n", b"\n"):  # the likelier one is no
        while not said.rstrip().endswith(b"[y/N]:"):
            said += os.read(ours, 1024)
        os.write(ours, answer)
        said += b"|"
    with contextlib.suppress(OSError):  # the end, as Linux puts it
        while chunk := os.read(ours, 1024):
            said += chunk
    os.close(ours)
    assert process.wait() == 0, said.decode()
    assert (
        b"turns a few degrees only, like a joint on a spring. Does it have a motor? [y/N]:" in said
    )
    passive = read_srdf(tmp_path / "config" / "heri" / "heri.srdf").passive
    assert set(passive) == {"BASE__SFB1", "BASE__LFB1", "BASE__LFB3"}
    assert set(load_hand(tmp_path / "config" / "heri").actuator_names) == {
        "BASE__LFB2",
        *(f"motor_{finger}" for finger in ("thumb", "finger1", "finger2", "finger3")),
    }


def test_an_end_of_the_answers_makes_nothing(tmp_path: Path) -> None:
    (tmp_path / "k.urdf").write_text(kinova())
    command = [*RTEE, "new", "k", "--ask", "--urdf", "k.urdf"]
    done = subprocess.run(command, cwd=tmp_path, input="n\n", capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "\nrtee: the input has ended before the question was answered\n"
    assert not (tmp_path / "config").exists()


def test_command_new(tmp_path: Path) -> None:
    (tmp_path / "g.urdf").write_text(GRIPPER)
    command = [*RTEE, "new"]
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
    assert done.stderr.startswith("rtee: config/g: hand 'g' already exists")
    done = run("h", "--urdf", "none.urdf")
    assert done.returncode == 2
    assert done.stderr == "rtee: none.urdf: URDF does not exist\n"
