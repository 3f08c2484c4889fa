"""The JSON schema of ``hand.yaml``, for editors."""

from __future__ import annotations

import ast
import inspect
import itertools
import json
from types import ModuleType
from typing import Any, Final

SCHEMA_FILE: Final = "hand.schema.json"
SCHEMA_LINE: Final = f"# yaml-language-server: $schema=../{SCHEMA_FILE}\n"
"""First line of a hand.yaml; the schema is in the same folder as the folders of the hands."""


def hand_schema() -> dict[str, Any]:
    """Return the JSON schema of ``hand.yaml``."""
    import msgspec

    from rtee.hand import config, config_schema

    made = msgspec.json.schema(config.HandConfig, schema_hook=lambda path: {"type": "string"})
    # Python caches equal types, so without this the order of imports would decide between 0
    # and 0.0 as a bound.
    made = json.loads(json.dumps(made), object_hook=_with_whole_bounds)
    sections = made["$defs"]
    for module in (config_schema, config):
        for section, texts in _descriptions(module).items():
            for field, text in texts.items():
                sections[section]["properties"][field]["description"] = text
    for section in sections.values():
        if "description" in section:  # Python 3.13 and later have removed the indentation already
            section["description"] = inspect.cleandoc(section["description"])
    root = sections.pop(config.HandConfig.__name__)
    schema = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": schema, "$defs": sections, **root}


def _with_whole_bounds(node: dict[str, Any]) -> dict[str, Any]:
    bounds = ("minimum", "maximum", "exclusiveMinimum")
    whole = {name: int(node[name]) for name in bounds if node.get(name, 0.5) % 1 == 0}
    return node | whole


def _descriptions(module: ModuleType) -> dict[str, dict[str, str]]:
    """Return the texts below the fields of a module's sections, by section and field."""
    found: dict[str, dict[str, str]] = {}
    for section in ast.parse(inspect.getsource(module)).body:
        for pair in itertools.pairwise(getattr(section, "body", ())):
            match section, pair:
                case (
                    ast.ClassDef(name=name),
                    (
                        ast.AnnAssign(target=ast.Name(id=field)),
                        ast.Expr(value=ast.Constant(value=str(text))),
                    ),
                ):
                    found.setdefault(name, {})[field] = inspect.cleandoc(text)
    return found


def schema_text() -> str:
    """Return the JSON schema as the text of its file."""
    return json.dumps(hand_schema(), indent=2, ensure_ascii=False) + "\n"
