"""Options of a qb SoftHand in hand.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rtee.drivers.options import DeviceOptions
from rtee.drivers.qb_softhand.codec import TURNAROUND

Positive = Annotated[float, Field(gt=0.0)]


class QbSoftHandOptions(DeviceOptions):
    """Options of a qb SoftHand.

    Attributes:
        port: Where it is: a tty, ``socket://host:port`` or ``rfc2217://host:port``.
        device: Its number on the line.
        motors: 1 (SoftHand) or 2 (SoftHand 2).
        baudrate: Rate the hand is set to [baud].
        closure_ticks: Travel of a motor from open to closed [ticks]; else as the hand says, or
            19000 if it does not.
        effort_per_ampere: Effort per motor current; else the current limit counts as the actuator's
            effort limit.
        watchdog: The hand deactivates after so long a silence [s]; only firmware that has a
            watchdog does; 0: off.
        status_every: Whether the motors are active is read every so many exchanges.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        turnaround: Time between a request and its answer that the wire does not explain [s].
    """

    port: str = "/dev/ttyUSB0"
    device: Annotated[int, Field(ge=1, le=127)] = 1
    motors: Literal[1, 2] = 1
    baudrate: Literal[2_000_000, 460_800] = 2_000_000
    closure_ticks: Annotated[int, Field(gt=0, le=32767)] | None = None
    effort_per_ampere: Positive | None = None
    watchdog: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    status_every: Annotated[int, Field(ge=1)] = 50
    deadline: Positive = 0.03
    retries: Annotated[int, Field(ge=0, le=10)] = 2
    turnaround: Annotated[float, Field(ge=0.0)] = TURNAROUND
