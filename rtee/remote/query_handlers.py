"""The requests that only want to know, or that change the actions; answered in a thread of theirs.

That thread is the only one that changes the library; the loop's thread only looks up in it.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from rtee.errors import RequestRejected, RteeError
from rtee.hand.fingerprint import fingerprint
from rtee.hand.own_copy import TRIALS, told
from rtee.loop.handloop import HandLoop
from rtee.messages.convert import device_status_fields, loop_statistics_fields
from rtee.remote.actions import action_fields, group_fields, made_of
from rtee.remote.grasp_planning import GraspPlanning
from rtee.remote.incoming_request import Asked, accepted
from rtee.remote.lease import Lease
from rtee.remote.loop_thread import LoopThread
from rtee.remote.planner import info_fields
from rtee.remote.publishing import Streams
from rtee.types import Event

Fields = Mapping[str, Any]

log = logging.getLogger(__name__)

_LONGEST_MARK = 1000
"""Longest text of a mark [characters]: some lines of a terminal, since plots show it as a label."""

_CONSTANT = frozenset({"info", "robot_description", "actions", "primitives", "partners"})
"""Requests whose answer changes only with the actions."""

_MOST_KEPT = 64
"""Answers kept: more than user interfaces ask for; each takes up to some hundred kilobytes."""


class RecordingStatus(Protocol):
    """How a recorder is doing."""

    @property
    def recording(self) -> bool:
        """Whether a recording is being written."""

    @property
    def path(self) -> Path | None:
        """The file that is written, if one is."""

    @property
    def trouble(self) -> str:
        """What is not recorded and why, in words; empty if everything is."""


class Recording(Protocol):
    """What is needed of a recorder; every method returns at once, in any thread."""

    def start(self) -> None:
        """Begin a new recording."""

    def stop(self) -> None:
        """End the recording."""

    def mark(self, text: str) -> None:
        """Put a mark into the recording."""

    def status(self) -> RecordingStatus:
        """Return how the recorder is doing."""


class Asking:
    """Answers the requests of the group ``ask``.

    Args:
        loop: The hand's loop.
        lease: Who holds the hand.
        thread: The loop's thread.
        streams: The streams of states.
        recording: The recorder, if there is one.
        profile: How the references move, in words.
    """

    def __init__(
        self,
        loop: HandLoop,
        lease: Lease,
        thread: LoopThread,
        streams: Streams,
        recording: Recording | None,
        profile: str,
    ) -> None:
        self._loop, self._lease, self._thread = loop, lease, thread
        self._streams, self._recording, self._profile = streams, recording, profile
        self._hand, self._library = loop.hand, loop.library
        self._folder = self._library.folder
        self._plans = GraspPlanning(self._hand.name)
        self._answered: dict[tuple[str, bytes], bytes] = {}
        self._version = -1
        self._answers: dict[str, Callable[[Fields], Fields]] = {
            "stream": self._stream,
            "status": self._status,
            "info": self._info,
            "robot_description": lambda _: {"data": self._hand.urdf.text},
            "actions": self._actions,
            "primitives": self._primitives,
            "partners": self._partners,
            "trials": lambda _: {"data": self._trials()},
            "record": self._record,
            "add": self._add,
            "store": self._store,
            "remove": self._remove,
            "rename": self._rename,
        }

    def handle(self, asked: Asked) -> None:
        """Answer a question.

        Raises:
            RteeError: if it cannot be answered.
        """
        name, fields = asked.request.name, asked.fields
        if name == "state":
            asked.send(self._streams.messages.state(self._loop.snapshot()), True)
        elif name == "grasp_plan":
            self._plans.handle(asked, self._library.folder)
        elif name in _CONSTANT:
            asked.send(self._kept(asked), True)
        else:
            asked.answer(self._answers[name](fields))

    def close(self) -> None:
        """End what is being planned; blocks for a moment."""
        self._plans.close()

    def _kept(self, asked: Asked) -> bytes:
        """Return an answer that changes only with the actions; worked out once for each question.

        Working it out takes milliseconds of Python's lock, which the loop also needs.
        """
        if asked.request.name not in ("info", "robot_description"):
            self._reload()
        if self._version != self._library.version or len(self._answered) >= _MOST_KEPT:
            self._answered.clear()
            self._version = self._library.version
        key = (asked.request.name, asked.question)
        if key not in self._answered:
            fields = self._answers[asked.request.name](asked.fields)
            self._answered[key] = asked.request.answer.encode(fields)
        return self._answered[key]

    # --- what is known

    def _stream(self, fields: Fields) -> Fields:
        return accepted(self._streams.ask(fields["rate"]))

    def _status(self, _: Fields) -> Fields:
        loop = self._loop
        statuses, statistics, plan = self._thread.call(
            lambda: (loop.statuses(), loop.statistics(), loop.controller.running)
        )
        path = self._recording_path()
        return {
            "hand": self._hand.name,
            "holder": self._lease.holder,
            "goal_id": plan.goal.goal_id if plan else "",
            "action": plan.goal.action if plan else "",
            "recording": bool(path),
            "recording_path": path,
            "recording_trouble": self._recording.status().trouble if self._recording else "",
            "grip_effort": loop.controller.grip_effort,
            "statistics": loop_statistics_fields(statistics),
            "devices": [device_status_fields(status) for status in statuses],
            "profile": self._profile,
        }

    def _recording_path(self) -> str:
        """Return the file of the recording under way, or an empty string."""
        status = self._recording.status() if self._recording else None
        return str(status.path or "") if status and status.recording else ""

    def _info(self, fields: Fields) -> Fields:
        names, positions = fields["name"], fields["position"].tolist()
        if len(names) != len(positions):
            raise RteeError("a posture needs as many positions as names")
        return info_fields(self._hand, dict(zip(names, positions, strict=True)))

    def _record(self, fields: Fields) -> Fields:
        recorder, what, text = self._recording, fields["what"], fields["text"]
        if recorder is None:
            raise RequestRejected(f"{self._hand.name} has no recorder")
        match what:
            case "start":
                recorder.start()
            case "stop":
                recorder.stop()
            case "mark":
                if not 0 < len(text) <= _LONGEST_MARK or not text.isprintable():
                    raise RequestRejected(
                        f"a mark is one line of 1 to {_LONGEST_MARK} characters, not {len(text)}"
                    )
                recorder.mark(text)
            case _:
                raise RequestRejected(
                    f"a recording cannot be told to '{what[:50]}'; start, stop or mark it"
                )
        return accepted(self._recording_path())

    def _trials(self) -> str:
        """Return the text of the file with what trials found, and of what the files are now."""
        folder = self._library.folder
        if folder is None:
            return ""
        with contextlib.suppress(OSError, UnicodeDecodeError):
            text = (folder.parent / TRIALS).read_text(encoding="utf-8")
            return f"{text}present: '{fingerprint(folder.parent)}'\n"
        return ""

    # --- actions

    def _actions(self, fields: Fields) -> Fields:
        found = self._library.all(
            fields["kind"] or None, fields["name"] or None, fields["elements"]
        )
        stored = self._library.is_stored
        custom = {action.name: stored(action.name) for action in found}
        return {"actions": [action_fields(a, custom[a.name]) for a in found]}

    def _primitives(self, _: Fields) -> Fields:
        return {"groups": [group_fields(group) for group in self._library.primitives()]}

    def _partners(self, fields: Fields) -> Fields:
        return {"names": self._library.partners(fields["name"], fields["what"])}

    def _reload(self) -> None:
        if self._library.folder is not None and self._library.reload():
            self._changed("rtee", "the files of actions were read again")

    def _add(self, fields: Fields) -> Fields:
        self._reload()
        action = made_of(self._library, fields["action"])
        self._library.add(action, store=fields["store"], replace_same=fields["replace"])
        return self._done(fields, f"the action '{action.name}' was added")

    def _store(self, fields: Fields) -> Fields:
        self._reload()
        self._library.store(fields["name"])
        return self._done(fields, f"the action '{fields['name']}' was stored")

    def _remove(self, fields: Fields) -> Fields:
        self._reload()
        self._library.remove(fields["name"])
        return self._done(fields, f"the action '{fields['name']}' was removed")

    def _rename(self, fields: Fields) -> Fields:
        self._reload()
        self._library.rename(fields["name"], fields["what"])
        return self._done(fields, f"the action '{fields['name']}' is now called '{fields['what']}'")

    def _done(self, fields: Fields, text: str) -> Fields:
        text += self._copied()
        self._changed(fields["client"], text)
        return accepted(text)

    def _copied(self) -> str:
        """Return that the hand was copied to be changed, for once, if it was."""
        before, self._folder = self._folder, self._library.folder
        if before is None or self._folder is None or before == self._folder:
            return ""
        text = told(before.parent, self._folder.parent)
        log.warning("%s", text)
        return f"; {text}"

    def _changed(self, client: str, text: str) -> None:
        event = Event("actions_changed", client, text, time.monotonic())
        self._thread.call_soon(self._loop.announce, event)
