"""Write the arrays of this folder: what planners put out for a can of 40 mm, by hand.

Run it again only to change them.
"""

from pathlib import Path

import numpy as np

HERE = Path(__file__).parent


def main() -> None:
    """Write the arrays."""
    # The can stands at (0.5, 0, 0.1) in the camera's frame; the gripper comes along z.
    along, closing = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    turn = np.column_stack([along, closing, np.cross(along, closing)])
    rows = [
        [score, 0.04, 0.02, depth, *turn.ravel(), 0.5, 0.0, 0.1 + shift, 0]
        for score, depth, shift in ((0.92, 0.02, 0.0), (0.81, 0.03, -0.01), (0.4, 0.01, 0.02))
    ]
    np.save(HERE / "graspnet.npy", np.array(rows, dtype=np.float32))
    base = np.eye(4)
    base[:3, 3] = 0.5, 0.0, 0.12 - 0.1034
    np.savez(
        HERE / "contact_graspnet.npz",
        poses=np.array([base], dtype=np.float32),
        openings=np.array([0.04], dtype=np.float32),
        scores=np.array([0.9], dtype=np.float32),
    )
    # GraspGen gives no widths.
    np.savez(
        HERE / "graspgen.npz",
        grasps=np.array([base], dtype=np.float32),
        confidences=np.array([0.8], dtype=np.float32),
    )
    # A flexed index finger, by the joint names of another model of the SVH.
    np.savez(HERE / "joints.npz", names=np.array(list(JOINTS)), values=np.array([0.3, 0.4]))
    # Index finger and thumb of the SVH on a ball of 30 mm, in the palm's frame.
    np.savez(
        HERE / "contacts.npz",
        points=np.array(CONTACTS),
        normals=np.array(NORMALS),
    )


CONTACTS = ((0.0323, 0.0470, 0.1558), (0.0496, 0.0521, 0.1318))
"""Points of the contacts [m]."""

JOINTS = ("index_proximal", "index_distal")
"""Names of two joints in another model of the SVH; `planner_grasps.py` has ours."""

NORMALS = ((0.577, 0.169, -0.799), (-0.577, -0.169, 0.799))
"""Their normals into the ball."""


if __name__ == "__main__":
    main()
