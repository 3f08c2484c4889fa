"""Where references start: at a valid measurement, else they brake where they are."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from rtee.drivers.plausibility import Plausibility
from rtee.loop.evidence import ContactMonitor
from rtee.loop.limiter import Limiter
from rtee.loop.measured import Measured
from rtee.loop.profiles import Profile


class ReferenceStart:
    """Starts the references of a hand's actuators; all that sets one to a measurement asks here.

    Args:
        profile: Moves the reference.
        limiter: Holds the positions sent last.
        contact: Detects contacts.
        plausible: Judges measured positions.
        active: Whether each actuator's device may be moved.
        effort: Effort limits sent last [N·m | N].
        pressing: Effort at which an actuator presses, as a fraction of its limit.

    Attributes:
        unplaced: Actuators that became active, but were not validly measured since; they have no
            reference yet.
    """

    def __init__(
        self,
        profile: Profile,
        limiter: Limiter,
        contact: ContactMonitor,
        plausible: Plausibility,
        active: Sequence[bool],
        effort: Sequence[float],
        pressing: float,
    ) -> None:
        self._profile, self._limiter = profile, limiter
        self._contact, self._plausible = contact, plausible
        self._active, self._effort, self._pressing = active, effort, pressing
        self.unplaced: set[int] = set()
        self._frozen: dict[int, bool] = {}
        self._now = -math.inf
        nothing = [math.nan] * len(active)
        self._measured = Measured(nothing, nothing, nothing, [False] * len(active), ())

    def at(self, i: int, stamp: float, touching: bool = False) -> float | None:
        """Return the measured position of an actuator if its reference may start from it [rad | m].

        Args:
            i: The actuator.
            stamp: Now [s].
            touching: Whether it is known to press against an object; else this is judged here.
        """
        touching = touching or self._touches(i)
        return self._plausible.start(i, stamp, self._limiter.position[i], touching=touching)

    def _touches(self, i: int) -> bool:
        """Return whether more than its position shows that an actuator presses on something."""
        return self._contact.shows(i, self._measured, self._pressing * self._effort[i])

    def set(self, positions: Mapping[int, float]) -> None:
        """Start references, at rest, from positions by actuator [rad | m]."""
        self._profile.seed(positions)
        for i, position in positions.items():
            self._limiter.seed(i, position)
            self._plausible.started(i, position)

    def brake(self, indices: Collection[int]) -> None:
        """Brake some actuators, unless the next tick finds that they can start where they are.

        Called before what is known of their contacts is forgotten.
        """
        self._frozen.update((i, self._touches(i)) for i in indices)
        self._profile.go({}, brake=[i for i in indices if self._active[i]])

    def activate(self, i: int) -> None:
        """Let an actuator that became active wait for its first valid measurement."""
        self.unplaced.add(i)
        self._plausible.forget((i,))

    def step(self, stamp: float, measured: Measured) -> list[int]:
        """Judge the measurements of a tick, and start the references that wait for them.

        Inactive actuators are followed.

        Args:
            stamp: Now [s].
            measured: The measured state.

        Returns:
            The active actuators whose reference was started.
        """
        self._measured, self._now, sent = measured, stamp, self._limiter.position
        self._plausible.step(stamp, measured.position, measured.fresh, self._active, sent)
        if not (self._frozen or self.unplaced) and all(self._active):
            return []
        start: dict[int, float] = {}
        frozen, self._frozen = self._frozen, {}
        for i, active in enumerate(self._active):
            if active and i not in frozen and i not in self.unplaced:
                continue
            position = self.at(i, stamp, frozen.get(i, False))
            if position is not None and (active or position != sent[i]):
                start[i] = position
        if start:
            self.set(start)
            self.unplaced.difference_update(start)
        return [i for i in start if self._active[i]]

    def posture_to_keep(self) -> list[float]:
        """Return the positions to leave the hand in [rad | m]; blocked fingers keep their grip."""
        return [
            position
            if self._contact.blocked(i) or (measured := self.at(i, self._now)) is None
            else measured
            for i, position in enumerate(self._limiter.position)
        ]
