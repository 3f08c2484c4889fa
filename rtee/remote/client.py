"""A running hand, from any process: execute actions, watch, stop.

async with rtee.connect("schunk_svh") as hand:
    result = await hand.do("pinch_tight", "index", "thumb", intensity=0.6)
"""

from __future__ import annotations

import contextlib
import math
import os
import uuid
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, TypedDict, Unpack

import anyio
import anyio.to_thread

from rtee.errors import GoalRejected, NoHand, RemoteError, suggestion
from rtee.hand.names import safe_name
from rtee.messages import decode_feedback, decode_result, encode_goal, topics
from rtee.remote.action_client import Library
from rtee.remote.find import open_hand
from rtee.remote.goal import RunningGoal
from rtee.remote.link import Link
from rtee.types import Feedback, Goal, Result, Stage

_PATIENCE = 60.0
"""Time to wait until devices have recovered [s]; homing a hand takes half of it."""

_GOODBYE = 1.0
"""Time in which a hand that is let go answers, if it is still there [s]."""


class GoalOptions(TypedDict, total=False):
    """What may be said about a goal.

    Attributes:
        intensity: 0 (rest) to 1 (the action's posture); 1 unless given.
        effort: Effort limit by actuator [N·m | N]; or a number, above 0 up to 1: that share of the
            limit of every actuator.
        tolerance: Error norm at which it counts as reached; 0.01 unless given.
        speed: Scale of the velocity limits, above 0 up to 1; 1 unless given.
        timeout: Longest time it may take [s]; as configured for the hand unless given.
        stage: How far a pinch goes: both, pre_grasp or grasp; both unless given.
        kind: Kind of the action, where that matters.
    """

    intensity: float
    effort: Mapping[str, float] | float
    tolerance: float
    speed: float
    timeout: float | None
    stage: Stage | str
    kind: str | None


def _goal(action: str, elements: Sequence[str], client: str, options: GoalOptions) -> Goal:
    values: dict[str, Any] = dict(options)
    if "stage" in values:
        try:
            values["stage"] = Stage(values["stage"])
        except ValueError:
            raise GoalRejected(
                f"unknown stage '{values['stage']}'; {suggestion(str(values['stage']), Stage)}"
            ) from None
    return Goal(action=action, elements=tuple(elements), client=client, **values)


