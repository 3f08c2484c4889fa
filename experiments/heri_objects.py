"""HERI II on an arm: three objects from the table into a container, on one timeline.

Each object is taken with another action: a pinch, Trigs below 100 %, and another composed one.
Motor positions and currents are plotted as one picture, with the actions' spans.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.common import Outcome, main, recording, strip
from rtee.trials.pictures import Stills
from rtee.trials.sweep import bench
from rtee.trials.transfer import Transfer, run_transfer

HAND = "heri_ii"

HOLD = 2.0


def _into(action: str, elements: tuple[str, ...], thing: str) -> Transfer:
    return Transfer(
        action, elements, thing, by=(0.32, 0.05), turn=0.0, reach="down", container=True, places=4
    )


TRANSFERS = (
    _into("PinchTight", ("finger_2", "thumb"), "box:0.04x0.04x0.1"),
    _into("3f_grasp", (), "cylinder:0.025x0.12"),
    _into("Grasp", (), "sphere:0.035"),
)


def run(
    folder: Path, *, pictures: bool = True, transfers: Sequence[Transfer] = TRANSFERS
) -> Outcome:
    """Take each object, hold it for 2 s, and put it into the container."""
    outcome = Outcome(f"each object is lifted, held for {HOLD:g} s and put into the container")
    ready = bench(HAND)
    # Once to find the places that work, and again from there, to record nothing else.
    found = [
        run_transfer(ready.hand, ready.library, ready.settings, transfer) for transfer in transfers
    ]
    ticks = 0
    with recording(ready, folder, outcome) as recorder:
        for transfer, first in zip(transfers, found, strict=True):
            what = f"{transfer.action} on {transfer.object}"
            if first.stance is None:
                outcome.check(False, f"{what}: in the container", first.reason)
                continue
            stills = Stills.of_transfer(ready.hand) if pictures else None
            result = run_transfer(
                ready.hand,
                ready.library,
                ready.settings,
                transfer,
                observers=[recorder],
                watch=stills,
                stances=[first.stance],
                teach=False,
                ticks=ticks,
            )
            ticks = result.ticks
            outcome.check(result.placed, f"{what}: in the container", result.reason or "yes")
            if stills is not None and stills.taken:
                strip(folder / f"{HAND}_{transfer.action}.png", stills.taken, outcome, columns=4)
    return outcome


if __name__ == "__main__":
    main(run, "heri_objects")
