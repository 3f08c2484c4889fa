"""The list of public names in ``docs/reference/api/index.md``, made from the pages beside it.

``python docs/api_names.py`` writes it, and the signatures of these names into
``tests/docs/public_api.txt``, where a change of the public API shows as a difference. Tests check
that both are current.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from pathlib import Path

import rtee

PAGES = Path(__file__).parent / "reference" / "api"
INDEX = PAGES / "index.md"
SIGNATURES = Path(__file__).parents[1] / "tests" / "docs" / "public_api.txt"
AUTHORS = ("buses.md", "drivers.md", "testing.md")
"""The second tier: what authors of drivers and of tests use."""

MARK = "<!-- Made by `python docs/api_names.py`; a test keeps it current. -->"

_DIRECTIVE = re.compile(r"^::: (\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Name:
    """A public name.

    Attributes:
        page: The page that documents it.
        path: Where it is imported from, with its name.
        summary: The first line of what is said about it.
    """

    page: str
    path: str
    summary: str

    @property
    def name(self) -> str:
        """The name itself."""
        return self.path.rpartition(".")[2]

    @property
    def stable(self) -> bool:
        """Whether it belongs to the first tier."""
        return self.page not in AUTHORS

    @property
    def row(self) -> str:
        """Its row in the list."""
        home = "rtee" if self.name in rtee.__all__ else self.path.rpartition(".")[0]
        said = self.summary.replace("|", "\\|")
        return f"| [`{self.name}`]({self.page}#{self.path}) | `{home}` | {said} |"


def resolved(path: str) -> object:
    """Return what a dotted path names.

    Raises:
        AttributeError: There is no such thing.
    """
    parts = path.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError as error:
            if not path.startswith(str(error.name)):
                raise
            continue
        for part in parts[count:]:
            found = getattr(found, part)
        return found
    raise AttributeError(path)


def public_members(module: object) -> list[str]:
    """Return the public classes and functions of a module; of a package, what it exports."""
    exported = getattr(module, "__all__", None)
    if exported is not None:
        return sorted(exported)
    own = getattr(module, "__name__", "")
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (inspect.isclass(value) or inspect.isfunction(value))
        and value.__module__ == own
    ]


def _summary(path: str) -> str:
    found = resolved(path)
    if inspect.isclass(found) or inspect.isroutine(found):
        text = inspect.getdoc(found) or ""
    else:
        text = _said_below(path)
    return " ".join(text.split("\n\n")[0].split())


def _said_below(path: str) -> str:
    """Return the string below the assignment of a constant."""
    module, _, name = path.rpartition(".")
    body = ast.parse(inspect.getsource(importlib.import_module(module))).body
    for statement, after in pairwise(body):
        if isinstance(statement, ast.ImportFrom) and name in [a.name for a in statement.names]:
            return _said_below(f"{statement.module}.{name}")
        targets = getattr(statement, "targets", [getattr(statement, "target", None)])
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        if name in names and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return str(after.value.value)
    return ""


def public_names() -> Iterator[Name]:
    """Yield the public names, page by page in the order of the navigation."""
    for page in sorted(PAGES.glob("*.md")):
        for path in _DIRECTIVE.findall(page.read_text()):
            found = resolved(path)
            members = public_members(found) if inspect.ismodule(found) else [""]
            for member in members:
                whole = f"{path}.{member}" if member else path
                yield Name(page.name, whole, _summary(whole))


def listed() -> str:
    """Return the list as Markdown."""
    names = sorted(public_names(), key=lambda name: name.name.lower())
    head = ["| name | from | |", "| --- | --- | --- |"]
    stable = [name.row for name in names if name.stable]
    others = [name.row for name in names if not name.stable]
    title = "\n## For authors of drivers and tests\n"
    return "\n".join([*head, *stable, title, *head, *others]) + "\n"


def page() -> str:
    """Return the page with the list made again."""
    head, mark, _ = INDEX.read_text().partition(MARK)
    assert mark, f"{INDEX} has lost its mark"
    return f"{head}{MARK}\n\n{listed()}"


def _signature(function: object) -> str:
    try:
        text = str(inspect.signature(function))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return "(...)"
    text = re.sub(r"(: |-> )'([^']*)'", r"\1\2", text)  # annotations are strings
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def _member(value: object) -> str | None:
    """Return what a member of a class looks like to callers; ``None`` if annotations say it."""
    prefix = ""
    if isinstance(value, classmethod | staticmethod):
        prefix, value = f"{type(value).__name__} ", value.__func__
    if isinstance(value, property):
        return f": property{_signature(value.fget).partition(')')[2]}"
    if inspect.iscoroutinefunction(value):
        prefix += "async "
    return f"{_signature(value)} {prefix}".rstrip() if inspect.isfunction(value) else None


def _class_lines(path: str, kind: type) -> Iterator[str]:
    """Yield a line for a class, and for each of its public members that rtee defines."""
    yield f"class {path}({', '.join(base.__name__ for base in kind.__bases__)})"
    members: dict[str, str] = {}
    for owner in reversed(kind.__mro__):
        if not owner.__module__.startswith("rtee"):
            continue
        for name, annotation in inspect.get_annotations(owner).items():
            members[name] = f": {annotation}"
        for name, value in vars(owner).items():
            if issubclass(kind, Enum) and isinstance(value, kind):
                members[name] = f" = {value.value!r}"
            elif (text := _member(value)) is not None:
                members[name] = text
    for name in sorted(members):
        if name == "__init__" or not name.startswith("_"):
            yield f"    {path.rpartition('.')[2]}.{name}{members[name]}"


def signatures() -> str:
    """Return the public names with their signatures, a line each."""
    lines: list[str] = []
    for path in sorted(name.path for name in public_names()):
        found = resolved(path)
        if inspect.isclass(found):
            lines += _class_lines(path, found)
        else:
            lines.append(f"{path}{_signature(found) if inspect.isroutine(found) else ''}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    INDEX.write_text(page())
    SIGNATURES.write_text(signatures())
