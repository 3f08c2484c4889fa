"""Handlers of the requests for information and of those that change the actions.

They are called in a thread of their own, since they may take milliseconds. Only this thread changes
the library of actions; the loop's thread only reads it.
"""

from __future__ import annotations

import contextlib
import logging
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from rtee import monotonic
from rtee.actions.fingerprints import Fingerprints
from rtee.actions.naming import normalise
from rtee.actions.types import Primitive
from rtee.errors import RequestRejected, RteeError
from rtee.hand.own_copy import TRIALS, copy_notice
from rtee.hand.yamlfile import emit
from rtee.loop.handloop import HandLoop
from rtee.loop.planning import OPEN
from rtee.messages.codec import paired
from rtee.messages.convert import DEVICE_STATUS, LOOP_STATISTICS, OBJECT, table_of
from rtee.messages.touch import reply_fields
from rtee.objects.description import NO_OBJECT
from rtee.planning.question import Question, ReachQuestion, ask
from rtee.remote.actions import GROUP, action_fields, build_action
from rtee.remote.agents import Agents
from rtee.remote.call_queue import CallQueue, LoopThread
from rtee.remote.goal_records import GoalRecords
from rtee.remote.hand_info import info_fields
from rtee.remote.incoming_request import IncomingRequest, accepted
from rtee.remote.lease import Lease
from rtee.remote.openings import opening_fields
from rtee.remote.publishing import Streams
from rtee.sample import TickRecord
from rtee.types import Event

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
        """Queue a request; its answer is sent when the plan is ready.

        Args:
            request: The request to plan or reach a grasp.
            actions: The hand's folder of actions.

        Raises:
            RteeError: if the request is refused.
        """
        question = _question(request)
        question.check()
        if actions is None:
            raise RequestRejected(f"{self._hand} has no actions folder to plan with")
        # Made by the first request: most hands get none, and need no thread for it.
        if self._queue is None:
            self._queue = CallQueue(f"plan {self._hand}", _WAITING)
        if not self._queue.put(partial(self._answer, request, actions.parent, question)):
            raise RequestRejected(f"{_WAITING} plans are already waiting; try again later")

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


def _question(request: IncomingRequest) -> Question | ReachQuestion:
    fields: dict[str, Any] = {
        name: tuple(value.tolist()) if isinstance(value, np.ndarray) else value
        for name, value in request.fields.items()
    }
    if request.request.name == "reach":
        return ReachQuestion(**fields | {"fingers": tuple(fields["fingers"])})
    return Question(**fields | {"table": table_of(fields["table"])})


Fields = Mapping[str, Any]

log = logging.getLogger(__name__)

_LONGEST_MARK = 1000
"""Longest text of a mark [characters]: plots show it as a label, a few lines long at most."""

_CONSTANT = frozenset({"info", "robot_description", "actions", "primitives", "partners"})
"""Requests whose answer changes only when the actions change."""

_CHANGING = frozenset({"add", "store", "remove", "rename"})
"""Requests that change the actions. They are refused while another client holds the lease, whose
next goal would use other actions than it expects."""

_ABOUT_ACTIONS = _CHANGING | {"actions", "primitives", "partners", "openings"}
"""Requests before which the files of actions are read again if they have changed."""

_MOST_ACTIONS = 256
"""Number of actions, not counting primitives, at which clients may add no more: each prolongs the
reading of the files by 0.3 ms."""

_FIRST_TICK = 2.0
"""Longest time from the discovery of a hand to its first tick [s]: a busy computer takes 0.1 s."""

_LOOK_EVERY = 0.005
"""Interval at which the first tick is looked for [s]: that of a slow loop."""

_MOST_KEPT = 64
"""Cached answers: more than user interfaces request; each takes up to a few hundred kilobytes."""


class RecordingStatus(Protocol):
    """Status of a recorder."""

    @property
    def recording(self) -> bool:
        """Whether a recording is being written."""

    @property
    def keeps(self) -> bool:
        """Whether messages are kept at present: on the disk, or in the flight recorder."""

    @property
    def path(self) -> Path | None:
        """The file being written, if there is one."""

    @property
    def problem(self) -> str:
        """Reason for which nothing is written at present; empty if the disk takes the data."""

    @property
    def trouble(self) -> str:
        """Losses of the recording and their reason, in words; empty if there are none."""


class RecorderControl(Protocol):
    """The interface of a recorder; any thread may call its methods, which return at once."""

    def start(self) -> None:
        """Start a new recording."""

    def stop(self) -> None:
        """Stop the recording."""

    def mark(self, text: str) -> None:
        """Add a mark to the recording."""

    def status(self) -> RecordingStatus:
        """Return the status of the recorder."""


