"""Plan one grasp for a running hand: read a question from stdin, write the answer to stdout.

A separate process, so that planning neither takes Python's lock from the loop nor needs
Pinocchio and Coal in its process. See `rtee.planning.question`.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from rtee.errors import RteeError, needing_extra

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.planning.question import Question, ReachQuestion


def plan(library: ActionLibrary, question: Question) -> dict[str, Any]:
    """Return the ranking that a question asks for, as plain data.

    Raises:
        UserError: if it cannot be answered.
    """
    with needing_extra("planning a grasp", "extract"):
        from rtee.planning.objects import read_object
        from rtee.planning.plan import plan_grasps
    from rtee.objects.shape import refuse_paths
    from rtee.planning.result import to_document

    text = question.object
    # A path would let a client read files of the hand's computer: clients send a mesh's content.
    if not question.mesh:
        refuse_paths(text)
    with TemporaryDirectory() as place:
        file = Path(place) / f"object{question.format}"
        if question.mesh:
            file.write_bytes(question.mesh)
        obj = read_object(str(file) if question.mesh else text, question.mass, question.scale)
    # The temporary file's path means nothing to the client.
    obj = replace(obj, name=text)
    ranking = plan_grasps(
        library.hand,
        library,
        obj,
        friction=question.friction,
        weight_axis=question.weight_axis or None,
        table=question.table,
    )
    return to_document(replace(ranking, plans=ranking.plans[: question.top]))


def reach(library: ActionLibrary, question: ReachQuestion) -> dict[str, Any]:
    """Return how the hand reaches a planner's grasp, as plain data; see `plan`."""
    with needing_extra("reaching a grasp", "extract"):
        from rtee.planning.gripper_poses import GripperPose, reach_gripper_pose
        from rtee.planning.objects import read_object
        from rtee.planning.reach import reach_contacts
    import numpy as np

    from rtee.objects.shape import refuse_paths
    from rtee.planning.grasp_solution import WantedContact, to_document

    pose, where = (
        np.reshape(numbers, (4, 4)) if numbers else None
        for numbers in (question.pose, question.object_pose)
    )
    # No path from outside is opened; see `plan`.
    if question.object:
        refuse_paths(question.object)
    given: dict[str, Any] = {
        "approach": question.approach or None,
        "retreat": question.retreat,
        "obj": read_object(question.object) if question.object else None,
        "object_pose": where,
    }
    if not question.points:
        assert pose is not None  # noqa: S101 - `ReachQuestion.check` has seen to that
        actions = library.openings.known(library)
        grasp, fingers = GripperPose(pose, question.width), question.fingers
        return to_document(
            reach_gripper_pose(library.hand, actions, grasp, fingers=fingers, **given)
        )
    points: list[Any] = np.reshape(question.points, (-1, 3)).tolist()
    normals: list[Any] = [None] * len(points)
    if question.normals:
        normals = np.reshape(question.normals, (-1, 3)).tolist()
    names = question.fingers or [""] * len(points)
    contacts = [WantedContact(*each) for each in zip(points, normals, names, strict=True)]
    given |= {"palm_pose": pose, "tolerance": question.tolerance}
    return to_document(reach_contacts(library.hand, library, contacts, **given))


def answer(asked: dict[str, Any]) -> dict[str, Any]:
    """Return the answer to what `rtee.planning.question.ask` has written."""
    from rtee.actions.library import ActionLibrary
    from rtee.hand.load import load_hand
    from rtee.hand.validation import validated
    from rtee.planning.question import Question, ReachQuestion

    folder = Path(asked["hand"])
    library = ActionLibrary.load(load_hand(folder), folder / "actions")
    if "reach" in asked:
        return reach(library, validated(ReachQuestion, asked["reach"]))
    return plan(library, validated(Question, asked))


def main() -> None:
    """Answer the question on stdin."""
    try:
        found: dict[str, Any] = {"answer": answer(json.load(sys.stdin))}
    except RteeError as error:
        found = {"error": str(error)}
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
