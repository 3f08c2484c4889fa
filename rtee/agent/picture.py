"""A picture of a planned grasp: the hand as it closes on the object, with its contacts."""

from __future__ import annotations

from rtee.actions.library import ActionLibrary
from rtee.hand.load import hand_folder, load_configured
from rtee.planning.closing import ActionWay
from rtee.planning.result import GraspPlan
from rtee.render.hand import HandRenderer


def draw(name: str, plan: GraspPlan) -> bytes:
    """Return a PNG file of a grasp by an action of a hand, whose files are read here.

    Raises:
        UserError: if the files cannot be used.
        UnknownAction: if they do not have the action.
        MissingExtra: The extra ``plot`` is not installed.
    """
    hand, _ = load_configured(name)
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    posture = ActionWay.of(hand, library.find(plan.action, plan.elements)).at(plan.touch)
    contacts = [(each.point, each.normal) for each in plan.contacts]
    return HandRenderer(hand, postures=[posture]).picture(posture, contacts=contacts, ghost=True)
