"""What one client can cost the others: messages, requests, subscribers, stored actions."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import Iterator

import anyio
import anyio.to_thread
import pytest
import zenoh

import rtee
from rtee import monotonic
from rtee.actions.library import ActionLibrary
from rtee.errors import RequestRejected, TooManyRequests
from rtee.hand.model import Hand
from rtee.loop.settings import LoopSettings
from rtee.messages.identity import Signer, claim_of, key_of
from rtee.messages.requests import HERE, REQUESTS, Role, inbox_key
from rtee.remote import command_handlers, query_handlers, rates, server
from rtee.remote.call_queue import DelayQueue
from rtee.remote.identities import _MOST_WAITING, Admitted, Identities
from rtee.remote.incoming_request import IncomingRequest
from rtee.remote.publishing import MOST_STREAMS
from rtee.remote.rates import REFUSALS, Ignored, Rates
from rtee.remote.server import _Inbox
from rtee.remote.session import LARGEST, direct, open_client

from .serving import LASTING, serving, until
from .test_remote_lost import READER, printed_line, started

pytestmark = pytest.mark.anyio


@pytest.fixture
def sessions() -> Iterator[list[zenoh.Session]]:
    made: list[zenoh.Session] = []
    yield made
    for one in made:
        one.close()


def _memory() -> int:
    """Return the memory of this process [bytes]."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


SENDER = """
import sys
from rtee.messages.requests import HERE, inbox_key
from rtee.remote.session import open_client
import zenoh
session = open_client([sys.argv[1]])
print("there", flush=True)
sys.stdin.readline()
try:
    for _ in range(3):
        session.put(
            inbox_key("small", HERE, sys.argv[2]),
            bytes(100_000_000),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
except zenoh.ZError:
    pass  # the connection was closed
print("sent", flush=True)
sys.stdin.readline()
"""