class RemoteHand(Library):
    """A running hand; made by `connect`.

    Everything that moves it is refused with `LeaseHeld` while another client holds it. A client
    holds it while a goal of its own runs, and from `acquire` to `release`; `stop` needs neither.

    Attributes:
        name: The hand's name.
        client: This client's name on the network.
    """

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._goals: dict[str, RunningGoal] = {}
        self._efforts: dict[str, float] | None = None
        self._taken = False
        self._jogged = False
        link.subscribe(topics.FEEDBACK, self._on_feedback)
        link.subscribe(topics.RESULTS, self._on_result)

    def _on_feedback(self, data: bytes) -> None:
        if not self._goals:  # it is about a goal of somebody else
            return
        feedback = decode_feedback(data)
        running = self._goals.get(feedback.goal_id)
        if running is not None:
            running.deliver(feedback)

    def _on_result(self, data: bytes) -> None:
        if not self._goals:
            return
        result = decode_result(data)
        running = self._goals.pop(result.goal_id, None)
        if running is not None:
            running.deliver(result)

    def _on_gone(self) -> None:
        super()._on_gone()
        goals, self._goals = self._goals, {}
        for running in goals.values():
            running.deliver(NoHand(f"the hand '{self.name}' has gone"))

    # --- moving it

    async def start(
        self, action: str, *elements: str, **options: Unpack[GoalOptions]
    ) -> RunningGoal:
        """Begin an action and return at once; a goal of this client that runs is pre-empted.

        Args:
            action: Its name; case and underscores do not matter.
            elements: Fingers or actuator of a primitive, in any order.
            options: See `GoalOptions`.

        Raises:
            RequestRejected: if the hand refuses it, with the reason.
            LeaseHeld: if another client holds the hand.
            NoHand: if the hand has gone.
        """
        effort = options.get("effort")
        if isinstance(effort, float | int):
            options["effort"] = await self.effort_limits(effort)
        goal = _goal(action, elements, self.client, options)
        # On its way first: the answer and what follows it wait until this task does.
        answer = self._link.send("do", encode_goal(goal))
        running = self._goals[goal.goal_id] = RunningGoal(goal, partial(self.cancel, goal.goal_id))
        try:
            await answer
        except BaseException:
            self._goals.pop(goal.goal_id, None)
            raise
        return running

    async def do(
        self,
        action: str,
        *elements: str,
        on_feedback: Callable[[Feedback], object] | None = None,
        **options: Unpack[GoalOptions],
    ) -> Result:
        """Execute an action and wait for its result; being cancelled cancels it.

        Args:
            action: Its name; case and underscores do not matter.
            elements: Fingers or actuator of a primitive, in any order.
            on_feedback: Called with feedback meanwhile.
            options: See `GoalOptions`.

        Raises:
            RequestRejected: if the hand refuses it, with the reason.
            LeaseHeld: if another client holds the hand.
            NoHand: if the hand has gone.
        """
        running = await self.start(action, *elements, **options)
        try:
            return await running.result(on_feedback)
        except anyio.get_cancelled_exc_class():
            with anyio.CancelScope(shield=True), contextlib.suppress(RemoteError):
                await running.cancel()
            raise

    async def open(self, on_feedback: Callable[[Feedback], object] | None = None) -> Result:
        """Go to the rest posture and wait for the result. See `start`."""
        return await self.do("open", on_feedback=on_feedback)

    async def effort_limits(
        self, share: float, only: Collection[str] | None = None, *, besides: Collection[str] = ()
    ) -> dict[str, float]:
        """Return a share of the effort limits of actuators [N·m | N], as `start` takes them.

        Args:
            share: Above 0 up to 1.
            only: Of which actuators; ``None``: of all.
            besides: Actuators to leave out.

        Raises:
            GoalRejected: if the share is none, or an actuator is unknown or has no effort limit.
        """
        if not 0.0 < share <= 1.0:
            raise GoalRejected(
                f"an effort for all actuators is a share of their limits, above 0 and at most 1 "
                f"(100 %), not {share:g}"
            )
        if self._efforts is None:
            self._efforts = {a.name: a.effort for a in (await self.info()).actuators}
        known = self._efforts
        chosen = [name for name in (known if only is None else only) if name not in besides]
        for name in chosen:
            if name not in known:
                raise GoalRejected(
                    f"effort for an unknown actuator '{name}'; {suggestion(name, known)}"
                )
        limits = {name: known[name] for name in chosen}
        unknown = [name for name, most in limits.items() if not math.isfinite(most)]
        if unknown:
            raise GoalRejected(
                f"'{unknown[0]}' has no effort limit to take a share of; give one under 'limits' "
                "in hand.yaml, or its effort by name"
            )
        return {name: share * most for name, most in limits.items()}

    async def cancel(self, goal_id: str = "") -> None:
        """Cancel a goal, or whichever runs: the hand brakes and holds the measured posture."""
        await self._link.ask("cancel", {"goal_id": goal_id, "client": self.client})

    async def hold(self) -> None:
        """Hold the measured posture; a goal that runs is cancelled."""
        await self._say("hold")

    async def jog(self, positions: Mapping[str, float], max_velocity: float | None = None) -> None:
        """Move some actuators; returns at once.

        Args:
            positions: Where to, by actuator [rad | m]; clamped into the limits.
            max_velocity: Velocity not to be exceeded [rad/s | m/s]; ``None``: the actuators' own.
        """
        await self._values("jog", "", positions, max_velocity)
        self._jogged = True

    async def stop(self) -> dict[str, bool]:
        """Stop all devices now, whoever holds the hand.

        Returns:
            By device, whether it confirmed that it was told.
        """
        reply = await self._say("stop")
        return dict(zip(reply["device"], reply["confirmed"].tolist(), strict=True))

    async def recover(self, device: str | None = None) -> None:
        """Bring a device, or all, out of a fault; nothing moves by it."""
        await self._say("recover", device or "", within=_PATIENCE)

    async def set_gains(self, gains: Mapping[str, float], device: str | None = None) -> None:
        """Change gains of a device, or of every device that has them.

        Without a device, ``grip_effort`` is the effort kept on what is held, 0 to 1 of the
        effort limit.
        """
        await self._values("gains", device or "", gains, None)

    async def record(self, what: str, text: str = "") -> None:
        """Start, stop or mark the recording; returns at once.

        Args:
            what: ``start`` a new one unless one is written, ``stop`` it, or put a ``mark`` into it.
            text: Text of the mark, one line.

        Raises:
            RequestRejected: if the hand refuses it, with the reason.
        """
        await self._link.ask("record", {"client": self.client, "what": what, "text": text})

    async def acquire(self) -> None:
        """Acquire the lease, until `release`: nobody else may move the hand."""
        await self._say("acquire")
        self._taken = True

    async def release(self) -> None:
        """Give the hand back."""
        await self._say("release")
        self._taken = self._jogged = False

    async def leave(self) -> None:
        """Let go of a hand that was only jogged; `connect` does it at the end of its context.

        What was taken, or moves by a goal of this client, is left to the hand's configuration.
        """
        if self._jogged and not self._taken:
            self._jogged = False
            with contextlib.suppress(RemoteError):
                await self._say("release", within=_GOODBYE)

    @contextlib.asynccontextmanager
    async def held(self) -> AsyncIterator[None]:
        """Hold the hand for as long as the context lasts."""
        await self.acquire()
        try:
            yield
        finally:
            with anyio.CancelScope(shield=True), contextlib.suppress(RemoteError):
                await self.release()

    async def _say(self, name: str, what: str = "", within: float = 5.0) -> dict[str, Any]:
        return await self._link.ask(name, {"client": self.client, "what": what}, within=within)

    async def _values(
        self, name: str, source: str, values: Mapping[str, float], limit: float | None
    ) -> None:
        fields = {
            "client": self.client,
            "source": source,
            "name": list(values),
            "value": list(values.values()),
            "limit": math.nan if limit is None else limit,
        }
        await self._link.ask(name, fields)


