from __future__ import annotations

import io
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from rtee.actions.types import (
    ActionReference,
    Composed,
    Evidence,
    Generic,
    Opposition,
    Posture,
    Primitive,
    PrimitiveKind,
    Step,
    Timed,
)
from rtee.errors import MissingExtra
from rtee.extract import report_trace
from rtee.extract.extraction import Extraction
from rtee.extract.report import make_report
from rtee.extract.report_camera import farthest, fitted, view
from rtee.extract.report_mesh import smooth_normals
from rtee.extract.report_pictures import Studio, render
from rtee.extract.report_rays import NumpyScene
from rtee.extract.report_trials import Tried
from rtee.hand.colours import PALETTE, finger_colours, finger_of_link
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.hand.tessellation import box, sphere

Image = pytest.importorskip("PIL.Image")

URDF = """<robot name="claw">
  <link name="palm"><collision><geometry><box size="0.08 0.03 0.02"/></geometry></collision></link>
  {links}
</robot>"""
JAW = """
  <link name="{name}"><collision><origin xyz="0 0 0.03"/>
    <geometry><box size="0.01 0.02 0.06"/></geometry></collision></link>
  <joint name="{name}_joint" type="revolute"><parent link="palm"/><child link="{name}"/>
    <origin xyz="{x} 0 0.01"/><axis xyz="0 {axis} 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="5"/></joint>"""


@pytest.fixture
def hand(tmp_path: Path) -> Hand:
    links = JAW.format(name="left", x=-0.035, axis=1) + JAW.format(name="right", x=0.035, axis=-1)
    (tmp_path / "claw.urdf").write_text(URDF.format(links=links))
    return load_model(tmp_path / "claw.urdf")


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
    png = render(hand, hand.rest, (240, 200))
    assert png.startswith(b"\x89PNG")
    picture = pixels(png)
    assert picture.shape == (200, 240, 3)
    for colour in finger_colours(hand).values():
        assert share(picture, colour) > 0.01
    assert (picture[:3] > 240).all()  # the background is white
    assert render(hand, hand.rest, (240, 200)) == png


def test_fingers_that_are_not_highlighted_are_faded(hand: Hand) -> None:
    picture = pixels(render(hand, hand.rest, (240, 200), highlight=["left"]))
    assert share(picture, PALETTE[0]) > 0.01
    assert share(picture, PALETTE[1]) < 0.001


def test_the_ghost_shows_where_the_hand_rests(hand: Hand) -> None:
    closed = farthest(hand)
    studio = Studio(hand, (240, 200))
    plain, ghost = (pixels(studio.picture(closed, ghost=g)) for g in (False, True))
    darker = (plain - ghost).min(axis=2) > 10
    assert 0.01 < darker.mean() < 0.4


def test_a_contact_is_marked_where_it_is(hand: Hand) -> None:
    contact = ((0.0, 0.0, 0.06), (1.0, 0.0, 0.0))
    studio = Studio(hand, (300, 260))
    plain = pixels(studio.picture(hand.rest))
    marked = pixels(studio.picture(hand.rest, contacts=[contact]))
    y, x = np.nonzero(np.abs(plain - marked).max(axis=2) > 40)
    at = studio._camera.project(np.array([contact[0]]))[0]
    assert np.hypot(x.mean() - at[0], y.mean() - at[1]) < 3
    assert len(x) > 30


def test_transparent_background(hand: Hand) -> None:
    picture = Image.open(io.BytesIO(render(hand, hand.rest, (120, 100), background=None)))
    alpha = np.asarray(picture)[..., 3]
    assert picture.mode == "RGBA"
    assert alpha.min() == 0
    assert alpha.max() == 255


def test_a_contact_is_seen_from_near(hand: Hand) -> None:
    studio = Studio(hand, (300, 260))
    u = np.array([0.5, 0.5])
    near = studio.close_up(u, ((0.0, 0.0, 0.06), (1.0, 0.0, 0.0)), ["left", "right"])
    picture = pixels(near)
    assert share(picture, PALETTE[0]) > 0.05
    assert share(picture, PALETTE[1]) > 0.05