async def test_large_messages_take_no_memory(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        sender = await started(SENDER, served.server.endpoint, remote.client)
        before = _memory()
        assert sender.stdin is not None
        await sender.stdin.send(b"\n")
        assert await printed_line(sender) == b"sent"
        assert (await remote.do("Trig", "index", intensity=0.1)).reached
        assert _memory() - before < 20 * LARGEST
        sender.kill()
        await sender.aclose()


async def test_who_asks_too_often_is_refused_and_others_are_not(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rates, "_BURST", 5e6)
    monkeypatch.setitem(rates._RATES, "info", 1e-6)
    async with (
        serving(hand, library),
        rtee.connect("small", client="flood") as flood,
        rtee.connect("small") as other,
    ):
        for number in range(5):
            await flood.info({"near": number / 10})
        question = REQUESTS["info"].question.encode({"name": ["near"], "position": [0.9]})
        with pytest.raises(TooManyRequests, match="too many requests 'info'"):
            await flood._link.send("info", question)
        await flood.status()  # other kinds are counted for themselves
        assert (await other.info()).name == "small"


async def test_who_puts_too_much_is_not_heard_for_a_while_and_others_are(
    hand: Hand, library: ActionLibrary
) -> None:
    async with (
        serving(hand, library) as served,
        rtee.connect("small", client="flood") as flood,
        rtee.connect("small") as other,
    ):
        inboxes = served.server.inboxes._inboxes
        assert sorted(inboxes) == sorted([flood.client, other.client])

        def shut_out() -> bool:
            for _ in range(50):
                flood._link.put(b"of no stream", "s1")
            return inboxes[flood.client].closed

        async with other.lease():
            await until(shut_out)
            result = await other.do("Trig", "index", intensity=0.1)
            assert result.reached, result
            assert await flood.status(), "requests have their own limits"
            assert list(await flood.stop()) == ["sim"]
        assert (await flood.do("Trig", "index", intensity=0.2)).reached
        async with other.lease():
            await until(shut_out)  # and leaves meanwhile


async def test_an_inbox_goes_with_its_client(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        async with rtee.connect("small") as remote:
            assert list(served.server.inboxes._inboxes) == [remote.client]
        await until(lambda: not served.server.inboxes._inboxes)


async def test_junk_on_the_key_of_a_client_is_not_heard_for_long(
    hand: Hand, library: ActionLibrary, sessions: list[zenoh.Session]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        sessions.append(open_client([served.server.endpoint]))
        key = inbox_key("small", HERE, remote.client)
        inbox = served.server.inboxes._inboxes[remote.client]
        publisher = sessions[0].declare_publisher(
            key, congestion_control=zenoh.CongestionControl.BLOCK
        )

        def closed() -> bool:
            for _ in range(10):
                publisher.put(b"junk")
            return inbox.closed

        await until(closed)
        await until(lambda: not inbox.closed and inbox.subscriber is not None)
        assert (await remote.do("Trig", "index", intensity=0.1)).reached


async def test_a_script_that_asks_too_often_only_takes_longer(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        for number in range(30):
            await remote.info({"near": number / 30})


async def test_who_asks_all_at_once_is_answered_in_turn(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library), rtee.connect("small") as remote:
        # More than the hand answers or refuses at once: it drops what is beyond.
        states = await asyncio.gather(*(remote.state() for _ in range(170)))
        assert len({state.names for state in states}) == 1
        for _ in range(60):
            await remote.state()


def test_rates() -> None:
    now = 100.0
    one = Rates(lambda: now)
    assert sum(one.allow("info") for _ in range(100)) == 10
    assert one.wait("info") == pytest.approx(1.0 / 20.0)
    assert one.wait("jog") == 0.0
    assert one.allow("status"), "kinds are counted for themselves"
    now += 0.5
    assert sum(one.allow("info") for _ in range(100)) == 10
    for _ in range(100):
        with pytest.raises(RequestRejected, match="why"):
            one.refuse("why")
    with pytest.raises(Ignored):
        one.refuse("why")
    assert not one.allow(REFUSALS)


def test_who_goes_on_to_put_too_much_is_heard_ever_less(monkeypatch: pytest.MonkeyPatch) -> None:
    now, inbox = 100.0, _Inbox("key")
    monkeypatch.setattr(monotonic, "now", lambda: now)
    times = []
    for _ in range(7):
        inbox.close()
        assert inbox.closed
        times.append(inbox.closed_for)
        now = inbox.until + 0.1
    assert times == [1.0, 2.0, 4.0, 8.0, 16.0, 16.0, 16.0]
    now += 40.0
    inbox.close()
    assert inbox.closed_for == 1.0


def test_rates_of_bytes() -> None:
    now = 100.0
    one = Rates(lambda: now)
    one.charge(1_999_999)
    assert one.has_bytes(), "an answer may be of any length as long as something is left"
    one.charge(1_000_001)
    assert not one.has_bytes()
    now += 0.5
    assert not one.has_bytes()
    now += 0.6
    assert one.has_bytes()


async def test_who_has_had_long_answers_waits_for_more_and_others_do_not(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with (
        serving(hand, library),
        rtee.connect("small", client="flood") as flood,
        rtee.connect("small") as other,
        rtee.connect("small") as third,
    ):
        question = REQUESTS["actions"].question.encode({"kind": "", "name": "", "elements": ()})
        length = len(await other._link.send("actions", question))
        monkeypatch.setattr(rates, "_BURST_BYTES", length / 2.0)
        monkeypatch.setattr(rates, "_MOST_BYTES", 1e-6)
        assert await flood._link.send("actions", question)
        with pytest.raises(TooManyRequests, match="too many long answers"):
            await flood._link.send("actions", question)
        assert (await flood.do("Trig", "index", intensity=0.1)).reached
        assert await third._link.send("actions", question)


def test_delayed_calls() -> None:
    calls = DelayQueue("test", 1e6, most=2)
    made: list[int] = []
    while calls.put(lambda: made.append(1)):
        pass  # the thread takes one, two more wait
    assert (made, calls.dropped) == ([], 1)
    calls.close()
    assert len(made) in (2, 3)


async def test_who_is_not_answered_any_more_waits_for_that(
    hand: Hand,
    library: ActionLibrary,
    sessions: list[zenoh.Session],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server, "_REFUSED_AFTER", 1e6)
    monkeypatch.setitem(rates._RATES, REFUSALS, 0.0)
    async with serving(hand, library) as served:
        rude = await anyio.to_thread.run_sync(open_client, [served.server.endpoint])
        sessions.append(rude)

        def ask(group: str, payload: bytes) -> threading.Event:
            ended = threading.Event()
            key, done = f"rtee/small/{group}", direct(lambda _: None, ended.set)
            rude.get(key, done, payload=payload, timeout=100.0)
            return ended

        early = [ask("ask/info", b"x"), ask("control/acquire", b"x")]
        long = ask("ask/info", bytes(5000))  # would keep memory
        assert await anyio.to_thread.run_sync(long.wait, 30)
        assert not any(each.is_set() for each in early)
    for each in early:
        assert await anyio.to_thread.run_sync(each.wait, 30)


async def test_what_is_no_request_is_not_answered_without_end(
    hand: Hand,
    library: ActionLibrary,
    sessions: list[zenoh.Session],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(rates._RATES, REFUSALS, 1e-6)
    monkeypatch.setattr(rates, "_BURST", 3e6)
    async with serving(hand, library) as served:
        rude = await anyio.to_thread.run_sync(open_client, [served.server.endpoint])
        sessions.append(rude)

        def ask(key: str, payload: bytes) -> bool:
            return bool(list(rude.get(f"rtee/small/{key}", payload=payload, timeout=30.0)))

        junk = [("control/do", b""), ("ask/info", bytes(70_000)), ("stop/stop", b"")]
        junk += [("hello/here", b""), *junk]
        answered = [await anyio.to_thread.run_sync(ask, *each) for each in junk]
        assert answered == [True, True, True, False, False, False, False]


async def test_stops_are_carried_out_together_and_always_take_effect(
    hand: Hand,
    library: ActionLibrary,
    sessions: list[zenoh.Session],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(command_handlers, "_STOPPED_FOR", 1e9)
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude = await anyio.to_thread.run_sync(open_client, [served.server.endpoint])
        sessions.append(rude)
        question = REQUESTS["stop"].question.encode({"client": "x", "what": ""})

        def flood() -> None:
            for _ in range(500):
                rude.get("rtee/small/stop/stop", payload=question, timeout=0.1)

        def stops() -> int:
            return sum(event.kind == "stop" for event in served.watcher.events)

        await anyio.to_thread.run_sync(flood)
        await until(lambda: stops() > 0)
        assert list(await remote.stop()) == ["sim"]
        # All that came during the first one were carried out together; unless the computer was too
        # busy to confirm them, they count for those afterwards.
        told = [event for event in served.watcher.events if event.kind == "stop"]
        assert stops() <= 2 or any("not confirmed" in event.text for event in told)
        # One that comes right after another, but with a goal in between, ends that goal.
        for _ in range(5):
            running = await remote.start("fist", **LASTING)
            assert list(await remote.stop()) == ["sim"]
            assert (await running.result()).cancelled


async def test_many_stops_are_all_answered_and_later_ones_later(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_REFUSED_AFTER", 1e6)
    monkeypatch.setitem(rates._RATES, "stop", 1e-6)
    monkeypatch.setattr(rates, "_BURST", 3e6)
    done: list[int] = []
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        remote._stops = None  # through the network

        async def stop(number: int) -> None:
            assert list(await remote.stop()) == ["sim"]
            done.append(number)

        async with anyio.create_task_group() as group:
            for number in range(3):
                await stop(number)
            running = await remote.start("fist", **LASTING)
            group.start_soon(stop, 3)
            assert (await running.result()).cancelled
            assert done == [0, 1, 2], "it has stopped the hand, and is told so later"
            await until(lambda: served.server.refused._waiting.qsize() == 0)
            served.server.refused._closing.set()
    assert done == [0, 1, 2, 3]


async def test_many_rates_of_states_leave_some_for_others(
    hand: Hand, library: ActionLibrary, sessions: list[zenoh.Session]
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as greedy:
        rude = await anyio.to_thread.run_sync(open_client, [served.server.endpoint])
        sessions.append(rude)
        subscribers = []
        for every in range(1, MOST_STREAMS + 1):
            topic = await greedy._monitoring._stream(200.0 / every)
            subscribers.append(rude.declare_subscriber(f"rtee/small/{topic}"))
        streams = served.server._queries._streams
        await until(
            lambda: sum(one.publisher.wanted for one in streams._asked.values()) == MOST_STREAMS
        )
        async with rtee.connect("small") as other:
            assert await other._monitoring._stream(200.0 / 100) == "states/64"
            assert (await anext(other.states(200.0 / 64))).names
        assert len(subscribers) == MOST_STREAMS


async def test_stalled_subscribers_hold_up_nobody(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        readers = [await started(READER) for _ in range(4)]
        async with rtee.connect("small") as other:
            for process in readers:
                os.kill(process.pid, signal.SIGTSTP)
            while len(served.server._identities) > 1:
                assert (await other.do("Trig", "index", intensity=0.1)).reached
                assert (await other.do("Trig", "index", intensity=0.2)).reached
            assert served.server.outbox.dropped == 0
        for process in readers:
            process.kill()
            await process.aclose()


READERS = """
import sys, time, anyio, rtee
from contextlib import AsyncExitStack
from rtee.remote.session import direct
async def main():
    async with AsyncExitStack() as stack:
        for number in range(20):
            hand = await stack.enter_async_context(rtee.connect("small", client=f"r{number}"))
            await stack.enter_async_context(hand.collected_states(1000.0))
        print("there", flush=True)
        await anyio.to_thread.run_sync(sys.stdin.readline)
        # Zenoh has one thread here that reads, for all sessions; another goes on to say that they
        # are alive.
        block = direct(lambda _: time.sleep(1e6))
        subscriber = hand._link._session.declare_subscriber("rtee/small/**", block)
        print("blocked", flush=True)
        await anyio.sleep_forever()
anyio.run(main)
"""
"""Twenty sessions that stop to read, and still say that they are alive."""


@pytest.mark.samples("frozen")
@pytest.mark.parametrize("how", ["frozen", "blocked"])
async def test_twenty_sessions_that_stop_to_read_hold_up_nobody(
    hand: Hand, library: ActionLibrary, how: str
) -> None:
    async with serving(hand, library, settings=LoopSettings(rate=1000.0)) as served:
        readers = await started(READERS)
        async with rtee.connect("small") as other, other.collected_states(100.0) as states:
            assert len(served.server._identities) == 21
            before = _memory()
            if how == "frozen":
                os.kill(readers.pid, signal.SIGTSTP)
            else:
                assert readers.stdin is not None
                await readers.stdin.send(b"\n")
                assert await printed_line(readers) == b"blocked"
            for intensity in (0.1, 0.2) * 6:  # some seconds, for which states go on to come
                states.drain()
                assert (await other.do("Trig", "index", intensity=intensity)).reached
                await other.status()  # fails when there is no answer within 5 s
                assert states.drain()
            # No more than the megabyte that the hand keeps for each that does not read.
            assert _memory() - before < 20 * LARGEST
            assert served.server.outbox.dropped == 0
        readers.kill()
        await readers.aclose()


async def test_only_so_many_actions_can_be_added(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(query_handlers, "_MOST_ACTIONS", 5)
    async with serving(hand, library), rtee.connect("small") as remote:
        await remote.add_generic("a", {"near": 0.5}, store=True)
        await remote.add_generic("b", {"near": 0.5}, store=True)
        with pytest.raises(RequestRejected, match="has 5 actions besides the primitives"):
            await remote.add_generic("c", {"near": 0.5}, store=True)
        await remote.remove_action("b")
        await remote.add_generic("c", {"near": 0.5}, store=True)


def test_clients_that_vanish_are_forgotten() -> None:
    identities, answers = Identities(), []

    def hello(name: str, token: str) -> None:
        request = REQUESTS["hello"]
        question = request.question.encode({"client": name, "what": token})
        asked = IncomingRequest(request, question, lambda data, ok: answers.append(ok), "")
        identities.hello(asked, "here")

    for number in range(5 * _MOST_WAITING):
        hello(f"ghost-{number}", f"{number:032x}")
        identities.came(f"{number + 1_000_000:032x}")
    assert len(identities) == 0
    assert len(identities._greeting) == len(identities._tokens) == _MOST_WAITING
    for number in range(5 * _MOST_WAITING):  # those that came and went
        token = f"{number + 2_000_000:032x}"
        hello("busy", token)
        identities.came(token)
        assert "busy" in identities
        assert identities.left(token) == "busy"
        assert "busy" not in identities
    assert len(identities._gone) <= _MOST_WAITING
    assert all(answers)


class Asking:
    """A client of a certificate, without a network."""

    def __init__(self, identities: Identities, access_path: str, number: int) -> None:
        self._identities, self.name = identities, f"{access_path}.{number}"
        answers: list[bytes] = []
        token = f"{access_path}{number}".encode().hex().zfill(32)
        request = REQUESTS["hello"]
        question = request.question.encode({"client": self.name, "what": token})
        identities.came(token)
        asked = IncomingRequest(request, question, lambda data, _: answers.append(data), "")
        identities.hello(asked, access_path)
        self._signer = Signer(self.name)
        secret = request.answer.decode(answers[0])["text"].split()[0]
        self._signer.key = key_of(bytes.fromhex(secret))

    def asks(self, kind: str = "status") -> bool:
        """Return whether it may ask once more."""
        proof = self._signer.attachment(self._signer.number(), kind, b"").encode()
        try:
            return self._identities.check(REQUESTS[kind], proof, b"") == self.name
        except (TooManyRequests, Ignored):
            return False


def test_more_clients_give_a_certificate_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each client within its own limits: sixty times what one may, before those of others."""
    now = 1000.0
    monkeypatch.setattr(Rates.__init__, "__defaults__", (lambda: now, 1.0))
    identities = Identities(lambda access_path: Admitted(Role.MAINTAINER, f"{access_path}."))
    ann = [Asking(identities, "ann", number) for number in range(40)]
    quiet, ben = Asking(identities, "ann", 40), Asking(identities, "ben", 0)

    def flood() -> int:
        return sum(client.asks() for client in ann for _ in range(60))

    once = flood()
    # Half of what comes in a second at once, by eight; the others have what is reserved for each.
    assert once == rates.TOGETHER * 50 + 32 * 3
    assert sum(quiet.asks() for _ in range(60)) == 3, "the others have left it nothing"
    assert ben.asks()
    assert sum(ben.asks() for _ in range(60)) == 49, "what it may alone"
    now += 1.0
    assert flood() == once
    now += 1.0
    identities.charge(ann[0].name, int(rates.TOGETHER * 2.1e6))
    now += 1.0
    assert not ann[0].asks(), "its answer was long"
    assert quiet.asks(), "it has had no long answer"
    assert ben.asks()


def test_who_was_interrupted_comes_back_with_its_token() -> None:
    identities, answers = Identities(), []
    request = REQUESTS["hello"]
    question = request.question.encode({"client": "one", "what": "0" * 32})
    identities.came("0" * 32)
    identities.hello(
        IncomingRequest(request, question, lambda data, _: answers.append(data), ""), "here"
    )
    signer = Signer("one")
    signer.key = key_of(bytes.fromhex(request.answer.decode(answers[0])["text"].split()[0]))

    def ask() -> str:
        proof = signer.attachment(signer.number(), "status", b"").encode()
        return identities.check(REQUESTS["status"], proof, b"")

    assert ask() == "one"
    assert identities.left("0" * 32) == "one"
    with pytest.raises(RequestRejected, match="there is no client 'one' here; say hello first"):
        ask()
    identities.came("1" * 32)
    with pytest.raises(RequestRejected, match="there is no client 'one' here; say hello first"):
        ask()
    identities.came("0" * 32)
    assert ask() == "one"


@pytest.mark.parametrize(
    "attachment", [None, b"", b"1", b"1 x", b"1 x y z", b"1 x \xff", b"1 x " + b"0" * 300]
)
def test_attachments_of_another_form_claim_nothing(attachment: bytes | None) -> None:
    assert claim_of(attachment) is None


@pytest.mark.parametrize("number", ["", "x", "-1", "1e3", "\u0661", ".5"])
def test_numbers_that_are_none_count_for_nothing(number: str) -> None:
    claim = claim_of(f"{number} x 00".encode())
    assert claim is None or claim.count == 0
