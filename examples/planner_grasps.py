"""What grasp planners put out, turned into postures and palm poses of a hand; nothing moves.

    python examples/planner_grasps.py [HAND]

The arrays in examples/planners stand in for a planner's; `hand.grasp_at` does such a grasp with a
hand that runs.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, RteeError
from rtee.hand.load import hand_folder, load_hand
from rtee.planning.grasp_solution import GraspSolution, WantedContact
from rtee.planning.gripper_poses import (
    from_base_poses,
    from_graspnet,
    reach_gripper_pose,
)
from rtee.planning.joint_vectors import fit_joints
from rtee.planning.objects import read_object
from rtee.planning.reach import reach_contacts
from rtee.planning.tips import Fingertips

PLANNERS = Path(__file__).parent / "planners"
FRANKA = 0.1034
"""From the base of the Franka hand, whose pose Contact-GraspNet gives, to its fingertips [m]."""


CAN = 0.04
"""Diameter of the can [m], which GraspGen does not give."""
OURS = {
    "index_proximal": "left_hand_Index_Finger_Proximal",
    "index_distal": "left_hand_Index_Finger_Distal",
}
"""The joints of the SVH by their names in the model of `joints.npz`."""


def show(what: str, solution: GraspSolution) -> None:
    """Print a grasp."""
    with_what = f"{solution.action} at {solution.intensity:.2f}" if solution.action else "a posture"
    where = np.array(solution.palm_pose)[:3, 3]
    print(f"{what}: {with_what} with {', '.join(solution.fingers)}; the palm at {where.round(3)} m")
    for left in solution.residuals:
        print(
            f"  {left.finger}: {1e3 * left.distance:+.1f} mm, {np.degrees(left.angle):.0f} degrees"
        )
    for met in solution.collisions:
        print(f"  {met.words}")


def main(name: str = "schunk_svh") -> None:
    """Read the arrays and print what they come to."""
    folder = hand_folder(name)[0]
    hand = load_hand(folder)
    library, tips = ActionLibrary.load(hand, folder / "actions"), Fingertips(hand)
    actions = library.openings.known(library)

    best = from_graspnet(np.load(PLANNERS / "graspnet.npy", allow_pickle=False))[0]
    show("GraspNet, AnyGrasp", reach_gripper_pose(hand, actions, best, tips=tips))

    with np.load(PLANNERS / "contact_graspnet.npz", allow_pickle=False) as found:
        grasps = from_base_poses(
            found["poses"], found["openings"], depth=FRANKA, scores=found["scores"]
        )
    show("Contact-GraspNet", reach_gripper_pose(hand, actions, grasps[0], tips=tips))

    with np.load(PLANNERS / "graspgen.npz", allow_pickle=False) as found:
        grasps = from_base_poses(
            found["grasps"], CAN, depth=FRANKA, closing="x", scores=found["confidences"]
        )
    show("GraspGen", reach_gripper_pose(hand, actions, grasps[0], tips=tips))

    with np.load(PLANNERS / "contacts.npz", allow_pickle=False) as found:
        pairs = zip(found["points"].tolist(), found["normals"].tolist(), strict=True)
        contacts = [WantedContact(tuple(point), tuple(normal)) for point, normal in pairs]
        middle = found["points"].mean(axis=0)
    try:
        ball, pose = read_object("sphere:0.015"), np.eye(4)
        pose[:3, 3] = middle
        solution = reach_contacts(hand, library, contacts, tips=tips, obj=ball, object_pose=pose)
        show("Contact points", solution)
    except ConfigError as error:  # they are the SVH's; another hand may not reach them
        print(f"Contact points: {error}")

    with np.load(PLANNERS / "joints.npz", allow_pickle=False) as found:
        theirs = dict(zip(found["names"].tolist(), found["values"].tolist(), strict=True))
    if not set(OURS.values()) <= set(hand.joint_names):
        theirs = dict.fromkeys(hand.joint_names, 0.1)  # another hand than the SVH
    fitted = fit_joints(hand, theirs, {name: OURS.get(name, name) for name in theirs})
    worst = max(map(abs, fitted.residuals.values()))
    print(f"Joint vector: {len(fitted.posture)} actuators, residuals up to {worst:.3f} rad | m")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:2])
    except RteeError as error:
        sys.exit(f"planner_grasps: {error}")
