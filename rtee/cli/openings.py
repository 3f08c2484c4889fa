"""`rtee openings`: how far the fingertips open in each action of a hand."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import typer

from rtee.cli._common import Hand, JsonOption, actions_of, hand_folder, owned, to_json
from rtee.cli._table import Column, table_of
from rtee.errors import ActionError, needing_extra
from rtee.hand.own_copy import own_place

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.actions.openings import OpeningTable
    from rtee.planning.result import Point


def openings(
    hand: Hand,
    *,
    save: bool = False,
    as_json: JsonOption = False,
) -> None:
    """List the openings of a hand's actions; with --save, make their tables.

    Exit status 1 when there are none, or some are out of date.

    Example: rtee openings schunk_svh --save

    Arguments and options:
        save: Make the tables and store them (extra extract).
    """
    if save:
        make(hand)
    library = actions_of(hand)
    valid, notes = current(library)
    if as_json:
        print(to_json(_document(library, valid)))
    else:
        _show(library, valid)
    if not valid and not notes:
        notes.append(f"no action of '{library.hand.name}' has an opening")
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    raise typer.Exit(1 if notes else 0)


def make(hand: str) -> None:
    """Make the tables of a hand's actions and store them in its folder."""
    from rtee.actions.openings import write_openings
    from rtee.cli.extract import measured_openings

    folder = hand_folder(hand)
    own_place(folder)  # a folder that cannot be written is refused before the work
    measured = measured_openings(folder)
    # Copied after the work, which leaves no copy behind if it fails.
    home = owned(folder)
    print(f"written to {write_openings(home, measured)}", file=sys.stderr)


def current(library: ActionLibrary) -> tuple[list[OpeningTable], list[str]]:
    """Return the openings that are up to date, and a sentence about each of the others."""
    tables = library.openings
    known = {(table.action, frozenset(table.elements)) for table in tables.tables}
    valid: list[OpeningTable] = []
    notes: dict[str, None] = {}
    for action in library:
        if tables.made and (action.name, frozenset(action.elements)) not in known:
            continue
        try:
            valid.append(tables.of(action))
        except ActionError as error:
            # Timed actions never have an opening, so nothing is wrong with those.
            if action.action_kind != "timed":
                notes[str(error)] = None
    # The tables have a meeting for every action but timed ones.
    measured = any(action.action_kind != "timed" for action in library)
    if tables.made and measured and not tables.meetings:
        name = library.hand.name
        notes[f"the empty hand's self-contacts are not known; `rtee openings {name} --save`"] = None
    return valid, list(notes)


def tool_centres(library: ActionLibrary, table: OpeningTable) -> tuple[Point, Point]:
    """Return where the fingertips meet an object, in the flange's frame [m].

    First at the widest opening, then at the narrowest. The hand's place on the flange must be
    known. Raises `MissingExtra` without the extra ``extract``, and `ModelError` if a mesh is
    missing or cannot be read.
    """
    with needing_extra("tool centre points", "extract"):
        from rtee.planning.gripper_poses import grasp_frame
        from rtee.planning.tips import Fingertips
    from rtee.hand.frames import base_in_flange

    flange = library.hand.flange
    assert flange is not None  # noqa: S101 - said above
    tips, action = Fingertips(library.hand), library.find(table.action, table.elements)
    ends = (float(table.intensity[0]), float(table.intensity[-1]))
    mounted = base_in_flange(flange)
    frames = [mounted @ grasp_frame(tips, action, table, intensity) for intensity in ends]
    widest, narrowest = ((float(f[0, 3]), float(f[1, 3]), float(f[2, 3])) for f in frames)
    return widest, narrowest


def _document(library: ActionLibrary, valid: list[OpeningTable]) -> dict[str, Any]:
    flange, openings = library.hand.flange, [_plain(table) for table in valid]
    document: dict[str, Any] = {"hand": library.hand.name, "openings": openings}
    if flange is not None:
        document["flange"] = flange.frame
        for table, plain in zip(valid, openings, strict=True):
            plain["tcp_widest"], plain["tcp_narrowest"] = tool_centres(library, table)
    return document


def _plain(table: OpeningTable) -> dict[str, Any]:
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


def _show(library: ActionLibrary, valid: list[OpeningTable]) -> None:
    if not valid:
        return
    flange = library.hand.flange
    columns: list[str | Column] = ["action", Column("opening mm", right=True), "sides", "note"]
    if flange is not None:
        columns.insert(2, f"TCP in {flange.frame} mm")
    rows = []
    for opening in valid:
        cells = [
            opening.label,
            f"{opening.widest * 1e3:.1f} to {opening.narrowest * 1e3:.1f}",
            " | ".join(", ".join(side) for side in opening.sides),
            opening.note,
        ]
        if flange is not None:
            ends = tool_centres(library, opening)
            cells.insert(2, " to ".join(" ".join(f"{1e3 * v:z.1f}" for v in end) for end in ends))
        rows.append(cells)
    table_of(columns, rows, f"Openings of {library.hand.name}").show()
