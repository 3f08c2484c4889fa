"""Which fingers of a closed hand press with a force: those that are there in time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rtee.actions.library import ActionLibrary, load_actions
from rtee.actions.openings import OpeningTable
from rtee.hand.model import Hand
from rtee.objects.shape import Table
from rtee.planning.closing import ActionPath, Closure
from rtee.planning.objects import read_object
from rtee.planning.planner import Planner
from rtee.planning.result import Contact
from rtee.planning.search import Search
from rtee.planning.springs import gains

ROOT = Path(__file__).parents[2]
ON_TABLE = Table((0.0, 0.0, 1.0))


@pytest.fixture(scope="module")
def library() -> ActionLibrary:
    return load_actions(ROOT / "config/inspire_rh56")


@dataclass(frozen=True)
class Fingers:
    """Thumb, index and middle finger, which close together, and where each was stopped."""

    hand: Hand
    opening: OpeningTable
    search: Search

    def closed(self, **stopped: float) -> Closure:
        names = self.hand.actuator_names
        shares, blocked = np.ones(len(names)), np.zeros(len(names), dtype=np.bool_)
        contacts = []
        for finger in self.hand.fingers:
            if finger.name in stopped:
                own = [names.index(name) for name in finger.actuators]
                shares[own], blocked[own] = stopped[finger.name], True
                contacts.append(Contact("tip", finger.name, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
        contacts.append(Contact("palm", "", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
        return Closure(np.eye(4), shares, shares, 0.5, tuple(contacts), blocked)

    def pressing(self, **stopped: float) -> set[str] | None:
        found = self.search.pressing(self.closed(**stopped))
        return None if found is None else {contact.finger for contact in found.contacts}


@pytest.fixture(scope="module")
def fingers(library: ActionLibrary) -> Fingers:
    action = library.find("MultiPinchTight_3", ("thumb", "index", "middle"))
    opening = library.openings.find(action)
    assert opening is not None
    path = ActionPath.of(library.hand, action)
    search = Search(action, SimpleNamespace(path=path), None, iter(()), 1, opening=opening)
    return Fingers(library.hand, opening, search)


def test_fingers_press_once_each_side_touches(fingers: Fingers) -> None:
    assert fingers.pressing(thumb=0.5, index=0.5, middle=0.5) == {"thumb", "index", "middle", ""}
    # The thumb waits for the first finger of the other side, and that does not wait for the next.
    assert fingers.pressing(thumb=0.3, index=0.5, middle=0.8) == {"thumb", "index", ""}
    assert fingers.pressing(thumb=0.8, index=0.5, middle=0.5) == {"thumb", "index", "middle", ""}


def test_a_finger_that_is_a_little_late_still_presses(fingers: Fingers) -> None:
    opening = fingers.opening
    # 5 mm, in intensities.
    late = 0.005 * np.ptp(opening.intensity) / (opening.widest - opening.narrowest)
    assert fingers.pressing(thumb=0.5, index=0.5, middle=0.5 + 0.9 * late) == {
        *("thumb", "index", "middle"),
        "",
    }
    assert fingers.pressing(thumb=0.5, index=0.5, middle=0.5 + 1.1 * late) == {"thumb", "index", ""}


def test_a_side_that_touches_nothing_does_not_press(fingers: Fingers) -> None:
    assert fingers.pressing(index=0.5, middle=0.5) is None
    assert fingers.pressing(thumb=0.5) is None


def test_the_force_of_fingers_all_around_is_their_sum(fingers: Fingers) -> None:
    assert fingers.search.normal(3.0) == 6.0
    sides = (("thumb",), ("index",), ("middle",))
    around = replace(fingers.search, opening=replace(fingers.opening, sides=sides))
    assert around.normal(3.0) == 3.0


def test_soft_servos_lower_the_score() -> None:
    library = load_actions(ROOT / "config/allegro")
    soft, thing = library.hand, read_object("cylinder:0.025x0.12")
    action = library.find("PinchTight", ("index", "thumb"))
    # With the usual gain, a servo gives its full effort at 0.05 rad; the Allegro's, at 0.3 to 0.5.
    stiff = replace(soft, dynamics={})
    assert gains(stiff).max() > 5.0 * gains(soft).max()
    scores = []
    for hand in (soft, stiff):
        planner = Planner(hand, thing, table=ON_TABLE, openings=library.openings)
        plans, _ = planner.plan([action])
        scores.append(plans[0].score if plans else 0.0)
    # Two of its tips let this cylinder sink by 7 mm, and lost it in all tries in simulation.
    assert scores[0] < 0.1
    assert scores[1] > 0.5


def test_fingers_that_come_late_are_no_contacts_of_the_plan() -> None:
    # An L10's "Grasp" meets this cylinder with thumb and index, which do not oppose each other.
    library = load_actions(ROOT / "config/linkerhand_l10")
    thing = read_object("cylinder:0.025x0.12")
    planner = Planner(library.hand, thing, table=ON_TABLE, openings=library.openings)
    pinch = planner.plan([library.find("PinchTight", ("index", "thumb"))])[0]
    grasp = planner.plan([library.find("Grasp")])[0]
    assert pinch[0].force is not None
    assert grasp[0].score < pinch[0].score


def test_fingers_that_slide_along_an_object_do_not_hold_it() -> None:
    # This cylinder is hardly wider than the gap between two fingers of a HERI II: they pass it on
    # either side, and the thumb pushes it out between them. Lost in all tries in simulation.
    library = load_actions(ROOT / "config/heri_ii")
    thing = read_object("cylinder:0.0215x0.0508", 0.083)
    planner = Planner(library.hand, thing, table=ON_TABLE, openings=library.openings)
    square = planner.plan([library.find("PinchTight", ("finger_2", "thumb"))])[0]
    passing = planner.plan([library.find("3f_grasp")])[0]
    assert square[0].score > 0.5
    assert all(plan.score < 0.1 for plan in passing)
