"""Openings of actions: tables of the distance and the force between the fingertips.

The *opening* of an action is the least distance between its opposing tips. Its table holds, by
intensity, the opening and the actuators' *levers*: the decrease of the opening per unit of each
actuator, which by virtual work is also the effort for a unit of force between the tips. The offline
half computes the tables (`rtee.extract.openings`) and stores them in a file beside the actions, so
that running a hand needs neither Pinocchio nor Coal.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtee.actions.naming import label, normalise
from rtee.actions.types import Action, Primitive, Timed
from rtee.errors import ActionError, ConfigError
from rtee.hand.files import write_atomically
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Hand
from rtee.hand.yamlfile import emit, parse_yaml, read_text
from rtee.sample import FloatArray
from rtee.types import readonly

FILE_NAME: Final = "openings.yaml"
"""Name of the file of the tables in a hand's folder."""

FORMAT: Final = 1
"""Version of the file."""

_WORD: Final = 16
"""Characters of a fingerprint: 64 bits."""

_MOST_KNOWN: Final = 512
"""Most actions whose openings are kept: more than a hand has, but planners add actions for a
moment, each under a new name."""

_WHAT: Final = "the openings"

MARGIN: Final = 0.01
"""Excess of the opening over the object's width before a hand closes, if it opens so far [m]."""

TABLE: Final = 5e-4
"""Error of the table of openings, and of measured positions, at the tips [m]: that of goals."""

JOINTS: Final = 3e-3
"""The same where several actuators press [m]: each yields, and the tips miss the points of the
table. In MuJoCo, an empty Ability Hand's tips meet at 1.4 mm by its table."""

_ASTRIDE: Final = 0.01
"""Step in which the gap between neighbouring fingertips beyond the object's width counts as worse
[m]: about half of a fingertip, by whose edge they may still hold it."""

_LATE: Final = 0.4
"""Largest angle by which an object may turn between the first and the last finger of a side [rad],
as the distance between these over its width, where one motor moves them, so that none can wait. A
SoftHand's pinch of three fingers loses balls of 30 and 40 mm, at 0.6 and 0.5, and holds those of 50
to 70 mm."""

_SQUARE: Final = 0.1
"""Difference of the tips' angles to the object below which actions count as equally good [rad]."""

_STRONGER: Final = 1.5
"""Ratio of forces below which actions count as equally strong, so that other criteria decide."""

_WEAKEST: Final = 1e-3
"""Least force compared [N]; its reciprocal is the largest, since some actuators have no limit."""

_CROWDED: Final = 0.005
"""Depth above which two fingers of one side meet before they reach the object [m]: more than the
overlap of fingers that only lie side by side."""

_TAKES_PART: Final = 0.1
"""Share of the largest lever below which an actuator does not press."""


