"""``hand.yaml``: everything about a hand that its URDF and SRDF do not say."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from rtee.errors import ConfigError, suggestion
from rtee.hand.catalog import FILE_NAME
from rtee.hand.config_schema import (
    ActuatorDynamics,
    ActuatorLimits,
    DefaultLimits,
    DeviceSection,
    LogSection,
    LoopSection,
    ProfileSettings,
    RealtimeSettings,
    RemoteSettings,
    Ros2Settings,
    SafetySettings,
    Section,
    ThermalSettings,
    TouchSection,
)
from rtee.hand.model import CLEARANCE
from rtee.hand.names import check_name
from rtee.hand.yamlfile import YamlDocument, read_yaml
from rtee.types import FORMER_NAMES

_CONFIG = typing.cast("ConfigDict", {**Section.__pydantic_config__, "frozen": True})


MeasuredOpening = Annotated[
    tuple[Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=2)]],
    # YAML has lists only, which strict mode would not take for tuples.
    Field(strict=False),
]
"""An intensity and the opening measured there [m]."""


class LimitsSection(BaseModel):
    """Limits by actuator, and those of all others under ``defaults``."""

    model_config = _CONFIG | ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ActuatorLimits] = Field(init=False)

    defaults: DefaultLimits = DefaultLimits()
    """Limits of all actuators that have none of their own here."""

    @property
    def actuators(self) -> dict[str, ActuatorLimits]:
        """The limits by actuator."""
        return dict(self.__pydantic_extra__ or {})


class DynamicsSection(BaseModel):
    """Dynamics by actuator, and those of all others under ``defaults``."""

    model_config = _CONFIG | ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ActuatorDynamics] = Field(init=False)

    defaults: ActuatorDynamics = ActuatorDynamics()
    """What holds for all actuators where they say nothing else."""

    @property
    def actuators(self) -> dict[str, ActuatorDynamics]:
        """The dynamics by actuator."""
        return dict(self.__pydantic_extra__ or {})


class HandConfig(BaseModel):
    """A hand."""

    model_config = _CONFIG

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
    """Actuators that take no part, such as those of a wrist: they stay fixed at ``rest``, move in
    no action and need no device."""
    limits: LimitsSection = LimitsSection()
    """Limits that tighten or complete the URDF's."""
    dynamics: DynamicsSection = DynamicsSection()
    """Dynamics of the actuators: gains, inertia, friction, how joints follow them; for
    the simulation, and for planners that ask for the hand's description."""
    tip_friction: dict[str, Annotated[float, Field(ge=0, le=10)]] = Field(default={})
    """Coefficient of friction of the fingertips' surfaces by finger, ``defaults``: of all others;
    for planners that ask for the hand's description. Unless given, the URDF's ``mu1``, if any."""
    touch: dict[str, TouchSection] = Field(default={})
    """Where its touch sensors are, by the names that their devices give them."""
    openings: dict[str, list[MeasuredOpening]] = Field(default={})
    """Openings measured on the real hand, by action and elements, such as ``PinchTight index
    thumb``: pairs of intensity and opening [m]."""
    clearance: Annotated[float, Field(ge=0, le=0.1)] = CLEARANCE
    """Distance that clear poses and the ways to them keep from all links that they are not to touch
    [m]; links that have hardly more at rest keep four fifths of what they have there."""
    payload: Annotated[float, Field(gt=0)] | None = None
    """Largest mass that its data sheet lets it hold by friction [kg]; trials of heavier objects say
    that they do not fit."""
    profile: ProfileSettings = ProfileSettings()
    """How references move between set-points."""
    loop: LoopSection = LoopSection()
    """The control loop."""
    realtime: RealtimeSettings = RealtimeSettings()
    """What the operating system is asked for."""
    safety: SafetySettings = SafetySettings()
    """What the hand does when something ends or breaks."""
    thermal: ThermalSettings = ThermalSettings()
    """Temperatures of actuators."""
    log: LogSection = LogSection()
    """Recordings."""
    remote: RemoteSettings = RemoteSettings()
    """The hand on the network."""
    ros2: Ros2Settings = Ros2Settings()
    """The hand as a node of ROS 2."""
    driver: Literal["kinematic", "devices"] = "kinematic"
    """What ``rtee run`` drives by default: a kinematic stand-in, or the ``devices``."""
    devices: dict[str, DeviceSection] = Field(default={})
    """The devices by name."""

    @field_validator("name")
    @classmethod
    def _allowed(cls, value: str) -> str:
        return check_name(value, "hand")

    @field_validator("devices")
    @classmethod
    def _allowed_devices(cls, value: dict[str, DeviceSection]) -> dict[str, DeviceSection]:
        for name in value:
            check_name(name, "device")
        return value

    @field_validator("touch")
    @classmethod
    def _allowed_sensors(cls, value: dict[str, TouchSection]) -> dict[str, TouchSection]:
        for name in value:
            check_name(name, "touch sensor")
        return value

    @model_validator(mode="after")
    def _has_devices(self) -> Self:
        if self.driver == "devices" and not self.devices:
            raise ValueError("driver is 'devices' but no devices are given")
        return self


def read_config(path: Path | str) -> HandConfig:
    """Read a hand.yaml.

    Args:
        path: The file, or its folder.

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
    """Return the error that comes first in the file."""
    found = document.located(errors.errors())
    location, error = found[0]
    reasons = [e["msg"] for place, e in found if place == location]  # several for a union
    # In words for people, who write YAML and do not know pydantic's types.
    message = " or ".join(
        reason.removeprefix("Value error, ").removeprefix("Input ").replace(" tuple", " list")
        for reason in reasons
    )
    value = repr(error["input"])[:80]
    match error["type"]:
        # Older files: the answer is what to change, not that the key is unknown.
        case "extra_forbidden" | "unexpected_keyword_argument" if location[-1] in FORMER_NAMES:
            return document.error(location, f"is called '{FORMER_NAMES[str(location[-1])]}' now")
        case "literal_error" if str(error["input"]) in FORMER_NAMES:
            former = str(error["input"])
            return document.error(location, f"'{former}' is called '{FORMER_NAMES[former]}' now")
        case "extra_forbidden" | "unexpected_keyword_argument":
            hint = suggestion(str(location[-1]), _keys(location[:-1]))
            return document.error(location, f"unknown key; {hint}")
        case "missing":
            return document.error(location, "is missing")
        case "dataclass_type" | "model_type":
            message = f"should be a mapping, such as {{name: value}}, not {value}"
            return document.error(location, message)
        case "path_type":
            return document.error(location, f"should be a valid string, not {value}")
        case "value_error" | "assertion_error":
            return document.error(location, message)
        case _:
            return document.error(location, f"{message}, not {value}")


def _keys(location: Sequence[str | int]) -> list[str]:
    """Return the keys that are allowed at a location."""
    kind: Any = HandConfig
    for part in location:
        fields = _fields(kind)
        named = ActuatorDynamics if kind is DynamicsSection else ActuatorLimits
        # Keys of mappings are names, whose values are sections: of actuators, or of devices.
        kind = fields.get(str(part), named) if fields else typing.get_args(kind)[-1]
    return list(_fields(kind))


def _fields(kind: Any) -> dict[str, Any]:
    """Return the fields of a section with their types; none if it is not a section."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {name: field.annotation for name, field in kind.model_fields.items()}
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    return {}
