"""Tables: fitted to the width of a terminal; in a pipe one line per row, never cut."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rtee.hand.names import common_prefix

if TYPE_CHECKING:
    from rich.console import Group, RenderableType
    from rich.table import Table as Grid

_GAP: Final = 2
"""Spaces between columns [characters]: a single one could be part of a cell."""

_INDENT: Final = 2
"""Indentation of rows below a heading [characters]."""

_NOTHING: Final = "-"
"""Printed for an empty cell, so that each line has the same number of columns."""

_NARROW: Final = 8
"""Least width of a column [characters]: the length of a word."""

_PADDED: Final = 44
"""Longest cell to which others are padded [characters]; few cells are longer."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table, aligned to the right for numbers.

    The lines of a ``whole`` column are wrapped only if the other columns would otherwise have no
    room.
    """

    name: str
    right: bool = False
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a table, on a terminal dimmed if ``faint``.

    Each line of a cell is an item of a list. On a terminal, consecutive rows with the same heading
    are listed below it; in a pipe it is the first cell.
    """

    cells: tuple[str, ...]
    heading: str = ""
    faint: bool = False


@dataclass(frozen=True, slots=True)
class TextTable:
    """Columns and rows; the title is shown only on terminals.

    ``heading`` is the name of the column of headings, empty if the rows have none.
    """

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    title: str = ""
    heading: str = ""

    def show(self) -> None:
        """Print the table."""
        if on_terminal():
            # Imported only here: scripts, which print to pipes, need not wait for it.
            from rich.console import Console

            console = Console(highlight=False)
            console.print(self.drawn(console.width))
            return
        for line in self.lines():
            print(line, flush=True)

    def drawn(self, width: int) -> Group:
        """Return the table laid out for a terminal of this width [characters]."""
        from rich.console import Group
        from rich.padding import Padding
        from rich.text import Text

        parts: list[RenderableType] = [Text(self.title, style="bold")] if self.title else []
        widths = self.widths(width)
        if not self.heading:
            return Group(*parts, self._grid(self.rows, widths))
        for heading, rows in groupby(self.rows, key=lambda row: row.heading):
            grid = self._grid(list(rows), widths)
            parts += [Text(heading, style="bold"), Padding.indent(grid, _INDENT)]
        return Group(*parts)

    def lines(self) -> list[str]:
        """Return one line per row, with at least two spaces between cells."""
        head = tuple(column.name for column in self.columns)
        cells = [head, *(row.cells for row in self.rows)]
        if self.heading:
            firsts = [self.heading, *(row.heading for row in self.rows)]
            cells = [(first, *rest) for first, rest in zip(firsts, cells, strict=True)]
        flat = [[", ".join(cell.split("\n")) or _NOTHING for cell in row] for row in cells]
        widths = [
            # The heading always counts, since all cells below it may be too long.
            max(len(cell) for cell in column if len(cell) <= _PADDED or cell is column[0])
            for column in zip(*flat, strict=True)
        ]
        right = [False] * (len(widths) - len(self.columns)) + [c.right for c in self.columns]
        return [_line(row, widths, right) for row in flat]

    def widths(self, width: int) -> list[int]:
        """Return the widths of the columns on a terminal of this width [characters].

        Columns that may be wrapped share the remaining width; wide ones are narrowed first.
        """
        natural = [
            max(len(line) for cell in column for line in cell.split("\n"))
            for column in zip(
                tuple(column.name for column in self.columns),
                *(row.cells for row in self.rows),
                strict=True,
            )
        ]
        left = width - _GAP * (len(natural) - 1) - (_INDENT if self.heading else 0)
        flexible = [i for i, column in enumerate(self.columns) if not column.whole]
        whole = sum(n for n, column in zip(natural, self.columns, strict=True) if column.whole)
        if left - whole < sum(min(natural[i], _NARROW) for i in flexible):
            flexible = list(range(len(natural)))
        else:
            left -= whole
        # Narrow columns first: the width that they do not need is left to the wide ones.
        for count, i in zip(
            range(len(flexible), 0, -1), sorted(flexible, key=lambda i: natural[i]), strict=True
        ):
            natural[i] = min(natural[i], max(_NARROW, left // count))
            left -= natural[i]
        return natural

    def _grid(self, rows: Sequence[Row], widths: Sequence[int]) -> Grid:
        from rich.table import Table as Grid
        from rich.text import Text

        grid = Grid.grid(padding=(0, _GAP, 0, 0))
        grid.show_header = not self.heading
        for column, width in zip(self.columns, widths, strict=True):
            grid.add_column(
                Text(column.name, style="dim"),
                width=width,
                justify="right" if column.right else "left",
                # By default, rich would cut with an ellipsis.
                overflow="fold",
            )
        for row in rows:
            # Rich would take words in brackets for markup in a plain string.
            grid.add_row(*map(Text, row.cells), style="dim" if row.faint else "")
        return grid


def _line(cells: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    """Return cells in columns of some widths, aligned to the right or left.

    A cell that is too long moves the next ones only as far as these have no room to spare.
    """
    line, column = "", 0
    for cell, width, ends in zip(cells, widths, right, strict=True):
        begin = column + width - len(cell) if ends else column
        line = line.ljust(max(begin, len(line) + _GAP if line else 0)) + cell
        column += width + _GAP
    return line.rstrip()


def table_of(
    columns: Iterable[str | Column],
    rows: Iterable[Row | Sequence[str]],
    title: str = "",
    heading: str = "",
) -> TextTable:
    """Return a table; a name may stand for a plain column, and the cells for a plain row."""
    return TextTable(
        tuple(each if isinstance(each, Column) else Column(each) for each in columns),
        tuple(each if isinstance(each, Row) else Row(tuple(each)) for each in rows),
        title,
        heading,
    )


class _Output:
    """Options of a command about its output."""

    wide = False


def _print_wide(wide: bool) -> None:
    _Output.wide = wide


WideOption = Annotated[
    bool,
    typer.Option(
        "--wide",
        callback=_print_wide,
        help="One line per row, however long, with all that a pipe gets.",
    ),
]


def on_terminal() -> bool:
    """Return whether to lay out for a terminal: stdout is one, and ``--wide`` was not given."""
    return sys.stdout.isatty() and not _Output.wide


def prefix_to_drop(names: Collection[str]) -> str:
    """Return the prefix that names share, to leave out on a terminal; in a pipe return ``""``."""
    return common_prefix(names) if on_terminal() else ""
