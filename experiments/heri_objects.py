"""HERI II on a carrier: three objects with three actions, motors plotted with the spans marked."""

from __future__ import annotations

from pathlib import Path

from experiments.common import Outcome, hold, main
from rtee.trials.trial import Trial

TRIALS = (
    Trial("PinchTight", ("finger_2", "thumb"), "box:0.04x0.04x0.1"),
    Trial("3f_grasp", object="cylinder:0.025x0.12"),
    Trial("Grasp", object="sphere:0.03"),
)


def run(folder: Path, *, pictures: bool = True) -> Outcome:
    """Grasp, lift, hold for 2 s and shake each of the objects."""
    outcome = Outcome("each object is lifted, held for 2 s and shaken")
    for trial in TRIALS:
        hold("heri_ii", trial, folder, outcome, pictures=pictures)
    return outcome


if __name__ == "__main__":
    main(run, "heri_objects")
