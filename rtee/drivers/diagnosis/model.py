"""Diagnose a hand's model."""

from __future__ import annotations

from pathlib import Path

from rtee.actions.library import ActionLibrary
from rtee.actions.resting import pinch_at_rest
from rtee.actions.types import Primitive
from rtee.drivers.diagnosis.checks import Check, ok, warning
from rtee.errors import UserError
from rtee.hand.load import hand_folder, load_configured, load_hand
from rtee.hand.model import Hand

_REST = "rest"


def check_model(name: str) -> list[Check]:
    """Check a hand's rest posture, and whether it has devices.

    The check uses the geometry if Pinocchio and Coal are installed, otherwise the stored
    primitives.

    Args:
        name: The hand's name, or its folder.

    Raises:
        UserError: if its files contain a mistake.
    """
    hand = load_hand(name)
    found = _by_geometry(hand) if _has_geometry() else _by_primitives(hand, hand_folder(name)[0])
    if has_devices(name):
        return [found]
    remedy = "describe them under 'devices:' in hand.yaml"
    return [found, warning("devices", "none; the hand only moves on the screen", remedy)]


def has_devices(name: str) -> bool:
    """Return whether a hand's hand.yaml describes devices; raises `UserError`."""
    return bool(load_configured(name)[1].devices)


def _has_geometry() -> bool:
    try:
        import rtee.hand.geometry  # noqa: F401
    except ImportError:
        return False
    return True


def _by_geometry(hand: Hand) -> Check:
    from rtee.hand.resting import closed_rest_of

    try:
        closed = closed_rest_of(hand)
    except UserError as error:  # a mesh; the loop needs none
        return warning(_REST, f"cannot be checked: {error}", "correct the model")
    if closed is None:
        return ok(_REST, "no two fingertips pinch there")
    remedy = f"type into hand.yaml: {closed.line}; then: rtee extract {hand.name} --save"
    return warning(
        _REST, f"is a pinch: {closed.found} there, so `rtee open` closes the hand", remedy
    )


def _by_primitives(hand: Hand, folder: Path) -> Check:
    library = ActionLibrary.load(hand, folder / "actions")
    pinched = pinch_at_rest(hand, (a for a in library if isinstance(a, Primitive)))
    if not pinched:
        return ok(_REST, "no stored pinch of two fingertips lies there")
    found, _, remedy = pinched.partition("; ")
    return warning(_REST, found, remedy)
