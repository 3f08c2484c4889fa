"""Data types shared by all packages: plain, frozen and without I/O.

Units are SI throughout: rad or m, s, N·m or N, A, °C. Arrays are in the hand's order of actuators;
values in files and messages are keyed by name. ``NaN`` in a state means "not measured"; a reference
never contains ``NaN``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, TypeVar

import numpy as np

from rtee.errors import GoalRejected
from rtee.sample import NOTHING, BoolArray, FloatArray
from rtee.values import Value, number


# A function, since a dataclass refuses the mapping itself as a default: it has no hash.
def _nothing() -> Mapping[str, Any]:
    return NOTHING


def readonly(values: Sequence[float] | FloatArray) -> FloatArray:
    """Return a read-only copy of ``values`` as an array of floats."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


Position = TypeVar("Position", float, FloatArray)


def from_rest(rest: Position, goal: Position, intensity: float) -> Position:
    """Return the position at an intensity [rad | m]: 0 is the rest posture, 1 the goal."""
    return rest + intensity * (goal - rest)


class JointKind(StrEnum):
    """The kinds of moving joints a hand may have."""

    REVOLUTE = "revolute"
    CONTINUOUS = "continuous"
    PRISMATIC = "prismatic"


@dataclass(frozen=True, slots=True)
class ActuatorSpec(Value):
    """The properties of one actuator, for the loop and the drivers.

    Attributes:
        name: Its name, as in the URDF.
        kind: Revolute, continuous or prismatic.
        lower: Lower position limit [rad | m]; ``-inf`` for a continuous actuator.
        upper: Upper position limit [rad | m]; ``inf`` for a continuous actuator.
        velocity: Velocity limit [rad/s | m/s].
        acceleration: Acceleration limit [rad/s² | m/s²].
        jerk: Jerk limit [rad/s³ | m/s³].
        effort: Effort limit [N·m | N]; ``inf`` if the model has none.
        rest: Position in the rest posture [rad | m], inside the limits.
        fingers: Names of the fingers whose tips it moves.
    """

    name: str
    kind: JointKind
    lower: float
    upper: float
    velocity: float
    acceleration: float
    jerk: float
    effort: float
    rest: float
    fingers: tuple[str, ...] = ()

    @property
    def farthest(self) -> float:
        """The limit farthest from rest [rad | m]; the upper one if both are equally far."""
        return self.upper if self.upper - self.rest >= self.rest - self.lower else self.lower


# --- devices ---------------------------------------------------------------------------------


class Lifecycle(StrEnum):
    """States of a device, named as in ros2_control where it has them."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"
    FAULT = "fault"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class Mechanism:
    """What an actuator's mechanism can do by the model, however hand.yaml limits its use.

    A device's counts are scaled by these: a limit of hand.yaml must not stretch them.

    Attributes:
        lower: Lower end of its travel [rad | m].
        upper: Upper end of its travel [rad | m].
        effort: Its full effort [N·m | N]; ``inf`` if neither model nor hand.yaml gives one.
    """

    lower: float
    upper: float
    effort: float


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """The configuration of one device of a hand, from which its driver is made.

    Attributes:
        name: The device's name within the hand.
        hand: The hand's name.
        driver: Registry name, entry point or ``module:Class``.
        actuators: The actuators it drives, in the hand's order; a driver's arrays have this order.
            Their limits are those of hand.yaml, for the references.
        options: The driver's own options, from hand.yaml and the command line.
        rate: Rate of the loop [Hz].
        every: Ticks from one exchange to the next; ``None``: chosen for the driver's best rate.
        deadline: Longest time that an exchange may take [s]; ``None``: two of its periods, but at
            least 50 ms.
        emulated: Whether to talk to the device's emulator instead of the address in the options.
        worn: Whether the emulator deviates from the data sheet as real devices do.
        source: ``file:line`` of the configuration, for messages.
        folder: The hand's folder, for drivers that need its model; empty: look it up by name.
        mechanisms: What the actuators could do without the limits of hand.yaml, by name, where that
            differs; see `mechanism`.
        overridden: Names of the options that ``--option`` gives, for messages.
    """

    name: str
    hand: str
    driver: str
    actuators: tuple[ActuatorSpec, ...]
    options: Mapping[str, Any] = field(default_factory=_nothing)
    rate: float = 1000.0
    every: int | None = None
    deadline: float | None = None
    emulated: bool = False
    worn: bool = False
    source: str = ""
    folder: str = ""
    mechanisms: Mapping[str, Mechanism] = field(default_factory=_nothing)
    overridden: tuple[str, ...] = ()

    @property
    def owner(self) -> str:
        """Name under which the device owns its bus, unique among all hands of a process."""
        return f"{self.hand}/{self.name}"

    def origin(self, option: str = "") -> str:
        """Return where an option was given, for messages; by default, where all of them were."""
        if option:
            return f"--option {option}" if option in self.overridden else self.source
        given = (f"--option {name}" for name in self.overridden)
        return " with ".join(filter(None, (self.source, *given)))

    def mechanism(self, actuator: ActuatorSpec) -> Mechanism:
        """Return the ends of an actuator's travel and its full effort, for scales of counts."""
        known = self.mechanisms.get(actuator.name)
        return known or Mechanism(actuator.lower, actuator.upper, actuator.effort)


