"""Measure depth, creep and cost of simulated contacts, with the simulation's settings and others.

Run: ``python benchmarks/contacts.py [--rounds N] [--hand NAME]``; prints Markdown. With the name of
a hand, its contacts with all standard objects; without, those of all hands, after the settings.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from common import Table, command_line

from rtee.actions.types import Action
from rtee.drivers.mujoco import contacts
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import RteeError
from rtee.hand.catalog import hand_names
from rtee.trials.bench import TrialBench, bench
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.trials.result import OBJECTS, mass_of
from rtee.types import Goal, Named

GRASPS = (
    ("robotiq_2f_85", "sphere:0.03"),
    ("robotiq_2f_85", "box:0.04x0.04x0.1"),
    ("robotiq_3f", "cylinder:0.02x0.12"),
    ("heri_ii", "sphere:0.03"),
    ("heri_ii", "box:0.04x0.04x0.1"),
    ("schunk_svh", "sphere:0.03"),
)
"""Grasps that hold with every setting."""

HELD = 1.0
"""Time for which an object is watched after its support was removed [s]: slips show within it."""

CLOSING = 0.3
"""An object that moves faster than this was lost, and is left out of the study [m/s]."""


@dataclass(frozen=True)
class Settings:
    """Settings of contacts; the defaults are those of the simulation."""

    time_step: float | None = None
    time_constant: float = contacts.TIME_CONSTANT
    impedance: tuple[float, float, float, float, float] = contacts.IMPEDANCE
    skin: float = contacts.SKIN
    elliptic: bool = True
    impratio: float = contacts.IMPRATIO
    noslip: int = 0

    def apply(self, model: mujoco.MjModel) -> None:
        """Apply the settings to a compiled model."""
        model.geom_solref[:] = self.time_constant, 1.0
        model.geom_solimp[:] = self.impedance
        model.geom_margin[model.geom_margin > 0.0] = self.skin
        cones = mujoco.mjtCone
        model.opt.cone = cones.mjCONE_ELLIPTIC if self.elliptic else cones.mjCONE_PYRAMIDAL
        model.opt.impratio = self.impratio
        model.opt.noslip_iterations = self.noslip


CHOSEN = Settings()
OTHERS = {
    "as chosen": CHOSEN,
    "MuJoCo's defaults": Settings(0.002, 0.02, (0.9, 0.95, 0.001, 0.5, 2.0), 0.0, False, 1.0),
    "before: defaults, elliptic, impratio 10": Settings(
        0.002, 0.02, (0.9, 0.95, 0.001, 0.5, 2.0), 0.0, True, 10.0
    ),
    "time constant 20 ms": replace(CHOSEN, time_constant=0.02),
    "time constant 8 ms": replace(CHOSEN, time_constant=0.008),
    "impedance 0.9 to 0.95": replace(CHOSEN, impedance=(0.9, 0.95, 0.001, 0.5, 2.0)),
    "impedance 0.99 to 0.999 in 0.5 mm": replace(CHOSEN, impedance=(0.99, 0.999, 5e-4, 0.5, 2.0)),
    "without skin": replace(CHOSEN, skin=0.0),
    "pyramidal cones": replace(CHOSEN, elliptic=False),
    "impratio 1": replace(CHOSEN, impratio=1.0),
    "impratio 10": replace(CHOSEN, impratio=10.0),
    "3 noslip iterations": replace(CHOSEN, noslip=3),
    "time step 1 ms, time constant 2 ms": replace(CHOSEN, time_step=0.001, time_constant=0.002),
    "time step 4 ms, time constant 8 ms": replace(CHOSEN, time_step=0.004, time_constant=0.008),
}


@dataclass
class Seen:
    """The measurements of one grasp.

    Attributes:
        depth: Deepest contact of the object with the hand [m].
        force: Normal force there [N].
        creep: Speed of the object in the hand while it was held [m/s].
        energy: Mean kinetic energy of the object while it was held at rest [J].
        cost: Processor time per simulated second [s].
        held: Whether the object was still in the hand at the end.
    """

    depth: float
    force: float
    creep: float
    energy: float
    cost: float
    held: bool


def grasp_of(ready: TrialBench) -> Action:
    """Return the action with which a hand grasps."""
    return next(
        action
        for name in ("Grasp", "PinchTight", "")
        for action in ready.library
        if action.name == name or not name
    )


class Watch:
    """Watches the contacts of the object."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._object = simulation.model.body("object").id
        self._force = np.zeros(6)
        self.deepest = (0.0, 0.0)
        self.energies: list[float] = []

    def __call__(self, _: float) -> None:
        model, data = self._simulation.model, self._simulation.data
        if self._simulation.surroundings.speed > CLOSING:
            return
        for number, contact in enumerate(data.contact):
            roots = model.body_rootid[model.geom_bodyid[[contact.geom1, contact.geom2]]]
            # Contacts of the hand with itself do not count.
            if -contact.dist > self.deepest[0] and (roots == self._object).sum() == 1:
                mujoco.mj_contactForce(model, data, number, self._force)
                self.deepest = (-float(contact.dist), float(self._force[0]))
        dof = int(model.joint("object").dofadr[0])
        velocity = data.qvel[dof : dof + 6]
        mass = model.body_subtreemass[self._object]
        # Translation only: an object that chatters between fingers moves, whether it turns or not.
        self.energies.append(0.5 * float(mass * velocity[:3] @ velocity[:3]))


