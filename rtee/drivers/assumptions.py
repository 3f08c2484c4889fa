"""What drivers assume of their devices beyond what was seen on one, each with its source.

A wrong assumption of one kind is a reason to look at that kind in every family: what counts belong
to one finger or to both, what registers hold at power-up, what sensors read at rest, who answers,
what a device does when nobody speaks. The first contact with a real device confirms or refutes
them; the pages of the devices show them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum


class Topic(StrEnum):
    """What an assumption is about."""

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
    """Something that a driver relies on.

    Attributes:
        topic: What it is about.
        text: The assumption.
        source: Where it comes from; empty: nowhere, it is a guess.
    """

    topic: Topic
    text: str
    source: str = ""


def _all(*rows: tuple[Topic, str, str]) -> tuple[Assumption, ...]:
    return tuple(Assumption(*row) for row in rows)


_MANUAL = "the maker's manual"
_CLIENT = "the maker's published client"

ASSUMPTIONS: Mapping[str, tuple[Assumption, ...]] = {
    "robotiq_2f": _all(
        (Topic.POWER_UP, "not activated, all command registers 0", _MANUAL),
        (Topic.REST, "the motor's current reads 0 without a grip", "the manual's example frames"),
        (Topic.SCALE, "counts are linear in the distance between the fingers", ""),
        (Topic.DIRECTION, "counts rise while it closes", _MANUAL),
        (Topic.OFFSET, "open at 3, closed at 230 counts, unless calibrated", "published programs"),
        (Topic.FORCE, "force counts are linear from the weakest to the strongest grip", ""),
        (Topic.STOP, "clearing rGTO stops it at once", _MANUAL),
        (Topic.LINK, "it goes on to its last target when nobody speaks", ""),
    ),
    "robotiq_3f": _all(
        (Topic.POWER_UP, "not activated; the position counter stands at 6", "another driver"),
        (Topic.SCALE, "counts are linear in the finger's angle", ""),
        (Topic.DIRECTION, "counts rise while it closes", _MANUAL),
        (Topic.FORCE, "force counts are linear from the weakest to the strongest grip", ""),
        (Topic.STOP, "clearing rGTO stops it at once", _MANUAL),
        (Topic.LINK, "it goes on to its last target when nobody speaks", ""),
    ),
    "onrobot_rg": _all(
        (Topic.SCALE, "widths are the distance between both fingers, 0.1 mm a count", _MANUAL),
        (
            Topic.OFFSET,
            "the width with the fingertips' offset is less by twice that",
            "two drivers",
        ),
        (Topic.FORCE, "forces are those of one fingertip, 0.1 N a count", _MANUAL),
        (Topic.STOP, "command 8 stops it where it is", _MANUAL),
        (Topic.LINK, "it goes on to its last target when nobody speaks", ""),
    ),
    "onrobot_3fg": _all(
        (Topic.POWER_UP, "calibrated, with the fingers where they were", _MANUAL),
        (Topic.SCALE, "diameters, 0.1 mm a count, of the circle through the fingertips", _MANUAL),
        (Topic.FORCE, "the target force is a percentage of the greatest", _MANUAL),
        (Topic.LINK, "it goes on to its last target when nobody speaks", ""),
    ),
    "schunk_egu": _all(
        (Topic.POWER_UP, "in a fast stop, with the brake on", "captured from an EGU 60"),
        (
            Topic.SCALE,
            "positions and speeds are those of the distance between the fingers, not of one",
            "the maker's demo; a real EGU 60's largest stroke, 120 mm",
        ),
        (Topic.DIRECTION, "positions grow while it opens", "the maker's demo"),
        (Topic.FORCE, "the percentage is of the largest grip force between the fingers", ""),
        (Topic.STOP, "a stop ends a grip that has not met anything", "the maker's library"),
        (Topic.LINK, "it stops with error 0xEF when exchanges stay away", "the maker's tools"),
    ),
    "wsg50": _all(
        (Topic.POWER_UP, "not referenced", _MANUAL),
        (Topic.SCALE, "widths are the distance between both fingers [mm]", _MANUAL),
        (Topic.DIRECTION, "widths grow while it opens", _MANUAL),
        (Topic.FORCE, "forces are those between the fingers [N]", _MANUAL),
        (Topic.STOP, "STOP ends a motion and keeps a grip", _MANUAL),
        (Topic.LINK, "a disconnect that was not announced is a fast stop", _MANUAL),
    ),
    "schunk_svh": _all(
        (Topic.POWER_UP, "all channels off, counters at 0 wherever the fingers are", _CLIENT),
        (Topic.REST, "currents read near 0 without a load", ""),
        (Topic.SCALE, "ticks are linear in the joints' angles, by the maker's factors", _CLIENT),
        (Topic.OFFSET, "the open stop found by homing is where the factors say", _CLIENT),
        (Topic.FORCE, "torque is current times a factor", "the maker's ROS parameters"),
        (Topic.LINK, "it holds its last set-points when nobody speaks", ""),
    ),
    "qb_softhand": _all(
        (Topic.POWER_UP, "active, at the position it has", "the factory setting"),
        (Topic.REST, "currents read near 0 without a load", ""),
        (Topic.SCALE, "the closure is linear in the encoder's counts", "another client"),
        (Topic.DIRECTION, "counts rise while it closes", "another client"),
        (Topic.LINK, "it holds its last set-point when nobody speaks", ""),
    ),
    "inspire_rh56": _all(
        (
            Topic.POWER_UP,
            "no state (FF) and no set-point (FFFF) until it is commanded",
            "a published report of a hand",
        ),
        (Topic.REST, "force sensors read a few grams until they are calibrated", "recordings"),
        (Topic.SCALE, "counts are linear in each joint's angle", ""),
        (Topic.DIRECTION, "1000 is open, 0 closed; the thumb's rotation differs", "two clients"),
        (Topic.SPEED, "the whole way takes 0.18 to 0.45 s at the highest speed", "recordings"),
        (Topic.FORCE, "force lines measured on one hand hold for others", "a published study"),
        (Topic.STOP, "writing the measured angles stops it", ""),
        (Topic.LINK, "it goes on to its last set-points when nobody speaks", ""),
    ),
    "ability_hand": _all(
        (
            Topic.REST,
            "touch words are 100 to 800 at rest, steady within the threshold",
            "frames of a real hand; the maker's client takes the first reading off",
        ),
        (Topic.SCALE, "150 degrees are full scale, of the first joint of each digit", _MANUAL),
        (Topic.DIRECTION, "positive counts close; the thumb's rotation is negative", _CLIENT),
        (Topic.FORCE, "torque is current times the gear, without its losses", _MANUAL),
        (Topic.FORCE, "touch forces follow the client's placeholder line", _CLIENT),
        (Topic.STOP, "commanding the measured positions stops it", ""),
        (Topic.LINK, "it leaves API mode 0.3 s after the last frame", _MANUAL),
    ),
    "linkerhand": _all(
        (Topic.POWER_UP, "largest speeds and torques, the fingers where they are", _CLIENT),
        (Topic.SCALE, "counts are linear over the SDK's ranges of angles", _CLIENT),
        (Topic.DIRECTION, "255 is open, 0 closed", _CLIENT),
        (Topic.SPEED, "the whole way takes 1 s at the highest speed", ""),
        (Topic.FORCE, "255 is the effort limit of the model", ""),
        (Topic.LINK, "it holds its last set-points when nobody speaks", ""),
    ),
    "allegro": _all(
        (Topic.POWER_UP, "motors off, silent until a request", _CLIENT),
        (Topic.SCALE, "counts are 333.3 degrees over 65536, or as its version has it", _CLIENT),
        (Topic.OFFSET, "offsets and directions are applied in the hand from version 4 on", _CLIENT),
        (Topic.FORCE, "torque counts by the constants of the version", _CLIENT),
        (Topic.LINK, "it keeps its last torques when nobody speaks", ""),
    ),
    "dynamixel": _all(
        (Topic.IDENTITY, "a new id is confirmed under the old one", "the maker's SDK"),
        (Topic.POWER_UP, "torque off, goals at the present position", _MANUAL),
        (Topic.SCALE, "4096 counts are a turn", _MANUAL),
        (Topic.OFFSET, "count 2048 is the zero of the hand, unless calibrated", "the LEAP client"),
        (Topic.FORCE, "torque is proportional to the current", ""),
        (Topic.STOP, "writing the measured positions as goals stops it", ""),
        (Topic.LINK, "the bus watchdog stops it, where it is armed", _MANUAL),
    ),
    "feetech": _all(
        (Topic.IDENTITY, "a new id is confirmed under the old one", "LeRobot's and ORCA's set-up"),
        (Topic.POWER_UP, "torque off", _MANUAL),
        (Topic.SCALE, "4096 counts are a turn; of SCS, 1024 are 300 degrees", _MANUAL),
        (Topic.OFFSET, "the middle count is the zero of the actuator, unless calibrated", ""),
        (Topic.FORCE, "load counts are shares of the stall torque", ""),
        (Topic.STOP, "writing the measured positions as goals stops it", ""),
        (Topic.LINK, "it holds its last goal when nobody speaks", ""),
    ),
    "cia402": _all(
        (Topic.POWER_UP, "switched off; its counter may start anywhere", "CiA 402"),
        (Topic.SCALE, "counts per metre or radian are those of hand.yaml", "the user"),
        (Topic.OFFSET, "the counter is 0 where homing ends", "CiA 402"),
        (Topic.FORCE, "torques are in thousandths of the rated torque", "CiA 402"),
        (Topic.STOP, "bit 8 of the controlword halts it", "CiA 402"),
        (Topic.LINK, "its heartbeat consumer stops it, where it is armed", "CiA 301"),
    ),
    "heri_ethercat": _all(
        (Topic.POWER_UP, "motors off", "the maker's source"),
        (Topic.REST, "pressure sensors read an offset that is not known", ""),
        (Topic.SCALE, "positions are radians of the motor's shaft", "the maker's source"),
        (Topic.FORCE, "torque is proportional to the current", ""),
        (Topic.LINK, "the boards stop when frames stay away", ""),
    ),
    "xbot2": _all(
        (Topic.SCALE, "positions are those of the robot's model [rad]", "the maker's source"),
        (Topic.FORCE, "efforts are torques of the joints [N·m]", "the maker's source"),
        (Topic.LINK, "the server keeps its last references when nobody speaks", ""),
    ),
    "orca_touch": _all(
        (Topic.POWER_UP, "it sends no touch until its stream is started", "the hand's client"),
        (Topic.REST, "forces read 0 while nothing touches", ""),
        (Topic.SCALE, "0.1 N a count; the pressing force is never negative", "the hand's client"),
        (Topic.LINK, "it goes on sending", "the hand's client"),
    ),
}
"""The assumptions by the name of the driver."""
