"""The same object picked and placed by a 2F-85, a qb SoftHand and a 3FG15, by primitives only.

First in dynamics, then each with its real driver against its device emulated on the wire.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import anyio
import numpy as np

from experiments.common import Outcome, main, plot_of, recording, strip
from experiments.wires import on_the_wire, wired
from rtee.log import read
from rtee.log.recording import outcome_of
from rtee.loop.plan import OPEN
from rtee.trials.pictures import Stills
from rtee.trials.sweep import bench
from rtee.trials.transfer import OFF, TILT, Transfer, run_transfer
from rtee.types import Goal

RADIUS = 0.025
OBJECT = f"cylinder:{RADIUS:g}x0.14"
WIDTH = f"{2e3 * RADIUS:g}mm:500"
HOLD = 2.0


@dataclass(frozen=True, slots=True)
class Gripper:
    """One of the three devices.

    Attributes:
        name: The hand.
        action: The primitive that grasps.
        actuator: Its element.
        reach: From where the hand comes.
        wired: The object between the fingers of its emulated device: its width and stiffness, or
            where on the way it is met.
    """

    name: str
    action: str
    actuator: str
    reach: Literal["down", "level"]
    wired: str


GRIPPERS = (
    Gripper("robotiq_2f_85", "SingleJointMultipleTips_2", "finger_joint", "level", WIDTH),
    Gripper("qb_softhand", "SingleJointMultipleTips_5", "qbhand_synergy_joint", "level", "0.6"),
    Gripper(
        "onrobot_3fg15",
        "SingleJointMultipleTips_3",
        "robot_onrobot_3fg15_finger_joint1",
        "down",
        WIDTH,
    ),
)


def run(folder: Path, *, pictures: bool = True) -> Outcome:
    """Pick and place the object with each device in dynamics; grasp and let go on the wires."""
    outcome = Outcome(
        f"in dynamics, each device lifts the object, holds it for {HOLD:g} s, carries it, and "
        f"leaves it standing within {OFF * 1e2:g} cm of its target, upright within "
        f"{np.degrees(TILT):g} degrees; on its emulated wire, each grasps it, holds it for "
        f"{HOLD:g} s and lets go"
    )
    for gripper in GRIPPERS:
        in_dynamics(gripper, folder, outcome, pictures=pictures)
    on_wires(GRIPPERS, folder / "wires", outcome)
    return outcome


def in_dynamics(gripper: Gripper, folder: Path, outcome: Outcome, *, pictures: bool = True) -> None:
    """Pick the object up, carry it, set it down, let go and retreat, in simulation."""
    ready = bench(gripper.name)
    transfer = Transfer(gripper.action, (gripper.actuator,), OBJECT, reach=gripper.reach)
    stills = Stills.of_transfer(ready.hand) if pictures else None
    # Once to find the place that works, and again from there, to record nothing else.
    first = run_transfer(ready.hand, ready.library, ready.settings, transfer)
    with recording(ready, folder, outcome) as recorder:
        result = run_transfer(
            ready.hand,
            ready.library,
            ready.settings,
            transfer,
            observers=[recorder],
            watch=stills,
            skip=max(0, first.places - 1),
        )
    said = result.reason or (
        f"{result.off * 1e3:.1f} mm from its target, leaning by {np.degrees(result.tilt):.1f} "
        f"degrees, slipped by {result.slip * 1e3:.1f} mm in the hand"
    )
    outcome.check(result.placed, f"{gripper.name}: {said}")
    if stills is not None and stills.taken:
        strip(folder / f"{gripper.name}_pick_and_place.png", stills.taken, outcome, columns=4)


def on_wires(grippers: Sequence[Gripper], folder: Path, outcome: Outcome) -> None:
    """Grasp, hold and let go with the real drivers, all devices at the same time."""
    before = set(folder.glob("*.mcap"))

    async def together() -> None:
        async with anyio.create_task_group() as group:
            for gripper in grippers:
                group.start_soon(_on_wire, gripper, folder, outcome)

    anyio.run(together)
    for path in sorted(set(folder.glob("*.mcap")) - before):
        spans = [(span.name.split()[0], span.outcome) for span in read(path).spans]
        outcome.check(
            [name for name, _ in spans[-2:]] == [_action_of(grippers, path), OPEN],
            f"{path.name}: {', '.join(' '.join(span) for span in spans)}",
        )
        outcome.files += [path, plot_of(path)]


def _action_of(grippers: Sequence[Gripper], path: Path) -> str:
    return next(g.action for g in grippers if path.name.startswith(g.name))


async def _on_wire(gripper: Gripper, folder: Path, outcome: Outcome) -> None:
    async with on_the_wire(wired(gripper.name, thing=gripper.wired), folder) as hand:
        grasp = await hand.do(Goal(gripper.action, (gripper.actuator,), goal_id="grasp"))
        at = hand.loop.snapshot().position
        await anyio.sleep(HOLD)
        moved = float(np.abs(hand.loop.snapshot().position - at).max())
        kept = "grasp_lost" not in hand.events
        opened = await hand.do(Goal(OPEN, goal_id="open"))
    outcome.check(
        grasp.grasped and kept and moved < 0.02 and opened.reached,
        f"{gripper.name} on its wire: {outcome_of(grasp)} at {float(at[0]):.3f}, moved by "
        f"{moved:.4f} in {HOLD:g} s; open: {outcome_of(opened)}",
    )


if __name__ == "__main__":
    main(run, "same_object")
