"""Make the folder of a new hand: hand.yaml, URDF, SRDF and meshes, completely or not at all."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from rtee.errors import ConfigError, ModelError
from rtee.hand.candidates import (
    OneMotor,
    carriers,
    fixed_jaw,
    motor_notes,
    one_motor,
    passive_candidates,
)
from rtee.hand.catalog import FILE_NAME
from rtee.hand.chains import GROUP_OF_FINGERS
from rtee.hand.embedded_meshes import as_utf8, with_local_meshes
from rtee.hand.files import make_folder, new_tree, read_bytes, write_atomically
from rtee.hand.geometry import allowed_collisions
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import DisabledPair, Finger, Hand, JointRole
from rtee.hand.names import check_name
from rtee.hand.resting import closed_rest_of
from rtee.hand.schema import SCHEMA_FILE, SCHEMA_LINE, schema_text
from rtee.hand.srdf import read_srdf
from rtee.hand.srdfwrite import format_srdf, with_disabled, with_passive
from rtee.hand.subtree import Subtree
from rtee.hand.urdfread import Edit, read_urdf
from rtee.hand.whole_robot import check_one_hand
from rtee.hand.xmlfile import read_xml
from rtee.hand.yamlfile import emit_scalar, ignore_line, rest_line

Ask = Callable[[str, bool], bool]
"""Asks the user a yes-or-no question; the second argument is the likelier answer."""


@dataclass(frozen=True)
class NewHand:
    """The new hand.

    Attributes:
        folder: The hand's folder.
        hand: The hand, loaded from there.
        reasons: Why each finger is one.
        pairs: Pairs of links that need not be checked for collision.
        notes: Remarks, one sentence each.
    """

    folder: Path
    hand: Hand
    reasons: tuple[str, ...]
    pairs: tuple[DisabledPair, ...]
    notes: tuple[str, ...]


def make_hand(
    name: str,
    urdf: Path | str,
    srdf: Path | str | None = None,
    *,
    package_dirs: Sequence[Path | str] = (),
    into: Path | str = "config",
    ask: Ask | None = None,
    passive: Collection[str] | None = None,
    excluded: Sequence[DisabledPair] = (),
    subtree: Subtree | None = None,
) -> NewHand:
    """Make the folder of a new hand.

    The meshes are copied next to the URDF and addressed relative to it. Without an SRDF, one is
    written for the fingers found in the tree, with the reasons. Actuators that move all fingers as
    one body are ignored, and a rest posture that is a pinch is opened, both in hand.yaml.

    Args:
        name: The hand's name.
        urdf: Its URDF.
        srdf: Its SRDF, if it has one.
        package_dirs: Folders in which to look up mesh packages.
        into: Folder of the hands.
        ask: Asks the user about facts that the files leave open. Without it, joints that may have
            no motor are only noted.
        passive: The joints without a motor, if they are known, in addition to those of the SRDF.
        excluded: Pairs of links that are never checked for collision, with the reason, in addition
            to those found.
        subtree: Which part of a whole robot is the hand.

    Raises:
        ConfigError: if the name is not allowed or taken, or the folder cannot be written.
        ModelError: if the files do not describe a hand, or describe several, or a mesh is missing.
    """
    check_name(name, "hand")
    target = Path(into) / name
    if target.exists():
        raise ConfigError(f"hand '{name}' already exists; remove the folder first", path=target)
    edits: list[Edit] = [] if subtree is None else [subtree]
    load = partial(load_model, urdf, srdf, name=name, package_dirs=package_dirs)
    if passive is not None:
        inside = read_urdf(urdf, edits).joints
        load = partial(load, passive=[joint for joint in passive if joint in inside])
    settled = settle(load, edits, searched=srdf is None, motors_known=passive is not None, ask=ask)
    hand, notes = settled.hand, settled.notes
    pairs = _with(excluded, hand, allowed_collisions(hand))
    with new_tree(target) as folder:
        # The SRDF of a whole robot would not fit the hand alone.
        notes += _fill(folder, settled, pairs, None if subtree else srdf)
        # Before the folder gets its name, since a hand that cannot be loaded must not remain.
        load_hand(folder)
        write_atomically(target.parent / SCHEMA_FILE, schema_text())
    reasons = tuple(f"{finger.name}: {finger.reason}" for finger in hand.fingers)
    # Loaded again, so that its paths are not those of the temporary folder.
    return NewHand(target, load_hand(target), reasons, pairs, tuple(notes))


@dataclass(frozen=True)
class Settled:
    """A hand with the decisions that its files leave open.

    Attributes:
        hand: The hand.
        ignored: Actuators to ignore.
        rest: Rest positions for hand.yaml [rad | m].
        notes: Remarks and choices, one sentence each.
    """

    hand: Hand
    ignored: tuple[str, ...]
    rest: Mapping[str, float]
    notes: list[str]


def _with(
    excluded: Sequence[DisabledPair], hand: Hand, pairs: tuple[DisabledPair, ...]
) -> tuple[DisabledPair, ...]:
    """Return a hand's disabled pairs, followed by the excluded ones that are not among them."""
    there = {frozenset(pair[:2]) for pair in pairs}
    links = hand.urdf.links
    return pairs + tuple(
        pair
        for pair in excluded
        if frozenset(pair[:2]) not in there and pair[0] in links and pair[1] in links
    )


