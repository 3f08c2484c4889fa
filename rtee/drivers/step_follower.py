"""Follow a moving reference with a gripper that accepts one target at a time."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

from msgspec import Meta

from rtee import monotonic

_AGAIN = 0.5
"""Time after which a command that had no effect is sent again [s]: longer than a motion takes to
begin."""


Settle = Annotated[
    float,
    Meta(
        ge=0.0,
        le=1.0,  # not milliseconds
        description="time after which a resting reference is sent, however close it is [s]",
    ),
]
"""The option that becomes the argument ``settle`` of `StepFollower`."""


class Order(Enum):
    """Which command to send."""

    NOTHING = "nothing"
    GO = "go"
    STOP = "stop"


class StepFollower:
    """Decides when to send the gripper to its target, and when to stop it before it gets there.

    The gripper plans its motion by itself, and refuses or ignores a new target while it is busy. So
    a moving reference is followed in steps, each sent as soon as the gripper is free, and one more
    is sent when the reference rests. A motion that would pass the reference, or that uses more
    force than the reference now allows, is stopped.

    Nothing is sent while the gripper holds an object with the wanted force and the reference only
    presses on, nor after connecting, until the reference leaves the measured width.

    Widths and forces are in any unit of the caller.

    Args:
        settle: Time after which a resting target is sent, however close it is [s].
        step: Least distance to a moving target at which it is sent [width].
        same: Distance within which a target commands no motion as long as nothing was sent [width].
        reached: Distance within which a target counts as reached [width].
    """

    def __init__(self, settle: float, step: float, same: float, reached: float) -> None:
        self._settle = settle
        self._step = step
        self._same = same
        self._reached = reached
        self._wanted = (0.0, 0.0)
        self._since = 0.0
        self._due = (0.0, 0.0)
        self._sent: tuple[float, float] | None = None
        self._sent_at = 0.0

    @property
    def force(self) -> float | None:
        """The force that was sent last; ``None`` if nothing was sent."""
        return None if self._sent is None else self._sent[1]

    def forget(self) -> None:
        """Discard the sent values, as after a stop."""
        self._sent = None

    def halted(self, here: float) -> None:
        """Record that the gripper was stopped before its target, at a measured width."""
        self._sent = here, 0.0 if self._sent is None else self._sent[1]

    def sent(self) -> None:
        """Record that the gripper has accepted the command that `next` returned last."""
        self._sent, self._sent_at = self._due, monotonic.now()

    def next(self, target: float, force: float, here: float, *, busy: bool, held: bool) -> Order:
        """Return which command to send.

        Args:
            target: Width of the reference.
            force: Force of the reference.
            here: Measured width.
            busy: Whether the gripper moves, or builds up its force.
            held: Whether it reports that it holds something.
        """
        now = monotonic.now()
        if (target, force) != self._wanted:
            self._wanted, self._since = (target, force), now
        rested = now - self._since >= self._settle
        sent = self._sent
        if sent is None:
            # It may hold something, which it keeps until the reference leaves the measured width.
            if busy or abs(target - here) <= self._same:
                return Order.NOTHING
        elif busy:
            passes = (sent[0] - target) * (sent[0] - here) > 0
            passes = passes and abs(sent[0] - target) > self._reached
            # A greater force can wait until the gripper has arrived, a smaller one cannot.
            if not passes and force >= sent[1]:
                return Order.NOTHING
            # After the stop it rests here, as if it had been sent here with the same force.
            self._due = here, sent[1]
            return Order.STOP
        else:
            # The gripper controls the force: a target farther inside the object changes nothing.
            presses = held and (target - here) * (sent[0] - here) > 0
            there = presses or abs(target - here) <= self._reached
            if there and (sent[1] == force or not rested or not held):
                return Order.NOTHING
        again = sent == self._wanted and now - self._sent_at < _AGAIN
        if again or not (rested or abs(target - here) >= self._step):
            return Order.NOTHING
        self._due = self._wanted
        return Order.GO