@pytest.mark.parametrize("point", [(-0.03, 0.0, 0.06), (0.03, 0.0, 0.06), (0.0, 0.0, -0.01)])
def test_a_close_up_covers_neither_the_contact_nor_more_than_need_be(
    hand: Hand, point: tuple[float, float, float]
) -> None:
    studio = Studio(hand, (300, 260))
    contact = (point, (1.0, 0.0, 0.0))
    corner = studio.free_corner(hand.rest, contact, ["left"], 0.4)
    x, y = studio._camera.project(np.array([point]))[0] / (300, 260)
    assert not ((x > 0.6 if "right" in corner else x < 0.4) and (y > 0.6) == ("bottom" in corner))
    far = studio.free_corner(hand.rest, ((0.0, 0.0, 0.02), (1.0, 0.0, 0.0)), ["left"], 0.4)
    assert far != studio.free_corner(hand.rest, ((0.0, 0.0, 0.02), (1.0, 0.0, 0.0)), ["right"], 0.4)


def test_without_the_extra_it_says_what_to_install(
    hand: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(MissingExtra, match=r'extra \'plot\': pip install "rtee\[plot\]"'):
        render(hand, hand.rest)


def test_without_embree_it_is_told_and_the_picture_is_the_same(
    hand: Hand, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("embreex")
    wanted = pixels(render(hand, hand.rest, (120, 100)))
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    report_trace.embree.cache_clear()
    report_trace.tell_once.cache_clear()
    try:
        found = [pixels(render(hand, hand.rest, (120, 100))) for _ in range(2)]
    finally:
        report_trace.embree.cache_clear()
    assert [record.message for record in caplog.records if "embreex" in record.message] == [
        "embreex is not installed: pictures are traced in numpy, which takes some seconds each"
    ]
    assert (found[0] == found[1]).all()
    # Rays along an edge may fall to either side.
    assert (np.abs(found[0] - wanted).max(axis=2) > 8).mean() < 0.002


def test_rays_hit_the_nearest_of_all_triangles() -> None:
    rng = np.random.default_rng(7)
    corners = rng.normal(size=(300, 1, 3)) + 0.2 * rng.normal(size=(300, 3, 3))
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:3] = np.eye(3)  # along the axes, where a box has no slope
    origins = 0.3 * rng.normal(size=(200, 3))
    # Every ray against every triangle, as a system of linear equations.
    a, b, c = np.moveaxis(corners, 1, 0)
    sides = np.stack([b - a, c - a], axis=2)[None].repeat(200, axis=0)
    system = np.concatenate([sides, -directions[:, None, :, None].repeat(300, axis=1)], axis=3)
    u, v, depth = np.moveaxis(np.linalg.solve(system, (origins[:, None] - a)[..., None]), 2, 0)[
        ..., 0
    ]
    depth[(u < 0) | (v < 0) | (u + v > 1) | (depth < 0)] = np.inf
    # A triangle is a little larger than it is: leave out rays that pass this near to a side.
    near = ((np.abs(np.stack([u, v, 1 - u - v])) < 1e-3).any(axis=0)).any(axis=1)
    depth, origins, directions = depth[~near], origins[~near], directions[~near]
    scene = NumpyScene(corners)
    found = scene.first(origins, directions)
    hit = np.isfinite(depth).any(axis=1)
    assert 20 < hit.sum() < len(hit)
    np.testing.assert_array_equal(found.face, np.where(hit, depth.argmin(axis=1), -1))
    np.testing.assert_allclose(found.depth[hit], depth.min(axis=1)[hit], rtol=1e-4)
    np.testing.assert_array_equal(scene.blocked(origins, directions, 0.8), depth.min(axis=1) < 0.8)


def test_the_camera_sees_all_points_and_no_more() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3)) * [0.1, 0.02, 0.3] + [1.0, 2.0, 3.0]
    back = np.array([0.6, 0.64, 0.48])
    camera = fitted(points, back / np.linalg.norm(back), np.array([0.0, 0.0, 1.0]), (400, 300))
    spots = camera.project(points)
    assert (spots > 0).all()
    assert (spots < [400, 300]).all()
    margins = np.concatenate([spots.min(axis=0), [400, 300] - spots.max(axis=0)])
    assert margins.min() < 0.08 * 300
    rays = camera.rays(spots[:, 0], spots[:, 1])
    toward = points - camera.position
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    np.testing.assert_allclose(rays, toward, atol=1e-12)


def test_fingers_that_close_towards_one_another_are_seen_from_the_side(hand: Hand) -> None:
    back, up = view(HandGeometry(hand))
    np.testing.assert_allclose(up, [0, 0, 1])
    assert abs(back[1]) > abs(back[0])


