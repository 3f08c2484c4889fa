from __future__ import annotations

import os
import random
from collections.abc import Iterator
from functools import partial

import anyio.to_thread
import pytest
import zenoh

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import MessageError
from rtee.hand.model import Hand
from rtee.messages.requests import HERE, REQUESTS, Request, inbox_key
from rtee.messages.schema import message_type
from rtee.remote.client import RemoteHand
from rtee.remote.incoming_request import LONGEST
from rtee.remote.session import open_client

from .serving import serving, until

pytestmark = pytest.mark.anyio

REPLY = message_type("rtee_msgs/msg/Reply")
WITH_CLIENT = [
    request
    for request in REQUESTS.values()
    if request.group == "control" and request.name != "hello"
]


class Rude:
    """Somebody on the network who sends what he likes."""

    def __init__(self, endpoint: str) -> None:
        self.session = open_client([endpoint])

    def ask(self, key: str, payload: bytes, signed: str | None = None) -> list[tuple[bool, bytes]]:
        replies = self.session.get(key, payload=payload, timeout=5.0, attachment=signed)
        return [
            (reply.ok is not None, (reply.ok or reply.err).payload.to_bytes()) for reply in replies
        ]

    def refusal(self, key: str, payload: bytes, signed: str | None = None) -> str:
        ((ok, data),) = self.ask(key, payload, signed)
        assert not ok, key
        reply = REPLY.decode(data)
        assert not reply["accepted"]
        assert reply["error"]
        assert "internal" not in reply["reason"]
        return str(reply["reason"])


def key_of(request: Request) -> str:
    return "rtee/small/hello/here" if request.name == "hello" else request.key("small")


def signed(remote: RemoteHand, request: str, payload: bytes, number: str = "") -> str:
    """Return what proves that a request is a client's."""
    signer = remote._link._signer
    return signer.attachment(number or signer.number(), request, payload)


@pytest.fixture
def rude() -> Iterator[list[Rude]]:
    made: list[Rude] = []
    yield made
    for one in made:
        one.session.close()


def _mutated(data: bytes, seed: int) -> bytes:
    source = random.Random(seed)
    out = bytearray(data)
    for _ in range(source.randint(1, 6)):
        at = source.randrange(len(out) + 1)
        match source.randrange(3):
            case 0:
                out[at : at + 1] = source.randbytes(1)
            case 1:
                del out[at : at + source.randint(1, 9)]
            case _:
                out[at:at] = source.randbytes(source.randint(1, 9))
    return bytes(out)


def _sensible(request: Request, client: str) -> bytes:
    values = {field.name: _value(field.kind, field.sequence) for field in request.question.fields}
    if "client" in values:
        values["client"] = client
    return request.question.encode(values)


def _value(kind: str, sequence: bool) -> object:
    if sequence:
        return []
    if "/" in kind:
        return {f.name: _value(f.kind, f.sequence) for f in message_type(kind).fields}
    return "x" if kind == "string" else 0