def grasp(name: str, shape: str, settings: Settings) -> Seen | None:
    """Grasp an object and hold it; ``None`` if it fits nowhere."""
    ready = bench(name)
    hand, action = ready.hand, grasp_of(ready)
    options = SimOptions(
        object=shape, object_mass=mass_of(shape), carrier="arm", timestep=settings.time_step
    )
    simulation = make_simulation(hand, options, hand.actuator_names, ready.settings.period)
    settings.apply(simulation.model)
    places = Places(simulation, hand, action).find(1)
    if not places:
        return None
    around = simulation.surroundings
    simulation.reset()
    around.place(around.base_pose @ places[0].pose)
    headless = HeadlessHand(hand, ready.library, ready.settings, simulation)
    watch = Watch(simulation)
    headless.before_tick(watch)
    headless.do(Goal(Named(action.name, action.elements)))
    # The fingers come to rest before the object has to be held.
    headless.wait(0.4)
    around.remove_support()
    # The object settles in the hand; that is not creep.
    headless.wait(0.4)
    start = around.position_in_hand
    watch.energies.clear()
    began = time.process_time()
    headless.wait(HELD)
    # Processor time, not time on the clock: other programs run beside.
    cost = (time.process_time() - began) / HELD
    creep = float(np.linalg.norm(around.position_in_hand - start)) / HELD
    energy = float(np.mean(watch.energies)) if watch.energies else 0.0
    return Seen(*watch.deepest, creep, energy, cost, bool(around.touching()))


def compare(rounds: int) -> None:
    """Print the measurements of some grasps with all settings."""
    table = Table(
        "setting", "depth [mm]", "creep [mm/s]", "energy [µJ]", "processor [ms/s]", "held"
    )
    for words, settings in OTHERS.items():
        seen = [grasp(*pair, settings) for _ in range(rounds) for pair in GRASPS]
        found = [one for one in seen if one is not None]
        kept = [one for one in found if one.held]
        depth = max(one.depth for one in found) * 1e3
        creep = float(np.median([one.creep for one in kept])) * 1e3 if kept else np.nan
        energy = float(np.median([one.energy for one in kept])) * 1e6 if kept else np.nan
        cost = float(np.median([one.cost for one in found])) * 1e3
        table.row(
            words, f"{depth:.2f}", f"{creep:.3f}", f"{energy:.3f}", f"{cost:.0f}",
            f"{len(kept)} of {len(found)}",
        )  # fmt: skip


def every_object(names: list[str]) -> None:
    """Print the deepest contact of hands with all standard objects."""
    table = Table("hand", "objects", "deepest [mm]", "there [N]", "of")
    for name in names:
        found: list[tuple[Seen, str]] = []
        for shape in OBJECTS:
            try:
                seen = grasp(name, shape, CHOSEN)
            except RteeError as error:
                print(f"{name} with {shape}: {error}")
                continue
            if seen is not None:
                found.append((seen, shape))
        deepest, shape = max(found, key=lambda pair: pair[0].depth)
        table.row(name, len(found), f"{deepest.depth * 1e3:.2f}", f"{deepest.force:.0f}", shape)


def main() -> None:
    """Print the figures as Markdown."""
    arguments = command_line(__doc__, rounds=1, hand=str).parse_args()
    if arguments.hand is None:
        compare(arguments.rounds)
        print()
    every_object([arguments.hand] if arguments.hand else list(hand_names()))


if __name__ == "__main__":
    main()
