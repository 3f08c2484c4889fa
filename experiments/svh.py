"""SCHUNK SVH, pure kinematics: every primitive, the composed action of Fig. 4, and schunkGrasp."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from experiments.common import Outcome, main, recording, strip
from experiments.kinematic import KinematicPlay
from rtee.actions.build import compose
from rtee.actions.library import ActionLibrary
from rtee.actions.types import Action, ActionReference, Primitive, PrimitiveKind
from rtee.extract.scene import Scene
from rtee.hand.model import Hand
from rtee.log import Recording, read
from rtee.loop.planning import OPEN
from rtee.sample import FloatArray
from rtee.trials.bench import bench
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Named

TOLERANCE = 0.01
"""How far from its posture an action may end [rad]."""

NEAR = 0.5
"""Distance of fingertips that counts as touching [mm]: `TOLERANCE` at the end of a finger."""

FIGURE_4 = "Fig_4"
PARTS = (("Trig", ("thumb",)), ("TipFlex", ("index",)), ("TipFlex", ("middle",)))
"""What the paper composes in Fig. 4; schunkGrasp, its Code 5, is another action."""

SHOWN = (
    ("Trig", ("index",)),
    ("TipFlex", ("index",)),
    ("FingFlex", ("index",)),
    ("PinchTight", ("thumb", "index")),
    ("PinchLoose", ("index", "middle")),
    ("MultiPinchTight_3", ("thumb", "index", "middle")),
    ("SingleJointMultipleTips_3", ("left_hand_Finger_Spread",)),
)
"""What is drawn of Fig. 2, besides rest: one primitive of each kind."""

PINCHES = (
    PrimitiveKind.PINCH_TIGHT,
    PrimitiveKind.PINCH_LOOSE,
    PrimitiveKind.MULTI_PINCH_TIGHT,
)

SIZE = (330, 360)


def label(name: str, elements: Sequence[str]) -> str:
    """Return a primitive as it is written under a picture."""
    return " ".join((name, *(element.removeprefix("left_hand_") for element in elements)))


def figure_4(hand: Hand, library: ActionLibrary) -> Action:
    """Return the composed action of Fig. 4; no two of its parts set the same actuator."""
    parts = [ActionReference(name, elements) for name, elements in PARTS]
    return compose(hand, library.find, FIGURE_4, parts, independent=True)


def run(folder: Path, *, pictures: bool = True, most: int | None = None) -> Outcome:
    """Execute primitives and composed actions, back to rest after each, and look at the recording.

    Args:
        folder: Where recording, plot and pictures go.
        pictures: Draw the pictures.
        most: Execute only so many primitives.
    """
    ready = bench("schunk_svh")
    hand = ready.hand
    outcome = Outcome(
        f"every action ends within {TOLERANCE:g} rad of its posture, and the hand returns to rest "
        f"after it; the fingertips of tight pinches touch, those of loose ones do not"
    )
    library = ActionLibrary.load(hand, ready.folder / "actions")
    library.add(figure_4(hand, library))
    primitives = [action for action in library if isinstance(action, Primitive)][:most]
    actions = [*primitives, library.find(FIGURE_4), library.find("schunkGrasp")]
    with recording(ready, folder, outcome) as recorder:
        play = KinematicPlay(hand, ready.settings.period)
        headless = HeadlessHand(hand, library, ready.settings, play, [recorder])
        for number, action in enumerate(actions):
            headless.do(
                Goal(Named(action.name, action.elements), timeout=20.0, goal_id=f"{number}")
            )
            headless.do(Goal(Named(OPEN), timeout=20.0, goal_id=f"{OPEN} {number}"))
    recorded = read(next(path for path in outcome.files if path.suffix == ".mcap"))
    ends = dict(_ends(recorded, hand))
    _check(hand, actions, ends, outcome)
    if pictures:
        _draw(hand, actions, ends, folder, outcome)
    return outcome


def _ends(recorded: Recording, hand: Hand) -> Iterator[tuple[str, FloatArray]]:
    """Return where the hand was when its goals ended, by their identifiers, as recorded."""
    states = recorded.actuator_states
    columns = [states.index(name) for name in hand.actuator_names]
    for span in recorded.spans:
        row = int(np.searchsorted(states.t, span.end, side="right")) - 1
        if span.outcome == "reached":
            yield span.goal_id, states.position[row, columns]


def _check(
    hand: Hand, actions: Sequence[Action], ends: dict[str, FloatArray], outcome: Outcome
) -> None:
    errors: dict[str, list[float]] = {}
    apart: dict[PrimitiveKind, list[float]] = {}
    scene = Scene(hand)
    for number, action in enumerate(actions):
        kind = action.kind if isinstance(action, Primitive) else action.name
        at, rest = ends.get(f"{number}"), ends.get(f"{OPEN} {number}")
        wanted = np.array([action.posture.position[name] for name in hand.actuator_names])
        errors.setdefault(str(kind), []).append(_off(at, wanted))
        errors.setdefault("back at rest", []).append(_off(rest, hand.rest))
        if isinstance(action, Primitive) and action.kind in PINCHES and at is not None:
            scene.place(at)
            tips = [hand.finger(finger).tip or "" for finger in action.elements]
            pairs = [scene.pair(*names) for names in combinations(tips, 2)]
            found = sorted(scene.distance(pair) for pair in pairs if pair is not None)
            # N fingertips that touch are connected by N - 1 pairs.
            apart.setdefault(action.kind, []).append(1e3 * found[len(tips) - 2])
    for name, values in errors.items():
        what = f"{name}, {len(values)} times: largest error"
        measured = f"{max(values):.4f} rad"
        outcome.check(max(values) <= TOLERANCE, what, measured, f"<= {TOLERANCE:g} rad")
    for kind, values in apart.items():
        if kind is PrimitiveKind.PINCH_LOOSE:
            outcome.above(f"{kind}: least distance of fingertips", min(values), 0.0, "mm")
        else:
            outcome.below(f"{kind}: largest distance of fingertips", max(values), NEAR, "mm")


def _off(at: FloatArray | None, wanted: FloatArray) -> float:
    return np.inf if at is None else float(np.abs(at - wanted).max())


def _draw(
    hand: Hand,
    actions: Sequence[Action],
    ends: dict[str, FloatArray],
    folder: Path,
    outcome: Outcome,
) -> None:
    """Draw the recorded states: one primitive of each kind, and the composed actions."""
    from rtee.render.hand import HandRenderer

    at = {
        (action.name, action.elements): ends[f"{number}"]
        for number, action in enumerate(actions)
        if f"{number}" in ends
    }
    rest = ends[f"{OPEN} {len(actions) - 1}"]
    renderer = HandRenderer(hand, SIZE, list(at.values()))
    figures = {
        "schunk_svh.png": [("rest", rest)] + [(label(*use), at[use]) for use in SHOWN if use in at],
        "schunk_svh_composed.png": [(label(*use), at[use]) for use in PARTS if use in at]
        + [
            ("Fig. 4: the three together", at[FIGURE_4, ()]),
            ("schunkGrasp", at["schunkGrasp", ()]),
        ],
    }
    for name, shown in figures.items():
        stills = [(title, renderer.picture(u, ghost=True)) for title, u in shown]
        strip(folder / name, stills, outcome, columns=4 if len(stills) > 5 else None)


if __name__ == "__main__":
    main(run, "svh")