@dataclass(frozen=True)
class OpeningTable:
    """The opening of one action over its intensity.

    Attributes:
        action: Name of the action.
        elements: Elements of a primitive.
        posture: Fingerprint of the posture, and the path to it, for which the table was made.
        sides: The fingers that oppose each other: those of one side and those of the other; or, if
            they close on a middle from all around, each finger by itself.
        actuators: The actuators that move, in the hand's order.
        intensity: Intensities of the rows ``(k,)``, rising.
        width: Openings ``(k,)`` [m], falling.
        lever: Decrease of the opening per unit of each actuator ``(k, a)`` [m/rad | 1]; by virtual
            work also the effort of each actuator for a force of 1 N between the sides.
        angle: Largest angle between a tip's motion and the line to its opposing tips ``(k,)``
            [rad].
        note: Sentence about peculiarities of the path.
    """

    action: str
    elements: tuple[str, ...]
    posture: str
    sides: tuple[tuple[str, ...], ...]
    actuators: tuple[str, ...]
    intensity: FloatArray
    width: FloatArray
    lever: FloatArray
    angle: FloatArray
    note: str = ""

    @property
    def label(self) -> str:
        """Name of the action for a sentence."""
        return label(self.action, self.elements)

    @property
    def fingers(self) -> tuple[str, ...]:
        """The fingers whose tips oppose each other."""
        return tuple(finger for side in self.sides for finger in side)

    @property
    def around(self) -> bool:
        """Whether the tips close on a centre from more than two sides."""
        return len(self.sides) > 2

    @property
    def widest(self) -> float:
        """The largest opening [m]."""
        return float(self.width[0])

    @property
    def narrowest(self) -> float:
        """The smallest opening [m]."""
        return float(self.width[-1])

    @property
    def error(self) -> float:
        """Error of the opening [m]: of the table, and of measured positions."""
        return TABLE if len(self.actuators) == 1 else JOINTS

    def at(self, intensity: float) -> float:
        """Return the opening at an intensity [m]; beyond the table, that of its end."""
        return float(np.interp(intensity, self.intensity, self.width))

    def intensity_at(self, width: float) -> float:
        """Return the intensity of an opening [m]; beyond the table, that of its end."""
        # np.interp needs rising abscissae, and the width falls.
        return float(np.interp(-width, -self.width, self.intensity))

    def levers_at(self, intensity: float) -> dict[str, float]:
        """Return the levers of the actuators [m/rad | 1] at an intensity."""
        columns = (np.interp(intensity, self.intensity, column) for column in self.lever.T)
        return dict(zip(self.actuators, map(float, columns), strict=True))

    def angle_at(self, intensity: float) -> float:
        """Return the largest angle of the tips' motion to the line between them [rad]."""
        return float(np.interp(intensity, self.intensity, self.angle))

    def strongest(self, hand: Hand, intensity: float) -> float:
        """Return the force that the effort limits allow at an intensity [N], by virtual work."""
        levers = {name: abs(lever) for name, lever in self.levers_at(intensity).items()}
        most = max(levers.values())
        # A lever is the effort for one newton, so that the weakest actuator limits the force.
        forces = [
            hand.actuator(name).effort / lever
            for name, lever in levers.items()
            if lever > _TAKES_PART * most
        ]
        return min(forces, default=0.0)

    def corrected(self, pairs: Iterable[tuple[float, float]]) -> OpeningTable:
        """Return the table corrected by pairs measured on the real hand: intensity, opening [m].

        Interpolates the difference from the model between two measured pairs, and takes that of the
        nearest pair beyond them. Drops rows at which the corrected table would not decrease.

        Raises:
            ActionError: if the corrected table decreases nowhere.
        """
        measured = sorted(pairs)
        if not measured:
            return self
        at = [pair[0] for pair in measured]
        off = [width - self.at(intensity) for intensity, width in measured]
        # The measured intensities become rows of the table, which is then exact there.
        grid = np.unique(np.concatenate([self.intensity, at]))
        grid = grid[(grid >= self.intensity[0]) & (grid <= self.intensity[-1])]
        width = np.interp(grid, self.intensity, self.width) + np.interp(grid, at, off)
        keep = [0]
        for i in range(1, len(grid)):
            # Only in a falling table, each width has one intensity; no width is negative.
            if width[i] < width[keep[-1]] and width[keep[-1]] > 0.0:
                keep.append(i)
        # A single row has only one opening, and no motion.
        if len(keep) < 2:
            raise ActionError(
                f"the openings of {self.label} measured in hand.yaml do not decrease as "
                "its intensity rises; correct or delete them there: each is [intensity, opening in "
                "metres]"
            )
        lever = np.array([np.interp(grid[keep], self.intensity, c) for c in self.lever.T]).T
        return replace(
            self,
            intensity=readonly(grid[keep]),
            width=readonly(np.maximum(width[keep], 0.0)),
            lever=readonly(lever.reshape(len(keep), -1)),
            angle=readonly(np.interp(grid[keep], self.intensity, self.angle)),
        )


