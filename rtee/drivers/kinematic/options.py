"""Options of the kinematic driver in hand.yaml."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class KinematicOptions(BaseModel):
    """How the imagined hand moves and what is in its way."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    time_constant: float = Field(
        0.03, gt=0, le=10, description="Time constant with which it follows [s]."
    )
    start: dict[str, float] = Field(
        default_factory=dict,
        description="Position at the beginning by actuator [rad | m]; else the rest posture.",
    )
    objects: dict[str, float] = Field(
        default_factory=dict,
        description="Objects in the way: finger or actuator to the part of the way from rest to "
        "the farthest bound (0 to 1) at which it is stopped.",
    )
    full_effort_at: float = Field(
        0.1, gt=0, description="Distance behind the reference that gives full effort [rad | m]."
    )
    temperatures: bool = Field(
        False, description="Whether it has temperatures, which effort raises."
    )
    ambient: float = Field(25.0, description="Temperature of the surroundings [°C].")
    heating: float = Field(60.0, ge=0, description="Rise at full effort in the long run [K].")
    thermal_time: float = Field(60.0, gt=0, description="Time constant of the temperature [s].")
