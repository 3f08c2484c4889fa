"""Attacks by other clients, with raw Zenoh sessions: under another's name, in the hand's name."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import pytest
import zenoh

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import LeaseHeld, RequestRejected
from rtee.hand.model import Hand
from rtee.messages import EVENT, GOAL, RESULT, message_type
from rtee.messages.identity import Signer, key_of
from rtee.messages.requests import HERE, REQUESTS, inbox_key
from rtee.remote.client import RemoteHand
from rtee.remote.session import direct
from rtee.types import Event, Goal, Intensity, Named, Result

from .serving import LASTING, Served, Told, serving, until

pytestmark = pytest.mark.anyio

REPLY = message_type("rtee_msgs/msg/Reply")
STATUS = REQUESTS["status"]


NOT_SIGNED = "has not signed this: a signature is the first 32 hexadecimal digits of HMAC-SHA256"


class Intruder:
    """A raw session of Zenoh, which follows no rule."""

    def __init__(self, endpoint: str, mode: str) -> None:
        config = zenoh.Config()
        settings: dict[str, Any] = {
            "mode": mode,
            "listen/endpoints": [],
            "connect/endpoints": [endpoint],
            "connect/exit_on_failure": True,
            "connect/timeout_ms": 5000,
            "scouting/multicast/enabled": False,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.seen: list[str] = []

    def listen(self, key: str) -> None:
        self.session.declare_subscriber(key, direct(lambda s: self.seen.append(str(s.key_expr))))

    def answer(self, key: str, data: bytes) -> None:
        def reply(query: zenoh.Query) -> None:
            self.seen.append(str(query.key_expr))
            with query:
                query.reply(query.key_expr, data)

        self.session.declare_queryable(key, direct(reply), complete=True)

    def ask(self, name: str, question: bytes, proof: str | None = None) -> list[str]:
        """Return the reasons why a request was refused; "" if it was not."""
        key = REQUESTS[name].key("small")
        found = self.session.get(key, payload=question, attachment=proof, timeout=5.0)
        return [REPLY.decode(e.err.payload.to_bytes())["reason"] if e.err else "" for e in found]

    def put(self, owner: str, question: bytes, proof: str | None = None) -> None:
        """Put what a client of the hand puts, where it puts it."""
        key = inbox_key("small", HERE, owner)
        block = zenoh.CongestionControl.BLOCK
        self.session.put(key, question, attachment=proof, congestion_control=block)


@pytest.fixture(params=["peer", "client"])
def mode(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def intruders() -> Iterator[list[Intruder]]:
    made: list[Intruder] = []
    yield made
    for one in made:
        one.session.close()


async def intruder(served: Served, mode: str, intruders: list[Intruder]) -> Intruder:
    made = await anyio.to_thread.run_sync(Intruder, served.server.endpoint, mode)
    intruders.append(made)
    return made


def fields_for(name: str, client: str, what: str = "") -> bytes:
    """Return the question of a request that names a client."""
    if name == "cancel":
        return REQUESTS[name].question.encode({"goal_id": "", "client": client})
    return REQUESTS[name].question.encode({"client": client, "what": what})


async def in_thread(function: Any, *arguments: Any) -> Any:
    return await anyio.to_thread.run_sync(partial(function, *arguments))


async def settled(remote: RemoteHand) -> None:
    """Wait until what was sent before has been received: everything comes through one thread."""
    await remote.status()


async def test_nobody_moves_the_hand_under_the_name_of_its_holder(
    hand: Hand, library: ActionLibrary, mode: str, intruders: list[Intruder]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as victim:
        await victim.acquire_lease()
        bad = await intruder(served, mode, intruders)
        holder = (await victim.status()).holder
        assert holder == victim.client
        forged = Signer(holder)
        forged.key = key_of(bytes(32))
        goal = GOAL.encode(Goal(Named("fist"), client=holder))
        unsigned = "needs the attachment '<number> <client> <signature>'"
        for name in ("release", "cancel", "hold", "recover", "acquire"):
            question = fields_for(name, holder)
            for proof in (None, f"1 {holder}", forged.attachment("9", name, question)):
                (reason,) = await in_thread(bad.ask, name, question, proof)
                assert (unsigned if proof in (None, f"1 {holder}") else NOT_SIGNED) in reason
        for proof in (None, f"1 {holder}", forged.attachment("9", "do", goal)):
            (reason,) = await in_thread(bad.ask, "do", goal, proof)
            assert (unsigned if proof in (None, f"1 {holder}") else NOT_SIGNED) in reason
            await in_thread(bad.put, holder, goal, proof)
        await settled(victim)
        assert (await victim.status()).holder == victim.client
        assert served.watcher.goals == []


async def test_a_recorded_request_cannot_be_sent_again(
    hand: Hand, library: ActionLibrary, mode: str, intruders: list[Intruder]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as victim:
        bad = await intruder(served, mode, intruders)
        signer = victim._link._signer
        goal = GOAL.encode(Goal(Named("Trig", ("index",)), Intensity(0.1), client=victim.client))
        proof = signer.attachment(signer.number(), "do", goal)
        assert await in_thread(bad.ask, "do", goal, proof) == [""], "once it is good"
        await until(lambda: len(served.watcher.results) == 1)
        assert "larger than those before" in (await in_thread(bad.ask, "do", goal, proof))[0]
        # Neither for another request, nor with another question.
        other = GOAL.encode(Goal(Named("fist"), client=victim.client))
        number = signer.number()
        question = fields_for("hold", victim.client)
        proof = signer.attachment(number, "hold", question)
        assert NOT_SIGNED in (await in_thread(bad.ask, "do", other, proof))[0]
        assert NOT_SIGNED in (await in_thread(bad.ask, "recover", question, proof))[0]
        assert len(served.watcher.goals) == 1


async def test_names_in_messages_are_not_believed(hand: Hand, library: ActionLibrary) -> None:
    async with (
        serving(hand, library) as served,
        rtee.connect("small", client="one") as one,
        rtee.connect("small", client="two") as two,
    ):
        await one.acquire_lease()
        two._goals._link.client = one.client  # what it writes into its messages
        with pytest.raises(LeaseHeld):
            await two.do("fist")
        with pytest.raises(LeaseHeld):
            await two.hold()
        with pytest.raises(LeaseHeld):
            await two.jog({"near": 0.5})
        await two.release_lease()
        assert (await one.status()).holder == one.client
        assert list(await two.stop()) == ["sim"], "stop needs no permission"
        event = await served.event("stop")
        assert "by two-" in event.text


async def test_nobody_takes_the_name_of_another_client(
    hand: Hand, library: ActionLibrary, mode: str, intruders: list[Intruder]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as victim:
        bad = await intruder(served, mode, intruders)
        token = "0" * 32
        there = bad.session.liveliness().declare_token(f"rtee/small/clients/{token}")

        def hello(name: str, token: str) -> list[str]:
            found = bad.session.get(
                "rtee/small/hello/here", payload=fields_for("hello", name, token), timeout=1.0
            )
            return [
                REPLY.decode((each.err or each.ok).payload.to_bytes())["reason"] for each in found
            ]

        assert "already" in (await in_thread(hello, victim.client, token))[0]
        assert "32 random hexadecimal digits" in (await in_thread(hello, "x", "*"))[0]
        assert (await in_thread(hello, "x", token)) == [""]
        there.undeclare()


async def test_a_dead_client_is_missed_whatever_tokens_others_declare(
    hand: Hand, library: ActionLibrary, mode: str, intruders: list[Intruder]
) -> None:
    async with serving(hand, library) as served:
        bad = await intruder(served, mode, intruders)
        async with rtee.connect("small") as victim:
            liveliness = bad.session.liveliness()
            names = (victim.client, "*", "**", "0$*")
            tokens = [liveliness.declare_token(f"rtee/small/clients/{name}") for name in names]
            found = await in_thread(
                lambda: list(bad.session.liveliness().get("rtee/small/clients/*", timeout=0.5))
            )
            assert not any(victim._link._token_name in str(each.ok.key_expr) for each in found)
            await victim.start("fist", **LASTING)
        lost = await served.event("client_lost")
        assert lost.source == victim.client
        await until(lambda: bool(served.watcher.results))
        assert served.watcher.results[0].cancelled
        assert len(tokens) == 4


async def test_nobody_answers_or_speaks_for_the_hand(
    hand: Hand, library: ActionLibrary, mode: str, intruders: list[Intruder]
) -> None:
    async with serving(hand, library) as served:
        bad = await intruder(served, mode, intruders)
        for key in ("ask/*", "control/*", "stop/*", "hello/*", "**"):
            await in_thread(bad.answer, f"rtee/small/{key}", b"junk")
        for key in ("control/*", "put/**", "hello/*", "clients/*", "ask/*"):
            await in_thread(bad.listen, f"rtee/small/{key}")
        liveliness = bad.session.liveliness()
        tokens = [liveliness.declare_token(f"rtee/{name}/alive") for name in ("small", "other")]
        async with rtee.connect(endpoint=served.server.endpoint) as victim:
            events = victim.events()
            running = await victim.start("Trig", "index", intensity=0.3, speed=0.5)
            forged = RESULT.encode(Result(running.goal.goal_id, "Trig", reason="forged"))
            for topic, data in (
                ("results", forged),
                ("events", EVENT.encode(Event("stop", "x", "a lie", 0.0))),
                ("feedback", b"junk"),
                (f"answers/{victim.client}", b"junk"),
                ("goals", GOAL.encode(Goal(Named("fist")))),
                ("joint_states", b"junk"),
            ):
                await in_thread(partial(bad.session.put, f"rtee/small/{topic}", data))
            for name in ("status", "info", "actions"):
                assert await getattr(victim, name)() is not None
            assert list(await victim.stop()) == ["sim"]
            result = await running.result()
            assert result.reason != "forged"
            told = await anext(events)
            assert told.text != "a lie"
        assert bad.seen == []
        assert len(tokens) == 2


async def test_actions_and_recording_are_the_holders(
    hand: Hand, library: ActionLibrary, mode: str, intruders: list[Intruder]
) -> None:
    told = Told(Path("a.mcap"))
    async with (
        serving(hand, library, recorder=told) as served,
        rtee.connect("small") as holder,
        rtee.connect("small") as other,
    ):
        await holder.acquire_lease()
        bad = await intruder(served, mode, intruders)
        for name in ("remove", "store"):
            question = REQUESTS[name].question.encode(
                {"client": holder.client, "name": "fist", "what": ""}
            )
            assert "needs the attachment" in (await in_thread(bad.ask, name, question))[0]
        with pytest.raises(LeaseHeld):
            await other.remove_action("fist")
        with pytest.raises(LeaseHeld):
            await other.rename_action("fist", "x")
        with pytest.raises(LeaseHeld):
            await other.add_generic("x", {"near": 0.5})
        with pytest.raises(LeaseHeld):
            await other.record("stop")
        await other.record("mark", "anybody may note what they see")
        await holder.add_generic("x", {"near": 0.5})
        await holder.record("stop")
    assert told.calls == ["anybody may note what they see", "stop"]


@pytest.mark.parametrize("name", ["open", "Open", "OPEN", "o_pen"])
async def test_open_cannot_be_shadowed(hand: Hand, library: ActionLibrary, name: str) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match="brings the hand to rest"):
            await remote.add_generic(name, {"near": 1.5})
        with pytest.raises(RequestRejected, match="brings the hand to rest"):
            await remote.rename_action("fist", name)
        await remote.open()
        assert served.watcher.goals[-1].what == Named("open")
