"""One hand's loop, as the rest of the program uses it."""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping

import anyio

from rtee.commands import Cancel, Freeze, Hold, Jog, SetGripEffort
from rtee.errors import ConfigError, GoalRejected, RteeError, suggestion
from rtee.loop.hand_ticks import CONFIRM_WITHIN, HandTicks
from rtee.loop.observer import LoopObserver, TickRecord
from rtee.loop.plan import OPEN, make_plan
from rtee.loop.settings import Behaviour
from rtee.loop.supervisor import Supervisor
from rtee.types import Event, Goal, Reference, Result

log = logging.getLogger(__name__)

ITSELF = "rtee"
"""The client of goals that the loop gives itself."""

GRIP_EFFORT = "grip_effort"
"""The gain of the hand itself: the effort kept on what is held."""


class HandLoop(HandTicks):
    """The loop of one hand.

    Its methods are called in the thread of its event loop, but for `submit`, `cancel`, `hold` and
    `jog`: those only check and append to what the next tick does, which any thread may.

    ``async with`` starts the devices' tasks and, at the end, closes them. `tick` is called by
    whoever has the clock; it never waits.
    """

    # --- goals -------------------------------------------------------------------------------

    def submit(self, goal: Goal, *, partly: bool = False) -> None:
        """Take a goal; it begins at the next tick. Its result comes to the observers.

        Args:
            goal: The goal.
            partly: Leave out the actuators whose device is not active, unless it is all of them.

        Raises:
            GoalRejected: if a value of it cannot be used, or a device is not active.
            UnknownAction: if there is no such action.
            ActionError: if the action doesn't exist with these elements.
        """
        if self._ended:
            raise GoalRejected("the loop has ended")
        plan = make_plan(
            goal,
            self.hand,
            self.library,
            self.settings,
            effort_refused=self._refuses_effort() if goal.effort else None,
        )
        if not all(self._was_active.values()):
            able = self._able()
            if partly and able & plan.involved:
                plan = plan.only(able)
            self._check_able(plan.involved, able)
        self._pending.append(plan)

    def _refuses_effort(self) -> dict[int, str]:
        """Return the actuators whose device takes no effort limits, each with the reason."""
        return {
            index: device.driver.capabilities.refuses.get("max_effort", "")
            for device in self.devices.values()
            if "max_effort" not in device.driver.capabilities.accepts
            for index in device.indices
        }

    def _able(self) -> set[int]:
        """Return the actuators that may be moved."""
        return {
            index
            for name, device in self.devices.items()
            if self._was_active[name]
            for index in device.indices
        }

    def _check_able(self, indices: Iterable[int], able: Collection[int]) -> None:
        idle = [self.hand.actuators[i].name for i in sorted(indices) if i not in able]
        if not idle:
            return
        doing = [f"; {n} is {d.driver.doing}" for n, d in self.devices.items() if d.driver.doing]
        hint = "".join(doing) or "; see `rtee status`, then recover"
        raise GoalRejected(f"the device of {', '.join(idle)} is not active{hint}")

    async def execute(self, goal: Goal, *, partly: bool = False) -> Result:
        """Take a goal and wait for its result; being cancelled cancels the goal. See `submit`."""
        done, results = anyio.Event(), list[Result]()
        self._waiters[goal.goal_id] = (done, results)
        try:
            self.submit(goal, partly=partly)
            await done.wait()
        except anyio.get_cancelled_exc_class():
            self.cancel(goal.goal_id)
            raise
        finally:
            self._waiters.pop(goal.goal_id, None)
        return results[0]

    def cancel(self, goal_id: str) -> None:
        """Cancel a goal: the hand brakes and holds the measured posture. Unknown: nothing."""
        self._pending.append(Cancel(goal_id))

    def hold(self, reason: str = "") -> None:
        """Brake and hold the measured posture; what blocked fingers may hold, they keep."""
        self._pending.append(Hold(reason))

    def jog(self, positions: Mapping[str, float], max_velocity: float | None = None) -> None:
        """Move some actuators by hand; a running goal is pre-empted.

        Args:
            positions: Where to, by actuator [rad | m]; clamped into the limits.
            max_velocity: Velocity not to be exceeded [rad/s | m/s]; ``None``: the actuators' own.

        Raises:
            GoalRejected: if an actuator is unknown or not active, or a value is no number.
        """
        names = self.hand.actuator_names
        for name, value in positions.items():
            if name not in names:
                raise GoalRejected(f"unknown actuator '{name}'; {suggestion(name, names)}")
            if not math.isfinite(value):
                raise GoalRejected(f"the position of '{name}' must be a number, not {value:g}")
        if max_velocity is not None and not (max_velocity > 0 and math.isfinite(max_velocity)):
            raise GoalRejected(f"the velocity must be above 0, not {max_velocity:g}")
        self._check_able((self.hand.actuator_index(name) for name in positions), self._able())
        limit = math.inf if max_velocity is None else float(max_velocity)
        self._pending.append(Jog(dict(positions), limit))

    # --- devices -----------------------------------------------------------------------------

    async def stop(self, reason: str = "stopped") -> list[tuple[str, bool]]:
        """Stop all devices now; a running goal is cancelled. Cannot raise.

        Returns:
            Every device with whether it confirmed that it was told.
        """
        confirmed = await self._all_devices(reason, Supervisor.stop)
        missing = [name for name, done in confirmed if not done]
        text = f"{self.name}: {reason}"
        text += f"; not confirmed by {', '.join(missing)}" if missing else "; confirmed"
        self._observers.event(
            Event("stop", self.name, text, self._now(), "error" if missing else "info")
        )
        return confirmed

    async def disable(self, reason: str = "disabled") -> list[tuple[str, bool]]:
        """Disable all devices; they are limp and inactive afterwards. Returns as `stop`."""
        return await self._all_devices(reason, Supervisor.disable)

    async def keep(self, reason: str = "") -> list[tuple[str, bool]]:
        """Send every device its last reference: where it is, or what it holds with.

        Afterwards no references are sent any more, though the loop may still tick. Returns as
        `stop`.
        """
        posture = self.controller.posture_to_keep()
        effort = self.controller.reference_effort

        async def keep(device: Supervisor, within: float) -> bool:
            where = list(device.indices)
            position = [posture[i] for i in where]
            if not all(map(math.isfinite, position)):
                return await device.stop(within)
            last = Reference.at(position, max_effort=[effort[i] for i in where])
            return await device.hold(last, within)

        return await self._all_devices(reason, keep, last=True)

    async def _all_devices(
        self,
        reason: str,
        what: Callable[[Supervisor, float], Awaitable[bool]],
        *,
        last: bool = False,
    ) -> list[tuple[str, bool]]:
        confirmed: dict[str, bool] = dict.fromkeys(self.devices, False)

        async def one(device: Supervisor) -> None:
            try:
                confirmed[device.name] = await what(device, CONFIRM_WITHIN)
            except Exception:
                log.exception("device '%s' could not be told: %s", device.name, reason)

        for device in self.devices.values():
            device.muted = True
        if not last:
            self._pending.append(Freeze(reason))
        try:
            async with anyio.create_task_group() as group:
                for device in self.devices.values():
                    group.start_soon(one, device)
        finally:
            if not last:
                # Whatever moved meanwhile: the reference begins again where the hand is now.
                self._pending.append(Freeze(reason))
                for device in self.devices.values():
                    device.muted = False
        return list(confirmed.items())

    async def recover(self, device: str | None = None) -> None:
        """Bring a device, or all, out of fault or inactivity; nothing moves by it.

        Raises:
            ConfigError: if there is no such device.
            RteeError: what the device says if it doesn't work; the others were recovered.
        """
        if device is not None and device not in self.devices:
            raise ConfigError(f"unknown device '{device}'; {suggestion(device, self.devices)}")
        wanted = list(self.devices.values()) if device is None else [self.devices[device]]
        errors: list[Exception] = []

        async def one(supervisor: Supervisor) -> None:
            try:
                await supervisor.recover()
            except RteeError as error:
                errors.append(error)

        async with anyio.create_task_group() as group:
            for supervisor in wanted:
                group.start_soon(one, supervisor)
        if errors:
            raise errors[0]

    async def set_gains(self, gains: Mapping[str, float], device: str | None = None) -> None:
        """Change gains of a device, or of every device that has them.

        Without a device, ``grip_effort`` is the effort kept on what is held, 0 to 1 of the
        effort limit.

        Raises:
            ConfigError: if there is no such device, no device has such a gain, or a value is bad.
            RteeError: if a device doesn't take them.
        """
        if device is not None and device not in self.devices:
            raise ConfigError(f"unknown device '{device}'; {suggestion(device, self.devices)}")
        chosen = [d for d in self.devices.values() if device in (None, d.name)]
        gains = dict(gains)
        holding = gains.pop(GRIP_EFFORT, None) if device is None else None
        if holding is not None and not 0.0 <= holding <= 1.0:
            raise ConfigError(f"{GRIP_EFFORT} must be 0 to 1, not {holding:g}")
        for name, value in gains.items():
            known = {gain for d in chosen for gain in d.driver.capabilities.gains}
            if name not in known:
                raise ConfigError(f"unknown gain '{name}'; {suggestion(name, known)}")
            if not math.isfinite(value):
                raise ConfigError(f"the gain '{name}' must be a number, not {value:g}")
        for supervisor in chosen:
            own = {k: v for k, v in gains.items() if k in supervisor.driver.capabilities.gains}
            if own:
                await supervisor.set_gains(own)
        if holding is not None:
            self._pending.append(SetGripEffort(float(holding)))

    # --- when nobody drives it ---------------------------------------------------------------

    def client_lost(self, client: str) -> None:
        """Do what is configured for when the client that holds the hand has died."""
        text = f"the client '{client}' is lost"
        self._observers.event(Event("client_lost", client, text, self._now(), "warning"))
        self.behave(self.settings.safety.on_client_lost, text)

    def behave(self, behaviour: Behaviour, reason: str) -> None:
        """Do what the settings say for when nobody drives the hand any more; returns at once."""
        match behaviour:
            case Behaviour.HOLD:
                self.hold(reason)
            case Behaviour.STOP:
                self._start(self.stop, reason)
            case Behaviour.DISABLE:
                self._start(self.disable, reason)
            case Behaviour.OPEN:
                self.hold(reason)
                try:
                    self.submit(Goal(OPEN, client=ITSELF), partly=True)
                except RteeError as error:
                    log.warning("%s cannot open: %s", self.name, error)

    # --- watching ----------------------------------------------------------------------------

    def add_observer(self, observer: LoopObserver) -> None:
        """Have an observer told everything from now on."""
        self._observers.add(observer)

    def remove_observer(self, observer: LoopObserver) -> None:
        """Tell an observer no more."""
        self._observers.remove(observer)

    def announce(self, event: Event) -> None:
        """Tell the observers an event from outside, such as a mark or a new action."""
        self._observers.event(event)

    def snapshot(self) -> TickRecord:
        """Return what was known at the last tick.

        Raises:
            RteeError: if there was none yet.
        """
        if self._record is None:
            raise RteeError(f"{self.name}: the loop has not ticked yet")
        return self._record
