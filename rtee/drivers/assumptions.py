"""Assumptions of drivers about their devices, each with its source; none is confirmed on a device.

If an assumption on one topic proves wrong, check that topic in every family: whether counts refer
to one finger or to both, the registers at power-up, the sensors at rest, which devices answer, the
behaviour when the host is silent. The first contact with a real device confirms or refutes them;
the device pages list them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


class Topic(StrEnum):
    """Topic of an assumption."""

    IDENTITY = "identity"
    POWER_UP = "power-up"
    REST = "at rest"
    LIMITS = "limits"
    DIRECTION = "direction"
    SCALE = "scale"
    OFFSET = "zero"
    SPEED = "speed"
    FORCE = "force"
    STOP = "stop"
    LINK = "silence"


@dataclass(frozen=True, slots=True)
class Assumption:
    """An assumption on which a driver relies.

    Attributes:
        topic: Its topic.
        text: The assumption.
        source: Its source; empty if it is a guess.
    """

    topic: Topic
    text: str
    source: str = ""


def _read() -> Mapping[str, tuple[Assumption, ...]]:
    found: dict[str, list[Assumption]] = {}
    for line in Path(__file__).with_name("assumptions.txt").read_text("utf-8").splitlines():
        if line.startswith("["):
            rows = found.setdefault(line[1:-1], [])
        elif line and not line.startswith("#"):
            topic, *rest = line.split(" | ")
            rows.append(Assumption(Topic(topic), *rest))
    return {driver: tuple(rows) for driver, rows in found.items()}


ASSUMPTIONS = _read()
"""The assumptions by the name of the driver, from ``assumptions.txt``."""
