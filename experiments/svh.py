"""SCHUNK SVH, pure kinematics: every primitive, and the composed schunkGrasp."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.common import Outcome, main, recording, strip
from rtee.actions.types import Primitive, PrimitiveKind
from rtee.trials.headless import HeadlessHand
from rtee.trials.kinematic import KinematicPlay
from rtee.trials.sweep import bench
from rtee.types import Goal

TOLERANCE = 0.01
SHOWN = (
    PrimitiveKind.TRIG,
    PrimitiveKind.TIP_FLEX,
    PrimitiveKind.FING_FLEX,
    PrimitiveKind.PINCH_TIGHT,
    PrimitiveKind.PINCH_LOOSE,
    PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS,
)


def run(folder: Path, *, pictures: bool = True, most: int | None = None) -> Outcome:
    """Execute all primitives one after the other, or the first ``most``, then schunkGrasp."""
    ready = bench("schunk_svh")
    hand = ready.hand
    outcome = Outcome(f"every action ends within {TOLERANCE:g} rad of its posture")
    primitives = [action for action in ready.library if isinstance(action, Primitive)]
    actions = [*primitives[:most], ready.library.find("schunkGrasp")]
    with recording(ready, folder, outcome) as recorder:
        play = KinematicPlay(hand, ready.settings.period)
        headless = HeadlessHand(hand, ready.library, ready.settings, play, [recorder])
        for number, action in enumerate(actions):
            elements = action.elements if isinstance(action, Primitive) else ()
            goal = Goal(action.name, elements, goal_id=f"{number}", timeout=20.0)
            result = headless.do(goal)
            wanted = np.array([action.posture.position[n] for n in action.posture.involved])
            there = np.array([result.position[n] for n in action.posture.involved])
            error = float(np.abs(wanted - there).max())
            name = " ".join((action.name, *elements))
            seen = result.reached and error <= TOLERANCE
            outcome.check(seen, name, f"{error:.4f} rad off", f"<= {TOLERANCE:g} rad")
    if pictures:
        from rtee.render.hand import HandRenderer

        first = {p.kind: p for p in reversed(primitives)}
        shown = [first[kind] for kind in SHOWN if kind in first]
        shown.append(ready.library.find("schunkGrasp"))
        postures = [np.array([a.posture.position[n] for n in hand.actuator_names]) for a in shown]
        renderer = HandRenderer(hand, (330, 360), postures)
        stills = [
            (" ".join((a.name, *getattr(a, "elements", ()))), renderer.picture(u, ghost=True))
            for a, u in zip(shown, postures, strict=True)
        ]
        strip(folder / "schunk_svh.png", stills, outcome)
    return outcome


if __name__ == "__main__":
    main(run, "svh")
