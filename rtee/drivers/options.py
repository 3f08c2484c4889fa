"""The options of a driver in hand.yaml: checked once, when the driver is made."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtee.errors import ConfigError, suggestion
from rtee.types import DeviceSpec

Positive = Annotated[float, Field(gt=0.0)]
"""An option that must be above 0."""


class DeviceOptions(BaseModel):
    """Options that every device has; unknown names are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    emulator: dict[str, Any] = Field(
        default_factory=dict,
        description="Properties of the emulated device (`rtee run --emulated`), by its emulator.",
    )


O = TypeVar("O", bound=BaseModel)  # noqa: E741 - reads well as a type variable


def read_options(model: type[O], spec: DeviceSpec) -> O:
    """Return the options of a device, checked.

    Raises:
        ConfigError: if a name is unknown or a value invalid; it names the option and the file.
    """
    try:
        return model.model_validate(dict(spec.options))
    except ValidationError as error:
        raise ConfigError(_sentence(model, spec, error), key=_key(spec, error)) from None


def _key(spec: DeviceSpec, error: ValidationError) -> str:
    where = ".".join(str(part) for part in error.errors()[0]["loc"])
    return f"devices.{spec.name}.options.{where}"


def _sentence(model: type[BaseModel], spec: DeviceSpec, error: ValidationError) -> str:
    # Only the first error: a user corrects them one by one anyway.
    first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"]) or "options"
    where = f"{spec.source}: " if spec.source else ""
    if first["type"] == "extra_forbidden":
        hint = suggestion(name, list(model.model_fields))
        return f"{where}device '{spec.name}': unknown option '{name}'; {hint}"
    if first["type"] == "missing":
        return f"{where}device '{spec.name}': option '{name}' is missing"
    message = first["msg"].removeprefix("Value error, ")
    return f"{where}device '{spec.name}': option '{name}': {message[:1].lower()}{message[1:]}"
