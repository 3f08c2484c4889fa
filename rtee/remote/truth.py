"""The present state of the hand, and the evidence for it, for all panels of the GUI.

It receives states, results, events and the status as they arrive, and reports their age.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np

from rtee import monotonic
from rtee.messages.state import State
from rtee.remote.monitoring import HandStatus
from rtee.remote.words import asked
from rtee.types import EARLY, DeviceStatus, Event, Outcome, Result

STALE_AFTER: Final = 1.0
"""Age at which the newest state is out of date [s]: a hundred states late."""

_FELT: Final = 0.5
"""Measured force above which an object counts as held without a result [N]: above sensor drift."""

_NOTHING: Final = 0.05
"""Measured force below which nothing is pressed [N]: below the lightest grasp."""

_OLDER: Final = 1.0
"""Time after a stop in which a status may still be from before it [s]: they come once a second."""

_OLD: Final = "use the emergency stop"


class Tone(StrEnum):
    """The severity of a statement for the reader; pages show it as a colour."""

    GOOD = "good"
    PLAIN = "plain"
    WARN = "warn"
    BAD = "bad"


class Words(NamedTuple):
    """A statement, and its tone."""

    text: str
    tone: Tone = Tone.PLAIN


class Turn(NamedTuple):
    """The last event that made earlier results obsolete.

    Attributes:
        why: When and what, in words.
        goal: The goal or stream that caused it, or an empty string.
    """

    why: str = ""
    goal: str = ""


class HeldObject(StrEnum):
    """Knowledge about an object in the hand."""

    HOLDING = "holding"
    EMPTY = "empty"
    LOST = "lost"
    UNKNOWN = "not known"


def clock() -> str:
    """Return the time of day in this computer's zone."""
    return time.strftime("%H:%M:%S")


