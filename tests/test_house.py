"""The shape of the code: modules are things of their own, and none imports itself by a detour."""

from __future__ import annotations

import re
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[1]
FEWEST_LINES = 60
"""A module shorter than this [lines] that one other module alone imports is a part of that one."""


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("rtee", cache_dir=None, exclude_type_checking_imports=False)


def lines(module: str) -> int:
    return len(path_of(module).read_text().splitlines())


def path_of(module: str) -> Path:
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def test_no_small_module_is_there_for_another_alone(graph: grimp.ImportGraph) -> None:
    """One that is documented, tested or used by itself is a thing of its own."""
    places = ("tests", "benchmarks", "experiments", "examples")
    others = [path.read_text() for place in places for path in (ROOT / place).rglob("*.py")]
    others += [path.read_text() for path in (ROOT / "docs").rglob("*.md")]
    parts = [
        module
        for module in sorted(graph.modules)
        if path_of(module).name != "__init__.py"
        and lines(module) < FEWEST_LINES
        and len(graph.find_modules_that_directly_import(module)) == 1
        and not any(re.search(rf"{re.escape(module)}\b", text) for text in others)
    ]
    assert parts == []


def test_no_module_imports_itself_by_a_detour(graph: grimp.ImportGraph) -> None:
    """Imports under TYPE_CHECKING count: they, too, are what a reader has to follow."""
    circles = [
        (module, direct)
        for module in sorted(graph.modules)
        for direct in sorted(graph.find_modules_directly_imported_by(module))
        if graph.find_shortest_chain(direct, module)
    ]
    assert circles == []


def test_one_module_asks_for_the_time(graph: grimp.ImportGraph) -> None:
    """All others ask it, so that simulated time is that of everything."""
    asking = [m for m in sorted(graph.modules) if "time.monotonic" in path_of(m).read_text()]
    assert asking == ["rtee.monotonic"]


def test_one_module_starts_python_processes(graph: grimp.ImportGraph) -> None:
    """Others would import from the working folder; ``deploy`` only looks where Python is."""
    starting = [m for m in sorted(graph.modules) if "sys.executable" in path_of(m).read_text()]
    assert starting == ["rtee.child", "rtee.deploy.files"]