@dataclass(frozen=True, slots=True)
class Reference:
    """Set-points for one device, in the order of its actuators; never ``NaN``.

    Attributes:
        position: Position ``(n,)`` [rad | m], inside the limits.
        max_effort: Effort limit ``(n,)`` [N·m | N]; ``inf``: the device's own limit.
        max_velocity: Velocity limit ``(n,)`` [rad/s | m/s]; ``inf``: the device's own limit.
        mask: Whether each actuator is commanded ``(n,)``.
        velocity: Velocity of the profile ``(n,)`` [rad/s | m/s], for devices with feed-forward.

    Raises:
        ValueError: if a value is ``NaN`` or a position is infinite.
    """

    position: FloatArray
    max_effort: FloatArray
    max_velocity: FloatArray
    mask: BoolArray
    velocity: FloatArray

    def __post_init__(self) -> None:
        # This runs at every exchange: for so few numbers, lists are faster than numpy's functions.
        # A sum is NaN or infinite if one of its terms is, and infinite limits are allowed.
        if not math.isfinite(sum(self.position.tolist()) + sum(self.velocity.tolist())):
            raise ValueError("a reference must be finite")
        if math.isnan(sum(self.max_effort.tolist()) + sum(self.max_velocity.tolist())):
            raise ValueError("a reference must not contain NaN")

    @classmethod
    def at(
        cls,
        position: Sequence[float] | FloatArray,
        *,
        max_effort: Sequence[float] | FloatArray | None = None,
        max_velocity: Sequence[float] | FloatArray | None = None,
        mask: Sequence[bool] | BoolArray | None = None,
        velocity: Sequence[float] | FloatArray | None = None,
    ) -> Reference:
        """Return a reference for a position; limits left out are the device's own."""
        target = np.asarray(position, dtype=np.float64)
        shape = target.shape

        def array(values: Sequence[float] | FloatArray | None, default: float) -> FloatArray:
            return np.full(shape, default) if values is None else np.asarray(values, np.float64)

        return cls(
            position=target,
            max_effort=array(max_effort, math.inf),
            max_velocity=array(max_velocity, math.inf),
            mask=np.ones(shape, dtype=bool) if mask is None else np.asarray(mask, dtype=bool),
            velocity=array(velocity, 0.0),
        )


