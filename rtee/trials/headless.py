"""A hand in simulation without a clock: the loop's controller, as fast as the machine allows."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.commands import Command, CommandRecord, SetActive
from rtee.errors import LoopError
from rtee.hand.model import Hand
from rtee.log.layout import RUN_BEGINS
from rtee.loop.controller import Controller
from rtee.loop.measured import TIP_FORCE, Measured, tip_forces
from rtee.loop.observer import Observer
from rtee.loop.plan import Plan
from rtee.loop.planning import make_plan
from rtee.loop.settings import LoopSettings
from rtee.objects.description import ObjectDescription
from rtee.sample import ActuatorState, BoolArray, FloatArray, TickRecord, measured_arrays
from rtee.types import Event, Feedback, Goal, Result

_PATIENCE = 120.0  # longest simulated time of a goal [s]: the slowest action takes about ten


class Plant(Protocol):
    """The backend that moves the hand: the simulation, or a kinematic stand-in."""

    object_description: ObjectDescription | None
    """Appearance of the object, if there is one."""

    @property
    def position(self) -> FloatArray:
        """Actuator positions ``(n,)`` [rad | m]."""

    @property
    def velocity(self) -> FloatArray:
        """Actuator velocities ``(n,)`` [rad/s | m/s]."""

    @property
    def effort(self) -> FloatArray:
        """Actuator efforts ``(n,)`` [N·m | N]."""

    @property
    def contact_forces(self) -> FloatArray:
        """Contact force on each finger ``(fingers,)`` [N]."""

    @property
    def scene_channels(self) -> Mapping[str, FloatArray]:
        """Visible objects besides the hand, as channels; see `rtee.objects.description`."""

    def advance(self) -> None:
        """Go on by one period."""

    def command(self, position: FloatArray, max_effort: FloatArray, mask: BoolArray) -> None:
        """Set references and effort limits of the masked actuators."""


P = TypeVar("P", bound=Plant)


class HeadlessHand(Generic[P]):
    """Runs goals on a simulated hand at simulated time.

    The controller is the one of the loop and the records are those of the loop, so a recording made
    here is equal, bit for bit, whenever the same goals run from the same start.

    Attributes:
        hand: The hand.
        simulation: The simulated hand and its surroundings.
        library: Its actions.
        observers: They get every tick and event.
        controller: The loop's pure core.
        time: Simulated time of the next tick, since the start [s].
        ticks: Ticks since the start; as in the loop, the first one has the number 0.
        results: How the goals ended, by their identifiers.
        events: The events since the start.
        forces: Contact force on each finger in the last tick ``(fingers,)`` [N].
    """

    def __init__(
        self,
        hand: Hand,
        library: ActionLibrary,
        settings: LoopSettings,
        simulation: P,
        observers: Sequence[Observer] = (),
        *,
        ticks: int = 0,
    ) -> None:
        """Start with every actuator active and standing where it is.

        Args:
            hand: The hand.
            library: Its actions.
            settings: The loop's settings; their period must be the simulation's.
            simulation: The simulated hand.
            observers: They get every tick and event, as in the loop.
            ticks: How many ticks went before, so that one recording may hold several runs.
        """
        self.hand = hand
        self.simulation = simulation
        self.controller = Controller(hand, settings)
        self.time = ticks * settings.period
        # The clock is read once, so that stamps are as regular as the simulated time.
        self._wall_ns = time.time_ns() - round(self.time * 1e9)
        self.library = library
        self._settings = settings
        self.observers = tuple(observers)
        self.ticks = ticks
        self.results: dict[str, Result] = {}
        self.events: list[Event] = []
        self._before: list[Callable[[float], None]] = []
        self._due: list[Plan | Command] = []
        self._latest = Measured((), (), (), (), ())
        self.forces: FloatArray = np.zeros(len(hand.fingers))
        n = len(hand.actuators)
        self._everything = np.ones(n, dtype=bool)
        self._silent = np.full(n, -1, dtype=np.int8)  # no device says whether it has grasped
        # The values that are the same in each tick.
        self._latest.temperature = [float("nan")] * n
        self._latest.fresh, self._latest.grasped = [True] * n, [-1] * n
        self._describe_object()
        if ticks:
            text = "another run begins, with a controller of its own"
            for observer in self.observers:
                observer.on_event(Event(RUN_BEGINS, "simulation", text, self.time))
        # A recorded command: a check of the recording starts its controller in the same way.
        self.apply(SetActive(dict.fromkeys(hand.actuator_names, True)))
        self.tick()  # the controller starts from what is measured

    @property
    def period(self) -> float:
        """Time of a tick [s]."""
        return self._settings.period

    def before_tick(self, call: Callable[[float], None]) -> None:
        """Call a function with the simulated time [s] before every tick: a carrier's script."""
        self._before.append(call)

    def _describe_object(self) -> None:
        if (obj := self.simulation.object_description) is not None:
            for observer in self.observers:
                observer.on_object(obj, self.time)

    def apply(self, command: Command) -> None:
        """Give a command to the controller, with the next tick."""
        for observer in self.observers:
            observer.on_command(CommandRecord(self.ticks, self.time, command))
        self._due.append(command)

    def do(self, goal: Goal) -> Result:
        """Execute a goal to its end.

        Raises:
            GoalRejected: if the goal cannot be taken.
            UnknownAction: if there is no such action.
            LoopError: if the goal never ends.
        """
        self.start(goal)
        deadline = self.time + _PATIENCE
        while goal.goal_id not in self.results:
            self.tick()
            if self.time > deadline:
                raise LoopError(
                    f"the goal '{goal.goal_id}' did not end within {_PATIENCE:g} s of simulation"
                )
        return self.results[goal.goal_id]

    def start(self, goal: Goal) -> None:
        """Begin a goal with the next tick, without waiting for its end; raises as `do`."""
        plan = make_plan(goal, self.hand, self.library, self._settings)
        for observer in self.observers:
            observer.on_goal(goal, self.time)
            observer.on_plan(plan, self.time)
        self._due.append(plan)

    def wait(self, duration: float) -> None:
        """Let simulated time pass [s]."""
        # Half a tick less, so that rounding does not add one.
        end = self.time + duration - 0.5 * self._settings.period
        while self.time < end:
            self.tick()

    def tick(self) -> None:
        """Do one tick: step the simulation, then the controller, then command the actuators."""
        for call in self._before:
            call(self.time)
        simulation, controller = self.simulation, self.controller
        simulation.advance()
        position, effort = simulation.position, simulation.effort
        forces = self.forces = simulation.contact_forces
        measured = self._measured(position, effort, forces)
        # After measuring, as in the loop: a goal begins with what is measured in its own tick.
        due, self._due = self._due, []
        for what in due:
            if isinstance(what, Plan):
                controller.accept(what, self.time)
            else:
                controller.apply(what, self.time)
        controller.step(self.time, measured)
        # Copies: the controller goes on in the same arrays, and records keep theirs.
        reference = np.array(controller.reference_position)
        limit = np.array(controller.reference_effort)
        simulation.command(reference, limit, self._everything)
        if self.observers:
            self._record(position, effort, reference, limit, forces)
        self._tell()
        self.ticks += 1
        # Not added up, since rounding errors would grow with the ticks.
        self.time = self.ticks * self._settings.period

    def _measured(self, position: FloatArray, effort: FloatArray, forces: FloatArray) -> Measured:
        # One object, as in the loop: plans find the measurements at their beginning in it.
        measured = self._latest
        measured.position, measured.effort = position.tolist(), effort.tolist()
        measured.touch = tip_forces([forces])
        return measured

    def _record(
        self,
        position: FloatArray,
        effort: FloatArray,
        reference: FloatArray,
        limit: FloatArray,
        forces: FloatArray,
    ) -> None:
        seen = self.simulation.scene_channels
        channels = {f"simulation/{name}": values for name, values in seen.items()}
        channels[f"simulation/{TIP_FORCE}"] = forces
        measured = ActuatorState.measured(
            position, self.time, velocity=self.simulation.velocity, effort=effort
        )
        record = TickRecord(
            *measured_arrays(measured),
            tick=self.ticks,
            stamp=self.time,
            wall_ns=self._wall_ns + round(self.time * 1e9),
            fresh=self._everything,
            grasped=self._silent,
            reference_position=reference,
            reference_velocity=np.array(self.controller.reference_velocity),
            reference_effort=limit,
            channels=channels,
        )
        for observer in self.observers:
            observer.on_tick(record)

    def _tell(self) -> None:
        outbox = self.controller.outbox
        if not outbox:
            return
        for item in outbox.items:
            if isinstance(item, Result):
                self.results[item.goal_id] = item
            elif isinstance(item, Event):
                self.events.append(item)
            for observer in self.observers:
                if isinstance(item, Result):
                    observer.on_result(item)
                elif isinstance(item, Feedback):
                    observer.on_feedback(item)
                else:
                    observer.on_event(item)
        outbox.items.clear()
        # No device is behind this hand that could be disabled.
        outbox.disable.clear()