@dataclass(frozen=True)
class Meeting:
    """Contacts of the empty hand with itself along the path of one action from rest.

    Attributes:
        action: Name of the action.
        elements: Elements of a primitive.
        posture: Fingerprint of the posture, and the path to it, for which this was found.
        at: Intensity of the first contact of links that an actuator moves against each other, by
            the actuator's name; actuators without a contact are left out.
    """

    action: str
    elements: tuple[str, ...]
    posture: str
    at: Mapping[str, float]


def doubtful(action: Action) -> bool:
    """Return whether links collide at a primitive's posture, or its tips would not hold a ball."""
    if not (isinstance(action, Primitive) and action.evidence):
        return False
    evidence = action.evidence[0]
    opposed = evidence.opposition is None or evidence.opposition.force_closure
    return not (evidence.clear and opposed)


def crowded(action: Action, opening: OpeningTable) -> bool:
    """Return whether fingers of one side press on one another at the action's posture.

    Such fingers meet each other before they meet an object, and touch sensors cannot tell them
    apart.
    """
    if not (isinstance(action, Primitive) and action.evidence):
        return False
    return any(
        depth > _CROWDED and any({one, other} <= set(side) for side in opening.sides)
        for one, other, depth in action.evidence[0].pairs
    )


def spread(
    hand: Hand, action: Action, opening: OpeningTable, intensity: float
) -> tuple[float, float]:
    """Return how neighbouring fingertips of one side lie at an intensity.

    Args:
        hand: The hand.
        action: The action.
        opening: Its opening.
        intensity: Where on its path.

    Returns:
        How far they are apart [m]: a narrower object lies between them, and they close past it. And
        by how much the last one is farther from the other sides than the first [m]: the first one
        meets the object alone, and pushes it aside.
    """
    tips = {finger.name: finger.tip for finger in hand.fingers}
    target = action.waypoints[-1].position
    way = np.array([target[name] for name in hand.actuator_names]) - hand.rest
    sides = [
        [
            tip_pose_and_jacobian(hand, tip, hand.rest + intensity * way)[0][:3, 3]
            for tip in (tips.get(finger) for finger in side)
            if tip is not None
        ]
        for side in opening.sides
    ]
    apart = behind = 0.0
    for side, points in enumerate(sides):
        if len(points) < 2:
            continue
        for k, point in enumerate(points):
            apart = max(apart, _nearest(point, [p for j, p in enumerate(points) if j != k]))
        opposed = [point for other, those in enumerate(sides) if other != side for point in those]
        ways = [_nearest(point, opposed) for point in points]
        behind = max(behind, max(ways) - min(ways))
    return apart, behind


def _nearest(point: FloatArray, others: Iterable[FloatArray]) -> float:
    """Return the distance of the nearest of the points [m]; 0 if there are none."""
    return min((float(np.linalg.norm(point - other)) for other in others), default=0.0)


def meeting(
    action: Action, opening: OpeningTable, actions: Iterable[Action], openings: Openings
) -> float:
    """Return the opening at which the empty hand's fingers meet one another [m].

    It is the opening at the first contact in the action's evidence, or in that of an action with
    the same posture; otherwise the narrowest of the table. A single motor also moves fingers that
    do not take part in the opening; their first contact may stop it.

    Args:
        action: The action.
        opening: Its opening.
        actions: All actions of the hand.
        openings: Where the empty hand meets itself.
    """
    wanted = action.waypoints[-1]
    contacts = [
        each.evidence[0].contact_at
        for each in actions
        if each.evidence and each.waypoints[-1].position == wanted.position
    ]
    own = max((opening.at(at) for at in contacts if at is not None), default=opening.narrowest)
    first = openings.meeting(action) if len(opening.actuators) == 1 else None
    if not first:
        return own
    # At these intensities, links come within the clearance; the fingers still have to close that
    # gap.
    near = max(opening.at(first.get(name, 1.0)) for name in opening.actuators)
    return max(own, near - openings.hand.clearance)


