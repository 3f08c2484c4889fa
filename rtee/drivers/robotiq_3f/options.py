"""Options of the driver of Robotiq's three-finger gripper."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from rtee.drivers.robotiq_common import RobotiqOptions
from rtee.errors import ConfigError
from rtee.types import DeviceSpec

Role = Literal["fingers", "a", "b", "c", "scissor"]


class Robotiq3FOptions(RobotiqOptions):
    """Options of Robotiq's three-finger gripper."""

    mode: Literal["basic", "pinch", "wide", "scissor"] = Field(
        "basic", description="arrangement of the fingers; changing it moves the scissor"
    )
    roles: dict[str, Role] = Field(
        default_factory=dict,
        description="what each actuator drives: fingers, a, b, c or scissor; guessed from names",
    )
    register_base: Literal[0, 1000] | None = Field(
        None, description="where the blocks lie: 0, or 1000 and 2000; by default 0 on tcp://"
    )
    function: Literal[3, 4] | None = Field(
        None, description="Modbus function to read with; by default 4 on tcp://, else 3"
    )
    current_per_count: float = Field(
        0.01, gt=0.0, description="[A]; the manuals contradict each other about it"
    )
    activation_timeout: float = Field(30.0, gt=0.0, description="[s]")


def roles_of(spec: DeviceSpec, options: Robotiq3FOptions) -> tuple[Role, ...]:
    """Return what each actuator drives: as configured, else guessed from the names.

    Raises `ConfigError` if two drive the same motor, or a name is none of the device's.
    """
    names = [actuator.name for actuator in spec.actuators]
    key = f"devices.{spec.name}.options.roles"
    for name in options.roles:
        if name not in names:
            raise ConfigError(
                f"device '{spec.name}': roles name '{name}', not its actuator", key=key
            )
    fingers = [name for name in names if "palm" not in name and name not in options.roles]
    guessed: dict[str, Role] = {name: "scissor" for name in names if "palm" in name}
    if len(fingers) == 1 and not any(r in ("a", "b", "c") for r in options.roles.values()):
        guessed[fingers[0]] = "fingers"
    for name in fingers if len(fingers) > 1 else ():
        guessed[name] = "c" if "middle" in name else "b" if "_2" in name else "a"
    roles = tuple(options.roles.get(name, guessed.get(name, "fingers")) for name in names)
    if len(set(roles)) != len(roles) or ("fingers" in roles and {"a", "b", "c"} & set(roles)):
        raise ConfigError(
            f"device '{spec.name}': two actuators drive the same motor "
            f"({', '.join(f'{n}: {r}' for n, r in zip(names, roles, strict=True))}); "
            "set `roles` in its options",
            key=key,
        )
    if not roles:
        raise ConfigError(f"device '{spec.name}': it has no actuators", key=key)
    return roles
