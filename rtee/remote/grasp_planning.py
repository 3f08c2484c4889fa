"""Plan grasps for clients, one after the other, in processes beside the loop."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from rtee.errors import RequestRejected
from rtee.messages.convert import table_of
from rtee.planning.question import Question, ReachQuestion, ask
from rtee.remote.call_queue import CallQueue
from rtee.remote.incoming_request import IncomingRequest

_WAITING: Final = 4
"""Plans that may wait: each takes a second or two of processor time."""


class GraspPlanning:
    """Answers the requests ``grasp_plan`` and ``reach``."""

    def __init__(self, hand: str) -> None:
        self._hand = hand
        self._queue: CallQueue | None = None
        self._process: subprocess.Popen[str] | None = None
        self._closed = False

    def handle(self, request: IncomingRequest, actions: Path | None) -> None:
        """Queue a request, which is answered when the plan is ready.

        The folder of actions is inside the hand's folder. Raises `RteeError` if the request is
        refused.
        """
        reach = request.request.name == "reach"
        question = _reach_question(request.fields) if reach else _question(request.fields)
        question.check()
        if actions is None:
            raise RequestRejected(f"{self._hand} has no folder with actions to plan with")
        # Made by the first request: most hands get none, and need no thread for it.
        if self._queue is None:
            self._queue = CallQueue(f"plan {self._hand}", _WAITING)
        if not self._queue.put(partial(self._answer, request, actions.parent, question)):
            raise RequestRejected(f"{_WAITING} plans are waiting already")

    def _answer(
        self, request: IncomingRequest, folder: Path, question: Question | ReachQuestion
    ) -> None:
        try:
            if self._closed:
                raise RequestRejected(f"{self._hand} has ended")
            request.answer({"data": ask(folder, question, self._started)})
        except Exception as error:
            request.refuse(error)

    def _started(self, process: subprocess.Popen[str]) -> None:
        # `close` may have run after `_answer` checked, and found no process to kill.
        self._process = process
        if self._closed:
            process.kill()

    def close(self) -> None:
        """End the plan under way; blocks for a moment."""
        self._closed = True
        if self._process is not None:
            self._process.kill()
        if self._queue is not None:
            self._queue.close()


def _question(fields: Mapping[str, Any]) -> Question:
    return Question(
        object=fields["object"],
        mesh=fields["mesh"],
        format=fields["format"],
        mass=float(fields["mass"]),
        friction=float(fields["friction"]),
        scale=float(fields["scale"]),
        weight_axis=tuple(float(value) for value in fields["weight_axis"]),
        top=int(fields["top"]),
        table=table_of(fields["table"]),
    )


def _reach_question(fields: Mapping[str, Any]) -> ReachQuestion:
    points, normals, pose, approach, object_pose = (
        tuple(map(float, fields[name]))
        for name in ("points", "normals", "pose", "approach", "object_pose")
    )
    return ReachQuestion(
        points=points,
        normals=normals,
        fingers=tuple(map(str, fields["fingers"])),
        width=float(fields["width"]),
        pose=pose,
        approach=approach,
        retreat=float(fields["retreat"]),
        tolerance=float(fields["tolerance"]),
        object=str(fields["object"]),
        object_pose=object_pose,
    )