def best_for(
    hand: Hand, actions: Sequence[tuple[Action, OpeningTable]], width: float, margin: float = MARGIN
) -> tuple[Action, OpeningTable]:
    """Return the action that best suits an object of a width, and its opening; the first if equal.

    The criteria, in order: collision-free and in force closure; closes further than the object is
    wide; opens by the whole margin; fingers of one side clear of one another; those of one side not
    astride the object; force in the direction of pressing, in coarse classes; fingers of one side
    that one motor moves arrive together; tips meet the object squarely; few actuators; a pinch
    before the motion of one finger.

    Args:
        hand: The hand.
        actions: Actions with their openings, one at least.
        width: Width of the object [m], inside the range of each opening.
        margin: Excess of the opening over the width before the hand closes [m].
    """

    def quick(pair: tuple[Action, OpeningTable]) -> tuple[bool, ...]:
        action, opening = pair
        # Tips that stay apart press on nothing much narrower; within the error, they may meet.
        apart = opening.narrowest > opening.error
        ends = apart and width <= opening.narrowest + opening.error
        return doubtful(action), ends, width + margin > opening.widest, crowded(action, opening)

    def thorough(pair: tuple[Action, OpeningTable]) -> tuple[float, ...]:
        action, opening = pair
        at = opening.intensity_at(width)
        angle = opening.angle_at(at)
        # A tip that moves at more than a right angle to the line of closing does not press.
        force = opening.strongest(hand, at) * math.cos(min(angle, math.pi / 2.0))
        force = min(max(force, _WEAKEST), 1.0 / _WEAKEST)
        # By the logarithm, so that a class is a ratio of forces, for weak and strong ones alike.
        strength = math.log(force) / math.log(_STRONGER)
        apart, behind = spread(hand, action, opening, at)
        return (
            max(round((apart - width) / _ASTRIDE), 0),
            -round(strength),
            len(opening.actuators) == 1 and behind > _LATE * width,
            round(angle / _SQUARE),
            len(opening.actuators),
            -len(action.fingers),
        )

    least = min(map(quick, actions))
    # The rest takes milliseconds, and decides among these alone.
    return min((pair for pair in actions if quick(pair) == least), key=thorough)


def fingerprint_of(hand: Hand, action: Action) -> str:
    """Return a fingerprint of the path of an action: its posture and the hand's rest posture."""
    digest = hashlib.sha256()
    for name, rest in zip(hand.actuator_names, hand.rest.tolist(), strict=True):
        # With the decimals of the files, so that a posture read back has the same fingerprint.
        digest.update(f"{name} {rest:.9f}\n".encode())
    for posture in action.waypoints:
        for name in posture.involved:
            digest.update(f"{name} {posture.position[name]:.9f}\n".encode())
    return digest.hexdigest()[:_WORD]


def model_of(hand: Hand) -> str:
    """Return a fingerprint of the hand's URDF."""
    return hashlib.sha256(hand.urdf.text.encode()).hexdigest()[:_WORD]


