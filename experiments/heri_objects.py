"""HERI II on an arm: three objects from the table into a container, on one timeline.

Each object is taken with another action: a pinch, Trigs below 100 %, and another composed one.
Motor positions and currents are plotted as one picture, with the spans from the start of each
action to the end of holding. A simulated motor has an effort alone; its current is that effort by
the constant of the real hand's motors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from experiments.common import Outcome, main, recording, strip
from experiments.transfer import LOST, WAYS, Transfer, run_transfer
from rtee.drivers.heri_ethercat.codec import TORQUE_PER_AMPERE
from rtee.log import read
from rtee.log.figure import Band, Figure, PlotSubject, bands_of, figure
from rtee.log.playback import fingers
from rtee.log.plots import write_png
from rtee.log.recording import Recording
from rtee.loop.planning import OPEN
from rtee.trials.bench import bench
from rtee.trials.grasp_placement import fingers_of
from rtee.trials.pictures import Stills

HAND = "heri_ii"

HOLD = 2.0


def _into(action: str, elements: tuple[str, ...], obj: str) -> Transfer:
    return Transfer(
        action,
        elements,
        obj,
        by=(0.32, 0.05),
        turn=0.0,
        reach="down",
        container=True,
        places=6,
    )


TRANSFERS = (
    _into("PinchTight", ("finger_2", "thumb"), "box:0.03x0.02x0.1"),
    _into("3f_grasp", (), "box:0.08x0.03x0.1"),
    _into("Grasp", (), "sphere:0.035"),
)


def held_spans(found: Recording) -> tuple[Band, ...]:
    """Return the spans of the actions, each until the hand begins to open, as in the paper."""
    bands = bands_of(found.spans, 0.0, found.duration)
    ends = [band.span.start for band in bands[1:]] + [found.duration]
    return tuple(
        band if band.span.name == OPEN else replace(band, span=replace(band.span, end=end))
        for band, end in zip(bands, ends, strict=True)
    )


def with_currents(shown: Figure) -> Figure:
    """Return a plot of HERI II that shows the currents [A] of its motors for their efforts."""
    rows = tuple(
        replace(
            row,
            efforts=tuple(
                replace(line, values=line.values / TORQUE_PER_AMPERE) for line in row.efforts
            ),
        )
        for row in shown.rows
    )
    return replace(shown, rows=rows, effort_label="current [A]")


def plot(path: Path) -> None:
    """Plot the recording again, with currents and the spans to the end of holding."""
    found = read(path)
    shown = with_currents(figure(found, by=PlotSubject.ACTUATOR, fingers=fingers(found)))
    write_png(replace(shown, bands=held_spans(found)), path.with_suffix(".png"))


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
            stills = Stills(ready.hand, WAYS) if pictures else None
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
            outcome.below(f"{what}: moves in the hand", result.slide * 1e3, LOST * 1e3, "mm")
            action = ready.library.find(transfer.action, transfer.elements)
            fingers = fingers_of(ready.hand, action)
            outcome.touches(what, result.pressed, result.held_by, fingers)
            outcome.check(result.placed, f"{what}: in the container", result.reason or "yes")
            if stills is not None and stills.taken:
                strip(folder / f"{HAND}_{transfer.action}.png", stills.taken, outcome, columns=4)
    for path in outcome.files:
        if path.suffix == ".mcap":
            plot(path)
    return outcome


if __name__ == "__main__":
    main(run, "heri_objects")
