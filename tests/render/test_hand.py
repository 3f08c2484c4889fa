from __future__ import annotations

import io
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from rtee.errors import ConfigError, MissingExtra, ModelError
from rtee.hand.colours import PALETTE, finger_colours
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.render.camera import farthest
from rtee.render.hand import HandRenderer
from tests.render.models import claw

Image = pytest.importorskip("PIL.Image")


@pytest.fixture
def hand(tmp_path: Path) -> Hand:
    return claw(tmp_path)


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def share(picture: np.ndarray, colour: str) -> float:
    """Return the share of pixels whose hue is about that of a colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], dtype=float)
    shown = picture.reshape(-1, 3).astype(float)
    shown -= shown.min(axis=1, keepdims=True)
    wanted -= wanted.min()
    strong = np.linalg.norm(shown, axis=1) > 60
    alike = shown @ wanted > 0.97 * np.linalg.norm(shown, axis=1) * np.linalg.norm(wanted)
    return float((strong & alike).mean())


def test_picture_shows_every_finger_in_its_colour(hand: Hand) -> None:
    png = HandRenderer(hand, (240, 200)).picture(hand.rest)
    assert png.startswith(b"\x89PNG")
    picture = pixels(png)
    assert picture.shape == (200, 240, 3)
    for colour in finger_colours(hand).values():
        assert share(picture, colour) > 0.01
    assert (picture[:3] > 240).all()  # the background is white
    assert HandRenderer(hand, (240, 200)).picture(hand.rest) == png


def test_fingers_that_are_not_highlighted_are_faded(hand: Hand) -> None:
    picture = pixels(HandRenderer(hand, (240, 200)).picture(hand.rest, highlight=["left"]))
    assert share(picture, PALETTE[0]) > 0.01
    assert share(picture, PALETTE[1]) < 0.001


def test_the_ghost_shows_where_the_hand_rests(hand: Hand) -> None:
    closed = farthest(hand)
    renderer = HandRenderer(hand, (240, 200))
    plain, ghost = (pixels(renderer.picture(closed, ghost=g)) for g in (False, True))
    darker = (plain - ghost).min(axis=2) > 10
    assert 0.01 < darker.mean() < 0.4


def test_a_contact_is_marked_where_it_is(hand: Hand) -> None:
    contact = ((0.0, 0.0, 0.06), (1.0, 0.0, 0.0))
    renderer = HandRenderer(hand, (300, 260))
    plain = pixels(renderer.picture(hand.rest))
    marked = pixels(renderer.picture(hand.rest, contacts=[contact]))
    y, x = np.nonzero(np.abs(plain - marked).max(axis=2) > 40)
    at = renderer._camera.project(np.array([contact[0]]))[0]
    assert np.hypot(x.mean() - at[0], y.mean() - at[1]) < 3
    assert len(x) > 30


def test_transparent_background(hand: Hand) -> None:
    picture = Image.open(
        io.BytesIO(HandRenderer(hand, (120, 100)).picture(hand.rest, background=None))
    )
    alpha = np.asarray(picture)[..., 3]
    assert picture.mode == "RGBA"
    assert alpha.min() == 0
    assert alpha.max() == 255


def test_a_contact_is_seen_from_near(hand: Hand) -> None:
    renderer = HandRenderer(hand, (300, 260))
    u = np.array([0.5, 0.5])
    near = renderer.close_up(u, ((0.0, 0.0, 0.06), (1.0, 0.0, 0.0)), ["left", "right"])
    picture = pixels(near)
    assert share(picture, PALETTE[0]) > 0.05
    assert share(picture, PALETTE[1]) > 0.05


@pytest.mark.parametrize("point", [(-0.03, 0.0, 0.06), (0.03, 0.0, 0.06), (0.0, 0.0, -0.01)])
def test_a_close_up_covers_neither_the_contact_nor_more_than_need_be(
    hand: Hand, point: tuple[float, float, float]
) -> None:
    renderer = HandRenderer(hand, (300, 260))
    contact = (point, (1.0, 0.0, 0.0))
    corner = renderer.free_corner(hand.rest, contact, ["left"], 0.4)
    x, y = renderer._camera.project(np.array([point]))[0] / (300, 260)
    assert not ((x > 0.6 if "right" in corner else x < 0.4) and (y > 0.6) == ("bottom" in corner))
    far = renderer.free_corner(hand.rest, ((0.0, 0.0, 0.02), (1.0, 0.0, 0.0)), ["left"], 0.4)
    assert far != renderer.free_corner(
        hand.rest, ((0.0, 0.0, 0.02), (1.0, 0.0, 0.0)), ["right"], 0.4
    )


def test_a_hand_without_shapes_is_refused(hand: Hand) -> None:
    file = hand.urdf.path.with_name("bare.urdf")
    shapes = r"<(collision|visual)>.*?</\1>"
    file.write_text(re.sub(shapes, "", hand.urdf.text, flags=re.DOTALL))
    with pytest.raises(ModelError, match=r"bare\.urdf.*would be empty"):
        HandRenderer(load_model(file))


def test_without_the_extra_it_says_what_to_install(
    hand: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(MissingExtra, match=r'extra \'plot\': pip install .*\[plot\]"'):
        HandRenderer(hand)


def test_without_embree_it_is_told(hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(ConfigError, match="a picture needs embreex, which has packages for x86-64"):
        HandRenderer(hand)