@contextlib.asynccontextmanager
async def connect(
    hand: str | None = None,
    *,
    endpoint: str | None = None,
    client: str = "python",
    wait: float = 0.0,
    on_wait: Callable[[str], object] | None = None,
) -> AsyncIterator[RemoteHand]:
    """Connect to a running hand for as long as the context lasts.

    If this process dies while it holds the hand, the hand does what its configuration says
    (``safety: on_client_lost``). So it does when the context ends by an error, or while the hand is
    taken or moves by a goal from here.

    Args:
        hand: Its name; not needed where only one runs.
        endpoint: Where it is, such as ``tcp/robot:7447``; else as ``RTEE_CONNECT`` says, else on
            this computer.
        client: A name for this client, for people.
        wait: Time to wait for a hand that does not run yet [s]; `RemoteHand.ready` waits until its
            devices are active, too.
        on_wait: Called with why it waits, in words, whenever that changes.

    Raises:
        NoHand: if no such hand runs.
        ConfigError: if several run and none is named.
    """
    session, name = await open_hand(hand, endpoint, wait, on_wait)
    identity = safe_name(f"{client[:60]}-{os.getpid()}-{uuid.uuid4().hex[:8]}", "client")
    link = Link(session, name, identity)
    try:
        remote = RemoteHand(link)
        await link.ask("hello", {"client": identity, "what": ""})
        await link.putting.found()
        yield remote
        await remote.leave()
    finally:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(link.close)