@dataclass(frozen=True, slots=True)
class DeviceStatus(Value):
    """Status of a device, published at a low rate.

    Attributes:
        name: The device's name within the hand.
        driver: The driver's name.
        lifecycle: State of the device.
        identity: Model, firmware, serial number and the like, as the device reports them.
        rate: Measured rate of exchanges [Hz].
        every: Ticks from one exchange to the next.
        age: Age of the newest measurement [s].
        exchanges: Exchanges done.
        overruns: Exchanges that missed their deadline.
        errors: Exchanges that failed.
        reconnects: Times the link was re-established.
        counters: Counters of the bus: transactions, retries, timeouts, checksum errors, bytes.
        fault_code: The device's own code of its fault, 0 for none.
        fault_name: The fault's name, empty for none.
        recoverable: Whether ``recover()`` may clear the fault.
        hint: Advice for the user.
        message: The last error in words.
        gains: Names of gains that can be tuned while the device runs.
        gain_values: Present values of the gains, in the same order; ``NaN``: not known.
    """

    name: str
    driver: str
    lifecycle: Lifecycle
    identity: Mapping[str, str] = field(default_factory=_nothing)
    rate: float = 0.0
    every: int = 1
    age: float = math.inf
    exchanges: int = 0
    overruns: int = 0
    errors: int = 0
    reconnects: int = 0
    counters: Mapping[str, int] = field(default_factory=_nothing)
    fault_code: int = 0
    fault_name: str = ""
    recoverable: bool = False
    hint: str = ""
    message: str = ""
    gains: tuple[str, ...] = ()
    gain_values: tuple[float, ...] = ()

    @property
    def remarks(self) -> str:
        """The fault, otherwise the last error, and the hint; empty if there is neither."""
        fault = f"fault {self.fault_code} ({self.fault_name})" if self.fault_name else ""
        return "; ".join(text for text in (fault or self.message, self.hint) if text)

    @property
    def trouble(self) -> str:
        """Why the device does not follow references, in a sentence; empty if it is active."""
        if self.lifecycle is Lifecycle.ACTIVE:
            return ""
        state = "in fault" if self.lifecycle is Lifecycle.FAULT else self.lifecycle
        return f"device '{self.name}' is {state}" + (f": {self.remarks}" if self.remarks else "")


# --- goals -----------------------------------------------------------------------------------


class Stage(StrEnum):
    """The stages of a pinch that a goal executes."""

    BOTH = "both"
    PRE_GRASP = "pre_grasp"
    GRASP = "grasp"


class OnContact(StrEnum):
    """Reactions of a finger to a contact, the most careful one first."""

    STOP = "stop"
    """The finger stays where it is."""
    HOLD = "hold"
    """The finger stays, but yields to more than a light force."""
    SQUEEZE = "squeeze"
    """The finger holds until enough fingers touch, then all build up the force together."""


class Aim(StrEnum):
    """The aim of a goal, which decides whether it has succeeded."""

    POSTURE = "posture"
    OBJECT = "object"
    CONTACT = "contact"


class Outcome(StrEnum):
    """Outcome of a goal in one word."""

    HELD = "held"
    """The hand holds an object, of the requested width if the goal gave one."""
    WRONG_WIDTH = "wrong_width"
    """The hand holds an object of another width."""
    UNKNOWN = "unknown"
    """The goal needs an object; it is unknown whether the hand holds something thin or nothing."""
    EMPTY = "empty"
    """The hand has closed without holding or touching anything."""
    TOUCHED = "touched"
    """A finger that reacts to contacts has touched something."""
    REACHED = "reached"
    """The measured posture is within the tolerance."""
    CLOSED = "closed"
    """The fingers met before reaching the posture, with nothing or something thin between them."""
    STALLED = "stalled"
    """The hand stopped short of the posture, and holds nothing."""
    CANCELLED = "cancelled"
    """The goal was cancelled; the hand holds the measured posture."""
    PREEMPTED = "preempted"
    """A new goal replaced this one."""
    TIMED_OUT = "timed_out"
    """The goal took longer than its timeout."""
    ABORTED = "aborted"
    """The goal could not continue; `Result.reason` says why."""


EARLY: Final = (Outcome.ABORTED, Outcome.CANCELLED, Outcome.PREEMPTED, Outcome.TIMED_OUT)
"""Outcomes of goals that ended early, which say nothing about an object."""


