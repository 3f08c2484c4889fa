"""Robotiq 3F in dynamics: timed_wide_grasp picks an object up; also a Robotiq 2F-140."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.common import Outcome, hold, main
from rtee.log import read
from rtee.trials.trial import Trial

TRIALS = (
    ("robotiq_3f", Trial("timed_wide_grasp", object="cylinder:0.06x0.12", places=4)),
    ("robotiq_2f_140", Trial("Grasp", object="box:0.05x0.05x0.1", places=2)),
)

SLIP = 0.005
"""How far the object may slide in the hand from the grasp to the end [m]."""

WIDE, SPREAD = "Open_Wide", "palm_finger_1_joint"
"""The step that spreads the two neighbouring fingers, and the actuator that does."""

LEAST = 0.18
"""How far they are spread at least [rad]: the end of the actuator's range is at 0.19."""

VIEW = np.array([-1.0, 0.3, 0.2])
"""From the object towards the camera: before the two neighbouring fingers."""


def run(folder: Path, *, pictures: bool = True) -> Outcome:
    """Grasp, lift, hold for 2 s and shake with each of the grippers."""
    outcome = Outcome(
        f"{WIDE} spreads the fingers; the object is lifted, held for 2 s and shaken, and slides by "
        f"less than {1e3 * SLIP:g} mm in the hand"
    )
    for name, trial in TRIALS:
        view = VIEW if name == "robotiq_3f" else None
        hold(name, trial, folder, outcome, slip=SLIP, pictures=pictures, view=view)
        if trial.action == "timed_wide_grasp":
            check_spread(outcome)
    return outcome


def check_spread(outcome: Outcome) -> None:
    """Note how far the fingers were spread when they began to close, as recorded."""
    recorded = read(next(path for path in outcome.files if path.suffix == ".mcap"))
    (span,) = recorded.spans
    wide = next(inner for inner in span.inner if inner.name == WIDE)
    states = recorded.actuator_states
    row = int(np.searchsorted(states.t, wide.end, side="right")) - 1
    spread = float(states.position[row, states.index(SPREAD)])
    outcome.above(f"{WIDE} spreads the fingers", spread, LEAST, "rad", ".3f")


if __name__ == "__main__":
    main(run, "wide_grasp")
