"""The JSON schema of ``hand.yaml``, for editors."""

from __future__ import annotations

import json
from typing import Any, Final

from rtee.hand.config_schema import ActuatorLimits, DefaultLimits

SCHEMA_FILE: Final = "hand.schema.json"
SCHEMA_LINE: Final = f"# yaml-language-server: $schema=../{SCHEMA_FILE}\n"
"""First line of a hand.yaml; the schema is in the same folder as the folders of the hands."""


def hand_schema() -> dict[str, Any]:
    """Return the JSON schema of ``hand.yaml``."""
    from pydantic import TypeAdapter

    from rtee.hand.config import DynamicsSection, HandConfig, LimitsSection

    schema = TypeAdapter(HandConfig).json_schema()
    # pydantic does not find the docstrings of the fields that a dataclass inherits.
    inherited = schema["$defs"][DefaultLimits.__name__]["properties"]
    schema["$defs"][ActuatorLimits.__name__]["properties"] |= inherited
    # Nor does it know that a field takes all keys without a field.
    for name, kind in (("limits", LimitsSection), ("dynamics", DynamicsSection)):
        section = schema["$defs"][kind.__name__]
        others = section["properties"].pop("actuators")
        section["additionalProperties"] = others["additionalProperties"]
        del schema["properties"][name]["default"]["actuators"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def schema_text() -> str:
    """Return the JSON schema as the text of its file."""
    return json.dumps(hand_schema(), indent=2, ensure_ascii=False) + "\n"
