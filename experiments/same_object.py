"""The same object picked up by a 2F-85, a qb SoftHand and a 3FG15, by primitives only."""

from __future__ import annotations

from pathlib import Path

from experiments.common import Outcome, hold, main
from rtee.trials.trial import Trial

OBJECT = "cylinder:0.025x0.12"
GRASPS = (
    ("robotiq_2f_85", "SingleJointMultipleTips_2", "finger_joint"),
    ("qb_softhand", "SingleJointMultipleTips_5", "qbhand_synergy_joint"),
    ("onrobot_3fg15", "SingleJointMultipleTips_3", "robot_onrobot_3fg15_finger_joint1"),
)


def run(folder: Path, *, pictures: bool = True) -> Outcome:
    """Grasp, lift, hold for 2 s and shake the same object with each of the devices."""
    outcome = Outcome("the same object is lifted, held for 2 s and shaken by each device")
    for name, action, actuator in GRASPS:
        trial = Trial(action, (actuator,), OBJECT, places=5)
        hold(name, trial, folder, outcome, pictures=pictures)
    return outcome


if __name__ == "__main__":
    main(run, "same_object")
