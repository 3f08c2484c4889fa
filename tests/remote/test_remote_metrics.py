"""Metrics of hands as Prometheus scrapes them, and the alerts and the dashboard made of them."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import anyio
import anyio.to_thread
import pytest
from ruamel.yaml import YAML

import rtee
from rtee.actions.library import ActionLibrary
from rtee.cli.metrics import metrics
from rtee.hand.model import Hand
from rtee.remote.fleet import HandAddress, Look, following

from .serving import serving

pytestmark = pytest.mark.anyio

pytest.importorskip("prometheus_client", reason="needs the extra metrics")

DEPLOY = Path(__file__).parent.parent.parent / "deploy" / "prometheus"


def _scraped(port: int) -> str:
    accept = {"Accept": "application/openmetrics-text; version=1.0.0"}
    request = urllib.request.Request(f"http://127.0.0.1:{port}/metrics", headers=accept)
    with urllib.request.urlopen(request) as answer:
        return str(answer.read().decode())


async def test_a_scrape_tells_what_the_hand_did(hand: Hand, library: ActionLibrary) -> None:
    from prometheus_client.openmetrics.parser import text_string_to_metric_families

    from rtee.remote.metrics import serving as serving_metrics

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    async with serving(hand, library), following() as fleet, rtee.connect() as remote:
        await remote.do("Trig", "index", intensity=0.2)
        await remote.stop()
        await fleet.known()
        with serving_metrics(fleet, f"127.0.0.1:{port}"):
            text = await anyio.to_thread.run_sync(_scraped, port)
    samples = {
        (
            sample.name,
            *(sample.labels.get(k, "") for k in ("device", "outcome", "le")),
        ): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.labels["hand"] == "small"
    }
    assert samples["rtee_up", "", "", ""] == 1.0
    assert samples["rtee_goals_total", "", "reached", ""] == 1.0
    assert samples["rtee_stops_total", "", "", ""] == 1.0
    assert samples["rtee_device_active", "sim", "", ""] == 1.0
    assert samples["rtee_clients", "", "", ""] == 2.0
    ticks = samples["rtee_loop_ticks_total", "", "", ""]
    assert samples["rtee_loop_busy_seconds_bucket", "", "", "+Inf"] >= ticks > 0


async def test_connections_that_ask_for_nothing_are_few_and_keep_nobody_out() -> None:
    from rtee.remote.metrics import serving as serving_metrics

    def flood(port: int) -> str:
        with contextlib.ExitStack() as opened:
            silent = [
                opened.enter_context(socket.create_connection(("127.0.0.1", port)))
                for _ in range(100)
            ]
            # The oldest is closed, the newest is not.
            assert silent[0].recv(1) == b""
            silent[-1].sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
            assert silent[-1].recv(100).startswith(b"HTTP/1.0 200")
            return _scraped(port)

    async with following() as fleet:
        with serving_metrics(fleet, "127.0.0.1:0") as address:
            port = int(address.rpartition(":")[2].partition("/")[0])
            assert await anyio.to_thread.run_sync(flood, port)


async def test_silent_connections_end_no_answer_that_takes_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from rtee.remote import metrics

    begun, flooded = threading.Event(), threading.Event()

    def slowly(collector: object) -> Iterator[object]:
        begun.set()
        assert flooded.wait(60.0)
        yield from metrics.families([])

    def flood(port: int) -> None:
        with contextlib.ExitStack() as opened:
            assert begun.wait(60.0)
            for _ in range(100):
                opened.enter_context(socket.create_connection(("127.0.0.1", port)))
            last = opened.enter_context(socket.create_connection(("127.0.0.1", port)))
            last.sendall(b"GET / HTTP/1.0\r\n\r\n")
            flooded.set()  # the server has accepted all before it
            assert last.recv(100).startswith(b"HTTP/1.0 200")

    async with following() as fleet:
        with metrics.serving(fleet, "127.0.0.1:0") as address:
            port = int(address.rpartition(":")[2].partition("/")[0])
            monkeypatch.setattr(metrics._FleetCollector, "collect", slowly)
            async with anyio.create_task_group() as group:
                group.start_soon(anyio.to_thread.run_sync, flood, port)
                assert "rtee_up" in await anyio.to_thread.run_sync(_scraped, port)


async def test_the_command_says_where_it_serves(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def at_once() -> None:
        """Ctrl-C."""

    monkeypatch.setattr(anyio, "sleep_forever", at_once)
    await anyio.to_thread.run_sync(partial(metrics, listen="127.0.0.1:0"))
    said = capsys.readouterr().out
    assert re.fullmatch(r"rtee: metrics at http://127\.0\.0\.1:[1-9]\d*/metrics\n", said)


async def test_alerts_and_dashboard_name_metrics_that_there_are(
    hand: Hand, library: ActionLibrary
) -> None:
    from rtee.remote.metrics import families

    async with serving(hand, library), rtee.connect() as remote:
        look = Look(HandAddress("small"), await remote.status(), await remote.state())
    known = {family.name for family in families([look])}
    rules = YAML(typ="safe").load(DEPLOY / "rtee-alerts.yaml")["groups"][0]["rules"]
    panels = json.loads((DEPLOY / "grafana-dashboard.json").read_text())["panels"]
    used = [rule["expr"] for rule in rules]
    used += [target["expr"] for panel in panels for target in panel["targets"]]
    named = {
        re.sub("_(total|bucket|info)$", "", name)
        for text in used
        for name in re.findall(r"\brtee_[a-z_]+", text)
    }
    assert named
    assert named <= known
