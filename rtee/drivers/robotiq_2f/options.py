"""Options of the driver of Robotiq's two-finger grippers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from rtee.drivers.options import DeviceOptions
from rtee.drivers.register_blocks import ExchangeKind


class Robotiq2FOptions(DeviceOptions):
    """Options of a Robotiq two-finger gripper."""

    port: str = Field("/dev/ttyUSB0", description="tty, socket://, rfc2217:// (RTU) or tcp://")
    unit: int = Field(9, ge=1, le=247, description="Modbus number of the gripper")
    baudrate: int = Field(115200, gt=0)
    model: Literal["2f_85", "2f_140", "hand_e"] = "2f_85"
    home: Literal["on_demand", "on_connect"] = Field(
        "on_demand", description="when an inactive gripper is activated, which moves the fingers"
    )
    open_count: int = Field(3, ge=0, le=254, description="measured position when fully open")
    closed_count: int = Field(230, ge=1, le=255, description="measured position when fully closed")
    calibration: Path | None = Field(
        None, description="file of a calibration (`rtee calibrate`); its counts replace these"
    )
    closed_position: float | None = Field(
        None, description="actuator's position when fully closed; by default its upper limit"
    )
    register_base: int | None = Field(
        None, description="first register of both blocks, 0 for the old universal controller"
    )
    function: Literal[3, 4] | None = Field(
        None, description="Modbus function to read with; by default 3, or 4 with `register_base`"
    )
    exchange: ExchangeKind = Field("auto", description="function 23, or 16 and a read")
    check_fingers: bool = Field(
        True, description="refuse a gripper that tells positions of a second and third finger"
    )
    activation_timeout: float = Field(15.0, gt=0.0, description="[s]")
