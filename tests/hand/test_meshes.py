from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from hand.models import GRIPPER, check_meshes, line_of
from rtee.errors import ModelError
from rtee.hand.meshes import resolve_mesh, why_no_mesh
from rtee.hand.model import Hand

STL = b"\0" * 80 + struct.pack("<I", 1) + struct.pack("<12fH", *[0.0] * 12, 0)


@pytest.fixture
def urdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    folder = tmp_path / "hand_description" / "urdf"
    folder.mkdir(parents=True)
    return folder / "hand.urdf"


def put(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(STL)
    return path


def test_relative_to_the_file(urdf: Path) -> None:
    mesh = put(urdf.parent / "meshes" / "a.stl")
    assert resolve_mesh("meshes/a.stl", urdf).samefile(mesh)
    assert resolve_mesh("../urdf/meshes/a.stl", urdf).samefile(mesh)


def test_file_address(urdf: Path, tmp_path: Path) -> None:
    mesh = put(tmp_path / "some where" / "a.stl")
    assert resolve_mesh(f"file://{mesh}", urdf).samefile(mesh)
    assert resolve_mesh(f"file://{mesh}".replace(" ", "%20"), urdf).samefile(mesh)


@pytest.mark.parametrize("place", ["hand_description", "urdf/hand_description", "urdf"])
def test_package_beside_or_above_the_file(urdf: Path, tmp_path: Path, place: str) -> None:
    base = tmp_path if place == "hand_description" else tmp_path / "hand_description"
    mesh = put(base / place / "meshes" / "a.stl")
    assert resolve_mesh("package://hand_description/meshes/a.stl", urdf).samefile(mesh)


def test_package_dirs_hold_packages_or_are_one(urdf: Path, tmp_path: Path) -> None:
    mesh = put(tmp_path / "share" / "other" / "a.stl")
    for folder in (tmp_path / "share", tmp_path / "share" / "other"):
        assert resolve_mesh("package://other/a.stl", urdf, [folder]).samefile(mesh)
    (mesh.parent / "package.xml").write_text("<package><name>other</name></package>")
    renamed = mesh.parent.rename(tmp_path / "share" / "checkout") / "a.stl"
    assert resolve_mesh("package://other/a.stl", urdf, [tmp_path / "share"]).samefile(renamed)
    with pytest.raises(ModelError, match=r"does not exist; give its package's folder by --package"):
        resolve_mesh("package://other/a.stl", urdf, line=3)


@pytest.mark.parametrize(
    ("variable", "inside"), [("ROS_PACKAGE_PATH", "other"), ("AMENT_PREFIX_PATH", "share/other")]
)
def test_package_paths_of_the_environment(
    urdf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, inside: str
) -> None:
    mesh = put(tmp_path / "ws" / inside / "a.stl")
    monkeypatch.setenv(variable, f"/nowhere:{tmp_path / 'ws'}")
    assert resolve_mesh("package://other/a.stl", urdf).samefile(mesh)


@pytest.mark.parametrize(
    "address", ["https://example.org/a.stl", "none.stl", "a\0b.stl", "x" * 5000]
)
def test_addresses_that_lead_nowhere(urdf: Path, address: str) -> None:
    with pytest.raises(ModelError) as caught:
        resolve_mesh(address, urdf, line=12)
    assert caught.value.line == 12
    assert caught.value.path == urdf


@pytest.mark.parametrize(
    ("address", "hint"),
    [
        ("meshes/A.STL", "; did you mean 'a.stl'?"),
        ("meshes\\a.stl", "; URDFs separate folders by '/'"),
        ("$(find hand)/a.stl", "; it is left over from a xacro file, which must be expanded"),
        ("none/b.stl", ""),
    ],
)
def test_slips_in_addresses_are_named(urdf: Path, address: str, hint: str) -> None:
    put(urdf.parent / "meshes" / "a.stl")
    with pytest.raises(ModelError, match=re.escape(f"mesh '{address}' does not exist{hint}") + "$"):
        resolve_mesh(address, urdf)


@pytest.mark.parametrize("filler", [b"\n", b" ", b"element ", b"element v "])
def test_the_head_of_a_mesh_is_searched_in_one_pass(filler: bytes) -> None:
    # A search that begins anew at each of a million places would not end.
    assert why_no_mesh(b"ply\n" + filler * 1_000_000 + b"x", ".ply") is None


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.stl", b"", "the file is empty"),
        ("a.stl", STL[:100], "it is truncated: 1 triangles announced, 0 there"),
        ("a.stl", b"\0" * 84, "it has no triangles"),
        ("a.stl", b"garbage", "it is not an STL file"),
        ("a.stl", b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
        ("a.dae", b"<html/>", "it is not a COLLADA file"),
        ("a.dae", b"<!DOCTYPE c [<!ENTITY a 'b'>]><COLLADA/>", "XML entities, which are refused"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nelement face 100000000\nend_header\n0 0 0\n",
            "it is truncated: 100000003 vertices and faces announced in 78 bytes",
        ),
        ("a.off", b"OFF # a\n3 100000000 0\n0 0 0\n", "100000003 vertices and faces announced"),
        ("a.off", b"OFF\n" + b"9" * 5000 + b" 1 0\n", "vertices and faces announced in 5009"),
        ("a.step", b"ISO-10303", "has the unknown format '.step'"),
    ],
)
def test_unreadable_meshes(
    load: Callable[..., Hand], tmp_path: Path, name: str, content: bytes, why: str
) -> None:
    (tmp_path / name).write_bytes(content)
    text = GRIPPER.replace('<box size="0.1 0.1 0.02"/>', f'<mesh filename="{name}"/>')
    urdf = load(text).urdf
    with pytest.raises(ModelError, match=re.escape(why)) as caught:
        check_meshes(urdf)
    assert caught.value.line == line_of(text, "<mesh")


def test_text_stl(load: Callable[..., Hand], tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_text("solid a\nfacet normal 0 0 1\n")
    text = GRIPPER.replace('<box size="0.1 0.1 0.02"/>', '<mesh filename="a.stl"/>')
    check_meshes(load(text).urdf)


def test_meshes_of_the_real_hands(real_hand: Hand) -> None:
    check_meshes(real_hand.urdf)
