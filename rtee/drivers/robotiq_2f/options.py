"""Options of the driver of Robotiq's two-finger grippers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from rtee.drivers.robotiq_common import RobotiqOptions


class Robotiq2FOptions(RobotiqOptions):
    """Options of a Robotiq two-finger gripper."""

    unit: int = Field(9, ge=1, le=247, description="Modbus number of the gripper")
    model: Literal["2f_85", "2f_140", "hand_e"] = "2f_85"
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
