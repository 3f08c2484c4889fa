"""Quality of service of topics and services, and its notation in rmw_zenoh's tokens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final


class Reliability(IntEnum):
    """Whether lost messages are sent again."""

    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(IntEnum):
    """Whether later subscribers are sent earlier messages."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class History(IntEnum):
    """Whether a queue keeps the last messages or all."""

    KEEP_LAST = 1
    KEEP_ALL = 2


_DEPTH = 42
"""Depth that rmw_zenoh leaves out when it writes a QoS."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service.

    The numbers are those of rmw. They are integers here, since other nodes may use unknown ones.
    Deadlines, lifespans and leases are always infinite.

    Attributes:
        depth: Number of messages kept.
        reliability: See `Reliability`.
        durability: See `Durability`.
        history: See `History`.
    """

    depth: int = 10
    reliability: int = Reliability.RELIABLE
    durability: int = Durability.VOLATILE
    history: int = History.KEEP_LAST

    @property
    def transient_local(self) -> bool:
        """Whether later subscribers are sent earlier messages."""
        return self.durability == Durability.TRANSIENT_LOCAL

    @property
    def reliable(self) -> bool:
        """Whether lost messages are sent again."""
        return self.reliability == Reliability.RELIABLE

    @property
    def chunk(self) -> str:
        """Notation in a liveliness token, where rmw_zenoh's defaults are left empty."""
        reliability = "" if self.reliable else str(int(self.reliability))
        durability = "" if self.durability == Durability.VOLATILE else str(int(self.durability))
        history = "" if self.history == History.KEEP_LAST else str(int(self.history))
        depth = "" if self.depth == _DEPTH else str(self.depth)
        # Deadline, lifespan and liveliness follow the history; empty means the default.
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


DEFAULT: Final = Qos()
"""QoS of topics, services, and the services and feedback of actions."""

SENSOR_DATA: Final = Qos(depth=5, reliability=Reliability.BEST_EFFORT)
"""QoS of measurements that would be out of date if they were sent again."""

LATCHED: Final = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
"""QoS of messages for later subscribers, too: the robot's description, an action's status."""

PARAMETERS: Final = Qos(depth=1000)
"""QoS of the services of parameters and of their events."""

ROSOUT: Final = replace(LATCHED, depth=1000)
"""QoS of the log of all nodes."""


def parse_chunk(chunk: str) -> Qos:
    """Return the QoS in a chunk of a token.

    Keeps unknown numbers, and takes defaults for missing or malformed fields: other nodes may be
    newer, and their QoS must not keep them from exchanging messages.
    """

    def number(text: str, default: int) -> int:
        # No number of a QoS has more than 18 digits, and int() of long texts is slow.
        return int(text) if text.isascii() and text.isdigit() and len(text) <= 18 else default

    # Pad a chunk that is too short with empty fields.
    fields = [*chunk.split(":"), "", "", ""]
    history, _, depth = fields[2].partition(",")
    return Qos(
        number(depth.partition(",")[0], _DEPTH),
        number(fields[0], Reliability.RELIABLE),
        number(fields[1], Durability.VOLATILE),
        number(history, History.KEEP_LAST),
    )
