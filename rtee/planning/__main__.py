"""Plan one grasp for a running hand: read a question from stdin, write the answer to stdout.

A separate process, so that planning neither takes Python's lock from the loop nor needs
Pinocchio and Coal in its process. See `rtee.planning.question`.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rtee.errors import RteeError, needing_extra


def answer(question: dict[str, Any]) -> dict[str, Any]:
    """Return the ranking that a question of `rtee.planning.question.ask` asks for, as plain data.

    Raises:
        UserError: if it cannot be answered.
    """
    with needing_extra("planning a grasp", "extract"):
        from rtee.planning.objects import read_object
        from rtee.planning.plan import plan_grasps
    from rtee.actions.library import ActionLibrary
    from rtee.hand.load import load_hand
    from rtee.hand.validation import validated
    from rtee.objects.shape import Table, refuse_paths
    from rtee.planning.result import to_document

    text, mass, scale = question["object"], question["mass"], question["scale"]
    mesh = base64.b64decode(question["mesh"])
    # A path would let a client read files of the hand's computer: meshes come by content.
    if not mesh:
        refuse_paths(text)
    folder = Path(question["hand"])
    hand = load_hand(folder)
    library = ActionLibrary.load(hand, folder / "actions")
    with TemporaryDirectory() as place:
        file = Path(place) / f"object{question['format']}"
        if mesh:
            file.write_bytes(mesh)
        obj = read_object(str(file) if mesh else text, mass, scale)
    axis = question["weight_axis"] or None
    table = validated(Table, question["table"]) if question["table"] else None
    # The temporary file's path means nothing to the client.
    obj = dataclasses.replace(obj, name=text)
    ranking = plan_grasps(
        hand, library, obj, friction=question["friction"], weight_axis=axis, table=table
    )
    return to_document(dataclasses.replace(ranking, plans=ranking.plans[: question["top"]]))


def reach(question: dict[str, Any]) -> dict[str, Any]:
    """Return how the hand reaches a planner's grasp, as plain data; see `answer`."""
    with needing_extra("reaching a grasp", "extract"):
        from rtee.planning.gripper_poses import GripperPose, reach_gripper_pose, with_openings
        from rtee.planning.objects import read_object
        from rtee.planning.reach import reach_contacts
    import numpy as np

    from rtee.actions.library import ActionLibrary
    from rtee.hand.load import load_hand
    from rtee.objects.shape import refuse_paths
    from rtee.planning.grasp_solution import WantedContact, to_document

    folder, asked = Path(question["hand"]), question["reach"]
    hand = load_hand(folder)
    library = ActionLibrary.load(hand, folder / "actions")
    pose, where = (
        np.reshape(asked[name], (4, 4)) if asked[name] else None for name in ("pose", "object_pose")
    )
    text = asked["object"]
    # No path from outside is opened; see `answer`.
    if text:
        refuse_paths(text)
    obj = read_object(text) if text else None
    approach, retreat = asked["approach"] or None, asked["retreat"]
    if not asked["points"]:
        assert pose is not None  # noqa: S101 - `ReachQuestion.check` has seen to that
        actions = with_openings(library, library.openings)
        grasp = GripperPose(pose, asked["width"])
        found = reach_gripper_pose(
            hand,
            actions,
            grasp,
            fingers=asked["fingers"],
            approach=approach,
            retreat=retreat,
            obj=obj,
            object_pose=where,
        )
        return to_document(found)
    points = np.reshape(asked["points"], (-1, 3)).tolist()
    normals = np.reshape(asked["normals"], (-1, 3)).tolist() or [None] * len(points)
    fingers = asked["fingers"] or [""] * len(points)
    contacts = [WantedContact(*each) for each in zip(points, normals, fingers, strict=True)]
    tolerance = asked["tolerance"]
    return to_document(
        reach_contacts(
            hand,
            library,
            contacts,
            palm_pose=pose,
            approach=approach,
            retreat=retreat,
            tolerance=tolerance,
            obj=obj,
            object_pose=where,
        )
    )


def main() -> None:
    """Answer the question on stdin."""
    try:
        question = json.load(sys.stdin)
        found: dict[str, Any] = {"answer": (reach if "reach" in question else answer)(question)}
    except RteeError as error:
        found = {"error": str(error)}
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
