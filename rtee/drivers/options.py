"""The options of a driver in hand.yaml: checked once, when the driver is made."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rtee.drivers.plain_options import options_error
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
        raise options_error(error.errors(), model.model_fields, spec) from None