class Shortfall(StrEnum):
    """Why the force on what is held is less than the requested one; no reason is false."""

    NONE = ""
    """It is not less, by more than its error, or this is not known."""
    END_OF_MOTION = "end_of_motion"
    """The fingers have closed as far as the action lets them, and could exert more."""
    EFFORT_LIMIT = "effort_limit"
    """The actuators exert as much as they may."""
    UNKNOWN = "unknown"
    """Neither is known to be the case."""


_SUCCESS = frozenset({Outcome.HELD, Outcome.TOUCHED, Outcome.REACHED, Outcome.CLOSED})


def new_goal_id() -> str:
    """Return a unique identifier for a goal."""
    return os.urandom(8).hex()


_NEEDS_OPENING = "needs the opening, or the width of the object, in metres"


def _plain(name: str, value: object) -> float:
    plain = number(value)
    if plain is None:
        raise GoalRejected(f"the {name} must be a number, not {value!r:.100}")
    return plain


def _above_zero(name: str, value: object, unit: str = "") -> None:
    plain = _plain(name, value)
    if not 0.0 < plain < math.inf:
        raise GoalRejected(f"the {name} must be above 0{unit}, not {plain:g}")


def _length(name: str, value: object) -> None:
    plain = _plain(name, value)
    if not 0.0 <= plain < math.inf:
        raise GoalRejected(f"the {name} must be 0 m or more, not {plain:g}")


@dataclass(frozen=True, slots=True)
class Named(Value):
    """An action by its name.

    Attributes:
        action: Name of the action; case and underscores do not matter.
        elements: Fingers or actuator of a primitive, in any order.
        kind: ``primitive``, ``composed``, ``timed`` or ``generic``, where a name is not unique.
    """

    action: str
    elements: tuple[str, ...] = ()
    kind: str | None = None


@dataclass(frozen=True, slots=True)
class Fingers(Value):
    """The action of some fingers that suits the goal best.

    Attributes:
        elements: The fingers, in any order; none: those that suit best.
    """

    elements: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Intensity(Value):
    """A posture on the path of an action.

    Attributes:
        share: 0 (rest posture) to 1 (the action's posture).
        stage: Stages of a pinch to execute.
        tolerance: Norm of the error at which the goal counts as reached [rad | m, separately].

    Raises:
        GoalRejected: if a value cannot be used.
    """

    share: float = 1.0
    stage: Stage = Stage.BOTH
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        if not 0.0 <= (share := _plain("intensity", self.share)) <= 1.0:
            raise GoalRejected(f"the intensity must be 0 to 1, not {share:g}")
        _above_zero("tolerance", self.tolerance)


@dataclass(frozen=True, slots=True)
class Opening(Value):
    """An opening of the fingertips.

    Attributes:
        width: The opening [m].

    Raises:
        GoalRejected: if it is negative or not a number.
    """

    width: float

    def __post_init__(self) -> None:
        _length("opening", self.width)


@dataclass(frozen=True, slots=True)
class Around(Value):
    """A grasp: open wider than an object, then close on it.

    Attributes:
        width: Width of the object [m].
        narrower: Tolerance of the width below this [m].
        wider: Tolerance of the width above this [m].

    Raises:
        GoalRejected: if a value is negative or not a number.
    """

    width: float
    narrower: float = 0.005
    wider: float = 0.005

    def __post_init__(self) -> None:
        _length("width", self.width)
        _length("tolerance 'narrower'", self.narrower)
        _length("tolerance 'wider'", self.wider)


@dataclass(frozen=True, slots=True)
class FirstContact(Value):
    """A touch: close slowly, and stop all fingers at the first contact.

    Attributes:
        tolerance: Norm of the error at which the hand counts as closed [rad | m, separately].

    Raises:
        GoalRejected: if the tolerance cannot be used.
    """

    tolerance: float = 0.01

    def __post_init__(self) -> None:
        _above_zero("tolerance", self.tolerance)