def test_normals_are_smooth_on_a_sphere_and_sharp_on_a_box() -> None:
    vertices, faces = sphere(2.0)
    radial = vertices[faces] / 2.0
    cosine = np.einsum("fij,fij->fi", smooth_normals(vertices, faces), radial)
    assert cosine.min() > 0.99
    vertices, faces = box((1.0, 2.0, 3.0))
    # As triangles without shared vertices, as in an STL file.
    loose = vertices[faces].reshape(-1, 3)
    normals = smooth_normals(loose, np.arange(len(loose)).reshape(-1, 3))
    np.testing.assert_allclose(np.abs(normals).max(axis=2), 1.0)
    assert smooth_normals(vertices, np.zeros((0, 3), dtype=np.int64)).shape == (0, 3, 3)


def test_links_belong_to_the_finger_they_hang_on(shared: Path) -> None:
    folder = shared / "hands" / "schunk"
    hand = load_model(folder / "schunk.urdf", folder / "schunk.srdf")
    owner = finger_of_link(hand)
    assert all(owner[f.tip] == f.name for f in hand.fingers if f.tip)
    assert hand.base not in owner


class Page(HTMLParser):
    """Collects what a page refers to, and checks that its elements nest."""

    VOID = frozenset({"meta", "img", "br", "wbr"})

    def __init__(self) -> None:
        super().__init__()
        self.images: list[str] = []
        self.references: list[str] = []
        self.targets: set[str] = set()
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "src":
                self.images.append(value or "")
            elif name == "href":
                self.references.append(value or "")
            elif name == "id":
                self.targets.add(value or "")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def actions(hand: Hand) -> tuple[list[Primitive], list[Composed | Timed | Generic]]:
    both = Posture({"left_joint": 0.5, "right_joint": 0.4}, ("left_joint", "right_joint"))
    one = Posture({"left_joint": 0.8, "right_joint": 0.0}, ("left_joint",))
    evidence = Evidence(
        depth=0.0012,
        point=(0.0, 0.0, 0.06),
        normal=(1.0, 0.0, 0.0),
        clear=False,
        colliding=(("palm", "left"),),
        contact_at=0.75,
        opposition=Opposition((0.1, 0.2), force_closure=True),
    )
    primitives = [
        Primitive(PrimitiveKind.PINCH_TIGHT, ("left", "right"), (both,), (evidence,)),
        Primitive(PrimitiveKind.TRIG, ("left",), (one,)),
    ]
    use = ActionReference("Trig", ("left",), 0.5)
    custom: list[Composed | Timed | Generic] = [
        Composed("half <b>", (use,), one),
        Timed("twice", (Step(use, "first", 0.0, 0.5, one), Step(use, "second", 1.0, 0.0, both))),
        Generic("given", both, "A posture given directly."),
    ]
    return primitives, custom


def test_report_is_one_page_with_a_picture_of_every_action(hand: Hand, tmp_path: Path) -> None:
    primitives, custom = actions(hand)
    seen: list[tuple[int, int]] = []
    extraction = Extraction(tuple(primitives), 0.5, ("a note & more",))
    text = make_report(
        hand,
        extraction,
        custom,
        size=(200, 180),
        progress=lambda done, total: seen.append((done, total)),
    )
    page = Page()
    page.feed(text)
    assert not page.open
    # At rest, two primitives, a close-up, composed, two steps, generic.
    assert len(page.images) == 8
    assert all(image.startswith("data:image/webp;base64,") for image in page.images)
    assert page.references == ["#Trig", "#PinchTight", "#Composed", "#Timed", "#Generic"]
    assert {reference[1:] for reference in page.references} <= page.targets
    assert not re.search(r"https?://|url\(|@import", text)
    for words in ("half <b>", "a note & more", "depth 1.2 mm", "not clear: palm and left collide"):
        assert words in page.text
    assert "holds a ball at friction 0.5" in page.text
    assert "2. second: 1 s before, 0 s after" in page.text
    assert "Trig left × 0.5" in page.text
    assert str(tmp_path) not in text
    assert max(done for done, _ in seen) == 7
    assert {total for _, total in seen} == {7}


def test_report_tells_what_trials_found(hand: Hand, tmp_path: Path) -> None:
    tried = [
        Tried("Grasp <all>", "sphere:0.03", True, "slip 1.5 mm"),
        Tried("Grasp <all>", "drill", False, "it fell while it was lifted"),
        Tried("Trig left", "sphere:0.03", False),
    ]
    text = make_report(hand, Extraction((), 0.0), trials=tried, size=(100, 100))
    page = Page()
    page.feed(text)
    assert not page.open
    assert "trials" in page.targets
    for words in (
        "Does it hold?",
        "(1 of 3)",
        "Grasp <all>",
        "sphere",
        "drill",
        "1 of 2",
        "0 of 1",
    ):
        assert words in page.text
    assert "sphere<br>30" in text
    assert 'title="lost; it fell while it was lifted"' in text
