"""Templates of self-contained HTML pages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtee.errors import needing_extra

if TYPE_CHECKING:
    from jinja2 import Template


def load_template(path: Path, what: str, **filters: Callable[..., Any]) -> Template:
    """Return the template of ``what``, such as ``a report``; raise `MissingExtra` without Jinja."""
    with needing_extra(what, "plot"):
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    environment = Environment(
        loader=FileSystemLoader(path.parent),
        # Names come from files and are text, never markup.
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        # A misspelt name in the template is an error, instead of a gap in the page.
        undefined=StrictUndefined,
    )
    environment.filters |= filters
    return environment.get_template(path.name)
