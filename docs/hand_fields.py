"""The tables of fields in ``docs/reference/hand-yaml.md``, made from the schema of ``hand.yaml``.

``python docs/hand_fields.py`` writes them; a test keeps them current.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rtee.hand.schema import hand_schema

PAGE = Path(__file__).parent / "reference" / "hand-yaml.md"
BEGIN = "<!-- Made by `python docs/hand_fields.py`; a test keeps the tables current. -->"

_SHOWN = {"null": "empty", "true": "yes", "false": "no"}


def field_tables() -> str:
    """Return every field of ``hand.yaml`` in Markdown tables, section by section."""
    schema = hand_schema()
    parts = ["## The hand\n\n" + _table(schema, schema)]
    for path, section in _sections(schema, schema, ""):
        text = str(section["description"]).replace("``", "`")
        parts.append(f"## `{path}`\n\n{text}\n\n" + _table(schema, section))
    return "\n".join(parts)


def _sections(
    schema: dict[str, Any], section: dict[str, Any], path: str
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the sections inside a section with their paths, in the order of the fields."""
    for name, given in section["properties"].items():
        field = _resolved(schema, given)
        place = f"{path}.{name}" if path else name
        if "properties" in field:
            yield place, field
            yield from _sections(schema, field, place)
        elif isinstance(field.get("additionalProperties"), dict):
            item = _resolved(schema, field["additionalProperties"])
            if "properties" in item:
                yield f"{place}.NAME", item
                yield from _sections(schema, item, f"{place}.NAME")


def _resolved(schema: dict[str, Any], field: dict[str, Any]) -> dict[str, Any]:
    # A section that may be left out is one of two alternatives.
    for choice in (field, *field.get("anyOf", ())):
        if (reference := choice.get("$ref")) is not None:
            break
    else:
        return field
    found: dict[str, Any] = schema["$defs"][reference.rpartition("/")[2]]
    return found


def _table(schema: dict[str, Any], section: dict[str, Any]) -> str:
    rows = ["| key | value | default | |", "| --- | --- | --- | --- |"]
    required = section.get("required", ())
    for name, field in section["properties"].items():
        target = _resolved(schema, field)
        text = str(field.get("description", target.get("description", "")))
        text = " ".join(text.replace("``", "`").split()).replace("|", "\\|")
        rows.append(
            f"| `{name}` | {_kind(schema, field)} | {_default(name, field, required)} | {text} |"
        )
    return "\n".join(rows) + "\n"


def _default(name: str, field: dict[str, Any], required: Any) -> str:
    if name in required:
        return "required"
    value = field.get("default")
    if value and isinstance(value, dict):
        return ""
    text = json.dumps(value) if not isinstance(value, float) else f"{value:g}"
    return _SHOWN.get(text, f"`{text}`" if text not in ('""', "[]", "{}") else "empty")


def _kind(schema: dict[str, Any], field: dict[str, Any]) -> str:
    """Return in words what a field may be."""
    field = _resolved(schema, field)
    if "anyOf" in field:
        return " or ".join(
            _kind(schema, option) for option in field["anyOf"] if option.get("type") != "null"
        )
    if "const" in field:
        return f"`{field['const']}`"
    if "enum" in field:
        return ", ".join(f"`{option}`" for option in field["enum"])
    if "properties" in field:
        return "section"
    kind = str(field.get("type", "anything"))
    if "prefixItems" in field:
        items = [_kind(schema, item) for item in field["prefixItems"]]
        return ("pair: " if len(items) == 2 else f"{len(items)} values: ") + ", ".join(items)
    if kind == "array":
        return f"list: {_kind(schema, field['items'])}"
    if kind == "object":
        inner = field.get("additionalProperties")
        return f"mapping: {_kind(schema, inner)}" if isinstance(inner, dict) else "mapping"
    return {"string": "text", "boolean": "yes or no"}.get(kind, kind) + _bounds(field)


def _bounds(field: dict[str, Any]) -> str:
    low, high = field.get("minimum"), field.get("maximum")
    if "exclusiveMinimum" in field:
        return f" above {field['exclusiveMinimum']:g}" + (f", up to {high:g}" if high else "")
    if low is not None and high is not None:
        return f" {low:g} … {high:g}"
    return f" from {low:g}" if low is not None else ""


def page() -> str:
    """Return the page with its tables, which come last."""
    head, begin, _ = PAGE.read_text().partition(BEGIN)
    assert begin, f"{PAGE} has lost its mark"
    return f"{head}{BEGIN}\n\n{field_tables()}"


if __name__ == "__main__":
    PAGE.write_text(page())