class Truth:
    """The known state of one hand.

    Attributes:
        hand: The hand's name, or an empty string.
        state: The newest state.
        status: The newest status.
        trouble: Why there is no connection, or an empty string.
        grip: Knowledge about an object in the hand.
        stopped: The last stop, until something moves again.
        turn: The last event that made earlier results obsolete; another object each time.
    """

    def __init__(self, hand: str = "") -> None:
        self.hand = hand
        self.state: State | None = None
        self.status: HandStatus | None = None
        self.trouble = "looking for a hand …"
        self.grip = HeldObject.UNKNOWN
        self.stopped = Words("")
        self.turn = Turn()
        self._hot: dict[str, str] = {}  # events of actuators that are too warm
        self._busy: dict[str, str] = {}  # what devices are doing before they follow references
        self._received = -math.inf
        self._since = ""
        self._fingers: tuple[str, ...] = ()
        self._asked = ""  # the force that the goal asked for, if what is held is held with less
        self._word = False  # the devices' own report of a grasp
        self._doubted = False  # by the last result, the force may be that of the hand on itself
        self._over = ""  # the goal that ended last, which the status may still call running
        self._halted = ""  # the goal that the last stop ended, as far as is known
        self._halted_until = -math.inf

    # --- incoming messages

    def on_state(self, state: State) -> None:
        """Take a state that has just arrived."""
        self.state, self._received = state, monotonic.now()
        word, before = bool((np.asarray(state.grasped) == 1).any()), self._word
        self._word = word
        # Estimates from efforts are not evidence by themselves.
        sensed = state.force_source in ("tip forces", "device")
        measured = state.force if sensed and state.force is not None else math.nan
        if word:
            self._conclude(HeldObject.HOLDING)
        elif self.grip is HeldObject.HOLDING:
            if before or measured < _NOTHING:
                self._conclude(HeldObject.UNKNOWN if self.moving else HeldObject.LOST)
        # Without a result: a grasp from before this page, or by other means than a goal. Tips that
        # meet press on one another.
        elif (
            self.grip is HeldObject.UNKNOWN
            and not (self._doubted or self.moving or state.opening == 0.0)
            and measured > _FELT
        ):
            self._conclude(HeldObject.HOLDING)

    def on_status(self, status: HandStatus) -> None:
        """Take the status of loop and devices."""
        begun, streamed = self.moving, self.status is not None and self.status.stream.stream
        self.status, self.trouble = status, ""
        if status.stream.stream and not streamed:
            self._turn("moved live", status.stream.stream)
        if self.moving:
            self._turn(status.action, status.goal_id)
            self.stopped = Words("")
            self._doubted = False
            if not begun and not self._word:  # the object may have been released
                self._conclude(HeldObject.UNKNOWN)
        if self.ill:
            self._conclude(HeldObject.UNKNOWN)

    def on_result(self, result: Result) -> None:
        """Take the result of any client's goal."""
        self._over = result.goal_id
        self._turn(result.action, result.goal_id)
        self._doubted = result.unknown
        self._asked = asked(result)
        if result.grasped:
            self._fingers = result.grasped_fingers
            self._conclude(HeldObject.HOLDING)
        elif result.unknown or result.outcome in (*EARLY, Outcome.TOUCHED):
            self._conclude(HeldObject.UNKNOWN)
        else:
            self._conclude(HeldObject.EMPTY)

    def on_event(self, event: Event) -> None:
        """Take an event of the hand."""
        match event.kind:
            case "grasp_lost":
                self._conclude(HeldObject.LOST)
                self._fingers = (event.source,)
            case "device_lost" | "device_fault":
                self._turn(event.kind.replace("_", " "))
                self._conclude(HeldObject.UNKNOWN)
            case "device_busy":
                self._busy[event.source] = event.text
            case "thermal" if event.severity == "info":
                self._hot.pop(event.source, None)
            case "thermal":
                self._hot[event.source] = event.text
            case "stop":
                self._turn("stopped")
                self._halted = "" if self.status is None else self.status.goal_id
                self._halted_until = monotonic.now() + _OLDER
                tone = Tone.BAD if event.severity == "error" else Tone.WARN
                words = event.text.removeprefix(f"{self.hand}: ")
                self.stopped = Words(f"{clock()} {words}", tone)

    def on_gone(self, why: str) -> None:
        """Mark the hand as unreachable; its last state is kept, as old."""
        if not self.trouble:
            self._turn("not connected")
        self.trouble = why
        self._hot.clear()
        self._conclude(HeldObject.UNKNOWN)

    def _turn(self, what: str, goal: str = "") -> None:
        if not goal or goal != self.turn.goal:
            self.turn = Turn(f"{clock()} {what}", goal)

    def _conclude(self, grip: HeldObject) -> None:
        if grip is not self.grip:
            self.grip, self._since = grip, clock()
            if grip is HeldObject.LOST:
                self._turn("part lost")
            if grip is not HeldObject.HOLDING:
                self._fingers, self._asked = (), ""

    # --- sentences

    @property
    def age(self) -> float:
        """Age of the newest state [s]; infinite if there is none."""
        return monotonic.now() - self._received

    @property
    def stale(self) -> bool:
        """Whether the last state is out of date."""
        return bool(self.trouble) or self.age > STALE_AFTER

    @property
    def moving(self) -> bool:
        """Whether a goal is running."""
        goal = "" if self.status is None else self.status.goal_id
        if goal == self._halted and monotonic.now() < self._halted_until:
            return False
        return goal not in ("", self._over)

    @property
    def busy(self) -> bool:
        """Whether a goal or a stream moves the hand, or a client holds its lease."""
        status = self.status
        return self.moving or (status is not None and bool(status.holder or status.stream.stream))

    @property
    def ill(self) -> Sequence[DeviceStatus]:
        """The devices that do not follow references."""
        return () if self.status is None else self.status.inactive

    @property
    def homing(self) -> bool:
        """Whether the devices that do not follow are starting up, mostly homing."""
        return bool(self.ill) and all(
            each.message and f" is {each.message.split()[0]}" in self._busy.get(each.name, "")
            for each in self.ill
        )

    def held(self) -> Words:
        """Describe the held object: width, force and evidence."""
        if self.stale or self.state is None:
            return Words("no data", Tone.BAD)
        if self.homing:
            return Words("moves by itself: keep clear", Tone.WARN)
        if self.ill:
            return Words(f"no data from {', '.join(each.name for each in self.ill)}", Tone.BAD)
        match self.grip:
            case HeldObject.HOLDING:
                return Words(f"holding{self._measures()}", Tone.WARN if self._asked else Tone.GOOD)
            case HeldObject.LOST:
                who = f" by {', '.join(self._fingers)}" if self._fingers else ""
                return Words(f"part lost{who} {self._since}", Tone.BAD)
            case HeldObject.EMPTY:
                return Words("empty")
        return Words("moving" if self.moving else "not known whether something is held")

    def _measures(self) -> str:
        state = self.state
        words = [""]
        if state is not None and state.opening is not None:
            words.append(f"{1e3 * state.opening:.1f} mm")
        if state is not None and state.force is not None:
            source = "tip sensors" if state.force_source == "tip forces" else state.force_source
            force = f"{state.force:.1f} ± {state.force_error or 0.0:.1f} N"
            words.append(f"{force}{self._asked} ({source})")
        elif self._fingers:
            words.append(f"by {', '.join(self._fingers)}")
        return " · ".join(words)

    def link(self) -> Words:
        """Say whether the hand is connected, or how old the last state is."""
        if self.stale:
            words = [f"not connected: {self.trouble}"] if self.trouble else []
            if self.status is not None:
                words.append(f"no data for {self.age:.1f} s: STOP cannot reach the hand, {_OLD}")
            return Words(" · ".join(words), Tone.BAD)
        if self.ill:
            ill = " · ".join(device.trouble for device in self.ill)
            return Words(ill, Tone.WARN if self.homing else Tone.BAD)
        return Words(f"{self.hand}: connected", Tone.GOOD)

    def control(self, own: str = "", others: Sequence[str] = ()) -> Words:
        """Describe who controls the hand: this window's client, another window's, or any other."""
        holder = "" if self.status is None else self.status.holder
        if not holder:
            return Words("control: free")
        who = "this window" if holder == own else holder
        who = f"another window ({holder.rpartition('-')[2]})" if holder in others else who
        return Words(f"control: {who}", Tone.PLAIN if holder == own else Tone.WARN)

    def doing(self) -> Words:
        """Describe the running action, the recording, the last stop, and restrictions."""
        status = self.status
        if status is None or self.stale:
            return self.stopped
        trouble = [f"recording: {status.recording_trouble}"] if status.recording_trouble else []
        limits = [*trouble, *self._hot.values()]
        words = [self.stopped.text] if self.stopped.text else []
        words += [f"running {status.action}"] if status.action and not words else []
        words += ["● recording"] if status.recording and not trouble else []
        tone = Tone.WARN if limits and self.stopped.tone is Tone.PLAIN else self.stopped.tone
        return Words(" · ".join([*words, *limits]), tone)
