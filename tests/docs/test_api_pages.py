"""The pages of the Python API name what there is, and all of it."""

from __future__ import annotations

import ast
import importlib
import inspect
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import rtee
import rtee.testing

MOST_STABLE = 110
"""Most stable names: what is not worth a promise is provisional."""

PROVISIONAL = {
    "rtee.actions.openings.Openings",
    "rtee.actions.types.Opposition",
    "rtee.commands.CommandRecord",
    "rtee.hand.config_schema.ActuatorDynamics",
    "rtee.hand.config_schema.FlangeSection",
    "rtee.hand.config_schema.TouchSection",
    "rtee.hand.model.JointRole",
    "rtee.hand.transmission.Transmission",
    "rtee.hand.urdf.Urdf",
    "rtee.hand.urdfread.Edit",
    "rtee.log.recording.Channel",
    "rtee.log.plans.GripEstimate",
    "rtee.log.recording.TouchSeries",
    "rtee.loop.plan.Plan",
    "rtee.objects.description.ObjectPart",
    "rtee.objects.shape.Table",
    "rtee.planning.objects.GraspObject",
    "rtee.planning.grasp_solution.Collision",
    "rtee.planning.grasp_solution.Residual",
    "rtee.planning.result.GraspCheck",
    "rtee.planning.result.Contact",
    "rtee.remote.client.HandConnection",
    "rtee.remote.counts.Counts",
    "rtee.remote.link.Link",
    "rtee.remote.monitoring.CollectedStates",
    "rtee.sample.Quantity",
    "rtee.types.Aim",
}
"""Types in signatures of public names that are provisional themselves."""


@cache
def documented() -> dict[object, str]:
    """Everything public to where it is imported from."""
    from api_names import public_names, resolved

    return {resolved(name.path): name.path for name in public_names()}


def test_the_list_of_names_is_current() -> None:
    from api_names import INDEX, page

    assert INDEX.read_text() == page(), "run: python docs/api_names.py"


def test_the_public_api_has_not_changed_unnoticed() -> None:
    from api_names import SIGNATURES, signatures

    said = "the public API differs; if it is meant to, run: python docs/api_names.py"
    assert SIGNATURES.read_text().splitlines() == signatures().splitlines(), said


def test_every_name_has_a_summary() -> None:
    from api_names import public_names

    assert [name.path for name in public_names() if not name.summary] == []


def test_no_name_stands_twice() -> None:
    from api_names import public_names, resolved

    found = [resolved(name.path) for name in public_names()]
    assert len(found) == len(set(found))


def test_the_stable_names_are_those_of_the_package_and_few_others() -> None:
    from api_names import public_names, resolved

    stable = {resolved(name.path) for name in public_names() if name.stable}
    assert [name for name in rtee.__all__ if getattr(rtee, name) not in stable] == [
        "SimulatedHand",  # of the second tier, with all that tests use
        "simulated",
    ]
    assert len(stable) <= MOST_STABLE


def test_what_authors_of_drivers_import_is_documented() -> None:
    there = set(documented().values())
    lacking = [
        name
        for name in rtee.testing.__all__
        if getattr(rtee.testing, name) not in documented() and f"rtee.testing.{name}" not in there
    ]
    assert lacking == []


@cache
def _names_for_types(module: str) -> dict[str, object]:
    """What names mean in a module, those imported for type checkers included."""
    loaded = importlib.import_module(module)
    found = dict(vars(loaded))
    for block in ast.walk(ast.parse(inspect.getsource(loaded))):
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            for line in block.body:
                if isinstance(line, ast.ImportFrom) and str(line.module).startswith("rtee"):
                    source = importlib.import_module(str(line.module))
                    for alias in line.names:
                        found[alias.asname or alias.name] = getattr(source, alias.name)
    return found


def _spoken_of(owner: object, annotations: dict[str, object]) -> Iterator[type]:
    """Yield the public classes of rtee that annotations name."""
    known = _names_for_types(owner.__module__)
    for text in annotations.values():
        for node in ast.walk(ast.parse(str(text), mode="eval")):
            meant = known.get(node.id) if isinstance(node, ast.Name) else None
            if (
                isinstance(meant, type)
                and meant.__module__.startswith("rtee.")
                and not meant.__name__.startswith("_")
            ):
                yield meant


def _signatures(thing: object) -> Iterator[tuple[object, dict[str, object]]]:
    """Yield what a caller of a class or function sees of types."""
    if inspect.isfunction(thing):
        yield thing, thing.__annotations__
    if not inspect.isclass(thing):
        return
    for kind in thing.__mro__:
        if not kind.__module__.startswith("rtee."):
            continue
        public = {k: v for k, v in inspect.get_annotations(kind).items() if not k.startswith("_")}
        yield kind, public
        for name, member in vars(kind).items():
            if name.startswith("_") and name != "__init__":
                continue
            function = member.fget if isinstance(member, property) else member
            function = getattr(function, "__func__", function)
            if inspect.isfunction(function) and function.__module__.startswith("rtee."):
                yield function, function.__annotations__


def test_every_type_in_a_public_signature_is_documented_or_held_as_provisional() -> None:
    lacking: dict[str, str] = {}
    for thing, path in documented().items():
        for owner, notes in _signatures(thing):
            for kind in _spoken_of(owner, notes):
                name = f"{kind.__module__}.{kind.__qualname__}"
                if kind not in documented() and name not in PROVISIONAL:
                    lacking[name] = path
    assert lacking == {}


def test_the_signatures_are_really_read() -> None:
    from rtee.drivers.base import Driver
    from rtee.remote.client import RemoteHand
    from rtee.remote.goal import RunningGoal
    from rtee.remote.hand_info import HandInfo

    def of(thing: type) -> set[type]:
        return {k for owner, notes in _signatures(thing) for k in _spoken_of(owner, notes)}

    assert {RunningGoal, HandInfo} <= of(RemoteHand)
    assert "BusPool" in {kind.__name__ for kind in of(Driver)}, "imported for type checkers only"


def test_inherited_members_are_shown(repository: Path) -> None:
    assert "            inherited_members: true\n" in (repository / "mkdocs.yml").read_text()


def test_every_page_is_in_the_navigation(repository: Path) -> None:
    text = (repository / "mkdocs.yml").read_text()
    pages = sorted((repository / "docs").rglob("*.md"))
    lacking = [
        page.name for page in pages if str(page.relative_to(repository / "docs")) not in text
    ]
    assert len(pages) > 40
    assert lacking == []


@pytest.mark.parametrize("text", ["rtee.remote.nothing", "rtee.remote.client.Nobody", "nothing"])
def test_a_name_that_is_not_there_is_noticed(text: str) -> None:
    from api_names import resolved

    with pytest.raises((AttributeError, ModuleNotFoundError)):
        resolved(text)


def test_the_contract_suites_variable_is_named(repository: Path) -> None:
    from rtee.testing.case import CYCLES

    page = (repository / "docs" / "reference" / "api" / "testing.md").read_text()
    assert CYCLES in page
