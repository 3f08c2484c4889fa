"""Recompute the references of a recording and compare them bit for bit."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rtee.commands import CommandRecord
from rtee.errors import LogError, RteeError
from rtee.hand.files import temporary_folder
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.log.dataclass_json import from_json
from rtee.log.layout import REPLAY, RUN_BEGINS, STATE, Replayable, library_name
from rtee.log.recording import Entry, JointSeries, Recording
from rtee.loop import contact_rules
from rtee.loop.controller import Controller
from rtee.loop.measured import TIP_FORCE, Measured, tip_forces
from rtee.loop.plan import Plan
from rtee.loop.snapshot import differs, restore
from rtee.messages import topics
from rtee.messages.layout import JOINT_ARRAYS
from rtee.sample import FloatArray, Measurements, measured_arrays
from rtee.types import Result, readonly

TOPICS = (
    topics.ACTUATOR_STATES,
    topics.REFERENCE,
    topics.CHANNELS,
    topics.GOALS,
    topics.PLANS,
    topics.COMMANDS,
    topics.STREAM_SAMPLES,
    topics.RESULTS,
    topics.EVENTS,
    topics.ROBOT_DESCRIPTION,
)
"""Topics that are needed to recompute a recording."""

S = TypeVar("S", bound=JointSeries)

_UNEQUAL = "holds no states and references of the same ticks"


@dataclass(frozen=True, slots=True)
class Difference:
    """The first computed reference that differs from the recorded one.

    Attributes:
        tick: The tick.
        t: Time of the tick since the recording's start [s].
        actuator: The actuator.
        quantity: ``position``, ``velocity`` or ``effort``.
        recorded: The recorded value, which was sent to the device.
        computed: The value computed now.
    """

    tick: int
    t: float
    actuator: str
    quantity: str
    recorded: float
    computed: float


@dataclass(frozen=True, slots=True)
class ReplayCheck:
    """The result of comparing the references.

    Attributes:
        ticks: Ticks compared.
        goals: Goals executed again.
        values: Numbers compared.
        different: Numbers that differ in at least one bit.
        largest: Largest difference of a position [rad | m].
        first: The first difference.
        results: Whether the goals ended as recorded.
        missing: Ticks missing in the recording.
        damage: Sentences about damage, such as a part that fails its checksum.
        rules: Version of the rules of contact with which it was recorded.
        differing: Fields in which the controller's state at its beginning differs from those of
            this version of rtee, since another one wrote it; see `rtee.loop.snapshot.restore`.
    """

    ticks: int
    goals: int
    values: int
    different: int
    largest: float
    first: Difference | None
    results: bool
    missing: int
    damage: tuple[str, ...] = ()
    rules: int = contact_rules.VERSION
    differing: tuple[str, ...] = ()

    @property
    def note(self) -> str:
        """Why references and results may differ without a fault, a line each; mostly empty."""
        reasons = []
        if self.rules != contact_rules.VERSION:
            reasons.append(
                f"recorded with version {self.rules} of the rules of contact, computed with "
                f"version {contact_rules.VERSION}: after a contact, a stop at which a measurement "
                "leaped, a stream that ended near a limit, or outside of hand.yaml's limits, "
                "references and results may differ on purpose"
            )
        if self.differing:
            reasons.append(f"it {differs(self.differing)}")
        return "\n".join(reasons)

    @property
    def same(self) -> bool:
        """Whether all references equal the recorded ones bit for bit, and nothing is damaged."""
        return not self.different and self.results and not self.damage


def recorded_hand(recording: Recording, used: Replayable) -> Hand:
    """Return the hand of a recording with the actuators' limits and dynamics used at the time.

    Raises:
        LogError: if the recording lacks the hand's model.
    """
    with temporary_folder(recording.paths[0]) as folder:
        urdf = folder / "hand.urdf"
        text = recording.urdf or _attached(recording, ".urdf")
        if not text:
            raise LogError("contains no URDF", path=recording.paths[0])
        # Write files, since a model is only loaded from files, here as for a run.
        urdf.write_text(text, "utf-8")
        srdf: Path | None = None
        attached = _attached(recording, ".srdf")
        if attached:
            srdf = folder / "hand.srdf"
            srdf.write_text(attached, "utf-8")
        specs = used.actuators
        names = [spec.name for spec in specs]
        hand = load_model(urdf, srdf, name=recording.hand, actuators=names)
    rest = readonly([spec.rest for spec in specs])
    return replace(hand, actuators=specs, rest=rest, dynamics=used.dynamics)


def _attached(recording: Recording, suffix: str) -> str:
    for name, data in recording.attachments.items():
        if name.endswith(suffix):
            return data.decode("utf-8", "replace")
    return ""


def check(recording: Recording | Iterable[Recording]) -> ReplayCheck:
    """Run the goals and commands of a recording through the same code again.

    Args:
        recording: A recording from the loop's start on, with every tick; or its pieces in order
            (`rtee.log.reader.windows`).

    Raises:
        LogError: if the recording lacks data needed for the computation, or has invalid data.
    """
    pieces = iter((recording,) if isinstance(recording, Recording) else recording)
    piece = next(pieces)
    checker = _Checker(piece)
    try:
        checker.take(piece)
        for piece in pieces:
            checker.take(piece)
    except (ValueError, ArithmeticError, AttributeError, LookupError, TypeError) as error:
        if isinstance(error, RteeError):
            raise
        if isinstance(error, AttributeError) and checker.differing:
            raise LogError(differs(checker.differing), path=checker.path) from error
        raise LogError(f"cannot be recomputed: {error}", path=checker.path) from error
    return checker.checked()


class _Checker:
    """Computes the references of a recording piece by piece, and compares them."""

    def __init__(self, first: Recording) -> None:
        self.path = first.paths[0]
        self._replayable = replayable = _replayable(first)
        self._hand = recorded_hand(first, replayable)
        self._names = tuple(spec.name for spec in replayable.actuators)
        self._controller = Controller(self._hand, replayable.settings)
        self._measured = Measured((), (), (), (), ())
        self._forces: dict[str, FloatArray] = {}
        self._waiting: deque[Entry[Plan] | Entry[CommandRecord]] = deque()
        self._runs: deque[float] = deque()
        # Results that the other side has not produced yet: few, even in weeks of recording.
        self._computed: deque[Result] = deque()
        self._recorded: deque[Result] = deque()
        self._newest = 0  # results of the last tick
        self._begin = self._next_tick = 0  # the first tick, and that after the last one
        self._begin_wall = -1
        self.differing: tuple[str, ...] = ()
        self._sum = ReplayCheck(0, 0, 0, 0, 0.0, None, True, 0, rules=replayable.rules)

    def take(self, piece: Recording) -> None:
        """Compute and compare the ticks of a piece."""
        if not self._sum.ticks:
            piece = self._begun(piece)
        states, reference = piece.actuator_states, piece.reference
        rows = range(len(states))
        self._sum = replace(
            self._sum,
            goals=self._sum.goals + len(piece.plans),
            damage=tuple(dict.fromkeys((*self._sum.damage, *piece.damage))),
        )
        self._recorded += [entry.value for entry in piece.results]
        self._runs += [e.value.stamp for e in piece.events if e.value.kind == RUN_BEGINS]
        steering: list[Entry[Plan] | Entry[CommandRecord]] = [
            *piece.plans,
            *piece.commands,
            *piece.stream_samples,
        ]
        self._waiting += sorted(steering, key=lambda entry: (entry.stamp, entry.sequence))
        if len(reference) != len(states):
            raise LogError(_UNEQUAL, path=self.path)
        if not rows:
            return
        if states.names != self._names or reference.names != self._names:
            raise LogError("has actuators that differ from those in its settings", path=self.path)
        computed = {name: np.empty((len(rows), len(self._names))) for name in JOINT_ARRAYS}
        for row, measured in zip(rows, self._measurements(piece), strict=True):
            self._step(int(states.tick[row]), float(states.time[row]), measured)
            computed["position"][row] = self._controller.reference_position
            computed["velocity"][row] = self._controller.reference_velocity
            computed["effort"][row] = self._controller.reference_effort
        self._next_tick = int(states.tick[-1]) + 1
        self._compare(piece, computed)

    def _begun(self, piece: Recording) -> Recording:
        """Return the part of a piece that can be recomputed, which begins at some tick."""
        ticks = piece.actuator_states.tick
        if not self._begin and len(ticks) and ticks[0] != 0:
            state = json.loads(piece.attachments.get(STATE, b"{}"))
            if state.get("library") != library_name() or state["tick"] < ticks[0] - 1:
                raise LogError(
                    f"begins at tick {ticks[0]} of the loop, without a controller state written by "
                    "this version of rtee: only what was recorded from the loop's start can be "
                    "recomputed (with rotated files: give --series)",
                    path=self.path,
                )
            try:
                self.differing = restore(self._controller, state["nodes"])
            except LogError as error:
                raise LogError(error.message, path=self.path) from None
            # It was captured before its tick's results were reported: they belong to the state
            # before.
            self._controller.outbox.items.clear()
            # As in the live loop: commands may read this tick's measurements.
            self._measured = self._controller.measured
            self._begin, self._begin_wall = state["tick"] + 1, state["wall"]
            self._next_tick = self._begin
        if not self._begin:
            return piece
        later: dict[str, Any] = {
            name: [each for each in getattr(piece, name) if each.wall > self._begin_wall]
            for name in ("goals", "plans", "commands", "stream_samples", "results", "events")
        }
        rows = ticks >= self._begin
        return replace(
            piece,
            actuator_states=_rows(piece.actuator_states, rows),
            reference=_rows(piece.reference, piece.reference.wall > self._begin_wall),
            **later,
        )

    def _step(self, tick: int, stamp: float, measured: Measured) -> None:
        while self._runs and self._runs[0] <= stamp:
            self._runs.popleft()
            self._controller = Controller(self._hand, self._replayable.settings)
        # In the order of the live loop: what steers the hand comes before the tick's step.
        while self._waiting and self._waiting[0].stamp <= stamp:
            steering = self._waiting[0].value
            if isinstance(steering, Plan):
                self._controller.accept(steering, stamp)
            # A command between two ticks has the stamp of the earlier one, but took effect at the
            # later one.
            elif steering.tick > tick:
                break
            else:
                self._controller.apply(steering.command, steering.stamp)
            self._waiting.popleft()
        self._controller.step(stamp, measured)
        items = self._controller.outbox.items
        ended = [item for item in items if isinstance(item, Result)]
        self._computed += ended
        self._newest = len(ended)
        items.clear()

    def _measurements(self, piece: Recording) -> Iterator[Measured]:
        """Yield the controller's input at every tick.

        Yields the same object each time, like the live loop: commands that the controller receives
        before its step find the measurements of the same tick in it.
        """
        states, measured = piece.actuator_states, self._measured
        forces = {n: c for n, c in piece.channels.items() if n.endswith(f"/{TIP_FORCE}")}
        changes = deque(
            sorted(
                (
                    (t, name, value)
                    for name, each in forces.items()
                    for t, value in zip(each.t.tolist(), each.values, strict=True)
                ),
                key=lambda change: change[0],
            )
        )
        arrays = measured_arrays(states)
        for row in range(len(states)):
            # Channels are recorded when they change; until then, the value before holds.
            while changes and changes[0][0] <= states.t[row]:
                _, name, self._forces[name] = changes.popleft()
            measured.touch = tip_forces([*self._forces.values()])
            measured.update(Measurements(*(each[row] for each in arrays)))
            measured.fresh = states.fresh[row].tolist()
            measured.grasped = states.grasped[row].tolist()
            yield measured
        self._forces |= {name: value for _, name, value in changes}

    def _compare(self, piece: Recording, computed: dict[str, FloatArray]) -> None:
        states, reference, found = piece.actuator_states, piece.reference, self._sum
        unequal = {name: _unequal(getattr(reference, name), own) for name, own in computed.items()}
        rows = np.flatnonzero(np.any([each.any(axis=1) for each in unequal.values()], axis=0))
        first = found.first
        if rows.size and first is None:
            row = int(rows[0])
            name = next(name for name in unequal if unequal[name][row].any())
            column = int(np.flatnonzero(unequal[name][row])[0])
            first = Difference(
                tick=int(states.tick[row]),
                t=float(states.t[row]),
                actuator=states.names[column],
                quantity=name,
                recorded=float(getattr(reference, name)[row, column]),
                computed=float(computed[name][row, column]),
            )
        largest = np.nanmax(np.abs(reference.position - computed["position"]), initial=0.0)
        same = found.results
        while self._computed and self._recorded:
            same = self._computed.popleft() == self._recorded.popleft() and same
        self._sum = replace(
            found,
            ticks=found.ticks + len(states),
            values=found.values + sum(each.size for each in unequal.values()),
            different=found.different + sum(int(each.sum()) for each in unequal.values()),
            largest=max(found.largest, float(largest)),
            first=first,
            results=same,
        )

    def checked(self) -> ReplayCheck:
        """Return the result of all pieces."""
        if not self._sum.ticks:
            raise LogError(_UNEQUAL, path=self.path)
        return replace(
            self._sum,
            # When the loop ended, it may have published one more result after the last recorded
            # tick. Those of the last tick come after it, and so may begin the next part.
            results=self._sum.results
            and len(self._computed) <= self._newest
            and len(self._recorded) <= 1,
            missing=self._next_tick - self._begin - self._sum.ticks,
            differing=self.differing,
        )


def _rows(series: S, chosen: NDArray[np.bool_]) -> S:
    arrays: dict[str, Any] = {
        each.name: getattr(series, each.name)[chosen]
        for each in fields(series)
        if each.name != "names"
    }
    return replace(series, **arrays)


def _replayable(recording: Recording) -> Replayable:
    path = recording.paths[0]
    attached = recording.attachments.get(REPLAY)
    if attached is None:
        raise LogError("contains no settings of the loop, so it cannot be recomputed", path=path)
    chosen = recording.metadata.get("decimation", "1"), recording.metadata.get("record", "full")
    if chosen != ("1", "full"):
        raise LogError("lacks some ticks, so it cannot be recomputed", path=path)
    return from_json(attached, Replayable)


def _unequal(first: FloatArray, second: FloatArray) -> NDArray[np.bool_]:
    """Return where two arrays differ in a bit; a ``NaN`` equals itself."""
    # As integers: -0.0 and 0.0 differ, NaN does not.
    different: NDArray[np.bool_] = np.ascontiguousarray(first).view(np.uint64) != second.view(
        np.uint64
    )
    return different