@dataclass(frozen=True, slots=True)
class TipSpeed(Value):
    """A speed at which the opening of the fingertips changes.

    Attributes:
        value: The speed [m/s].

    Raises:
        GoalRejected: if it is not above 0.
    """

    value: float

    def __post_init__(self) -> None:
        _above_zero("speed", self.value, " m/s")


@dataclass(frozen=True, slots=True)
class Force(Value):
    """A force between the fingertips, kept while they hold an object.

    Attributes:
        value: The force [N].
        most: Limit up to which slips raise the force [N]; ``None``: they do not raise it.

    Raises:
        GoalRejected: if a value cannot be used.
    """

    value: float
    most: float | None = None

    def __post_init__(self) -> None:
        _above_zero("force", self.value, " N")
        if self.most is None:
            return
        if not self.value <= (most := _plain("largest force", self.most)) < math.inf:
            raise GoalRejected(
                f"the largest force must be at least the force, {float(self.value):g} N, not "
                f"{most:g}"
            )


@dataclass(frozen=True, slots=True)
class Goal(Value):
    """A request to move the fingers.

    Attributes:
        what: An action by name, or the fingers that move.
        to: Target: a posture, an opening, an object or the first contact.
        speed: Share of the velocity limits, above 0 and up to 1, or the speed of the opening. The
            first contact is sought at 10 mm/s unless a lower share or a speed is given.
        effort: Effort limits by actuator [N·m | N], the hand's own for the others; or a force.
        on_contact: Reaction to a contact by finger; the key "" stands for all others. A finger
            without a reaction here reacts as configured for the hand.
        timeout: Longest time the goal may take [s]; ``None``: as configured for the hand.
        goal_id: Its identifier.
        client: The client that sends it.

    Raises:
        GoalRejected: if a value cannot be used, or two of them exclude one another.
    """

    what: Named | Fingers
    to: Intensity | Opening | Around | FirstContact = Intensity()
    speed: float | TipSpeed = 1.0
    effort: Mapping[str, float] | Force = field(default_factory=_nothing)
    on_contact: Mapping[str, OnContact] = field(default_factory=_nothing)
    timeout: float | None = None
    goal_id: str = field(default_factory=new_goal_id)
    client: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.speed, TipSpeed):
            speed = _plain("speed", self.speed)
            if not 0.0 < speed <= 1.0:
                raise GoalRejected(f"the speed must be above 0 and at most 1, not {speed:g}")
        if self.timeout is not None:
            _above_zero("timeout", self.timeout, " s")
        for name, by_name in (("effort", self.effort), ("on_contact", self.on_contact)):
            if not isinstance(by_name, Mapping | Force):
                raise GoalRejected(f"'{name}' must be a mapping by name, not {by_name!r:.100}")
        match self.to:
            case Intensity():
                if isinstance(self.effort, Force):
                    raise GoalRejected(f"a force {_NEEDS_OPENING}")
                if isinstance(self.speed, TipSpeed):
                    raise GoalRejected(f"a speed in m/s {_NEEDS_OPENING}")
                if isinstance(self.what, Fingers):
                    raise GoalRejected(
                        "the goal names no action: only an opening, a width or a touch needs none"
                    )
            case FirstContact() if isinstance(self.effort, Force) or self.on_contact:
                raise GoalRejected("a touch takes no force or on_contact: it stops by itself")
            case FirstContact() | Opening() | Around():
                pass
            case _:
                raise GoalRejected(
                    "'to' must be an Intensity(…), Opening(…), Around(…) or FirstContact(), "
                    f"not {self.to!r:.100}"
                )

    @property
    def force(self) -> Force | None:
        """The force between the fingertips, if the goal gives one."""
        return self.effort if isinstance(self.effort, Force) else None