def settle(
    load: Callable[..., Hand],
    edits: Sequence[Edit],
    *,
    searched: bool,
    motors_known: bool,
    ask: Ask | None,
) -> Settled:
    """Decide which joints are actuators, which are ignored, and where the hand rests.

    Args:
        load: Loads the model; takes the edits, the joints without a motor, the ignored actuators
            and the rest positions that are chosen.
        edits: Edits of the model, such as the part of a whole robot.
        searched: Whether the fingers are found in the tree, without an SRDF.
        motors_known: Whether the model says which joints have a motor.
        ask: Asks the user; without it, joints that may have no motor are only noted.

    Raises:
        ModelError: if the files do not describe a hand, or describe several, or a mesh is missing.
    """
    chosen: dict[str, Any] = {"edits": edits}
    hand: Hand = load(**chosen)
    notes: list[str] = []
    if searched:
        check_one_hand(hand)
    if searched and not motors_known:
        passive, notes = _passive(hand, ask)
        if passive:
            chosen["passive"] = passive
            hand = load(**chosen)
        coupled, told = _one_motor(hand, ask)
        notes += told
        if coupled:
            chosen["edits"] = [*edits, coupled]
            hand = load(**chosen)
    # After the passive joints, so that a joint without a motor is not taken for a wrist.
    ignored, reasons = _ignored(hand, ask)
    notes += reasons
    if ignored:
        chosen["ignore"] = ignored
        hand = load(**chosen)
    added, told = _fixed_jaw(hand, ask)
    notes += told
    hand = replace(hand, fingers=(*hand.fingers, *added))
    # An SRDF says by itself where a hand rests.
    closed = closed_rest_of(hand, narrow=searched)
    if closed is not None:
        hand = load(**chosen, rest=closed.opened)
        hand = replace(hand, fingers=(*hand.fingers, *added))
        notes.append(
            f"{closed.found} where the model rests, so the hand is to rest where they are "
            f"{closed.opening * 1e3:.1f} mm apart, by '{closed.line}' in hand.yaml"
        )
    if free := [each.name for each in hand.actuators if not math.isfinite(each.effort)]:
        more = f" and {len(free) - 1} more" if len(free) > 1 else ""
        notes.append(
            f"no effort limit for actuator '{free[0]}'{more}; without one under limits: in "
            "hand.yaml, no goal can ask for a force or for a share of the effort"
        )
    rest = {} if closed is None else closed.opened
    return Settled(hand, ignored, rest, [*hand.notes, *notes])


def _passive(hand: Hand, ask: Ask | None) -> tuple[tuple[str, ...], list[str]]:
    """Return the joints without a motor according to the user, or notes on likely ones."""
    if ask is None:
        return (), motor_notes(hand)
    chosen = tuple(
        candidate.joint
        for candidate in passive_candidates(hand)
        if not ask(
            f"joint '{candidate.joint}' {candidate.why}. Does it have a motor?",
            not candidate.likely,
        )
    )
    if len(chosen) == len(hand.actuators):
        raise ModelError("the hand has no joint with a motor", path=hand.urdf.path)
    return chosen, [f"joint '{joint}' is passive: it has no motor" for joint in chosen]


def _one_motor(hand: Hand, ask: Ask | None) -> tuple[OneMotor | None, list[str]]:
    """Return which jaw follows the other according to the user, or a note that it may."""
    found = one_motor(hand)
    if found is None:
        return None, []
    why = f"'{found.master}' and '{found.joint}' mirror each other, as where one motor drives both"
    if ask is None:
        return None, [
            f"{why}; if so, put {found.element} into the joint '{found.joint}' of the URDF and "
            "make the hand again, or let `rtee new --ask` do it"
        ]
    if not ask(f"{why}. Is there one motor?", True):
        return None, []
    return found, [f"{why}: '{found.joint}' follows by {found.element}"]


