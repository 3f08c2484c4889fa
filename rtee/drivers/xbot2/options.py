"""Options of joints behind XBot2 in hand.yaml."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from rtee.drivers.options import DeviceOptions, Positive
from rtee.drivers.xbot2.codec import COMMAND_PORT, SERVICE_PORT, STATE_PORT

Port = Annotated[int, Field(gt=0, lt=65536)]


class JointOptions(BaseModel):
    """Options of one joint.

    Positions are mapped linearly from the actuator's limits to the ends given here, separately for
    commands and states, since a gripper may use different units for them (normalised closure, rad).

    Attributes:
        joint: Its name at the server; by default the actuator's.
        command: Commanded values at the actuator's lower and upper limit; by default the limits.
        state: Reported values at these limits; by default those of ``command``.
        effort_sign: Sign of an effort that drives the actuator up.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    joint: str | None = None
    command: tuple[float, float] | None = None
    state: tuple[float, float] | None = None
    effort_sign: Literal[1, -1] = 1

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        for pair in (self.command, self.state):
            if pair is not None and pair[0] == pair[1]:
                raise ValueError("the ends of a range must differ")
        return self


class XBot2Options(DeviceOptions):
    """Options of joints behind XBot2.

    Attributes:
        address: The robot's computer, ``tcp://host``.
        state_port: Where it publishes states.
        service_port: Where it answers requests.
        command_port: Where it takes commands.
        joints: The joints of actuators that differ from the defaults.
        control: ``position`` sends positions only. ``limited`` sends the effort limit with each
            position, as the joint's effort reference, for boards that use it so, such as those of
            HERI II. ``effort`` closes and opens with the effort limit, and holds by position at the
            reference.
        rate: Rate at which the server publishes [Hz].
        band: In effort control, the largest error that causes no motion, as a share of the range.
        deadline: Longest time to wait for an answer or the first state [s].
    """

    address: str = "tcp://127.0.0.1"
    state_port: Port = STATE_PORT
    service_port: Port = SERVICE_PORT
    command_port: Port = COMMAND_PORT
    joints: dict[str, JointOptions] = Field(default_factory=dict)
    control: Literal["position", "limited", "effort"] = "position"
    rate: Positive = 100.0
    band: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.02
    deadline: Positive = 1.0

    @field_validator("address")
    @classmethod
    def _an_address(cls, address: str) -> str:
        if not (host := address.removeprefix("tcp://")) or host == address or ":" in host:
            raise ValueError("an address is 'tcp://host'; ports are options of their own")
        return address
