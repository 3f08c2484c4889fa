"""Recompute the references of a recording and compare them bit for bit."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtee.commands import CommandRecord
from rtee.errors import LogError, RteeError
from rtee.hand.files import temporary_folder
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.log.dataclass_json import from_json
from rtee.log.layout import REPLAY, RUN_BEGINS, Replayable
from rtee.log.recording import Entry, Recording
from rtee.loop import contact_rules
from rtee.loop.controller import Controller
from rtee.loop.measured import TIP_FORCE, Measured, tip_forces
from rtee.loop.plan import Plan
from rtee.sample import FloatArray, Measurements, measured_arrays
from rtee.types import Result, readonly

_QUANTITIES = ("position", "velocity", "effort")


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
class Check:
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

    @property
    def note(self) -> str:
        """Why references after a contact may differ on purpose, in words; empty: they may not."""
        if self.rules == contact_rules.VERSION:
            return ""
        return (
            f"recorded with version {self.rules} of the rules of contact, computed with version "
            f"{contact_rules.VERSION}: after a contact, references may differ on purpose"
        )

    @property
    def same(self) -> bool:
        """Whether all references equal the recorded ones bit for bit, and nothing is damaged."""
        return not self.different and self.results and not self.damage


def recorded_hand(recording: Recording, actuators: Replayable) -> Hand:
    """Return the hand of a recording with the actuators' limits used at the time.

    Raises:
        LogError: if the recording lacks the hand's model.
    """
    with temporary_folder(recording.paths[0]) as folder:
        urdf = folder / "hand.urdf"
        text = recording.urdf or _attached(recording, ".urdf")
        if not text:
            raise LogError("holds no URDF", path=recording.paths[0])
        # Write files, since a model is only loaded from files, here as for a run.
        urdf.write_text(text)
        srdf: Path | None = None
        attached = _attached(recording, ".srdf")
        if attached:
            srdf = folder / "hand.srdf"
            srdf.write_text(attached)
        specs = actuators.actuators
        names = [spec.name for spec in specs]
        hand = load_model(urdf, srdf, name=recording.hand, actuators=names)
    return replace(hand, actuators=specs, rest=readonly([spec.rest for spec in specs]))


def _attached(recording: Recording, suffix: str) -> str:
    for name, data in recording.attachments.items():
        if name.endswith(suffix):
            return data.decode("utf-8", "replace")
    return ""


def check(recording: Recording) -> Check:
    """Run the goals and commands of a recording through the same code again.

    Args:
        recording: A recording from the loop's start on, with every tick.

    Raises:
        LogError: if the recording lacks data needed for the computation, or has invalid data.
    """
    replayable = _replayable(recording)
    try:
        return _check(recording, replayable)
    except (ValueError, ArithmeticError, LookupError, TypeError) as error:
        if isinstance(error, RteeError):
            raise
        raise LogError(f"cannot be recomputed: {error}", path=recording.paths[0]) from error


def _check(recording: Recording, replayable: Replayable) -> Check:
    hand = recorded_hand(recording, replayable)
    controller = Controller(hand, replayable.settings)
    states, reference = recording.actuator_states, recording.reference
    names = tuple(spec.name for spec in replayable.actuators)
    if states.names != names or reference.names != names:
        raise LogError("has other actuators than its settings", path=recording.paths[0])
    computed = {name: np.empty((len(states), len(names))) for name in _QUANTITIES}
    results: list[Result] = []
    due = _steering(recording)
    runs = deque(e.value.stamp for e in recording.events if e.value.kind == RUN_BEGINS)
    for row, measured in enumerate(_measured(recording)):
        stamp = float(states.time[row])
        while runs and runs[0] <= stamp:
            runs.popleft()
            controller = Controller(hand, replayable.settings)
        # In the order of the live loop: what steers the hand comes before the tick's step.
        for steering in due(int(states.tick[row]), stamp):
            if isinstance(steering, Plan):
                controller.accept(steering, stamp)
            else:
                controller.apply(steering.command, steering.stamp)
        controller.step(stamp, measured)
        computed["position"][row] = controller.reference_position
        computed["velocity"][row] = controller.reference_velocity
        computed["effort"][row] = controller.reference_effort
        results += [item for item in controller.outbox.items if isinstance(item, Result)]
        controller.outbox.items.clear()
    return _compared(recording, computed, results, replayable.rules)


def _replayable(recording: Recording) -> Replayable:
    path = recording.paths[0]
    attached = recording.attachments.get(REPLAY)
    if attached is None:
        raise LogError("holds no settings of the loop: it cannot be recomputed", path=path)
    states = recording.actuator_states
    if recording.metadata.get("decimation", "1") != "1":
        raise LogError("does not hold every tick: it cannot be recomputed", path=path)
    if not len(states) or len(states) != len(recording.reference):
        raise LogError("holds no states and references of the same ticks", path=path)
    if states.tick[0] != 0:
        raise LogError(
            f"begins at tick {states.tick[0]} of the loop; only what was recorded from the loop's "
            "start can be recomputed (with rotated files: give --series)",
            path=path,
        )
    return from_json(attached, Replayable)


def _measured(recording: Recording) -> Iterator[Measured]:
    """Yield the controller's input at every tick.

    Yields the same object each time, like the live loop: commands that the controller receives
    before its step find the measurements of the same tick in it.
    """
    states = recording.actuator_states
    measured = Measured((), (), (), (), ())
    touch = _tip_forces(recording)
    arrays = measured_arrays(states)
    for row in range(len(states)):
        measured.touch = touch(float(states.t[row]))
        measured.update(Measurements(*(each[row] for each in arrays)))
        measured.fresh = states.fresh[row].tolist()
        measured.grasped = states.grasped[row].tolist()
        yield measured


def _tip_forces(recording: Recording) -> Callable[[float], list[float]]:
    """Return a function of time [s] that returns the recorded forces at the fingertips [N]."""
    channels = [c for name, c in recording.channels.items() if name.endswith(f"/{TIP_FORCE}")]
    rows = [-1] * len(channels)

    def at(t: float) -> list[float]:
        newest = []
        for k, channel in enumerate(channels):
            # Channels are recorded when they change; until then, the value before holds.
            while rows[k] + 1 < len(channel.t) and channel.t[rows[k] + 1] <= t:
                rows[k] += 1
            if rows[k] >= 0:
                newest.append(channel.values[rows[k]])
        return tip_forces(newest)

    return at


def _steering(recording: Recording) -> Callable[[int, float], Iterator[Plan | CommandRecord]]:
    """Return a function that yields the plans and commands due at a tick, in their order."""
    entries: list[Entry[Plan] | Entry[CommandRecord]] = [
        *recording.plans,
        *recording.commands,
        *recording.stream_samples,
    ]
    waiting = deque(sorted(entries, key=lambda entry: (entry.stamp, entry.sequence)))

    def due(tick: int, stamp: float) -> Iterator[Plan | CommandRecord]:
        while waiting and waiting[0].stamp <= stamp:
            steering = waiting[0].value
            # A command between two ticks has the stamp of the earlier one, but took effect at the
            # later one.
            if isinstance(steering, CommandRecord) and steering.tick > tick:
                break
            # Removed only after the yield, since the caller of the generator may stop there.
            yield steering
            waiting.popleft()

    return due


def _compared(
    recording: Recording, computed: dict[str, FloatArray], results: list[Result], rules: int
) -> Check:
    states, reference = recording.actuator_states, recording.reference
    unequal = {name: _unequal(getattr(reference, name), computed[name]) for name in _QUANTITIES}
    rows = np.flatnonzero(np.any([each.any(axis=1) for each in unequal.values()], axis=0))
    first: Difference | None = None
    if rows.size:
        row = int(rows[0])
        name = next(name for name in _QUANTITIES if unequal[name][row].any())
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
    recorded = [entry.value for entry in recording.results]
    return Check(
        ticks=len(states),
        goals=len(recording.plans),
        values=sum(each.size for each in unequal.values()),
        different=sum(int(each.sum()) for each in unequal.values()),
        largest=float(largest),
        first=first,
        # When the loop ended, it may have published one more result after the last recorded tick.
        results=results == recorded[: len(results)] and len(recorded) - len(results) <= 1,
        missing=int(states.tick[-1] - states.tick[0]) + 1 - len(states),
        damage=recording.damage,
        rules=rules,
    )


def _unequal(first: FloatArray, second: FloatArray) -> NDArray[np.bool_]:
    """Return where two arrays differ in a bit; a ``NaN`` equals itself."""
    # As integers: -0.0 and 0.0 differ, NaN does not.
    different: NDArray[np.bool_] = np.ascontiguousarray(first).view(np.uint64) != second.view(
        np.uint64
    )
    return different
