"""`rtee openings`: how far the fingertips open in each action of a hand."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtee.cli._common import Hand, JsonOption, actions_of, hand_folder, owned

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.actions.openings import Opening


def openings(
    hand: Hand,
    save: Annotated[
        bool, typer.Option("--save", help="Make the tables and store them (extra extract).")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List the openings of a hand's actions; with --save, make their tables.

    Exit status 1 when there are none, or some are out of date.

    Example: rtee openings schunk_svh --save
    """
    if save:
        make(hand)
    library = actions_of(hand)
    valid, notes = current(library)
    if as_json:
        import json

        print(json.dumps({"hand": library.hand.name, "openings": [_plain(o) for o in valid]}))
    else:
        _show(library.hand.name, valid)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    raise typer.Exit(0 if valid and not notes else 1)


def make(hand: str) -> None:
    """Make the tables of a hand's actions and store them in its folder."""
    from rtee.actions.openings import write_openings
    from rtee.cli.extract import measured_openings
    from rtee.hand.own_copy import own_place

    folder = hand_folder(hand)
    own_place(folder)  # a folder that cannot be written is refused before the work
    measured = measured_openings(folder)
    # Copied after the work, which leaves no copy behind if it fails.
    home = owned(folder)
    print(f"written to {write_openings(home, measured.hand, measured.tables)}", file=sys.stderr)


def current(library: ActionLibrary) -> tuple[list[Opening], list[str]]:
    """Return the openings that are up to date, and a sentence about each of the others."""
    from rtee.errors import ActionError

    tables = library.openings
    known = {(table.action, frozenset(table.elements)) for table in tables.tables}
    valid: list[Opening] = []
    notes: dict[str, None] = {}
    for action in library:
        if tables.made and (action.name, frozenset(action.elements)) not in known:
            continue
        try:
            valid.append(tables.of(action))
        except ActionError as error:
            # Timed actions never have an opening, so that nothing is wrong with those.
            if action.action_kind != "timed":
                notes[str(error)] = None
    return valid, list(notes)


def _plain(table: Opening) -> dict[str, Any]:
    return {
        "action": table.action,
        "elements": list(table.elements),
        "sides": [list(side) for side in table.sides],
        "widest": table.widest,
        "narrowest": table.narrowest,
        "intensity": table.intensity.tolist(),
        "opening": table.width.tolist(),
        "note": table.note,
    }


def _show(hand: str, valid: list[Opening]) -> None:
    from rtee.cli._table import Column, Row, Table

    if not valid:
        return
    rows = [
        Row(
            (
                table.label,
                f"{table.widest * 1e3:.1f} to {table.narrowest * 1e3:.1f}",
                " | ".join(", ".join(side) for side in table.sides),
                table.note,
            )
        )
        for table in valid
    ]
    columns = (Column("action"), Column("opening mm", True), Column("sides"), Column("note"))
    Table(columns, tuple(rows), f"Openings of {hand}").show()