class QueryHandlers:
    """Handles the requests of the group ``ask``.

    ``profile`` describes the profile of the references in words; ``counts`` returns a
    ``rtee_msgs/Counts``.
    """

    def __init__(
        self,
        loop: HandLoop,
        lease: Lease,
        agents: Agents,
        goals: GoalRecords,
        thread: LoopThread,
        streams: Streams,
        recording: RecorderControl | None,
        profile: str,
        counts: Callable[[], Fields],
    ) -> None:
        self._loop, self._lease, self._thread = loop, lease, thread
        self._agents, self._counts = agents, counts
        self._streams, self._recording, self._profile = streams, recording, profile
        self._hand, self._library = loop.hand, loop.library
        self._folder = self._library.folder
        self._plans = GraspPlanning(self._hand.name)
        self._cache: dict[tuple[str, bytes], bytes] = {}
        self._version = -1
        self._handlers: dict[str, Callable[[Fields], Fields]] = {
            "stream": lambda fields: accepted(streams.ask(fields["rate"])),
            "goal": lambda fields: goals.status(fields["goal_id"]),
            "touch": lambda _: reply_fields(self._last_tick()),
            "status": self._status,
            "object_description": self._object_description,
            "info": self._info,
            "robot_description": lambda _: {"data": self._hand.urdf.text},
            "actions": self._actions,
            "primitives": lambda _: {"groups": list(map(GROUP.fields, self._library.primitives()))},
            "partners": lambda fields: {
                "names": self._library.partners(fields["name"], fields["what"])
            },
            "openings": lambda _: opening_fields(self._library, loop.devices.values()),
            "trials": lambda _: {"data": self._trials()},
            "record": self._record,
            "add": self._add,
            "store": self._store,
            "remove": self._remove,
            "rename": self._rename,
        }

    def handle(self, request: IncomingRequest) -> bytes | None:
        """Return the encoded answer to a request; ``None`` if it is sent later.

        Raises `RteeError` if the request is refused.
        """
        name, fields = request.request.name, request.fields
        if name == "state":
            return self._streams.messages.state(self._last_tick())
        if name in ("grasp_plan", "reach"):
            self._plans.handle(request, self._library.folder)
            return None
        if name in _CHANGING or (name == "record" and fields["what"] != "mark"):
            self._lease.check(request.client)
        if name in _ABOUT_ACTIONS:
            self._reload()
        if name in _CONSTANT:
            return self._cached(request)
        if name in _CHANGING:
            fields = {**fields, "client": request.client}  # the event names the real client
        return request.request.answer.encode(self._handlers[name](fields))

    def close(self) -> None:
        """End the plan under way; blocks for a moment."""
        self._plans.close()

    def _last_tick(self) -> TickRecord:
        """Return the record of the last tick; of a hand that has just started, wait for the first.

        Raises `RteeError` if there is none in time.
        """
        end = monotonic.now() + _FIRST_TICK
        while True:
            try:
                return self._loop.snapshot()
            except RteeError:
                if monotonic.now() >= end:
                    raise
            monotonic.sleep(_LOOK_EVERY)

    def _cached(self, request: IncomingRequest) -> bytes:
        """Return an answer that is cached for each question until the actions change.

        Computing it holds Python's interpreter lock for milliseconds, which the loop also needs.
        """
        if self._version != self._library.version or len(self._cache) >= _MOST_KEPT:
            self._cache.clear()
            self._version = self._library.version
        key = (request.request.name, request.question)
        if key not in self._cache:
            fields = self._handlers[request.request.name](request.fields)
            self._cache[key] = request.request.answer.encode(fields)
        return self._cache[key]

    # --- information

    def _status(self, _: Fields) -> Fields:
        loop = self._loop
        # Read in the loop's thread, so that they belong to the same tick.
        statuses, statistics, plan = self._thread.call(
            lambda: (loop.statuses(), loop.statistics(), loop.controller.running)
        )
        stream = loop.streams.status()
        path = self._recording_path()
        return {
            "hand": self._hand.name,
            "holder": self._lease.holder,
            "goal_id": plan.goal_id if plan else "",
            "action": plan.action if plan else "",
            "recording": bool(path),
            "recording_path": path,
            "recording_trouble": self._recording.status().trouble if self._recording else "",
            "grip_effort": loop.controller.grip_effort,
            "statistics": LOOP_STATISTICS.fields(statistics),
            "devices": [DEVICE_STATUS.fields(status) for status in statuses],
            "profile": self._profile,
            "stream": asdict(stream),
            "agents_out": self._agents.status_text,
            "counts": self._counts(),
        }

    def _object_description(self, _: Fields) -> Fields:
        objects = (device.guarded.object_description for device in self._loop.devices.values())
        return OBJECT.fields(next(filter(None, objects), NO_OBJECT))

    def _recording_path(self) -> str:
        """Return the file being recorded, or an empty string."""
        status = self._recording.status() if self._recording else None
        return str(status.path or "") if status and status.recording else ""

    def _info(self, fields: Fields) -> Fields:
        positions = paired("position", fields["name"], fields["position"].tolist())
        return info_fields(self._hand, positions)

    def _record(self, fields: Fields) -> Fields:
        recorder, verb, text = self._recording, fields["what"], fields["text"]
        if recorder is None:
            raise RequestRejected(f"{self._hand.name} has no recorder")
        match verb:
            case "start":
                recorder.start()
            case "stop":
                recorder.stop()
            case "mark":
                if text and not text.isprintable():
                    raise RequestRejected(
                        f"a mark must be one line without control characters, not {text!r:.100}"
                    )
                if not 0 < len(text) <= _LONGEST_MARK:
                    raise RequestRejected(
                        f"a mark must be one line of 1 to {_LONGEST_MARK} characters, not "
                        f"{len(text)}"
                    )
                if (status := recorder.status()).problem:
                    raise RequestRejected(
                        f"the recording of {self._hand.name} is not written, so the mark would be "
                        f"lost: {status.problem}"
                    )
                if not status.keeps:
                    raise RequestRejected(
                        f"{self._hand.name} is not recording, so the mark would be lost; begin a"
                        " recording first, in the GUI or by record('start')"
                    )
                recorder.mark(text)
            case _:
                raise RequestRejected(
                    f"unknown request '{verb[:50]}' for the recording; it must be start, stop or "
                    "mark"
                )
        return accepted(self._recording_path())

    def _trials(self) -> str:
        """Return the text of the file with the results of trials, and the files' fingerprint."""
        folder = self._library.folder
        if folder is None:
            return ""
        with contextlib.suppress(OSError, UnicodeDecodeError):
            text = (folder.parent / TRIALS).read_text(encoding="utf-8")
            present = Fingerprints.of(folder.parent, self._library)
            actions = {"present_actions": present.actions} if present.actions else {}
            details = emit({"present_model": present.model, **actions})
            return f"{text}{details}present: '{present.files}'\n"
        return ""

    # --- actions

    def _actions(self, fields: Fields) -> Fields:
        actions = self._library.all(
            fields["kind"] or None, fields["name"] or None, fields["elements"]
        )
        # Once for each name: a primitive has an action for each combination of elements.
        stored = {name: self._library.is_stored(name) for name in {a.name for a in actions}}
        return {"actions": [action_fields(a, stored[a.name]) for a in actions]}

    def _reload(self) -> None:
        if self._library.folder is not None and self._library.reload():
            self._changed("rtee", "the files of actions were read again")

    def _add(self, fields: Fields) -> Fields:
        action = build_action(self._library, fields["action"])
        _check_free(action.name)
        known = {normalise(each.name) for each in self._library if not isinstance(each, Primitive)}
        if len(known) >= _MOST_ACTIONS and normalise(action.name) not in known:
            raise RequestRejected(
                f"{self._hand.name} has {len(known)} actions besides the primitives, and more than"
                f" {_MOST_ACTIONS} would slow it down; remove some first"
            )
        self._library.add(action, store=fields["store"], replace_same=fields["replace"])
        return self._done(fields, f"the action '{action.name}' was added")

    def _store(self, fields: Fields) -> Fields:
        self._library.store(fields["name"])
        return self._done(fields, f"the action '{fields['name']}' was stored")

    def _remove(self, fields: Fields) -> Fields:
        _check_free(fields["name"])
        self._library.remove(fields["name"])
        return self._done(fields, f"the action '{fields['name']}' was removed")

    def _rename(self, fields: Fields) -> Fields:
        _check_free(fields["name"])
        _check_free(fields["what"])
        self._library.rename(fields["name"], fields["what"])
        return self._done(fields, f"the action '{fields['name']}' is now called '{fields['what']}'")

    def _done(self, fields: Fields, text: str) -> Fields:
        text += self._copied()
        self._changed(fields["client"], text)
        return accepted(text)

    def _copied(self) -> str:
        """Return a remark if the change has just copied the hand, otherwise an empty string."""
        before, self._folder = self._folder, self._library.folder
        if before is None or self._folder is None or before == self._folder:
            return ""
        text = copy_notice(before.parent, self._folder.parent)
        log.warning("%s", text)
        return f"; {text}"

    def _changed(self, client: str, text: str) -> None:
        event = Event("actions_changed", client, text, monotonic.now())
        self._thread.call_soon(self._loop.announce, event)


def _check_free(name: str) -> None:
    """Raise `RequestRejected` if clients may not add, rename or remove an action of this name."""
    if normalise(name) == OPEN:
        raise RequestRejected(
            f"'{OPEN}' brings the hand to rest, also when a client is lost; an action of this name"
            " can only be defined in the hand's own files"
        )