async def test_a_megabyte_of_junk_on_every_key_is_refused_with_a_reason(
    hand: Hand, library: ActionLibrary, rude: list[Rude]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude.append(Rude(served.server.endpoint))
        for request in REQUESTS.values():
            for junk in (os.urandom(1_000_000), b"\x00\x01\x00\x00" + bytes(LONGEST)):
                ask = rude[0].refusal
                reason = await anyio.to_thread.run_sync(ask, key_of(request), junk)
                assert "is more than any request has" in reason
        await _still_well(remote)
        assert served.watcher.goals[:-1] == []


async def test_short_junk_is_refused_with_a_reason(
    hand: Hand, library: ActionLibrary, rude: list[Rude]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude.append(Rude(served.server.endpoint))
        for request in REQUESTS.values():
            for junk in (b"{}", os.urandom(300), b"\x00\x01\x00\x00\xff\xff\xff\xff"):
                for proof in (None, signed(remote, request.name, junk)):
                    ask, key = rude[0].refusal, key_of(request)
                    reason = await anyio.to_thread.run_sync(ask, key, junk, proof)
                    unknown = proof is None and request.group not in ("hello", "stop")
                    assert ("needs the attachment" in reason) == unknown
        await _still_well(remote)


async def test_damaged_requests_end_in_an_answer(
    hand: Hand, library: ActionLibrary, rude: list[Rude]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude.append(Rude(served.server.endpoint))
        for request in REQUESTS.values():
            whole = _sensible(request, remote.client)
            for seed in range(8):
                data = _mutated(whole, seed)
                answers = await anyio.to_thread.run_sync(
                    rude[0].ask, key_of(request), data, signed(remote, request.name, data)
                )
                # A greeting of somebody who never comes has no answer until it times out.
                assert len(answers) == 1 or request.name == "hello"
                for ok, answer in answers:
                    (request.answer if ok else REPLY).decode(answer)
                if request.name == "hello":
                    break
        await _still_well(remote)


async def test_junk_that_is_put_is_refused_or_ignored(
    hand: Hand, library: ActionLibrary, rude: list[Rude]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude.append(Rude(served.server.endpoint))
        session, client = rude[0].session, remote.client
        put = partial(session.put, congestion_control=zenoh.CongestionControl.BLOCK)
        with session.declare_subscriber(f"rtee/small/answers/{client}") as answers:
            key = inbox_key("small", HERE, client)
            for junk in 2 * (b"", b"junk", bytes(LONGEST + 1)):
                for attachment in (None, "", f"7 {client}", f"7 {client} {'0' * 32}"):
                    put(key, junk, attachment=attachment)
                for attachment in ("7 " + "x" * 500, "7 nobody 00", "\u00fc 7 **"):
                    put(key, junk, attachment=attachment)
            # So much junk on a client's keys, and the hand does not listen there for a while.
            inbox = served.server.inboxes._inboxes[client]
            await until(lambda: inbox.closed)
            await until(lambda: not inbox.closed and inbox.subscriber is not None)
            number = remote._link._signer.number("mine")
            publisher = session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.BLOCK
            )
            # What is put before this session knows that the hand listens again goes nowhere.
            await until(lambda: publisher.matching_status.matching)
            async with remote.stream(50):
                publisher.put(b"junk", attachment=signed(remote, "sample", b"junk", number))
                sample = await anyio.to_thread.run_sync(answers.recv)
            assert sample.attachment.to_string() == f"-{number}", "who did not sign has no answer"
            assert REPLY.decode(sample.payload.to_bytes())["reason"]
        await _still_well(remote)
        assert [goal.client for goal in served.watcher.goals] == [client]


async def test_who_is_not_there_moves_nothing(
    hand: Hand, library: ActionLibrary, rude: list[Rude]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude.append(Rude(served.server.endpoint))
        for request in WITH_CLIENT:
            data = _sensible(request, "nobody")
            ok, answer = (await anyio.to_thread.run_sync(rude[0].ask, request.key("small"), data))[
                0
            ]
            assert not ok
            assert REPLY.decode(answer)["reason"]
        await _still_well(remote)


async def test_keys_that_are_no_requests(
    hand: Hand, library: ActionLibrary, rude: list[Rude]
) -> None:
    async with serving(hand, library) as served:
        rude.append(Rude(served.server.endpoint))
        for key in ("hello/root", "hello/here/x", "dance/do", "**"):
            answers = await anyio.to_thread.run_sync(rude[0].ask, f"rtee/small/{key}", b"")
            assert answers == [], "nothing like that reaches the hand"
        for key in ("control/dance", "ask/do", "stop/do", "control/stop", "ask/*"):
            ask = rude[0].refusal
            reason = await anyio.to_thread.run_sync(ask, f"rtee/small/{key}", b"")
            group, _, name = key.partition("/")
            assert reason.startswith(f"there is no request '{name}' in '{group}', but ")
        assert not [event for event in served.watcher.events if event.kind == "stop"]


async def test_junk_from_a_hand_is_ignored(
    hand: Hand, library: ActionLibrary, rude: list[Rude]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude.append(Rude(served.server.endpoint))
        running = await remote.start("fist", intensity=0.3)
        for topic in ("feedback", "results", "events"):
            remote._link._session.put(f"rtee/small/{topic}", b"junk")
        assert (await running.result()).reached


async def _still_well(remote: RemoteHand) -> None:
    assert (await remote.do("Trig", "index", intensity=0.1)).reached


def test_no_question_takes_longer_than_its_bytes() -> None:
    for request in REQUESTS.values():
        with pytest.raises(MessageError):
            request.question.decode(b"\x00\x01\x00\x00" + b"\xff" * LONGEST)