@dataclass(frozen=True)
class Openings:
    """The openings of a hand's actions.

    Attributes:
        hand: The hand.
        tables: The stored tables.
        meetings: Where the empty hand meets itself, of all actions but timed ones.
        made: Whether there is a file of openings.
        outdated: Whether they were made for another model of the hand.
    """

    hand: Hand
    tables: tuple[OpeningTable, ...] = ()
    meetings: tuple[Meeting, ...] = ()
    made: bool = True
    outdated: bool = False

    @cached_property
    def _known(
        self,
    ) -> dict[object, tuple[OpeningTable | None, Mapping[str, float] | None, Action]]:
        return {}

    @cached_property
    def _by_key(self) -> dict[tuple[str, frozenset[str]], OpeningTable]:
        return {_key(table.action, table.elements): table for table in self.tables}

    def of(self, action: Action) -> OpeningTable:
        """Return the opening of an action, corrected by the measurements in hand.yaml.

        Raises:
            ActionError: if it has none that is up to date; the message says what to do.
        """
        return self.find(action) or self._find(action)

    def find(self, action: Action) -> OpeningTable | None:
        """Return the opening of an action; ``None``: it has none, and `of` says why."""
        return self._looked_up(action)[0]

    def known(self, actions: Iterable[Action]) -> list[tuple[Action, OpeningTable]]:
        """Return the actions that have an opening, each with its opening.

        Raises:
            ActionError: if none has one; the message says why.
        """
        every = list(actions)
        found = [(each, opening) for each in every if (opening := self.find(each)) is not None]
        if not found:
            # Tables that are missing or outdated give every action the same reason.
            for action in every:
                self.of(action)
            name = self.hand.name
            raise ActionError(f"'{name}' has no actions; 'rtee extract {name} --save' finds them")
        return found

    def meeting(self, action: Action) -> Mapping[str, float] | None:
        """Return the contacts of the empty hand with itself on an action's path; see `Meeting.at`.

        ``None``: not known, or not for its present posture and model.
        """
        return self._looked_up(action)[1]

    def _looked_up(
        self, action: Action
    ) -> tuple[OpeningTable | None, Mapping[str, float] | None, Action]:
        """Return an action's opening and its contacts of the empty hand, cached."""
        # By name: the action that opens the hand, for one, is a new object for every goal.
        name = action.name, action.elements
        known = self._known.get(name)
        if known is None or known[2] is not action:
            # Cleared as a whole, which several threads may do at once; entries are soon found
            # again.
            if len(self._known) >= _MOST_KNOWN:
                self._known.clear()
            opening = None
            with suppress(ActionError):
                opening = self._find(action)
            known = self._known[name] = opening, self._meeting(action), action
        return known

    def _find(self, action: Action) -> OpeningTable:
        name = label(action.name, action.elements)
        if isinstance(action, Timed):
            raise ActionError(f"{name} is a timed action, which has no opening")
        remedy = f"`rtee openings {self.hand.name} --save` makes the tables"
        if not self.made:
            raise ActionError(f"the openings of '{self.hand.name}' are not known; {remedy}")
        table = self._by_key.get(_key(action.name, action.elements))
        if self.outdated:
            raise ActionError(
                f"the openings of '{self.hand.name}' were made for another version of its model; "
                f"{remedy}"
            )
        if table is None:
            raise ActionError(
                f"{name} has no opening: no two fingertips oppose each other on its path, or the "
                f"action is newer than the tables; {remedy}"
            )
        if table.posture != fingerprint_of(self.hand, action):
            raise ActionError(f"the opening of {name} was made for another posture; {remedy}")
        return table.corrected(self.measured(action))

    def _meeting(self, action: Action) -> Mapping[str, float] | None:
        wanted = _key(action.name, action.elements)
        for each in () if self.outdated else self.meetings:
            if _key(each.action, each.elements) == wanted:
                return each.at if each.posture == fingerprint_of(self.hand, action) else None
        return None

    def measured(self, action: Action) -> tuple[tuple[float, float], ...]:
        """Return the measured pairs of intensity and opening [m] of an action in hand.yaml."""
        wanted = _key(action.name, action.elements)
        for words, pairs in self.hand.openings.items():
            name, *elements = words.split()
            if _key(name, tuple(elements)) == wanted:
                return pairs
        return ()


def _key(action: str, elements: tuple[str, ...]) -> tuple[str, frozenset[str]]:
    return normalise(action), frozenset(elements)


# --- the file --------------------------------------------------------------------------------


