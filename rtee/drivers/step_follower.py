"""Follow a moving reference with a gripper that takes one target at a time and moves by itself."""

from __future__ import annotations

import time
from enum import Enum
from typing import Annotated

from pydantic import Field

_AGAIN = 0.5
"""Time after which a command that was without effect is given again [s]: longer than a motion takes
to begin."""


Settle = Annotated[
    float,
    Field(ge=0.0, description="a reference that rests this long is gone to, however near [s]"),
]
"""The option `StepFollower` takes as ``settle``."""


class Order(Enum):
    """What to send."""

    NOTHING = "nothing"
    GO = "go"
    STOP = "stop"


class StepFollower:
    """Decides when such a gripper is sent to its target, and when it is stopped before.

    It refuses or ignores a new target while it is busy. So a reference that moves is followed in
    steps, each as soon as the gripper is free, and one that rests by a last one. A motion that
    leads past the reference, or with more force than is asked for now, is stopped. A gripper that
    holds something with the force asked for is left alone when it is asked to press on, and one
    just attached to as long as it is asked to stay.

    Widths and forces are in any unit of the caller.

    Args:
        settle: A target that is the same for this long is gone to, however near [s].
        step: One that moves is gone to in steps of at least this [width].
        same: One this near to the measured width asks for no motion, as long as nothing was sent
            [width].
        reached: One this near counts as reached [width].
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
        """The force that was sent last; ``None``: nothing was."""
        return None if self._sent is None else self._sent[1]

    def forget(self) -> None:
        """Forget what was sent, as after a stop."""
        self._sent = None

    def halted(self, here: float) -> None:
        """Note that the gripper was stopped where it is, on its way."""
        self._sent = here, 0.0 if self._sent is None else self._sent[1]

    def sent(self) -> None:
        """Note that the gripper has accepted what the last `next` returned."""
        self._sent, self._sent_at = self._due, time.monotonic()

    def next(self, target: float, force: float, here: float, *, busy: bool, held: bool) -> Order:
        """Return what to send.

        Args:
            target: Width that the reference asks for.
            force: Force that it asks for.
            here: Measured width.
            busy: The gripper moves, or builds up its force.
            held: It reports that it holds something.
        """
        now = time.monotonic()
        if (target, force) != self._wanted:
            self._wanted, self._since = (target, force), now
        rested = now - self._since >= self._settle
        sent = self._sent
        if sent is None:
            if busy or abs(target - here) <= self._same:
                return Order.NOTHING
        elif busy:
            leads_past = (sent[0] - target) * (sent[0] - here) > 0
            leads_past = leads_past and abs(sent[0] - target) > self._reached
            # A greater force can wait until it has arrived, a lesser one cannot.
            if not leads_past and force >= sent[1]:
                return Order.NOTHING
            self._due = here, sent[1]
            return Order.STOP
        else:
            # It regulates the force by itself: a target farther beyond the object changes nothing.
            presses = held and (target - here) * (sent[0] - here) > 0
            there = presses or abs(target - here) <= self._reached
            if there and (sent[1] == force or not rested or not held):
                return Order.NOTHING
        again = sent == self._wanted and now - self._sent_at < _AGAIN
        if again or not (rested or abs(target - here) >= self._step):
            return Order.NOTHING
        self._due = self._wanted
        return Order.GO
