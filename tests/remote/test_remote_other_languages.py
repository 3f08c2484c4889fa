"""What docs/reference/network.md tells programs in other languages."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio.to_thread
import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.hand.model import Hand
from rtee.messages import GOAL
from rtee.messages.identity import Signer, key_of
from rtee.messages.schema import message_type
from rtee.types import Goal, Intensity, Named

from .serving import serving
from .test_remote_junk import Rude, signed

pytestmark = pytest.mark.anyio

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/reference/network.md").read_text()
REQUEST = message_type("rtee_msgs/msg/ClientRequest")
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="Node is not installed: no 'node' on the path")


def node(*words: str) -> subprocess.CompletedProcess[str]:
    command = [str(NODE), str(ROOT / "examples/client.mjs"), *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@needs_node
async def test_a_client_in_javascript(hand: Hand, library: ActionLibrary) -> None:
    async def run(*words: str) -> subprocess.CompletedProcess[str]:
        return await anyio.to_thread.run_sync(node, *words)

    assert len((ROOT / "examples/client.mjs").read_text().splitlines()) <= 300
    missing = await run("small", "open")
    assert missing.returncode == 2
    assert missing.stderr == "client: no hand 'small' runs here; start it with 'rtee run small'\n"
    async with serving(hand, library) as served:
        done = await run("small", "PinchTight", "thumb", "index", "--intensity", "0.5")
        assert (done.stderr, done.returncode) == ("", 0)
        assert json.loads(done.stdout)["reached"]
        (goal,) = served.watcher.goals
        # As a client of rtee sends it: the page's defaults are its own.
        meant = Goal(Named("PinchTight", ("thumb", "index")), Intensity(0.5))
        assert goal == replace(meant, goal_id=goal.goal_id, client=goal.client)
        refused = await run("small", "Nothing")
        assert refused.returncode == 2
        assert refused.stderr.startswith("client: UnknownAction: unknown action 'Nothing'; valid: ")


async def test_what_a_wrong_request_gets(hand: Hand, library: ActionLibrary) -> None:
    section = PAGE.split("### Requests")[1].split("### ")[0]
    row = r"^\| .* \| `(?:Request|Message)\w+`: (.*?)(?: ….*)? \|$"
    told = re.findall(row, section, re.MULTILINE)
    assert len(told) == 5
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude = Rude(served.server.endpoint)
        question = REQUEST.encode({"client": remote.client, "what": ""})
        key = "rtee/small/control/hold"
        good = signed(remote, "hold", question)
        stranger = good.replace(remote.client, "NAME")
        # First: to strangers the hand answers but a few refusals in a second.
        unknown = rude.refusal("rtee/small/ask/x", b"", good)
        assert unknown.startswith(f"{told[4]} stream, state, goal")
        seen: list[str] = []
        for proof in (None, "1 a", stranger, good[:-1] + "!", good, good):
            found = rude.ask(key, question, proof)
            if found[0][0]:
                continue
            reason = message_type("rtee_msgs/msg/Reply").decode(found[0][1])["reason"]
            reason = reason.replace(remote.client, "NAME").replace("'hold'", "'do'")
            (fitting,) = [sentence for sentence in told if reason.startswith(sentence)]
            seen.append(fitting)
        assert list(dict.fromkeys(seen)) == told[:4]
        assert rude.ask("rtee/small/nothing/x", b"") == []
        rude.session.close()


async def test_each_field_of_a_goal(hand: Hand, library: ActionLibrary) -> None:
    table = PAGE.split("### A goal")[1].split("### ")[0]
    rows = re.findall(r"^\| (`.*) \| (.*) \| (.*) \|$", table, re.MULTILINE)
    zeros = {name: zero for names, _, zero in rows for name in re.findall(r"`(\w+)`", names)}
    goal = GOAL.fields(Goal(Named("Trig", ("index",)), goal_id="g"))
    assert list(zeros) == list(goal)
    empty: dict[type, Any] = {float: 0.0, bool: False, str: ""}
    refused = []
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        rude = Rude(served.server.endpoint)
        for name, value in goal.items():
            # Lists, and the header, are empty as they are; this hand has no openings.
            if (type(value) not in empty and name != "stage") or name == "opening":
                continue
            zero = "" if name == "stage" else empty[type(value)]
            fields = {**goal, "goal_id": f"without-{name}", name: zero}
            if name in ("force", "tip_speed", "max_force"):  # which need a width
                fields = {"force": 1.0, **fields} | {"opening": 0.01, "action": "", name: zero}
            payload = message_type("rtee_msgs/msg/Goal").encode(fields)
            if not rude.ask("rtee/small/control/do", payload, signed(remote, "do", payload))[0][0]:
                refused.append(name)
            await remote.hold()
        rude.session.close()
    assert refused == [name for name, zero in zeros.items() if zero.startswith("refused")]


def test_the_example_of_a_signature() -> None:
    signer = Signer("x")
    signer.key = key_of(bytes(32))
    assert f"`{signer.attachment('1', 'status', b'').split()[2]}`" in PAGE