@dataclass(frozen=True, slots=True)
class Feedback(Value):
    """The progress of a goal, by measured positions.

    Attributes:
        goal_id: The goal.
        progress: 0 to 1, never falling while the goal runs.
        inner: For a timed action, the name (alias) of the inner action under way, otherwise empty.
        inner_progress: For a timed action, the progress of every inner action, by name, in order.
        stamp: CLOCK_MONOTONIC [s].
    """

    goal_id: str
    progress: float
    inner: str = ""
    inner_progress: Mapping[str, float] = field(default_factory=_nothing)
    stamp: float = 0.0


@dataclass(frozen=True, slots=True)
class Result(Value):
    """The result of a goal: one word, `outcome`, and flags that are independent of one another.

    It has no truth value: ``if hand.do(...)`` would not say which flag is meant.

    Attributes:
        goal_id: The goal.
        action: The action's name.
        reached: Whether the measured posture is within the tolerance.
        stalled: Whether the hand stopped short of the posture.
        grasped: Whether the hand holds an object.
        grasped_fingers: The fingers that hold the object.
        preempted: Whether a new goal replaced this one.
        cancelled: Whether the goal was cancelled; the hand holds the measured posture.
        timed_out: Whether the goal took longer than its timeout.
        aborted: Whether the goal could not continue; see ``reason``.
        reason: Why the goal was aborted, in words.
        error: Norm of the remaining error over the involved actuators [rad | m].
        duration: Time from acceptance to the end [s].
        position: Measured actuator positions at the end, by name.
        elements: Elements of the action, for a goal with an opening or a force.
        opening: Opening of the fingertips at the end [m], or where fingers that bend met what they
            hold; ``None``: not known, as for an action without one, an aborted goal, whose device
            may be lost, or more than three fingers that one motor bends.
        opening_error: How far the opening may be off [m].
        force: Estimated force between the fingertips [N]; ``None``: not known, likewise.
        force_error: Error of the estimate [N].
        force_source: Source of the estimate: ``device`` (the force that it measures, by its data
            sheet), ``tip forces``, ``effort`` or ``effort limit``.
        force_asked: The force that the goal asked for [N]; ``None``: none.
        shortfall: Why the force on what is held is less than that, by more than its error.
        within: Whether the hand holds an object of the requested width, within the tolerance;
            ``None``: the goal gave no width, or the opening was not measured.
        touched: Fingers with a reaction to contacts that touched something.
        unknown: Whether the hand may hold either something thin or nothing: the fingertips are as
            close together as those of the empty hand.
        aim: The aim of the goal.
    """

    goal_id: str
    action: str
    reached: bool = False
    stalled: bool = False
    grasped: bool = False
    grasped_fingers: tuple[str, ...] = ()
    preempted: bool = False
    cancelled: bool = False
    timed_out: bool = False
    aborted: bool = False
    reason: str = ""
    error: float = 0.0
    duration: float = 0.0
    position: Mapping[str, float] = field(default_factory=_nothing)
    elements: tuple[str, ...] = ()
    opening: float | None = None
    opening_error: float | None = None
    force: float | None = None
    force_error: float | None = None
    force_source: str = ""
    force_asked: float | None = None
    shortfall: Shortfall = Shortfall.NONE
    within: bool | None = None
    touched: tuple[str, ...] = ()
    unknown: bool = False
    aim: Aim = Aim.POSTURE

    @property
    def outcome(self) -> Outcome:
        """Outcome of the goal; the reason for an early end takes precedence over its findings."""
        for early in EARLY:
            if getattr(self, early):
                return early
        if self.unknown:
            return Outcome.CLOSED if self.aim is Aim.POSTURE else Outcome.UNKNOWN
        if self.aim is not Aim.CONTACT and self.grasped:
            return Outcome.WRONG_WIDTH if self.within is False else Outcome.HELD
        if self.aim is not Aim.OBJECT and self.touched:
            return Outcome.TOUCHED
        if self.reached:
            return Outcome.REACHED if self.aim is Aim.POSTURE else Outcome.EMPTY
        return Outcome.EMPTY if self.aim is Aim.CONTACT else Outcome.STALLED

    @property
    def succeeded(self) -> bool:
        """Whether the outcome is ``held``, ``touched``, ``reached`` or ``closed``."""
        return self.outcome in _SUCCESS

    def to_dict(self) -> dict[str, Any]:
        """Return the fields and the ``outcome`` as JSON values; see `Value.to_dict`."""
        return {"outcome": self.outcome.value, **Value.to_dict(self)}

    def __bool__(self) -> bool:
        """Raise `TypeError`: a result has no truth value."""
        raise TypeError("a result has no truth value; use its 'succeeded' or its 'outcome'")