def _fixed_jaw(hand: Hand, ask: Ask | None) -> tuple[tuple[Finger, ...], list[str]]:
    """Return the fixed jaw that opposes the only finger according to the user, or a note on it."""
    chain = fixed_jaw(hand)
    if chain is None:
        only = (
            "there is only one finger; if a fixed part acts as another, add a group for it to the "
            "SRDF"
        )
        return (), [only] if len(hand.fingers) == 1 else []
    if ask is None:
        return (), [
            f"there is only one finger; {chain.reason}: it becomes the second finger by "
            f'<group name="fixed"><link name={quoteattr(chain.links[-1])}/></group> in the SRDF '
            f'and <group name="fixed"/> in its group {GROUP_OF_FINGERS}, or by `rtee new --ask`'
        ]
    if not ask(f"{chain.reason}. Is it the second finger?", True):
        return (), []
    finger = Finger(
        name=chain.name,
        base=chain.links[0],
        tip=chain.tip(hand.urdf),
        tip_links=(chain.links[-1],),
        links=chain.links,
        actuators=(),
        own=(),
        reason=chain.reason,
    )
    return (finger,), [chain.reason]


def _ignored(hand: Hand, ask: Ask | None) -> tuple[tuple[str, ...], list[str]]:
    """Return the actuators to ignore, and a note about them."""
    found = carriers(hand)
    if not found:
        return (), []
    one = len(found) == 1
    names = ", ".join(f"'{name}'" for name in found)
    why = f"{names} {'moves' if one else 'each move'} all fingers as one body, as a wrist does"
    them = "it" if one else "them"
    if ask is not None and not ask(f"{why}. Ignore {them}?", True):
        return (), []
    line, palm = ignore_line(found), hand.fingers[0].links[0]
    return found, [
        f"{why}, so {'it is' if one else 'they are'} ignored, by '{line}' in hand.yaml; "
        f"--root {palm} takes the hand alone"
    ]


def _fill(
    folder: Path,
    settled: Settled,
    pairs: tuple[DisabledPair, ...],
    srdf: Path | str | None,
) -> list[str]:
    """Write the files of a hand into a folder; return notes."""
    hand = settled.hand
    local = with_local_meshes(hand)
    for place, source in local.meshes.items():
        make_folder((folder / place).parent)
        write_atomically(folder / place, read_bytes(source, "mesh", ModelError))
    write_atomically(folder / f"{hand.name}.urdf", local.text)
    if srdf is None:
        srdf_text = format_srdf(hand, pairs, with_rest=not settled.rest)
    else:
        srdf_text = as_utf8(read_xml(srdf, "SRDF")[1])
        # Pairs are added only to an SRDF without any: one with pairs was made with care.
        given = read_srdf(srdf)
        if not given.disabled:
            srdf_text = with_disabled(srdf_text, pairs)
        standing = (j.name for j in hand.joints if j.role is JointRole.PASSIVE)
        srdf_text = with_passive(srdf_text, [j for j in standing if j not in given.passive])
    write_atomically(folder / f"{hand.name}.srdf", srdf_text)
    write_atomically(folder / FILE_NAME, _hand_yaml(settled))
    return list(local.notes)


def _hand_yaml(settled: Settled) -> str:
    hand = settled.hand
    example = emit_scalar(hand.actuators[0].name)
    chosen = ""
    if settled.rest:
        chosen += f"""
# Where actions start from and what `rtee open` goes to [rad or m]. At the model's own rest posture
# fingertips pinch.
{rest_line(settled.rest)}
"""
    if settled.ignored:
        chosen += f"""
# These move all fingers as one body, as a wrist does; they stay fixed and take no part.
{ignore_line(settled.ignored)}
"""
    return f"""{SCHEMA_LINE}name: {emit_scalar(hand.name)}
urdf: {emit_scalar(f"{hand.name}.urdf")}
srdf: {emit_scalar(f"{hand.name}.srdf")}
{chosen}
# Limits that the URDF does not have, or tighter ones [rad or m, s, N·m or N]:
# limits:
#   defaults: {{acceleration: 20.0, jerk: 400.0}}
#   {example}: {{velocity: {hand.actuators[0].velocity:g}}}

# What `rtee run` drives: `kinematic` moves on the screen only, `devices` are the real ones.
driver: kinematic
# devices:
#   hand: {{driver: NAME, actuators: all, options: {{port: /dev/ttyUSB0}}}}
"""
