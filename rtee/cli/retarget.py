"""`rtee retarget`: show the person's finger that each finger of a hand follows."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import AsyncIterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtee.cli._common import Hand, JsonOption, actions_of, hand_folder, owned, to_json
from rtee.cli._table import Column, table_of
from rtee.errors import needing_extra
from rtee.hand.own_copy import own_place

if TYPE_CHECKING:
    from rtee.hand.model import Hand as HandModel
    from rtee.retarget.correspondence import Correspondence
    from rtee.retarget.frames import TrackerFrame
    from rtee.retarget.retargeter import Retargeter
    from rtee.sample import FloatArray


def retarget(
    hand: Hand,
    *,
    save: bool = False,
    show: bool = False,
    landmarks: Path | None = None,
    port: int = 8080,
    as_json: JsonOption = False,
) -> None:
    """Show which finger of a hand follows which of a person's, and which tips meet.

    Example: rtee retarget leap_hand --show

    Arguments and options:
        save: Find the correspondence in the model, and store it as retarget.yaml.
        show: Show it in the browser, beside a person's hand.
        landmarks (FILE): With --show: the points to show; by default, a pinching hand.
        port (0..65535): With --show: port of the page.
    """
    with needing_extra("retargeting", "retarget"):
        from rtee.retarget.correspondence import read_correspondence, write_correspondence
        from rtee.retarget.fit import fit

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
        from msgspec import to_builtins

        print(to_json({"hand": library.hand.name, **to_builtins(found)}))
    else:
        _show(library.hand, found)
    if show:
        _open_page(folder, landmarks, port)


def _open_page(folder: Path, file: Path | None, port: int) -> None:
    import anyio

    with needing_extra("the GUI", "gui"):
        from rtee.gui.access import Access
        from rtee.gui.person import show_person
    from rtee.retarget import frames as tracker
    from rtee.retarget.layouts import LAYOUTS, Side
    from rtee.retarget.retargeter import Retargeter
    from rtee.testing.human_hand import shown

    retargeter = Retargeter.of(folder)
    seen = (
        tracker.read_frames(file, LAYOUTS["mediapipe"], Side.RIGHT)
        if file is not None
        else [tracker.TrackerFrame(k / 30.0, points) for k, points in enumerate(shown())]
    )
    page = partial(
        show_person, retargeter.hand, answered(retargeter, seen), access=Access(), port=port
    )
    # Ctrl-C is the usual end, not a failure.
    with contextlib.suppress(KeyboardInterrupt):
        anyio.run(page)


async def answered(
    retargeter: Retargeter, frames: Sequence[TrackerFrame]
) -> AsyncIterator[tuple[FloatArray, FloatArray]]:
    """Yield a person's points, placed beside the robot, and its positions; repeats in real time."""
    from rtee.retarget.frames import due

    while True:
        async for frame in due(frames):
            answer = retargeter.step(frame.points, frame.stamp)
            if frame.points is not None:
                positions = np.array([*answer.values()])
                yield retargeter.beside(frame.points), positions


def _show(hand: HandModel, found: Correspondence) -> None:
    met: dict[str, str] = {}
    for pinch in found.pinches:
        first, second = pinch.fingers
        what = "meets the thumb's" if pinch.contact else "comes near the thumb's"
        if pinch.widths:
            what = f"opens to {pinch.widths[0] * 1e3:.0f} mm from {first}"
        met[second] = what
    rows = (
        (name, str(each.human), f"{each.reach * each.scale * 1e3:.0f}", met.get(name, ""))
        for name, each in found.fingers.items()
    )
    columns = ("finger", "follows", Column("reach mm", right=True), "tip")
    table_of(columns, rows, f"What {hand.name} follows").show()
