"""Quality of service of topics and services, and how rmw_zenoh writes it in the ROS graph."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final


class Reliability(IntEnum):
    """Whether what is lost is sent again."""

    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(IntEnum):
    """Whether those who come later are sent what was published before."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class History(IntEnum):
    """How many messages are kept."""

    KEEP_LAST = 1
    KEEP_ALL = 2


_DEPTH = 42
"""Depth that rmw_zenoh leaves out when it writes a QoS."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service.

    The numbers are those of rmw; in the graph of others they may be any, so that they are integers
    here. Deadlines, lifespans and leases are always infinite.

    Attributes:
        depth: Messages that are kept.
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
        """Whether those who come later are sent what was published before."""
        return self.durability == Durability.TRANSIENT_LOCAL

    @property
    def reliable(self) -> bool:
        """Whether what is lost is sent again."""
        return self.reliability == Reliability.RELIABLE

    @property
    def chunk(self) -> str:
        """How it is written in a liveliness token; what is rmw_zenoh's default is left empty."""
        reliability = "" if self.reliable else str(int(self.reliability))
        durability = "" if self.durability == Durability.VOLATILE else str(int(self.durability))
        history = "" if self.history == History.KEEP_LAST else str(int(self.history))
        depth = "" if self.depth == _DEPTH else str(self.depth)
        # After the history: deadline, lifespan and liveliness. Empty means the default.
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


DEFAULT: Final = Qos()
"""Topics, services, and the services and feedback of actions."""

SENSOR_DATA: Final = Qos(depth=5, reliability=Reliability.BEST_EFFORT)
"""Measurements that are out of date when they would be sent again."""

LATCHED: Final = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
"""What those who come later need, too: the robot's description, an action's status."""

PARAMETERS: Final = Qos(depth=1000)
"""Services of parameters and their events."""

ROSOUT: Final = replace(LATCHED, depth=1000)
"""The log of all nodes."""


def parse_chunk(chunk: str) -> Qos:
    """Return the QoS of a chunk of a token.

    Numbers that are not known are kept, fields that are missing or no numbers count as defaults:
    other nodes may be newer, and their QoS never prevents that they are heard.
    """

    def number(text: str, default: int) -> int:
        # Few digits: nothing in a QoS is longer, and int() of long texts is slow.
        return int(text) if text.isascii() and text.isdigit() and len(text) <= 18 else default

    # Padded, so that a chunk that is too short has empty fields instead of missing ones.
    fields = [*chunk.split(":"), "", "", ""]
    history, _, depth = fields[2].partition(",")
    return Qos(
        number(depth.partition(",")[0], _DEPTH),
        number(fields[0], Reliability.RELIABLE),
        number(fields[1], Durability.VOLATILE),
        number(history, History.KEEP_LAST),
    )
