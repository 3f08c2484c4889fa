"""``hand.yaml``: everything about a hand that its URDF and SRDF do not say."""

from __future__ import annotations

import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from rtee.errors import ConfigError, suggestion
from rtee.hand.catalog import FILE_NAME
from rtee.hand.config_schema import (
    ActuatorLimits,
    Device,
    LimitsSection,
    Log,
    Loop,
    Profile,
    RealTime,
    Remote,
    Safety,
    Section,
    Thermal,
)
from rtee.hand.model import CLEARANCE
from rtee.hand.names import check_name
from rtee.hand.yamlfile import YamlDocument, read_yaml
from rtee.types import FORMER_NAMES


class HandConfig(Section):
    """A hand."""

    name: str
    """Its name: letters, digits, ``_``, ``-`` and ``.``; the same as its folder's."""
    title: str = ""
    """Its name for people."""
    urdf: str
    """Its URDF, relative to this file."""
    srdf: str | None = None
    """Its SRDF, relative to this file; without one the fingers are found from the tree."""
    package_dirs: list[str] = Field(default=[])
    """Folders in which ``package://`` addresses of meshes are looked up, relative to this file."""
    rest: dict[str, float] = Field(default={})
    """Rest positions by actuator [rad | m]; unless given, the SRDF's group_state ``rest``,
    ``open`` or ``home``, or 0 clamped into the limits."""
    ignore: list[str] = Field(default=[])
    """Actuators that take no part, such as those of a wrist: they stand fixed at ``rest``, move in
    no action and need no device."""
    limits: LimitsSection = LimitsSection()
    """Limits that tighten or complete the URDF's."""
    clearance: Annotated[float, Field(ge=0, le=0.1)] = CLEARANCE
    """Distance that clear poses and the ways to them keep from all links that they are not to touch
    [m]; links that have hardly more at rest keep four fifths of what they have there."""
    profile: Profile = Profile()
    """How references move between set-points."""
    loop: Loop = Loop()
    """The control loop."""
    realtime: RealTime = RealTime()
    """What the operating system is asked for."""
    safety: Safety = Safety()
    """What the hand does when something ends or breaks."""
    thermal: Thermal = Thermal()
    """Temperatures of actuators."""
    log: Log = Log()
    """Recordings."""
    remote: Remote = Remote()
    """The hand on the network."""
    driver: Literal["kinematic", "devices"] = "kinematic"
    """What ``rtee run`` drives by default: a kinematic stand-in, or the ``devices``."""
    devices: dict[str, Device] = Field(default={})
    """The devices by name."""

    @field_validator("name")
    @classmethod
    def _allowed(cls, value: str) -> str:
        return check_name(value, "hand")

    @field_validator("devices")
    @classmethod
    def _allowed_devices(cls, value: dict[str, Device]) -> dict[str, Device]:
        for name in value:
            check_name(name, "device")
        return value

    @model_validator(mode="after")
    def _has_devices(self) -> Self:
        if self.driver == "devices" and not self.devices:
            raise ValueError("driver is 'devices' but no devices are given")
        return self


def read_config(path: Path | str) -> HandConfig:
    """Read a hand.yaml.

    Args:
        path: The file, or the folder it stands in.

    Raises:
        ConfigError: The file cannot be read or a value is wrong; the message names file, line and
            field.
    """
    return read_document(path)[0]


def read_document(path: Path | str) -> tuple[HandConfig, YamlDocument]:
    """Read a hand.yaml; also return the document it came from, which knows the lines.

    Raises:
        ConfigError: As `read_config`.
    """
    file = Path(path)
    document = read_yaml(file / FILE_NAME if file.is_dir() else file, FILE_NAME)
    try:
        return HandConfig.model_validate(document.data), document
    except ValidationError as errors:
        raise _first_error(errors, document) from None


def _first_error(errors: ValidationError, document: YamlDocument) -> ConfigError:
    """Return the error that stands first in the file."""
    found = document.located(errors.errors())
    location, error = found[0]
    reasons = [e["msg"] for place, e in found if place == location]  # several for a union
    message = " or ".join(
        reason.removeprefix("Value error, ").removeprefix("Input ") for reason in reasons
    )
    match error["type"]:
        case "extra_forbidden" if location[-1] in FORMER_NAMES:
            return document.error(location, f"is called '{FORMER_NAMES[str(location[-1])]}' now")
        case "literal_error" if error["input"] in FORMER_NAMES:
            former = error["input"]
            return document.error(location, f"'{former}' is called '{FORMER_NAMES[former]}' now")
        case "extra_forbidden":
            hint = suggestion(str(location[-1]), _keys(location[:-1]))
            return document.error(location, f"unknown key; {hint}")
        case "missing":
            return document.error(location, "is missing")
        case "value_error" | "assertion_error":
            return document.error(location, message)
        case _:
            value = repr(error["input"])
            return document.error(location, f"{message}, not {value[:80]}")


def _keys(location: Sequence[str | int]) -> list[str]:
    """Return the keys that are allowed at a location."""
    model: Any = HandConfig
    for part in location:
        if isinstance(model, type) and issubclass(model, BaseModel):
            known = model.model_fields.get(str(part))
            model = known.annotation if known else ActuatorLimits
        else:
            model = typing.get_args(model)[-1]
        if isinstance(model, types.UnionType):
            model = typing.get_args(model)[0]
    if isinstance(model, type) and issubclass(model, BaseModel):
        return list(model.model_fields)
    return []
