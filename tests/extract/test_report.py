from __future__ import annotations

import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

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
from rtee.cli.actions import remarks
from rtee.errors import MissingExtra
from rtee.extract.extraction import Extraction
from rtee.extract.report import TrialSummary, make_report
from rtee.hand.model import Hand
from tests.render.models import claw

pytest.importorskip("PIL.Image")


@pytest.fixture
def hand(tmp_path: Path) -> Hand:
    return claw(tmp_path)


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
        TrialSummary("Grasp <all>", "sphere:0.03", True, "slip 1.5 mm"),
        TrialSummary("Grasp <all>", "drill", False, "it fell while it was lifted"),
        TrialSummary("Trig left", "sphere:0.03", False),
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


def test_a_pinch_that_collides_names_two_pairs_and_folds_more(hand: Hand) -> None:
    (pinch, _), _ = actions(hand)
    pairs = (("palm", "left"), ("palm", "right"), ("left", "right"))
    for count, said in (
        (0, "other links come too near"),
        (2, "palm and left; palm and right collide"),
        (3, "3 pairs of links"),
    ):
        evidence = replace(pinch.evidence[0], colliding=pairs[:count])
        found = Extraction((replace(pinch, evidence=(evidence,)),), 0.5)
        text = make_report(hand, found, size=(100, 100))
        page = Page()
        page.feed(text)
        assert not page.open
        assert f"not clear: {said}" in page.text
        assert f"not clear: {said}" in remarks(evidence) or count != 0
        assert ("<summary>not clear" in text) == (count == 3)


def test_without_jinja2_it_says_what_to_install(
    hand: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingExtra, match=r"a report needs the extra \'plot\'"):
        make_report(hand, Extraction((), 0.0))
