"""Options of the driver of OnRobot's three-finger grippers."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from rtee.drivers.options import DeviceOptions
from rtee.drivers.register_blocks import ExchangeKind


class OnRobot3FGOptions(DeviceOptions):
    """Options of a 3FG15 or 3FG25."""

    host: str = Field("192.168.1.1", description="the Compute Box's address (Modbus TCP)")
    port: str | None = Field(
        None, description="instead of `host`: tty, socket://, rfc2217:// (RTU) or tcp://host:port"
    )
    unit: int = Field(65, ge=0, le=255, description="65; 66 and 67 on a dual quick changer")
    baudrate: int = Field(1_000_000, gt=0, description="of a direct line (8E1)")
    grip: Literal["external", "internal"] = "external"
    force: float = Field(240.0, gt=0.0, description="largest force of the model [N]")
    smallest: float = Field(
        0.0346, gt=0.0, description="raw diameter at the actuator's upper limit [m]"
    )
    largest: float | None = Field(
        None, gt=0.0, description="raw diameter at its lower limit [m]; by default as it tells"
    )
    target: Literal["raw", "tips"] = Field(
        "raw",
        description="what the target diameter means: between the fingertips' centres, or their "
        "surfaces",
    )
    settle: float = Field(
        0.1, ge=0.0, description="a reference that rests this long is gripped at with force [s]"
    )
    exchange: ExchangeKind = Field("auto", description="function 23, or 16 and 3")
    rate: float = Field(50.0, gt=0.0, description="exchanges per second through the Compute Box")

    @property
    def address(self) -> str:
        """The address of the bus."""
        return self.port or f"tcp://{self.host}"
