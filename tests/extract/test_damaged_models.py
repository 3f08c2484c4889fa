"""Models damaged at random: they are extracted or give an `RteeError`; nothing else, no hang."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hand.test_mutations import damaged, load_or_refuse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtee.extract.extraction import extract
from rtee.hand.load import load_model

NUMBER = re.compile(r'(?<=[" ])[-+]?[0-9][0-9.eE+-]*(?=[" ])')
NUMBERS = ("0", "1e-308", "1e-9", "1e-5", "-0.001", "0.5", "3", "100", "-1e5", "1e6", "1e20")


@st.composite
def distorted(draw: st.DrawFn, text: str) -> str:
    """Draw a text with other numbers in some places, which more often still is a model."""
    for _ in range(draw(st.integers(1, 3))):
        places = list(NUMBER.finditer(text))
        place = draw(st.sampled_from(places))
        text = text[: place.start()] + draw(st.sampled_from(NUMBERS)) + text[place.end() :]
    return text


@pytest.mark.samples("two_finger_mimic")
@pytest.mark.parametrize("name", ["two_finger_mimic", "dagana", "robotiq_2f_140", "onrobot_3fg15"])
@settings(
    max_examples=12,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_damaged_models(name: str, shared: Path, tmp_path: Path, data: st.DataObject) -> None:
    folder = shared / "hands" / name
    change = data.draw(st.sampled_from([distorted, distorted, damaged]))
    urdf = tmp_path / "hand.urdf"
    urdf.write_text(data.draw(change((folder / f"{name}.urdf").read_text())), errors="replace")
    srdf = data.draw(st.sampled_from([folder / f"{name}.srdf", None]))
    found = load_or_refuse(lambda: extract(load_model(urdf, srdf, package_dirs=[folder])))
    for primitive in found.primitives if found else ():
        posture = primitive.posture.position
        assert all(value == value for value in posture.values())