class EventKind(StrEnum):
    """The kinds of events; ``docs/reference/events.md`` says when each occurs."""

    DEVICE_LOST = "device_lost"
    DEVICE_UNREACHABLE = "device_unreachable"
    RECONNECTED = "reconnected"
    DEVICE_FAULT = "device_fault"
    RECOVERED = "recovered"
    DEVICE_WARNING = "device_warning"
    DEVICE_RATE = "device_rate"
    DEVICE_BUSY = "device_busy"
    REJECTED = "rejected"
    TOUCH_REFUSED = "touch_refused"
    IMPLAUSIBLE = "implausible"
    LIMITED = "limited"
    THERMAL = "thermal"
    CONTACT = "contact"
    CONTACT_UNKNOWN = "contact_unknown"
    SLOWED = "slowed"
    SLIP = "slip"
    GRASP_LOST = "grasp_lost"
    STREAM_PAUSED = "stream_paused"
    STREAM_ENDED = "stream_ended"
    CLIENT_LOST = "client_lost"
    AGENTS_ADMITTED = "agents_admitted"
    ACTIONS_CHANGED = "actions_changed"
    LOOP_PAUSED = "loop_paused"
    IDLE = "idle"
    STOP = "stop"
    AT_REST = "at_rest"
    OBSERVER_FAILED = "observer_failed"
    MARK = "mark"
    TRACE = "trace"
    LOG_DROPPED = "log_dropped"
    LOG_FAILED = "log_failed"
    LOG_RESUMED = "log_resumed"
    FLIGHT_RECORDED = "flight_recorded"
    RUN_BEGINS = "run_begins"


@dataclass(frozen=True, slots=True)
class Event(Value):
    """A notable occurrence that is neither feedback nor a result.

    Attributes:
        kind: An `EventKind`, or the text of a kind that only newer hands have.
        source: The device, finger or client it concerns.
        text: One sentence.
        stamp: CLOCK_MONOTONIC [s].
        severity: ``info``, ``warning`` or ``error``.
    """

    kind: str
    source: str
    text: str
    stamp: float
    severity: str = "info"


@dataclass(frozen=True, slots=True)
class LoopStatistics(Value):
    """Statistics of the loop's clock since its start, with the rate over the last window.

    Attributes:
        rate: Configured rate [Hz].
        measured_rate: Rate over the last window [Hz].
        ticks: Ticks done.
        missed: Ticks missed (counted, never caught up).
        lateness_p50: Median lateness of the wake-up [s].
        lateness_p99: 99th percentile of the lateness [s].
        lateness_p999: 99.9th percentile of the lateness [s].
        lateness_max: Largest lateness [s].
        busy_p50: Median processor time of a tick [s].
        busy_p99: 99th percentile of the processor time [s].
        busy_p999: 99.9th percentile of the processor time [s].
        busy_max: Largest processor time [s].
        dropped: Log records dropped because the writer fell behind.
    """

    rate: float
    measured_rate: float = 0.0
    ticks: int = 0
    missed: int = 0
    lateness_p50: float = 0.0
    lateness_p99: float = 0.0
    lateness_p999: float = 0.0
    lateness_max: float = 0.0
    busy_p50: float = 0.0
    busy_p99: float = 0.0
    busy_p999: float = 0.0
    busy_max: float = 0.0
    dropped: int = 0
