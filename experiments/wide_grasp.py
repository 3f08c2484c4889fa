"""Robotiq 3F in dynamics: timed_wide_grasp picks an object up; also a Robotiq 2F-140."""

from __future__ import annotations

from pathlib import Path

from experiments.common import Outcome, hold, main
from rtee.trials.trial import Trial

TRIALS = (
    ("robotiq_3f", Trial("timed_wide_grasp", object="cylinder:0.045x0.12")),
    ("robotiq_2f_140", Trial("Grasp", object="box:0.05x0.05x0.1")),
)

SLIP = 0.005
"""How far the object may slide in the hand from the grasp to the end [m]."""


def run(folder: Path, *, pictures: bool = True) -> Outcome:
    """Grasp, lift, hold for 2 s and shake with each of the grippers."""
    outcome = Outcome("the object is lifted, held for 2 s and shaken")
    for name, trial in TRIALS:
        hold(name, trial, folder, outcome, slip=SLIP, pictures=pictures)
    return outcome


if __name__ == "__main__":
    main(run, "wide_grasp")