def to_document(openings: Openings) -> dict[str, Any]:
    """Return openings as plain data; equal openings give equal data."""
    entries = [
        {
            "action": table.action,
            "elements": list(table.elements),
            "posture": table.posture,
            "sides": [list(side) for side in table.sides],
            **({"note": table.note} if table.note else {}),
            "actuators": list(table.actuators),
            "intensity": _rounded(table.intensity),
            "opening": _rounded(table.width),
            "lever": [_rounded(row) for row in table.lever],
            "angle": [round(float(a), 3) for a in table.angle],
        }
        for table in openings.tables
    ]
    meetings = [
        {
            "action": each.action,
            "elements": list(each.elements),
            "posture": each.posture,
            **({"at": dict(each.at)} if each.at else {}),
        }
        for each in openings.meetings
    ]
    model = model_of(openings.hand)
    return {"format": FORMAT, "model": model, "openings": entries, "meetings": meetings}


def _rounded(values: FloatArray) -> list[float]:
    """Return numbers rounded to 1 µm or 1 µm/rad, finer than any measurement."""
    return [round(float(value), 6) for value in values]


def write_openings(folder: Path, openings: Openings) -> Path:
    """Write openings into a hand's folder and return the file.

    Raises:
        ConfigError: if the file cannot be written.
    """
    path = folder / FILE_NAME
    made = f"Openings of the actions, made by `rtee openings {openings.hand.name} --save`."
    write_atomically(path, emit(to_document(openings), (made,)))
    return path


def read_openings(folder: Path, hand: Hand) -> Openings:
    """Return the tables stored in a hand's folder.

    Raises:
        ConfigError: if the file is invalid.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return Openings(hand, made=False)
    text = read_text(path, _WHAT)
    data = parse_yaml(text, path, _WHAT).data
    try:
        if data["format"] != FORMAT:
            raise ConfigError(
                f"has format {data['format']}, not {FORMAT}; "
                f"`rtee openings {hand.name} --save` makes it again",
                path=path,
            )
        tables = tuple(_table(entry) for entry in data["openings"])
        meetings = tuple(_meeting(entry) for entry in data.get("meetings", ()))
        return Openings(hand, tables, meetings, outdated=data["model"] != model_of(hand))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"is not a valid file of openings ({error}); `rtee openings {hand.name} --save` makes "
            "them"
            " again",
            path=path,
        ) from error


def _table(entry: Mapping[str, Any]) -> OpeningTable:
    """Return a table from plain data; raise `ValueError` and the like if it is invalid."""
    intensity, width = readonly(entry["intensity"]), readonly(entry["opening"])
    lever, angle = readonly(entry["lever"]), readonly(entry["angle"])
    actuators = tuple(str(name) for name in entry["actuators"])
    shaped = (
        len(intensity) >= 2
        and width.shape == angle.shape == intensity.shape
        and lever.shape == (len(intensity), len(actuators))
    )
    if not shaped or not all(map(math.isfinite, (*intensity, *width, *lever.ravel(), *angle))):
        raise ValueError(f"the columns of '{entry['action']}' differ in length")
    # Interpolation silently gives wrong values unless both are monotonic.
    if not (np.all(np.diff(intensity) > 0.0) and np.all(np.diff(width) < 0.0)):
        raise ValueError(f"the opening of '{entry['action']}' does not decrease")
    return OpeningTable(
        str(entry["action"]),
        tuple(str(name) for name in entry["elements"]),
        str(entry["posture"]),
        tuple(tuple(str(name) for name in side) for side in entry["sides"]),
        actuators,
        intensity,
        width,
        lever,
        angle,
        str(entry.get("note", "")),
    )


def _meeting(entry: Mapping[str, Any]) -> Meeting:
    """Return a meeting from plain data; raise `ValueError` and the like if it is invalid."""
    return Meeting(
        str(entry["action"]),
        tuple(str(name) for name in entry["elements"]),
        str(entry["posture"]),
        {str(name): float(at) for name, at in entry.get("at", {}).items()},
    )
