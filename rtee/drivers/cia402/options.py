"""Options of CiA 402 drives in hand.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from rtee.drivers.options import CanRate, DeviceOptions, Moment, Positive
from rtee.hand.validation import Misfit, Section


class NodeOptions(Section, frozen=True):
    """Options of one drive.

    Attributes:
        id: Its node id.
        counts: Signed counts per rad or m of the actuator; by default from objects 608F and 6091.
        zero: Its position at 0 of the actuator [counts].
        direction: +1 or -1: sign of its counts relative to the actuator, without ``counts``.
        rated_torque: Its rated torque at the actuator [N·m | N]; by default from object 6076 and
            the gear.
        velocity_unit: Its unit of velocity (objects 606C, 6081) [counts/s]; for drives with a
            velocity in rpm, the increments per motor turn divided by 60.
        product: Expected product code (object 1018, 2); by default any.
        homing_method: Homing method (object 6098) of a drive without an absolute encoder.
    """

    id: Annotated[int, Meta(ge=1, le=127)]
    counts: float | None = None
    zero: int = 0
    direction: Literal[1, -1] = 1
    rated_torque: Positive | None = None
    velocity_unit: Positive = 1.0
    product: int | None = None
    homing_method: Annotated[int, Meta(ge=-128, le=127)] | None = None


class Cia402Options(DeviceOptions, frozen=True, kw_only=True):
    """Options of CiA 402 drives on a CAN bus.

    Attributes:
        channel: CAN channel, for example ``can0``.
        interface: python-can interface.
        bitrate: Bits per second.
        nodes: The drive of each actuator, by the actuator's name.
        mode: ``profile_position``: the drive generates the profile to each new set-point;
            ``cyclic_position``: it follows the set-points of this program.
        home: Whether drives with a homing method are homed at the first activation.
        max_torque: Torque limit for references without one [0.1 % of the rated torque].
        host: Node id of this program's heartbeat.
        watchdog: Time without this program's heartbeat after which drives react [s]; 0: never.
        on_silence: Their reaction (object 6007); see the drive's manual, as makers differ.
        heartbeat: Period of the drives' heartbeat [s].
        enable_timeout: Longest time for a transition to the next state [s].
        homing_timeout: Longest time for homing [s].
        sdo_timeout: Longest time for one SDO transfer [s].
        deadline: Longest time from SYNC to the last process data [s].
    """

    channel: str = "can0"
    interface: str = "socketcan"
    bitrate: CanRate = 1_000_000
    nodes: dict[str, NodeOptions]
    mode: Literal["profile_position", "cyclic_position"] = "profile_position"
    home: Literal["on_demand", "on_connect"] = "on_demand"
    max_torque: Annotated[int, Meta(ge=1, le=5000)] = 1000
    host: Annotated[int, Meta(ge=1, le=127)] = 126
    watchdog: Annotated[float, Meta(ge=0.0, le=60.0)] = 0.5
    on_silence: Literal[0, 1, 2, 3] = 1
    heartbeat: Annotated[float, Meta(gt=0.0, le=60.0)] = 0.1
    enable_timeout: Positive = 2.0
    homing_timeout: Positive = 30.0
    sdo_timeout: Positive = 0.5
    deadline: Moment = 0.02

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        ids = [node.id for node in self.nodes.values()]
        if len(set(ids)) != len(ids):
            raise ValueError("two drives have the same node id")
        if self.host in ids:
            raise ValueError("the host has the node id of a drive")
        for name, node in self.nodes.items():
            if node.counts == 0:
                raise Misfit("should not be 0", "nodes", name, "counts")
