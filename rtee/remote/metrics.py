"""Metrics of running hands for Prometheus, served with Prometheus' own client library.

A separate process queries the hands at each scrape only; a hand's process does nothing but answer.
Names follow Prometheus' rules: they end with the base unit in plural, and with ``_total`` for
counters.
"""

from __future__ import annotations

import asyncio
import math
import socket
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from socketserver import ThreadingMixIn
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
)

from rtee.errors import ConfigError
from rtee.remote.fleet import Fleet, Look
from rtee.remote.monitoring import HandStatus
from rtee.remote.session import address_of
from rtee.types import DeviceStatus, Lifecycle

_SCRAPED_WITHIN = 5.0
"""Time for all hands to answer a scrape [s]: half of Prometheus' own timeout."""

_MOST_OPEN: Final = 32
"""Connections that are served at once: more than a site has programs that ask for metrics."""

_Hand = Callable[[HandStatus], float]
_Device = Callable[[DeviceStatus], float]
_COUNTER, _GAUGE = CounterMetricFamily, GaugeMetricFamily

_OF_HANDS: Sequence[tuple[Any, str, str, _Hand]] = (
    (_COUNTER, "loop_ticks", "Ticks of the loop.", lambda s: s.statistics.ticks),
    (
        _COUNTER,
        "loop_missed_ticks",
        "Ticks that began late by a period.",
        lambda s: s.statistics.missed,
    ),
    (
        _GAUGE,
        "loop_rate_hertz",
        "Rate of the loop over the last second.",
        lambda s: s.statistics.measured_rate,
    ),
    (_GAUGE, "loop_configured_rate_hertz", "Rate that is configured.", lambda s: s.statistics.rate),
    (
        _GAUGE,
        "loop_lateness_max_seconds",
        "Largest lateness of a tick.",
        lambda s: s.statistics.lateness_max,
    ),
    (
        _COUNTER,
        "recorder_dropped_records",
        "Records that were not written.",
        lambda s: s.statistics.dropped,
    ),
    (_GAUGE, "recorder_recording", "Whether a recording is written.", lambda s: bool(s.recording)),
    (
        _GAUGE,
        "recorder_trouble",
        "Whether a recording lost something.",
        lambda s: bool(s.recording_trouble),
    ),
    (_GAUGE, "clients", "Connected clients, this one among them.", lambda s: s.counts.clients),
    (_GAUGE, "leased", "Whether a client holds the hand.", lambda s: bool(s.holder)),
    (_GAUGE, "goal_running", "Whether a goal runs.", lambda s: bool(s.goal_id)),
    (_COUNTER, "stops", "Stops.", lambda s: s.counts.stops),
)
"""Kind, name, meaning and value of the metrics of a hand."""

_OF_DEVICES: Sequence[tuple[Any, str, str, _Device]] = (
    (
        _GAUGE,
        "device_active",
        "Whether it follows references.",
        lambda d: d.lifecycle is Lifecycle.ACTIVE,
    ),
    (_GAUGE, "device_fault_code", "The device's own code; 0: none.", lambda d: d.fault_code),
    (_GAUGE, "device_rate_hertz", "Rate of exchanges.", lambda d: d.rate),
    (_GAUGE, "device_age_seconds", "Age of the newest measurement.", lambda d: d.age),
    (_COUNTER, "device_exchanges", "Exchanges.", lambda d: d.exchanges),
    (_COUNTER, "device_errors", "Exchanges that failed.", lambda d: d.errors),
    (_COUNTER, "device_overruns", "Exchanges that missed their deadline.", lambda d: d.overruns),
    (_COUNTER, "device_reconnects", "Times it was connected again.", lambda d: d.reconnects),
)
"""Counters of a device."""

_OF_ACTUATORS = (
    ("actuator_temperature_celsius", "Temperature.", "temperature"),
    ("actuator_current_amperes", "Current.", "current"),
)
"""Name, meaning and attribute of a state, of the metrics of an actuator."""


