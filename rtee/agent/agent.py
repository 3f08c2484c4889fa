"""One hand of an agent: the observed events, and the gate for the agent's motions."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any, Final

import anyio
import anyio.to_thread

from rtee.agent import texts
from rtee.errors import GoalRejected, NoHand, RteeError, needing_extra
from rtee.hand.config_schema import Gate
from rtee.remote.agent_limits import AgentLimits
from rtee.remote.agents import AGENT
from rtee.remote.approval import approve
from rtee.remote.client import RemoteHand, connect
from rtee.types import Goal, Result

_MOST: Final = 200
"""Maximum number of stored events and results: hours of quiet work."""

_AGAIN: Final = 0.3
"""Time between two attempts to reach a lost hand [s]."""

_FOUND_WITHIN: Final = 3.0
"""Longest wait for the hand in a call [s]: connecting takes a tenth of this."""


class Agent:
    """An agent's hand.

    Args:
        name: The hand's name.
        limits: The permissions of the agent.
        endpoint: Address of the hand; ``None`` for this computer.

    Attributes:
        name: The hand's name.
        limits: The permissions of the agent.
        endpoint: Address of the hand; ``None`` for this computer.
        notes: Numbered events and results, oldest first.
    """

    def __init__(self, name: str, limits: AgentLimits, endpoint: str | None = None) -> None:
        self.name, self.limits, self.endpoint = name, limits, endpoint
        self.notes: deque[dict[str, Any]] = deque(maxlen=_MOST)
        self._count = 0
        self._remote: RemoteHand | None = None
        self._there = anyio.Event()
        self._lost = f"no hand '{name}' has answered yet"
        self._moving = False

    async def run(self) -> None:
        """Stay connected and record events, until cancelled."""
        while True:
            try:
                async with connect(self.name, endpoint=self.endpoint, client=AGENT) as remote:
                    self._remote = remote
                    self._there.set()
                    async for event in remote.events():
                        self._note(texts.event(event))
            except RteeError as error:
                self._lost = str(error)
            self._remote, self._there = None, anyio.Event()
            await anyio.sleep(_AGAIN)

    def _note(self, what: dict[str, Any]) -> None:
        self._count += 1
        self.notes.append({"number": self._count, **what})

    async def remote(self) -> RemoteHand:
        """Return the connection to the hand; raises `NoHand` if there is none."""
        with anyio.move_on_after(_FOUND_WITHIN):
            await self._there.wait()
        if self._remote is None:
            raise NoHand(self._lost)
        return self._remote

    async def move(self, goal: Goal, words: str, obj: str = "") -> dict[str, Any]:
        """Pass a goal through the gate, execute it, and return its result.

        Args:
            goal: The goal.
            words: The request in words, for the person who approves it.
            obj: The object in simulation; empty for none.

        Raises:
            GoalRejected: if the gate refuses the goal, with the reason.
            RteeError: if the hand refuses the goal.
        """
        self.limits.check(goal)
        if self._moving:
            raise GoalRejected(
                "a motion of this agent is still running; wait for it to end, or stop it"
            )
        self._moving = True
        try:
            remote = await self.remote()
            if out := (await remote.status()).agents_out:
                raise GoalRejected(
                    f"agents may not move the hand since it was {out}; ask a person to admit them"
                )
            played = await self._pass(remote, goal, words, obj)
            result = texts.result(await _done(remote, goal))
        finally:
            self._moving = False
        self._note({"result": result})
        return {**result, "in_simulation": texts.outside(played)} if played else result

    async def _pass(self, remote: RemoteHand, goal: Goal, words: str, obj: str) -> str:
        """Simulate a goal if the gate requires it; return the outcome in words, or ``""``.

        If a person decides, they also see when a goal could not be simulated. Raises `GoalRejected`
        if the gate refuses the goal.
        """
        gate = self.limits.gate
        if gate is Gate.ACT:
            return ""
        try:
            played, against = await self._rehearsed(remote, goal, obj)
        except RteeError as error:
            if gate is not Gate.APPROVE:
                raise GoalRejected(
                    f"the rehearsal in simulation is not possible: {error}"
                ) from None
            played, against = "", f"it was not simulated: {error}"
        if gate is Gate.SIMULATE and against:
            raise GoalRejected(f"in simulation, {against} ({played})")
        if gate is Gate.APPROVE:
            told = f"In simulation: {played}." if played else ""
            but = f"BUT {against}." if against else ""
            asked = (f"{self.name}: an agent asks to {words}.", told, but)
            await approve(" ".join(filter(None, asked)))
        return played

    async def _rehearsed(self, remote: RemoteHand, goal: Goal, obj: str) -> tuple[str, str]:
        """Simulate the goal; return the result and any reason against the goal, as texts."""
        with needing_extra("playing a motion in simulation", "sim"):
            from rtee.trials.rehearsal import rehearse
        position = (await remote.state()).positions
        urdf = await remote.robot_description()
        play = partial(rehearse, self.name, urdf, goal, obj, position)
        rehearsal = await anyio.to_thread.run_sync(play, abandon_on_cancel=True)
        return rehearsal.words, rehearsal.refusal(self.limits.force)


async def _done(remote: RemoteHand, goal: Goal) -> Result:
    """Execute a goal and return its result; cancel the goal if this call is cancelled or fails."""
    running = await remote.start_goal(goal)
    try:
        return await running.result()
    finally:
        with anyio.CancelScope(shield=not running.done):
            await running.cancel()
