"""The everyday things are what their script makes, and of convex parts."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("coal")

from experiments.objects.make import MASSES, THINGS, stl
from rtee.planning.objects import read_object

FOLDER = Path(__file__).parents[2] / "experiments/objects"


def test_every_thing_has_a_mass_and_a_file() -> None:
    assert set(MASSES) == set(THINGS) == {path.stem for path in FOLDER.glob("*.stl")}


@pytest.mark.parametrize("name", sorted(THINGS))
def test_a_file_is_what_the_script_makes(name: str) -> None:
    assert (FOLDER / f"{name}.stl").read_bytes() == stl(THINGS[name]())


@pytest.mark.parametrize("name", sorted(THINGS))
def test_a_thing_is_of_convex_parts(name: str) -> None:
    obj = read_object(str(FOLDER / f"{name}.stl"))
    assert len(obj.pieces) == len(THINGS[name]())
    assert not obj.notes
