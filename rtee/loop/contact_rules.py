"""The rules by which evidence becomes a decision: touched, held, lost, slipped.

Each is a pure function of what `rtee.loop.evidence.ContactMonitor` has found. To change when
something counts as a contact, change a function here, its test, and `VERSION`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

from rtee.loop.free_motion import FREELY

VERSION: Final = 18
"""Version of these rules, written into recordings: `rtee log replay --check` says when a recording
was made with other rules."""

_LOST_MOVE: Final = 0.02
"""A grasp looks lost once the actuator has closed further by this share of its range [1]: more than
a soft object yields."""

_WEAK: Final = 0.94
"""A force that was reached is raised again below this share of the requested one."""

STRONG: Final = 1.06
"""It is lowered again above this share if efforts have risen as much: sensors also measure the pull
of the load, which must not loosen the grasp."""

_OTHER_SIDE: Final = 0.04
"""Least share of one side's force that the other side must show: in simulation, efforts of sides
that hold an object between them differ by a factor of 13 at most, those of other sides by 55."""

_YIELDED: Final = 0.5
"""Share of the opening that is left when the fingers have closed past an object [1]: a soft one
yields by less."""

_BENT: Final = 0.1
"""The same of fingers that bend: their actuators go on by some millimetres before the force shows.
In simulation, 0.26 is left on a plate of 2 mm, more on all else, and 0.02 on nothing."""

_STRAYS: Final = 6e-3
"""A fingertip strays when one actuator moves it this far from where it grasped [m]: more than the
5 mm by which what is held may move. In simulation, those that hold stray by 4.8 mm at most."""

FAINT: Final = 0.1
"""Below this share of the requested force, fingers press on nothing: it is mere noise, or what an
object weighs. In simulation, what is held shows 0.14 of the force at least, by sensors."""

_HANDED: Final = 0.3
"""Share of the force of all fingers of a motor that one of them hands over to one that bore nothing
when what they hold turns. In simulation, 0.44 to 0.55 where it turns out of two fingers and another
pair catches it, 4 to 21 mm from where it was, and 0.18 at most otherwise: where two fingers bear a
half each, a third one that joins them leaves a third to each."""

_GIVES: Final = 2e-4
"""What is pressed on gives way while the tips come nearer by more than this [m] within `STILL`:
more than the noise of positions. In simulation, they come nearer by 0.17 mm at most on what stays,
and by 0.3 mm and more on foam that goes on turning between them."""

STILL: Final = 0.5
"""For this long, the tips must have come no nearer [s]: twice the time for which a grasp must
rest."""

_CREEP: Final = 0.5
"""An actuator creeps when it closes further by this share of its tolerance while it holds: more
than noise, and before the grasp counts as lost."""

_LOAD: Final = 1.15
"""An external force pulls at the object when the force on a finger exceeds its former value by this
factor: sensors also measure the pull along the fingertip, before a slip."""

_DROP: Final = 0.7
"""A force has dropped when it is below this share of its former value: sensors are accurate to
some 10 %."""

ALL: Final = 0.9
"""Share of its limit above which an actuator exerts all that it may: motors keep to it no
better."""

_GAINS: Final = 1.25
"""An actuator catches up with its reference when it moves by this multiple of the reference's
motion: more than the noise of its position, and more than follows while the reference brakes."""


def any_touch(forces: Sequence[float], least: float, *, every: bool = False) -> bool | None:
    """Return whether fingers touch something, by the forces on them.

    Args:
        forces: Forces on the fingers [N]; ``NaN``: not measured.
        least: Least force of a touch [N].
        every: Whether each finger must touch, not just one.

    Returns:
        ``None`` if there are no forces, or one is not measured: that finger may be the one.
    """
    if not forces or any(force != force for force in forces):
        return None
    return (min(forces) if every else max(forces)) >= least


def both_sides_touch(sides: Iterable[Sequence[float]], least: float) -> bool | None:
    """Return whether a finger on each side touches: two fingers of one side hold nothing.

    Args:
        sides: Forces on the fingers of each side [N]; ``NaN``: not measured.
        least: Least force of a touch [N].

    Returns:
        ``None`` if no force is measured on a side.
    """
    felt = [[force for force in side if force == force] for side in sides]
    if not all(felt):
        return None
    return all(max(side) >= least for side in felt)


def one_touches(fingers: Sequence[bool | None]) -> bool | None:
    """Return whether any finger touches; ``None`` if only an unmeasured one might."""
    return True if True in fingers else None if None in fingers or not fingers else False


def touches(felt: bool | None, *, pushes: bool, blocked: bool) -> bool:
    """Return whether an actuator's fingers touch something.

    Args:
        felt: The verdict of the forces on its fingers, if any.
        pushes: Whether it needs more effort than free motion does.
        blocked: Whether it has stalled with more effort than friction takes, as far as that is
            known, or its device says that it holds something.
    """
    return pushes or blocked if felt is None else felt


def presses(force: float, least: float, still: Iterable[bool]) -> bool:
    """Return whether fingers that do not follow their references press on something, by efforts.

    Args:
        force: The force between them by the efforts of those that do not follow, net of weight and
            friction [N].
        least: The force to press with [N].
        still: For each side, whether a pressing actuator of known friction does not follow.
    """
    return force >= least and all(still)


def is_pressed(sides: Iterable[float], least: float) -> bool:
    """Return whether the other side presses on fingers that wait, however freely it still moves.

    Args:
        sides: The force of each side by the efforts of those that wait, net of weight and friction
            [N].
        least: The force to press with [N].
    """
    return max(sides, default=0.0) >= least


def pressing_share(effort: float, weight: float) -> float:
    """Return the part of an effort that presses, net of weight and friction; all [N·m | N]."""
    share = 1.0 - weight / effort if effort else 0.0
    return min(max(share, 0.0), 1.0) if share == share else 0.0


def faint(force: float, wanted: float) -> bool:
    """Return whether a force between the tips shows nothing between them; both [N].

    One side alone, or a small share of the requested force, holds nothing.
    """
    return force < FAINT * wanted


def gives_way(nearer: float) -> bool:
    """Return whether what is pressed on gives way, by how much nearer the tips have come [m]."""
    return nearer > _GIVES


def force_rests(share: float, now: float, then: float) -> bool:
    """Return whether a force that was reached stays unchanged.

    Args:
        share: The force as a share of the requested one.
        now: The force by efforts [N].
        then: The same when the force was reached [N].
    """
    if share <= STRONG:
        return share >= _WEAK
    return not now > STRONG * then


def falls_short(force: float, error: float, wanted: float) -> bool:
    """Return whether a force is less than the requested one, and not only by its error.

    Args:
        force: The force between the tips [N]; ``NaN``: not known.
        error: Its error [N]; ``NaN``: not known.
        wanted: The requested force [N].
    """
    return force < _WEAK * wanted and force + error < wanted


def may_oppose(felt: bool | None, *, left: float, tolerance: float) -> bool:
    """Return whether an actuator may hold against what the other side touches, though it is unfelt.

    At the end of its motion, no effort of its own will show a contact any more.

    Args:
        felt: The verdict of the forces on its fingers, if any.
        left: The way left to its target [rad | m].
        tolerance: Position error that counts as none [rad | m].
    """
    return felt is None and left <= tolerance


def both_press(sides: Sequence[float]) -> bool:
    """Return whether each side presses, by the forces that follow from efforts [N].

    If only one side does, its fingers press on one another beside the object.
    """
    return not sides or min(sides) >= _OTHER_SIDE * max(sides)


def keeps_pace(*, moved: float, wanted: float, left: float, tolerance: float) -> bool:
    """Return whether an actuator that hardly moves keeps pace with an equally slow reference.

    Args:
        moved: Its travel since it was last known to move [rad | m].
        wanted: The reference's travel since then [rad | m].
        left: The remaining travel of the reference [rad | m].
        tolerance: Position error that counts as none [rad | m].
    """
    # At rest a reference has no speed, though a yielding object creeps on.
    if left <= tolerance:
        return False
    return moved * wanted > 0.0 and abs(moved) >= FREELY * abs(wanted)


def is_bound(effort: float, limit: float) -> bool:
    """Return whether an effort may be capped by its limit: without the limit, it might be larger.

    Such an effort does not show what free motion takes.

    Args:
        effort: The effort [N·m | N]; ``NaN``: not measured.
        limit: The effort limit [N·m | N].
    """
    return abs(effort) >= ALL * limit


def catches_up(moved: float, led: float) -> bool:
    """Return whether an actuator makes up for a delay, which takes effort without any contact.

    What touches something falls behind its reference instead.

    Args:
        moved: How far it has closed since its effort first showed a contact [rad | m].
        led: How far its reference has moved since then [rad | m].
    """
    return moved > _GAINS * led


def holds(
    felt: bool | None,
    *,
    word: bool,
    denied: bool,
    away: bool,
    moved: bool,
    effort: float,
    least: float,
) -> bool:
    """Return whether a blocked actuator holds something.

    A sensor at the fingertip is better evidence than efforts, which include friction: an actuator
    that has not moved at all may be stopped by friction alone.

    Args:
        felt: The verdict of the forces on its fingers, if any.
        word: Whether its device reports so for this motion.
        denied: Whether its device reports that it holds nothing.
        away: Whether the motion leads away from what is, or just was, held.
        moved: Whether it has moved in this motion, or held something before it.
        effort: Size of its effort [N·m | N]; ``NaN``: not measured.
        least: Least effort at which it may hold something [N·m | N].
    """
    if felt is not None:
        return felt and not away
    return word or (moved and not denied and not away and effort >= least)


def shows(grasping: bool, *, word: bool, effort: float, hard: float) -> bool:
    """Return whether evidence other than its position shows that an actuator presses on something.

    Standing still is not enough: a broken encoder looks the same.

    Args:
        grasping: Whether it holds something.
        word: Whether its device says that it holds something.
        effort: Size of its effort [N·m | N]; ``NaN``: not measured.
        hard: Least effort at which it presses [N·m | N].
    """
    return effort >= hard or word or grasping


def may_be_nothing(opening: float, doubt: float, *, word: bool) -> bool:
    """Return whether the fingers may be pressing on the hand itself, not on an object.

    Fingertips press on one another as they press on an object. Where the opening is no wider than
    it may be in the empty hand, force and effort say nothing.

    Args:
        opening: The opening by the actuators' positions [m]; ``NaN``: not known.
        doubt: Largest opening that may be measured while the tips touch one another [m].
        word: Whether the device itself says that it holds something.
    """
    return opening <= doubt and not word


def closed_past(opening: float, doubt: float, held: float, *, bends: bool = False) -> bool:
    """Return whether fingertips have closed past what they held, and meet as in the empty hand.

    They press on one another then as they did on the object.

    Args:
        opening: The opening by the actuators' positions [m].
        doubt: Largest opening that may be measured while the tips touch one another [m].
        held: The opening when the object was met or grasped [m].
        bends: Whether fingers bend on the object while their actuators go on.
    """
    return held > doubt and opening <= min(doubt, (_BENT if bends else _YIELDED) * held)


def strays(moved: float) -> bool:
    """Return whether a fingertip swings or rolls with what it grasped, by its travel since [m]."""
    return moved > _STRAYS


def handed_over(then: Sequence[float], now: Sequence[float]) -> bool:
    """Return whether a finger that bore nothing bears what another finger of its motor bore.

    Such fingers cannot regrasp: what they hold has turned or moved, though the force is the same.

    Args:
        then: Forces on the fingers of an actuator when it grasped [N]; ``NaN``: not measured.
        now: The same forces now [N].
    """
    before, after = sum(then), sum(now)
    if len(then) != len(now) or not (before > 0.0 and after > 0.0):
        return False
    if sum(bore >= FAINT * before for bore in then) < 2:
        return False  # held elsewhere than at the tips, too: another tip may well join
    gave = took = 0.0
    for bore, bears in zip(then, now, strict=True):
        share = bears / after
        if bore < FAINT * before:
            took = max(took, share)
        # What presses as before gives nothing, though another finger presses, too.
        gave = max(gave, min(bore / before - share, (bore - bears) / before))
    return min(gave, took) >= _HANDED


def came_as_far(came: float, meets: float, early: float) -> bool:
    """Return whether an actuator came as far as it does in the empty hand; all [rad | m].

    If so, another finger, or the hand, may have stopped it. What stops it earlier is an object.

    Args:
        came: The farthest it came from rest; a stronger actuator may have pushed it back.
        meets: Where a link that it moves first meets another one, or its target.
        early: How far short of that the empty hand may stop it.
    """
    return came >= meets - early


def lost(
    felt: bool | None,
    *,
    word: bool | None,
    moved: float,
    push: float,
    tolerance: float,
    span: float,
    effort: float,
    least: float,
) -> bool:
    """Return whether a grasp looks lost.

    Args:
        felt: The verdict of the forces on the fingers, if any.
        word: The device's verdict on a grasp that it reported; ``None``: it reported none.
        moved: How far the actuator has closed since the grasp [rad | m].
        push: How far its reference leads into the object [rad | m].
        tolerance: Position error that counts as none [rad | m].
        span: Its range [rad | m].
        effort: Size of its effort [N·m | N]; ``NaN``: not measured.
        least: Least effort at which it may hold something [N·m | N].
    """
    if felt is False:
        return True
    if word is not None:
        return not word
    # Further than noise, but where nothing is felt at most half of the remaining closing travel: an
    # actuator whose fingers feel the object may creep by all of it.
    enough = max(3.0 * tolerance, _LOST_MOVE * span if math.isfinite(span) else 0.0)
    if felt is None:
        enough = min(enough, 0.5 * abs(push))
    if moved <= enough or moved <= 0.5 * tolerance:
        return False
    # Half of the threshold: noise must not end a grasp that has just been found.
    return math.isnan(effort) or effort < 0.5 * least


def settled(*, steady: float, least: float, building: bool) -> bool:
    """Return whether a grasp has come to rest, so that a result may report it.

    Args:
        steady: How long all actuators have been in place or blocked [s].
        least: How long that must be [s].
        building: Whether the force is still being built up or corrected.
    """
    return not building and steady >= least


def creeps(moved: float, tolerance: float) -> bool:
    """Return whether an actuator that holds closes further; both lengths [rad | m]."""
    return moved > _CREEP * tolerance


def pulled(
    effort: float, effort_before: float, touch: float, touch_before: float, least: float
) -> bool:
    """Return whether a held object seems to slip, or to be pulled.

    Args:
        effort: Size of the actuator's effort now [N·m | N].
        effort_before: The same when it came to rest.
        touch: Force on its fingers now [N]; ``NaN``: not measured.
        touch_before: The same when it came to rest.
        least: Least force of a touch [N].
    """
    dropped = effort < _DROP * effort_before or touch < _DROP * touch_before
    return dropped or touch > max(_LOAD * touch_before, touch_before + least)


def enough_touch(
    touching: set[str], sides: Sequence[frozenset[str]], fingers: set[str], least: int
) -> bool:
    """Return whether enough fingers touch to squeeze without pushing the object away.

    Args:
        touching: The fingers that touch.
        sides: The fingers of each side of the opening; empty: the action has none.
        fingers: All fingers that are to squeeze.
        least: Number of fingers that must touch where there are no sides.
    """
    if not touching:
        return False
    # With one finger on either side, nothing is pushed away; a fixed jaw need not touch first.
    if sides:
        return all(touching & side for side in sides if fingers & side)
    return len(touching) >= min(least, len(fingers))
