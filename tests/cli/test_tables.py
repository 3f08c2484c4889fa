from __future__ import annotations

import os
import subprocess

import pytest
from rtee_process import RTEE

from rtee.cli import _table
from rtee.cli._table import Column, Row, TextTable, on_terminal, prefix_to_drop, table_of

LONG = "a remark of many words that no narrow terminal shows on a line of its own"


def table(heading: str = "") -> TextTable:
    columns = (Column("name"), Column("count", right=True), Column("what", whole=True))
    rows = (
        Row(("first", "1", "one\ntwo"), heading and "A", faint=True),
        Row(("the second", "22", ""), heading and "A"),
        Row((LONG, "333", "three"), heading and "B"),
    )
    return TextTable(columns, rows, "Things", heading)


def drawn(one: TextTable, width: int) -> list[str]:
    from rich.console import Console

    console = Console(width=width, color_system=None)
    with console.capture() as capture:
        console.print(one.drawn(width))
    return capture.get().splitlines()


def test_elsewhere_than_on_a_terminal_a_row_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    table().show()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert LONG in lines[3]
    columns = [[cell.strip() for cell in line.split("  ") if cell.strip()] for line in lines]
    assert columns == [
        ["name", "count", "what"],
        ["first", "1", "one, two"],
        ["the second", "22", "-"],
        [LONG, "333", "three"],
    ]
    starts = [line.index(what) for line, (*_, what) in zip(lines, columns, strict=True)]
    assert starts[0] == starts[1] == starts[2] < starts[3]


def test_a_long_cell_shifts_only_what_has_no_room() -> None:
    """The actions of a grasp plan: one name has two characters more than are padded."""
    numbers = (Column("score", right=True), Column("intensity", right=True))
    long = "MultiPinchTight_4 (index, middle, ring, thumb)"
    rows = [(long, "0.84", "100%"), ("Trig (index)", "0.61", "7%"), ("x" * 44, "1.00", "12%")]
    head, *lines = table_of(
        (Column("action"), *numbers, Column("dynamics")), [Row((*row, "held")) for row in rows]
    ).lines()
    assert {line.index("held") for line in lines} == {head.index("dynamics")}
    assert {line.index("%") for line in lines} == {head.index("intensity") + 8}
    assert len(lines[0]) == len(lines[1])


def test_elsewhere_the_heading_is_the_first_cell() -> None:
    assert [line.split()[0] for line in table("group").lines()] == ["group", "A", "A", "B"]


@pytest.mark.parametrize("width", [30, 50, 80, 200])
@pytest.mark.parametrize("heading", ["", "group"])
def test_a_table_fits_the_terminal_and_loses_nothing(width: int, heading: str) -> None:
    lines = drawn(table(heading), width)
    assert max(map(len, lines)) <= width
    shown = "".join(line.replace(" ", "") for line in lines)
    for word in ("Things", "first", "22", "two", *([] if heading else ["count"])):
        assert word in shown
    assert all(word in " ".join(lines) for word in LONG.split())


@pytest.mark.parametrize("width", [40, 80])
def test_names_too_long_for_the_terminal_are_folded(width: int) -> None:
    names = "\n".join(f"left_hand_{finger}_finger_metacarpal_link" for finger in ("a", "b")) * 2
    columns = (Column("elements"), Column("involves", whole=True), Column("remarks"))
    row = Row(("thumb", names, f"not clear: {names}"), "PinchTight")
    lines = drawn(TextTable(columns, (row,), "", "action"), width)
    assert max(map(len, lines)) <= width
    shown = "".join("".join(line.split()) for line in lines)
    assert "thumb" in shown


def test_a_wide_table_is_that_of_a_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr(_table._Output, "wide", False)
    assert on_terminal()
    _table._print_wide(True)
    assert not on_terminal()


def test_rows_of_a_group_stand_below_their_heading() -> None:
    lines = [line.rstrip() for line in drawn(table("group"), 100)]
    assert [lines.index("A"), lines.index("B")] == [1, 5]
    assert lines[2].startswith("  first")


def test_the_widest_column_gives_way() -> None:
    wide, count, what = table().widths(40)
    assert (count, what) == (len("count"), len("three"))
    assert wide == 40 - count - what - 4
    assert table().widths(200)[0] == len(LONG)


def test_what_names_share_is_dropped_on_terminals_only(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["left_hand_thumb", "left_hand_index"]
    assert prefix_to_drop(names) == ""
    monkeypatch.setattr(_table, "on_terminal", lambda: True)
    assert prefix_to_drop(names) == "left_hand_"


def test_a_terminal_that_lacks_a_sign_gets_it_escaped() -> None:
    done = subprocess.run(
        [*RTEE, "actions", "schunk_svh"],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert r"Trig (thumb) \xd7 0.3" in done.stdout
