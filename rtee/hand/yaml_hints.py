"""Lines of hand.yaml for people to type."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rtee.hand.yamlwrite import emit_scalar


def rest_line(rest: Mapping[str, float]) -> str:
    """Return the line that gives rest positions [rad | m]."""
    pairs = (f"{emit_scalar(name)}: {value!r}" for name, value in rest.items())
    return f"rest: {{{', '.join(pairs)}}}"


def ignore_line(actuators: Iterable[str]) -> str:
    """Return the line that ignores actuators."""
    return f"ignore: [{', '.join(map(emit_scalar, actuators))}]"