def families(looks: Sequence[Look]) -> Iterator[Any]:
    """Yield the metrics of hands, as families of ``prometheus_client``."""
    hand = ("hand", "endpoint")
    up = GaugeMetricFamily("rtee_up", "Whether the hand answers.", labels=hand)
    answered = []
    for look in looks:
        up.add_metric(_labels(look), float(look.status is not None))
        if look.status is not None:
            answered.append((_labels(look), look, look.status))
    yield up
    for kind, name, text, of_hand in _OF_HANDS:
        family = kind(f"rtee_{name}", text, labels=hand)
        for labels, _, status in answered:
            family.add_metric(labels, float(of_hand(status)))
        yield family
    for kind, name, text, of_device in _OF_DEVICES:
        family = kind(f"rtee_{name}", text, labels=(*hand, "device", "driver"))
        for labels, _, status in answered:
            for device in status.devices:
                family.add_metric([*labels, device.name, device.driver], float(of_device(device)))
        yield family
    for name, text, attribute in _OF_ACTUATORS:
        family = GaugeMetricFamily(f"rtee_{name}", text, labels=(*hand, "actuator"))
        for labels, look, _ in answered:
            if look.state is None:
                continue
            values = getattr(look.state, attribute).tolist()
            for actuator, value in zip(look.state.names, values, strict=True):
                if not math.isnan(value):  # it is not measured
                    family.add_metric([*labels, actuator], value)
        yield family
    goals = CounterMetricFamily("rtee_goals", "Goals by outcome.", labels=(*hand, "outcome"))
    build = InfoMetricFamily("rtee_build", "The hand's software.", labels=hand)
    late = HistogramMetricFamily("rtee_loop_lateness_seconds", "Lateness of ticks.", labels=hand)
    busy = HistogramMetricFamily("rtee_loop_busy_seconds", "Processor time of ticks.", labels=hand)
    for labels, _, status in answered:
        counts = status.counts
        for outcome, count in counts.goals.items():
            goals.add_metric([*labels, outcome], count)
        build.add_metric(labels, {"version": counts.version, "profile": status.profile})
        for family, seen, total in (
            (late, counts.lateness, counts.lateness_sum),
            (busy, counts.busy, counts.busy_sum),
        ):
            buckets = [(str(bound), n) for bound, n in zip(counts.bound, seen, strict=True)]
            # The buckets are counted a little later than the total, and may contain more ticks.
            last = max([status.statistics.ticks, *seen])
            family.add_metric(labels, [*buckets, ("+Inf", last)], total)
    yield from (goals, build, late, busy)


def _labels(look: Look) -> list[str]:
    return [look.place.hand, look.place.endpoint]


class _FleetCollector:
    """Asks a fleet at each scrape, in the thread of the HTTP server."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet, self._loop = fleet, asyncio.get_running_loop()

    def collect(self) -> Iterator[Any]:
        """Yield the metrics of all hands now."""
        looking = asyncio.run_coroutine_threadsafe(self._fleet.look(), self._loop)
        yield from families(looking.result(_SCRAPED_WITHIN))


class _Handler(WSGIRequestHandler):
    """Handles requests without a line of log for each."""

    server: _Server

    def parse_request(self) -> bool:
        """Parse a request, which makes its connection one that has asked."""
        asked = super().parse_request()
        self.server.asked(self.request)
        return asked

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002
        """Log nothing."""


class _Server(ThreadingMixIn, WSGIServer):
    """An HTTP server that serves a limited number of connections.

    Each connection has a thread. Without a limit, connections that say nothing could use up the
    threads and the memory of the hand's service, to which this process belongs. Beyond it, the
    oldest of these is closed, or the new one if all others have asked for something.
    """

    daemon_threads = True
    request_queue_size = (
        _MOST_OPEN  # the usual 5 would have a flood keep others waiting for seconds
    )

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        self.address_family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        self._open: OrderedDict[socket.socket, bool] = OrderedDict()  # whether it has asked
        self._changing = threading.Lock()
        super().__init__((host, port), _Handler)
        self.set_app(make_wsgi_app(registry))

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread."""
        with self._changing:
            self._open[request] = False
            if len(self._open) > _MOST_OPEN:
                # Its thread then reads the end of the data, and ends.
                silent = next(each for each, asked in self._open.items() if not asked)
                del self._open[silent]
                with suppress(OSError):
                    silent.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def asked(self, request: socket.socket) -> None:
        """Keep a connection that has asked for something while others are silent."""
        with self._changing:
            if request in self._open:
                self._open[request] = True

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._changing:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report errors, but not connections that the client has ended."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


@contextmanager
def serving(fleet: Fleet, listen: str) -> Iterator[str]:
    """Serve the metrics of a fleet over HTTP, in a thread, for as long as the context lasts.

    Yields the URL.

    Args:
        fleet: The hands.
        listen: ``HOST:PORT`` to listen on. Anyone who reaches it can read the metrics.

    Raises:
        ConfigError: if the address cannot be used.
    """
    host, port = address_of(listen, "metrics")
    registry = CollectorRegistry()
    registry.register(_FleetCollector(fleet))
    try:
        server = _Server(host, port, registry)
    except OSError as error:
        raise ConfigError(f"metrics: {listen} cannot be used: {error.strerror or error}") from None
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    try:
        yield f"http://{listen.rpartition(':')[0]}:{server.server_port}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
