"""HERI II uses a drill in the hand: GRASP3f holds it, TrigOn presses its trigger, TrigOff ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.common import Outcome, main, recording, strip
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.log.recording import outcome_of
from rtee.trials.headless import HeadlessHand
from rtee.trials.sweep import bench
from rtee.types import Goal

PRESSED, LET_GO = 0.005, 0.001
TURNED = 30.0
MOMENTS = {0.0: "start", 1.6: "GRASP3f", 4.0: "TrigOn", 5.9: "TrigOff"}


def run(folder: Path, *, pictures: bool = True) -> Outcome:
    """Present the drill, run the timed action, and watch the trigger."""
    ready = bench("heri_ii")
    outcome = Outcome(
        f"the trigger is pressed by more than {PRESSED * 1e3:g} mm and let go again to less than "
        f"{LET_GO * 1e3:g} mm, and the drill stays in the hand under its "
        f"own weight, turned by less than {TURNED:g} degrees"
    )
    place = np.eye(4)
    # The handle lies across the fingers, its trigger before finger_1.
    place[:3, :3] = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    place[:3, 3] = (0.016, -0.024, 0.165)
    options = SimOptions(object="drill", object_mass=0.4, carrier="arm")
    names = ready.hand.actuator_names
    simulation = make_simulation(ready.hand, options, names, ready.settings.period, place=place)
    around = simulation.surroundings
    trigger: list[float] = []
    stills: list[tuple[str, bytes]] = []
    with recording(ready, folder, outcome) as recorder:
        headless = HeadlessHand(ready.hand, ready.library, ready.settings, simulation, [recorder])
        headless.before_tick(lambda _: trigger.append(around.trigger))
        if pictures:
            from rtee.trials.pictures import SimulationRenderer

            camera = SimulationRenderer(simulation, ready.hand, np.zeros((1, 3)))
            due = dict(MOMENTS)

            def look(time: float) -> None:
                reached = [moment for moment in due if time >= moment]
                stills.extend((due.pop(moment), camera.picture()) for moment in reached)

            headless.before_tick(look)
        result = headless.do(Goal("drill", goal_id="drill"))
        around.remove_support()
        before = around.position_in_hand
        pressed = max(trigger)
        headless.wait(2.0)
    moved = float(np.linalg.norm(around.position_in_hand - before))
    outcome.check(result.succeeded, "the timed action is completed", outcome_of(result))
    outcome.above("the trigger is pressed", 1e3 * pressed, 1e3 * PRESSED, "mm")
    outcome.below("the trigger comes back", 1e3 * trigger[-1], 1e3 * LET_GO, "mm")
    touched = len(around.touching())
    outcome.check(bool(touched), "links that touch the drill in the end", f"{touched}", "> 0")
    outcome.below("the drill moves in the hand in 2 s", 1e3 * moved, 20, "mm")
    turned = np.degrees(around.turned_in_hand(place))
    outcome.below("the drill turns since it was given", turned, TURNED, "degrees")
    if stills:
        strip(folder / "heri_ii_drill.png", stills, outcome)
    return outcome


if __name__ == "__main__":
    main(run, "drill")
