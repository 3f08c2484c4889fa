"""The permissions of an agent: a gate, and limits that hold behind every gate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self, TypeVar

from rtee.actions.naming import normalise
from rtee.errors import ConfigError, GoalRejected
from rtee.hand.config_schema import AgentSettings, Gate
from rtee.types import Around, Goal, Named, TipSpeed

T = TypeVar("T", Gate, float)

FORCE: Final = 10.0
"""Largest force unless a person gives another one [N]: a firm pinch of two human fingers."""

EFFORT: Final = 0.4
"""Largest share of the effort limits: the share with which hands hold objects."""

SPEED: Final = 0.5
"""Largest share of the velocity limits: a person beside the hand can still follow it."""

_WIDER: Final = tuple(Gate)
"""The gates; each admits more than those before it."""


@dataclass(frozen=True, slots=True)
class AgentLimits:
    """Limits of an agent on one hand.

    Attributes:
        gate: How the agent's motions are controlled.
        force: Largest force that may be asked for [N].
        effort: Largest share of the effort limits, where no force is given.
        speed: Largest share of the velocity limits.
        actions: Names of the actions, as `normalise` writes them; empty: all.
    """

    gate: Gate = Gate.WATCH
    force: float = FORCE
    effort: float = EFFORT
    speed: float = SPEED
    actions: frozenset[str] = frozenset()

    @classmethod
    def of(cls, file: AgentSettings, asked: AgentSettings) -> Self:
        """Return the limits of hand.yaml and of the command line, which may only narrow them.

        Raises:
            ConfigError: if the command line allows more than hand.yaml.
        """
        gate = _narrowed("gate", file.gate, asked.gate, Gate.WATCH)
        numbers = {
            name: _narrowed(name, getattr(file, name), getattr(asked, name), default)
            for name, default in (("force", FORCE), ("effort", EFFORT), ("speed", SPEED))
        }
        allowed, wanted = (frozenset(map(normalise, each.actions)) for each in (file, asked))
        if allowed and not wanted <= allowed:
            raise ConfigError(
                f"hand.yaml does not let an agent do {', '.join(sorted(wanted - allowed))}; "
                f"it allows {', '.join(file.actions)}"
            )
        return cls(gate, **numbers, actions=wanted or allowed)

    def allows(self, action: str) -> bool:
        """Return whether an action, or ``grasp`` and ``open``, is among those that may be done."""
        return not self.actions or normalise(action) in self.actions

    def check(self, goal: Goal) -> None:
        """Refuse a goal beyond the limits, for every gate.

        Raises:
            GoalRejected: if it is; the sentence names the limit.
        """
        name = "grasp"
        if isinstance(goal.what, Named) and not isinstance(goal.to, Around):
            name = goal.what.action
        if self.gate is Gate.WATCH:
            raise GoalRejected(
                f"the gate is 'watch', which allows no {name}; a person can allow more with "
                "'rtee mcp --gate', or under 'agent' in hand.yaml"
            )
        if not self.allows(name):
            raise GoalRejected(
                f"'{name}' is not among the allowed actions: {', '.join(sorted(self.actions))}"
            )
        if goal.force is not None and goal.force.value > self.force:
            raise GoalRejected(
                f"{goal.force.value:g} N is more than the {self.force:g} N that a person allows"
            )
        if isinstance(goal.speed, TipSpeed) or goal.speed > self.speed:
            raise GoalRejected(
                f"a speed of {goal.speed} is more than the {self.speed:g} that a person allows, "
                "as a share of the velocity limits"
            )


def _narrowed(name: str, file: T | None, asked: T | None, default: T) -> T:
    """Return the limit asked for, by default the file's; refuse one above the file's."""
    if file is not None and asked is not None and _rank(asked) > _rank(file):
        raise ConfigError(f"--{name} {asked} is more than hand.yaml allows an agent: {file}")
    return asked if asked is not None else default if file is None else file


def _rank(value: Gate | float) -> float:
    return _WIDER.index(value) if isinstance(value, Gate) else value
