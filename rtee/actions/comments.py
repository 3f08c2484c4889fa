"""Update of a YAML file that people have edited, with their comments kept."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

from rtee.hand.yamlfile import yaml_reader
from rtee.hand.yamlwrite import emit

_IDENTITY = ("elements", "alias", "action")
"""Keys that identify the entries of a list; the first one present counts."""


def rewritten(text: str, data: Mapping[str, Any]) -> str | None:
    """Return an edited file with new data, as for `emit`, changed as little as possible.

    Returns:
        The new text; ``None`` if the old one cannot be kept.
    """
    from ruamel.yaml.error import YAMLError

    yaml = yaml_reader(keep_comments=True)
    yaml.preserve_quotes = True
    # At the default width, ruamel would fold long lines that have not changed.
    yaml.width = 4096
    try:
        # Through text, so that both sides have the types that YAML gives them.
        fresh = yaml_reader().load(emit(data))
        document = yaml.load(text)
        if not isinstance(document, dict):
            return None
        stream = io.StringIO()
        yaml.dump(_merged(document, fresh), stream)
        # A merge that reads back as other data would be worse than a lost comment.
        same = yaml_reader().load(stream.getvalue()) == fresh
    except (YAMLError, ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return None
    return stream.getvalue() if same else None


def _merged(old: Any, new: Any) -> Any:
    if isinstance(old, dict) and isinstance(new, Mapping):
        # A new list, since the loop deletes keys.
        for key in [key for key in old if key not in new]:
            del old[key]
        for key, value in new.items():
            old[key] = _merged(old[key], value) if key in old else _styled(value)
        return old
    if isinstance(old, list) and isinstance(new, list):
        return _merged_list(old, new)
    # Equal values keep their old form, such as 0.50; but in Python, True equals 1.
    return old if old == new and isinstance(old, bool) == isinstance(new, bool) else new


def _merged_list(old: list[Any], new: list[Any]) -> list[Any]:
    if not all(isinstance(item, Mapping) for item in [*old, *new]):
        if old != new:
            old[:] = new
        return old
    known = {_identity(item, index): item for index, item in enumerate(old)}
    merged = []
    for index, item in enumerate(new):
        same = known.get(_identity(item, index))
        merged.append(_styled(item) if same is None else _merged(same, item))
    # Only if needed, since replacing the items drops the comments between them.
    if len(merged) != len(old) or any(a is not b for a, b in zip(old, merged, strict=True)):
        old[:] = merged
    return old


def _identity(item: Mapping[str, Any], index: int) -> object:
    key = next((key for key in _IDENTITY if key in item), None)
    if key is None:
        return index
    value = item[key]
    return tuple(value) if isinstance(value, list) else value


def _styled(value: Any) -> Any:
    """Return new data in the style of `emit`: lists of scalars in one line."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, Mapping):
        return CommentedMap((key, _styled(item)) for key, item in value.items())
    if isinstance(value, list):
        entries = CommentedSeq(_styled(item) for item in value)
        if not any(isinstance(item, Mapping) for item in value):
            entries.fa.set_flow_style()
        return entries
    return value
