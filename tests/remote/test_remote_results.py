"""Results arrive, whatever happens on the way; and who misses one asks for it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import anyio
import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import NoHand, RemoteError, RequestRejected, TooManyRequests
from rtee.hand.model import Hand
from rtee.messages import topics
from rtee.messages.convert import RESULT
from rtee.remote.goal import GoalClient
from rtee.remote.goal_records import KEPT_FOR, GoalRecords
from rtee.remote.lease import Lease
from rtee.remote.link import Link
from rtee.types import Feedback, Goal, Named, Result

from .serving import LASTING, serving, until

BURST = 40
"""Goals of one client at once: more than a hand has batches to send, fewer than are refused."""


@pytest.mark.anyio
async def test_of_a_burst_of_goals_every_result_arrives_everywhere(
    hand: Hand, library: ActionLibrary
) -> None:
    """The message of each result took a batch of its own; a burst of seventeen filled all."""
    async with serving(hand, library) as served, rtee.connect() as remote, rtee.connect() as other:
        seen: list[str] = []
        own: list[str] = []

        async def listen() -> None:
            async for result in other.results():
                seen.append(result.goal_id)

        async def do(number: int) -> None:
            goal = Goal(Named("Trig", ("index" if number % 2 else "thumb",)))
            running = await remote.start_goal(goal)
            await running.result()
            own.append(goal.goal_id)

        async with anyio.create_task_group() as group:
            group.start_soon(listen)
            await other.status()  # answered after the subscription has arrived
            async with anyio.create_task_group() as goals:
                for number in range(BURST):
                    goals.start_soon(do, number)
            ended = {result.goal_id for result in served.watcher.results}
            assert set(own) == ended
            assert len(own) == BURST
            await until(lambda: set(seen) == ended)
            group.cancel_scope.cancel()


class Deaf:
    """A link on which some topics never arrive, as on a congested connection."""

    def __init__(self, link: Link, *lost: str) -> None:
        self._link, self._lost = link, lost

    def subscribe(self, topic: str, receive: Callable[[bytes], object]) -> None:
        if topic not in self._lost:
            self._link.subscribe(topic, receive)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)


@pytest.mark.anyio
@pytest.mark.parametrize("lost", [(topics.RESULTS,), (topics.RESULTS, topics.FEEDBACK)])
async def test_who_misses_a_result_asks_for_it(
    hand: Hand, library: ActionLibrary, lost: tuple[str, ...]
) -> None:
    async with serving(hand, library) as served, rtee.connect() as remote:
        goals = GoalClient(Deaf(remote._link, *lost), remote.info)  # type: ignore[arg-type]
        result = await goals.do("Trig", "index", intensity=0.2)
        assert result.reached
        assert RESULT.fields(result) == RESULT.fields(served.watcher.results[-1])
        # A cancelled goal ends for its client, too.
        running = await goals.start("wave")
        await running.cancel()
        assert (await running.result()).cancelled


@pytest.mark.anyio
async def test_a_goal_that_the_hand_has_forgotten_ends_with_an_error(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library), rtee.connect() as remote:
        goals = GoalClient(Deaf(remote._link, topics.RESULTS), remote.info)  # type: ignore[arg-type]
        running = await goals.start("Trig", "index")
        # As after a minute without a connection: the hand knows nothing under this name.
        known = goals._running._running
        known["forgotten"] = known.pop(running.goal.goal_id)
        with pytest.raises(RequestRejected, match="does not know the goal any more"):
            await running.result()


class Mute(Deaf):
    """A link on which the answers to goals are lost."""

    def send(self, name: str, question: bytes, *, within: float) -> asyncio.Future[bytes]:
        sent = self._link.send(name, question, within=within)
        loop = asyncio.get_running_loop()
        lost: asyncio.Future[bytes] = loop.create_future()
        loop.call_later(within, lambda: lost.done() or lost.set_exception(NoHand("no answer")))
        sent.add_done_callback(asyncio.Future.exception)
        return lost


@pytest.mark.anyio
async def test_a_goal_whose_answer_is_lost_runs_all_the_same(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtee.remote.goal._ACCEPTED_WITHIN", 0.3)
    async with serving(hand, library) as served, rtee.connect() as remote:
        goals = GoalClient(Mute(remote._link), remote.info)  # type: ignore[arg-type]
        assert (await goals.do("Trig", "index", intensity=0.2)).reached
        # The caller gives up before the answer: the goal ends all the same.
        with anyio.move_on_after(0.1):
            await goals.start("wave")
        await until(lambda: len(served.watcher.results) == 2)
        assert served.watcher.results[-1].cancelled


class Lossy(Deaf):
    """A link on which the first cancellations get no answer."""

    def __init__(self, link: Link, losses: int, how: type[RemoteError]) -> None:
        super().__init__(link)
        self.losses, self._how = losses, how

    async def ask(self, name: str, *given: Any, **options: Any) -> dict[str, Any]:
        if name == "cancel" and self.losses:
            self.losses -= 1
            raise self._how("lost on the way")
        return await self._link.ask(name, *given, **options)


class Enough(BaseException):
    """Ends a call as a handler of a signal does."""


@pytest.mark.anyio
@pytest.mark.parametrize("how", [NoHand, TooManyRequests])
@pytest.mark.parametrize("way", ["left", "raised", "started"])
async def test_however_a_call_ends_its_goal_ends(
    hand: Hand,
    library: ActionLibrary,
    monkeypatch: pytest.MonkeyPatch,
    how: type[RemoteError],
    way: str,
) -> None:
    """A cancellation that got no answer was not repeated, and the goal went on without a caller."""
    monkeypatch.setattr("rtee.remote.goal._CANCEL_AGAIN", 0.01)
    async with serving(hand, library) as served, rtee.connect() as remote:
        link = Lossy(remote._link, 3, how)
        goals = GoalClient(link, remote.info)  # type: ignore[arg-type]
        scope = anyio.CancelScope()

        def give_up(_: Feedback) -> None:
            if way == "raised":
                raise Enough
            scope.cancel()

        with scope, contextlib.suppress(Enough):
            if way == "started":
                scope.cancel()
            await goals.do("Trig", "index", on_feedback=give_up, **LASTING)
        await until(lambda: bool(served.watcher.results))
        assert served.watcher.results[0].cancelled
        assert link.losses == 0


@pytest.mark.anyio
async def test_a_call_does_not_wait_for_ever_for_its_cancellation(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtee.remote.goal.ANSWER_WITHIN", 0.05)
    monkeypatch.setattr("rtee.remote.goal._CANCEL_AGAIN", 0.01)
    async with serving(hand, library) as served, rtee.connect() as remote:
        link = Lossy(remote._link, 10**9, NoHand)
        goals = GoalClient(link, remote.info)  # type: ignore[arg-type]
        running = await goals.start("Trig", "index", **LASTING)
        await goals._running.give_up(running.goal.goal_id)
        assert link.losses, "it returned before any cancellation had arrived"
        assert not served.watcher.results
        link.losses = 0  # the network is back: the goal ends without a caller
        assert (await running.result()).cancelled
        await until(lambda: not goals._running._cancelling)
        # Nobody repeats it once the link is lost, or for ever.
        link.losses = 10**9
        monkeypatch.setattr("rtee.remote.goal._CANCEL_FOR", 0.05)
        await goals._running.give_up("another")
        await until(lambda: not goals._running._cancelling)
        monkeypatch.undo()
        task = goals._running._cancel("another")
        remote._link.gone = True
        await until(task.done)
        remote._link.gone = False


def test_results_are_kept_for_a_while() -> None:
    now = [0.0]
    lease = Lease(lambda: now[0])
    records = GoalRecords(lease, lambda: now[0])
    nothing = {"running": False, "result": []}
    assert records.status("a") == nothing
    lease.started("client", "a")
    assert records.status("a") == {"running": True, "result": []}
    records.ended(Result("a", "Trig"))
    [fields] = records.status("a")["result"]
    assert RESULT.of(fields).goal_id == "a"
    assert not records.status("a")["running"]
    assert lease.holder == ""
    now[0] += KEPT_FOR / 2
    records.ended(Result("b", "Trig"))
    now[0] += KEPT_FOR / 2 + 1.0
    records.ended(Result("c", "Trig"))
    assert records.status("a") == nothing
    assert all(records.status(goal)["result"] for goal in ("b", "c"))
    for number in range(5000):
        records.ended(Result(f"many{number}", "Trig"))
    assert len(records._results) <= 1024
    assert records.status("many4999")["result"]
