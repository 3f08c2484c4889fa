"""Real models, damaged at random: they load or give an `RteeError`; nothing else, and no hang."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hand.models import YAML, check_meshes
from rtee.errors import RteeError
from rtee.hand.load import load_hand, load_model

T = TypeVar("T")

NAMES = ("schunk", "heri_II", "robotiq_3f", "qbhand", "dagana", "two_finger_mimic")

VALUES = st.one_of(
    st.sampled_from(
        ["", " ", "nan", "inf", "-inf", "0", "-1", "1e308", "1e999", "0 0", "0 0 0", "../x", "a/b"]
    ),
    st.sampled_from(["fixed", "revolute", "continuous", "prismatic", "floating", "1/0", "x^^2"]),
    st.sampled_from(
        ["(" * 300, "x" * 5000, "sqrt(-1)", "\u0000", "&amp;", "&lol;", "]]>", '"', "<"]
    ),
    st.text(max_size=12),
)


@st.composite
def damaged(draw: st.DrawFn, text: str) -> str:
    """Draw a text with one to three changes in it."""
    for _ in range(draw(st.integers(1, 3))):
        text = draw(st.sampled_from([_value, _cut, _swap, _drop_line, _double_line, _byte]))(
            draw, text
        )
    return text


def _pieces(text: str) -> list[str]:
    """Return a text as pieces, where every other one stands between quotation marks."""
    return text.split('"')


def _value(draw: st.DrawFn, text: str) -> str:
    """Change the value of an attribute."""
    pieces = _pieces(text)
    if len(pieces) < 3:
        return text
    at = 2 * draw(st.integers(0, (len(pieces) - 2) // 2)) + 1
    pieces[at] = draw(VALUES)
    return '"'.join(pieces)


def _swap(draw: st.DrawFn, text: str) -> str:
    """Put the value of one attribute into another."""
    pieces = _pieces(text)
    if len(pieces) < 5:
        return text
    last = (len(pieces) - 2) // 2
    pieces[2 * draw(st.integers(0, last)) + 1] = pieces[2 * draw(st.integers(0, last)) + 1]
    return '"'.join(pieces)


def _cut(draw: st.DrawFn, text: str) -> str:
    """Cut a text off."""
    return text[: draw(st.integers(0, len(text)))]


def _drop_line(draw: st.DrawFn, text: str) -> str:
    lines = text.splitlines(keepends=True)
    if lines:
        del lines[draw(st.integers(0, len(lines) - 1))]
    return "".join(lines)


def _double_line(draw: st.DrawFn, text: str) -> str:
    lines = text.splitlines(keepends=True)
    if lines:
        at = draw(st.integers(0, len(lines) - 1))
        lines.insert(draw(st.integers(0, len(lines))), lines[at])
    return "".join(lines)


def _byte(draw: st.DrawFn, text: str) -> str:
    at = draw(st.integers(0, len(text)))
    return text[:at] + draw(st.characters(codec="utf-8")) + text[at + 1 :]


SCALARS = (
    *("0", "-1", "0.5", "1e9", "1e-9", "1e999", ".nan", ".inf", "~", "true", "[]", "{}", "[1, 2]"),
    *("left", "right", "gripper.urdf", "../x", "a: b", "'", "*a", "hold", "kinematic", "x" * 5000),
)


@st.composite
def revalued(draw: st.DrawFn, text: str) -> str:
    """Draw a YAML text with another value in one to three places, where it stays YAML mostly."""
    for _ in range(draw(st.integers(1, 3))):
        places = list(re.finditer(r"(?<=: )[^\n{\[,}]+", text))
        place = draw(st.sampled_from(places))
        text = text[: place.start()] + draw(st.sampled_from(SCALARS)) + text[place.end() :]
    return text


def load_or_refuse(load: Callable[[], T]) -> T | None:
    """Return what is loaded; ``None`` if it is refused by one sentence and exit status 2."""
    try:
        return load()
    except RteeError as error:
        refusal = error
    assert len(str(refusal).splitlines()) == 1
    assert refusal.exit_status == 2
    return None


@pytest.mark.samples("robotiq_3f", "qbhand", "dagana", "two_finger_mimic")
@pytest.mark.parametrize("name", NAMES)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_models(name: str, shared: Path, tmp_path: Path, data: st.DataObject) -> None:
    folder = shared / "hands" / name
    urdf, srdf = folder / f"{name}.urdf", folder / f"{name}.srdf"
    which = data.draw(st.sampled_from(["urdf", "srdf", "both"]))
    if which != "srdf":
        text = data.draw(damaged(urdf.read_text(errors="replace")))
        urdf = tmp_path / "hand.urdf"
        urdf.write_text(text, errors="replace")
    if which != "urdf":
        text = data.draw(damaged(srdf.read_text(errors="replace")))
        srdf = tmp_path / "hand.srdf"
        srdf.write_text(text, errors="replace")
    given_srdf = data.draw(st.sampled_from([srdf, None]))
    hand = load_or_refuse(lambda: load_model(urdf, given_srdf, package_dirs=[folder]))
    if hand is None:
        return
    load_or_refuse(lambda: check_meshes(hand.urdf, hand.package_dirs))
    n = len(hand.actuators)
    assert n > 0
    assert np.all((hand.lower <= hand.rest) & (hand.rest <= hand.upper))
    assert np.isfinite(hand.transmission.joints(hand.rest)).all()
    assert hand.transmission.jacobian(hand.rest).shape == (len(hand.joints), n)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_configurations(configured: Path, data: st.DataObject) -> None:
    file = configured / "gripper" / "hand.yaml"
    text = YAML.replace("left", '"left"').replace("gripper.urdf", '"gripper.urdf"')
    change = data.draw(st.sampled_from([revalued, revalued, damaged]))
    file.write_text(data.draw(change(text)), errors="replace")
    hand = load_or_refuse(lambda: load_hand(configured / "gripper"))
    if hand is not None:
        assert np.all((hand.lower <= hand.rest) & (hand.rest <= hand.upper))
