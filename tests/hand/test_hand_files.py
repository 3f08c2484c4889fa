from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.errors import ConfigError, ModelError
from rtee.hand.files import (
    check_writable,
    make_folder,
    new_tree,
    read_bytes,
    temporary_folder,
    write_atomically,
    write_together,
)
from rtee.hand.names import check_name, common_prefix, safe_name


@pytest.mark.parametrize("name", ["schunk_svh", "2F-85", "a", "v1.2", "x" * 100])
def test_good_names(name: str) -> None:
    assert check_name(name, "hand") == name


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("", "is empty"),
        (".", "starts with a dot"),
        ("..", "starts with a dot"),
        (".hidden", "starts with a dot"),
        ("a..b", "holds '..'"),
        ("a/b", "not allowed"),
        ("a\\b", "not allowed"),
        ("a b", "not allowed"),
        ("a\n", "not allowed"),
        ("Hände", "not allowed"),
        ("x" * 101, "longer than 100"),
    ],
)
def test_bad_names(name: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why) as caught:
        check_name(name, "action", "hand.yaml", 7)
    assert str(caught.value).startswith("hand.yaml:7: action name ")


@given(st.text(max_size=200))
def test_any_text_becomes_a_good_name(text: str) -> None:
    name = safe_name(text)
    assert check_name(name, "hand") == name


def test_letters_with_marks_become_those_without() -> None:
    assert safe_name("Däumling é dist") == "Daumling_e_dist"


@pytest.mark.parametrize(
    ("names", "prefix"),
    [
        (["left_hand_thumb", "left_hand_index"], "left_hand_"),
        (["left_hand_thumb", "left_hand_"], ""),
        (["left_thumb_one", "left_thumb_once"], "left_thumb_"),
        (["thumb", "index"], ""),
        (["a_b", "a_c"], ""),
        (["left_hand_thumb"], ""),
        ([], ""),
    ],
)
def test_what_all_names_begin_with(names: list[str], prefix: str) -> None:
    assert common_prefix(names) == prefix


def test_written_whole_and_replaced(tmp_path: Path) -> None:
    file = tmp_path / "file"
    write_atomically(file, "first")
    os.chmod(file, 0o640)
    write_atomically(file, b"second")
    assert file.read_bytes() == b"second"
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert list(tmp_path.iterdir()) == [file]


def test_links_stay_and_lead_to_what_is_written(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    file, link = tmp_path / "there" / "file", tmp_path / "link"
    file.write_text("first")
    link.symlink_to(file)
    write_atomically(link, "second")
    assert link.is_symlink()
    assert file.read_text() == "second"
    assert list(file.parent.iterdir()) == [file]


def test_devices_and_pipes_are_no_files(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for check in (check_writable, lambda path: write_atomically(path, "x")):
        with pytest.raises(ConfigError, match="pipe: cannot be written: not a regular file"):
            check(pipe)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert list(tmp_path.iterdir()) == [pipe]


def test_nothing_is_left_when_the_disk_is_full(
    tmp_path: Path, largest_file: Callable[[int | None], None]
) -> None:
    file = tmp_path / "file"
    write_atomically(file, "old")
    largest_file(1000)
    with pytest.raises(ConfigError, match="cannot be written: file too large") as caught:
        write_atomically(file, "x" * 5000)
    largest_file(None)
    assert caught.value.path == file
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_of_several_files_none_is_written_without_space_for_all(
    tmp_path: Path, largest_file: Callable[[int | None], None]
) -> None:
    small, large = tmp_path / "small", tmp_path / "large"
    small.write_text("old")
    largest_file(1000)
    for private in (False, True):
        with pytest.raises(ConfigError, match="large: cannot be written: file too large"):
            write_together({small: "new", large: "x" * 5000}, private=private)
    largest_file(None)
    assert small.read_text() == "old"
    assert list(tmp_path.iterdir()) == [small]


def test_private_files_are_their_owners_only_and_follow_no_link(tmp_path: Path) -> None:
    key, link, other = (tmp_path / name for name in ("key", "link", "other"))
    key.write_text("old")
    other.write_text("of another")
    link.symlink_to(other)
    write_together({key: "secret", link: "secret"}, private=True)
    for path in (key, link):
        assert path.read_text() == "secret"
        assert stat.S_IMODE(path.lstat().st_mode) == 0o600
    assert other.read_text() == "of another"


def test_what_fails_in_a_new_tree_names_the_place_that_it_would_have_had(tmp_path: Path) -> None:
    target = tmp_path / "new"
    with pytest.raises(ConfigError) as caught, new_tree(target) as folder:
        write_atomically(folder / "none" / "file", "")
    assert caught.value.path == target / "none" / "file"
    assert list(tmp_path.iterdir()) == []


def test_folders_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="folder cannot be created: file exists"):
        make_folder(tmp_path / "file")
    with pytest.raises(ConfigError, match="folder cannot be created: not a directory"):
        make_folder(tmp_path / "file" / "sub")
    with pytest.raises(ConfigError, match="cannot be written: no such file or directory"):
        write_atomically(tmp_path / "none" / "file", "")
    assert make_folder(tmp_path / "a" / "b").is_dir()


def test_reading_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="calibration does not exist"):
        read_bytes(tmp_path / "none", "calibration")


@pytest.mark.parametrize("origin", [Path("hand.xacro"), None])
def test_errors_name_no_file_of_a_temporary_folder(origin: Path | None) -> None:
    with pytest.raises(ModelError) as caught, temporary_folder(origin) as folder:
        raise ModelError(f"there is no {folder / 'tip.stl'}", path=folder / "hand.urdf", line=7)
    assert (caught.value.path, caught.value.line) == (origin, None)
    assert caught.value.message == "there is no tip.stl"
