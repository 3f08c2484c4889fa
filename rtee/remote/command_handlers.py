"""Handlers of the requests that move or stop the hand; called in Zenoh's threads.

Commands that move the hand are only queued for the loop's next tick, which any thread may do: a
goal need not wait until the event loop wakes up. One lock serialises Zenoh's threads. The loop's
thread never takes it, so that requests cannot delay the loop.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from rtee import monotonic
from rtee.errors import GoalRejected, RequestRejected
from rtee.hand.names import check_name
from rtee.loop.handloop import HandLoop
from rtee.messages import GOAL
from rtee.messages.codec import paired
from rtee.messages.convert import STREAM_TARGETS
from rtee.messages.requests import REPLY, SAMPLE
from rtee.remote.agents import Agents
from rtee.remote.call_queue import LoopThread
from rtee.remote.incoming_request import IncomingRequest, accepted
from rtee.remote.lease import Lease
from rtee.remote.stopping import Stopped
from rtee.types import Event, Goal

Fields = Mapping[str, Any]

_STOPPED_FOR = 0.1
"""Time for which a confirmed stop answers the next one, too [s]: people press no faster."""

_WITHOUT_LEASE = ("release", "admit")
"""Requests that are accepted while another client holds the lease."""

_ACCEPTED: Final = REPLY.encode(accepted())
"""The answer to every accepted command, encoded once: a tick that is due waits for the thread that
answers."""


class CommandHandlers:
    """Handles the requests of the groups ``control`` and ``stop``."""

    def __init__(self, loop: HandLoop, lease: Lease, thread: LoopThread, agents: Agents) -> None:
        self._loop, self._lease, self._thread = loop, lease, thread
        self.agents = agents
        self._lock = threading.Lock()
        self._stop_lock = threading.Lock()
        self._stopping: list[tuple[str, Stopped]] = []
        self._stopped: Fields = {}
        self._stopped_at, self._stopped_after = -math.inf, 0
        # Counts requests that may move the hand, before and after each: a stop that overlaps with
        # one never seems to have come after it.
        self._moves = 0
        self._handlers: dict[str, Callable[[IncomingRequest], bytes | None]] = {
            "cancel": self._cancel,
            "hold": self._hold,
            "jog": self._jog,
            "begin_stream": self._begin_stream,
            "end_stream": self._end_stream,
            "gains": self._gains,
            "recover": self._recover,
            "acquire": self._acquire,
            "release": self._release,
            "admit": self._admit,
        }

    def handle(self, request: IncomingRequest) -> bytes | None:
        """Handle a request of the group ``control``; raises `RteeError` if it is refused.

        Returns the encoded answer; ``None`` if it is sent once the request has been carried out.
        """
        name = request.request.name
        if name == SAMPLE:
            raise RequestRejected("samples of a stream must be published, not queried")
        goal = GOAL.decode(request.question) if name == "do" else None
        if goal is None:
            request.check()
        elif goal.client != request.client:
            # The name in the message is a claim; the client that signed it counts.
            goal = replace(goal, client=request.client)
        with self._lock:
            # Under the lock, so that no other client gets the lease between check and command.
            if name not in _WITHOUT_LEASE:
                self.agents.check(request.client)
                self._lease.check(request.client)
            self._moves += 1
            answer = self._handlers[name](request) if goal is None else self._do(goal)
            self._moves += 1
        return answer

    def take_sample(self, request: IncomingRequest) -> None:
        """Pass a sample of a stream, which was published, to the loop; raises `RteeError`."""
        streams = self._loop.streams
        with self._lock:
            # First: samples of others must not use up the rate of the holder's stream.
            self._lease.check(request.client)
            # Before the sample is decoded, so that a flood costs little.
            if not streams.admit():
                return
            sample = STREAM_TARGETS.decode(request.question)
            self._lease.sampled(request.client, sample.stream)
            self._moves += 1
            streams.sample(sample)
            self._moves += 1

    def stop(self, client: str, answer: Stopped) -> None:
        """Stop all devices; any client may request it, even without ``hello``.

        ``client`` says who in words; ``answer`` is called once the devices have stopped.

        Stops that arrive while the devices are being stopped are carried out together afterwards. A
        stop shortly after a confirmed one, without a request in between that could move the hand,
        gets the same answer. Each stop locks agents out.
        """
        # First, so that no agent's goal comes after the stop; on disk afterwards, which takes time.
        self.agents.shut_out(f"stopped by {client or 'a client'}")
        self._begin_stop(client, answer)
        self.agents.keep()

    def _begin_stop(self, client: str, answer: Stopped) -> None:
        with self._stop_lock:
            if self._is_stopped():
                answer(self._stopped)
                return
            self._stopping.append((client, answer))
            if len(self._stopping) > 1:
                return  # an earlier stop is under way
        self._thread.start(self._stop_together)

    def _is_stopped(self) -> bool:
        recently = monotonic.now() - self._stopped_at < _STOPPED_FOR
        still = self._loop.controller.running is None  # the loop may run a goal of its own
        return recently and still and self._stopped_after == self._moves

    async def _stop_together(self) -> None:
        try:
            await self._stop_all()
        except BaseException:
            with self._stop_lock:
                self._stopping.clear()  # otherwise no further stop could begin
            raise

    async def _stop_all(self) -> None:
        while True:
            with self._stop_lock:
                # Read before the devices stop: a motion in between needs another stop.
                asked, moves = len(self._stopping), self._moves
                client = self._stopping[0][0] or "a client"
            confirmed = dict(await self._loop.stop(f"stopped by {client}"))
            fields = {"device": list(confirmed), "confirmed": list(confirmed.values())}
            with self._stop_lock:
                done, self._stopping[:asked] = self._stopping[:asked], []
                # A stop that a device has not confirmed must not answer the next one.
                if all(confirmed.values()):
                    self._stopped, self._stopped_after = fields, moves
                    self._stopped_at = monotonic.now()
                more = bool(self._stopping)
            for _, answer in done:
                answer(fields)
            if not more:
                return

    def client_left(self, client: str) -> None:
        """Release a client's lease when the client has left; then the loop acts as configured."""
        with self._lock:
            held = self._lease.client_left(client)
            self._moves += 1  # the configured behaviour may move the hand
        if held:
            self._thread.call_soon(self._loop.client_lost, client)

    def _do(self, goal: Goal) -> bytes:
        check_name(goal.goal_id, "goal")
        if self._lease.runs(goal.goal_id):
            raise GoalRejected(f"the goal '{goal.goal_id}' is running already")
        # Before `submit`, since the loop may end the goal before it returns.
        self._lease.started(goal.client, goal.goal_id)
        try:
            self._loop.submit(goal)
        except Exception:
            self._lease.ended(goal.goal_id)
            raise
        return _ACCEPTED

    def _cancel(self, request: IncomingRequest) -> bytes:
        self._loop.cancel(request.fields["goal_id"])
        return _ACCEPTED

    def _hold(self, request: IncomingRequest) -> bytes:
        self._loop.hold(f"{request.client} asked to hold")
        return _ACCEPTED

    def _jog(self, request: IncomingRequest) -> bytes:
        fields = request.fields
        limit = None if math.isnan(fields["limit"]) else fields["limit"]  # NaN: no limit given
        self._loop.jog(_values(fields), limit)
        self._lease.jogged(request.client)
        return _ACCEPTED

    def _begin_stream(self, request: IncomingRequest) -> bytes:
        fields = request.fields
        stream, deadline = check_name(fields["stream"], "stream"), fields["deadline"]
        if self._lease.runs(stream):
            raise GoalRejected(f"the stream '{stream}' is running already")
        # Before `begin`, since the loop may end the stream before it returns.
        within = None if math.isnan(deadline) else deadline  # NaN: as configured
        waits = self._loop.settings.stream.deadline if within is None else within
        self._lease.streams(request.client, stream, waits)
        try:
            efforts = paired("effort", fields["effort_name"], fields["effort"].tolist())
            self._loop.streams.begin(stream, fields["rate"], within, efforts)
        except Exception:
            self._lease.ended(stream)
            raise
        return _ACCEPTED

    def _end_stream(self, request: IncomingRequest) -> bytes:
        stream = request.fields["stream"]
        self._loop.streams.end(stream)
        # The answer says that the hand is free: the next command comes after the end in the loop.
        self._lease.stream_ended(stream)
        return _ACCEPTED

    def _gains(self, request: IncomingRequest) -> None:
        fields = request.fields
        values, device = _values(fields), fields["source"] or None
        self._answer_after(request, lambda: self._loop.set_gains(values, device))

    def _recover(self, request: IncomingRequest) -> None:
        device = request.fields["what"] or None
        self._answer_after(request, lambda: self._loop.recover(device))

    def _acquire(self, request: IncomingRequest) -> bytes:
        self._lease.acquire(request.client)
        return _ACCEPTED

    def _release(self, request: IncomingRequest) -> bytes:
        self._lease.release(request.client)
        return _ACCEPTED

    def _admit(self, request: IncomingRequest) -> bytes:
        self.agents.admit(request.client)
        text = f"{request.client} has let agents in"
        event = Event("agents_admitted", request.client, text, monotonic.now())
        self._thread.call_soon(self._loop.announce, event)
        return _ACCEPTED

    def _answer_after(self, request: IncomingRequest, work: Callable[[], Awaitable[None]]) -> None:
        """Run ``work`` in the loop's thread, and answer the request when it is done."""

        async def run() -> None:
            try:
                await work()
            # Any error, since the client waits for an answer.
            except Exception as error:
                request.refuse(error)
            else:
                request.send(_ACCEPTED, True)

        self._thread.start(run)


def _values(fields: Fields) -> dict[str, float]:
    return paired("value", fields["name"], fields["value"].tolist())
