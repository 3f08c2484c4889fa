"""`rtee retarget`: which finger of a hand follows which of a person's."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import Hand, JsonOption, actions_of, hand_folder, owned

if TYPE_CHECKING:
    from rtee.hand.model import Hand as HandModel
    from rtee.retarget.correspondence import Correspondence


def retarget(
    hand: Hand,
    save: Annotated[
        bool, typer.Option("--save", help="Find it in the model, and store it as retarget.yaml.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show which finger of a hand follows which of a person's, and which tips meet.

    Example: rtee retarget leap_hand --save
    """
    from rtee.errors import needing_extra

    with needing_extra("retargeting", "retarget"):
        from rtee.retarget.correspondence import read_correspondence, write_correspondence
        from rtee.retarget.fit import fit
    from rtee.hand.own_copy import own_place

    library = actions_of(hand)
    folder = hand_folder(hand)
    if save:
        own_place(folder)  # a folder that cannot be written is refused before the work
    found = None if save else read_correspondence(folder, library.hand)
    if found is None:
        found = fit(library)
    if save:
        path = write_correspondence(owned(folder), library.hand, found)
        print(f"written to {path}", file=sys.stderr)
    if as_json:
        import json
        from dataclasses import asdict

        print(json.dumps({"hand": library.hand.name, **asdict(found)}))
    else:
        _show(library.hand, found)


def _show(hand: HandModel, found: Correspondence) -> None:
    from rtee.cli._table import Column, Row, Table

    met: dict[str, str] = {}
    for pinch in found.pinches:
        first, second = pinch.fingers
        what = "meets the thumb's" if pinch.contact else "comes near the thumb's"
        if pinch.widths:
            what = f"opens to {pinch.widths[0] * 1e3:.0f} mm from {first}"
        met[second] = what
    rows = tuple(
        Row(
            (
                name,
                str(each.human),
                f"{each.reach * each.scale * 1e3:.0f}",
                met.get(name, ""),
            )
        )
        for name, each in found.fingers.items()
    )
    columns = (Column("finger"), Column("follows"), Column("reach mm", True), Column("tip"))
    Table(columns, rows, f"What {hand.name} follows").show()
