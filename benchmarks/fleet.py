"""Unplug one of four hands that Prometheus watches, and say when its alert fires.

    python benchmarks/fleet.py --prometheus /usr/bin/prometheus [--scrape 1] [--rate 500]

Four hands run: three kinematic ones, and a gripper with its real driver on a wire to an emulator
in a process of its own. `rtee metrics` serves their metrics, and Prometheus (Debian's package)
scrapes them with the alert rules in deploy/prometheus. The processor time of hands and exporter
is taken without scrapes and with them. Then the emulator is killed, and the time until Prometheus
says that the alert fires is printed; when the emulator is back and the gripper recovered, the alert
has to end.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from common import Table, command_line

DEPLOY = Path(__file__).parent.parent / "deploy" / "prometheus"
UNPLUGGED, OTHERS = "robotiq_2f_85", ("wsg50", "schunk_svh", "leap_hand")
RTEE = (sys.executable, "-m", "rtee")
METRICS, SERVER = 19464, 19090
"""Ports of the metrics and of Prometheus."""
SETTLED = 5.0
"""Time until hands that have started are at rest [s]."""
QUIET = 30.0
"""Time over which processor time is taken [s]."""
WITHIN = 120.0
"""Longest wait for anything [s]."""


@contextmanager
def process(*words: str, folder: Path, said: str = "") -> Iterator[subprocess.Popen[bytes]]:
    """Run a program as long as the context lasts; wait until its output says something."""
    log = folder / f"{words[-1].replace('/', '_')[-30:]}-{time.monotonic_ns()}.log"
    with log.open("wb") as output:
        started = subprocess.Popen(words, stdout=output, stderr=output)
    try:
        wait(lambda: said in log.read_text("utf-8", "replace"), f"{words[2:4]}: {said}: {log}")
        yield started
    finally:
        started.send_signal(signal.SIGTERM)
        started.wait()


def wait(condition: Callable[[], bool], what: str) -> float:
    """Return the time until something is true [s]."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > WITHIN:
            raise SystemExit(f"waited in vain: {what}")
        time.sleep(0.1)
    return time.monotonic() - began


def asked(path: str) -> Any:
    """Return what Prometheus answers."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{SERVER}/api/v1/{path}") as answer:
            return json.load(answer)["data"]
    except OSError:
        return {}


def firing() -> set[tuple[str, str]]:
    """Return alert and hand of what fires."""
    return {
        (alert["labels"]["alertname"], alert["labels"].get("hand", ""))
        for alert in asked("alerts").get("alerts", ())
        if alert["state"] == "firing"
    }


def counted(metric: str) -> int:
    """Return the sum of a metric over all hands, as Prometheus has it."""
    result = asked(f"query?query=sum({metric})").get("result", ())
    return int(result[0]["value"][1]) if result else 0


def busy(pid: int) -> float:
    """Return the processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def shares(hands: int, exporter: int) -> tuple[float, float]:
    """Return the shares of a core that hands and exporter take."""
    before = busy(hands), busy(exporter)
    time.sleep(QUIET)
    return (busy(hands) - before[0]) / QUIET, (busy(exporter) - before[1]) / QUIET


def recovered() -> None:
    """Activate the gripper, which its fingers show by closing and opening once."""
    command = (*RTEE, "recover", "--hand", UNPLUGGED)
    wait(lambda: subprocess.run(command, check=False).returncode == 0, "the gripper to recover")


def main() -> None:
    parser = command_line(__doc__, rate=500.0)
    parser.add_argument("--prometheus", default="prometheus", help="the program")
    parser.add_argument("--scrape", type=int, default=15, help="interval of the scrapes [s]")
    arguments = parser.parse_args()
    table = Table("what", "value")
    with tempfile.TemporaryDirectory() as name:
        measure(Path(name), arguments.prometheus, arguments.scrape, arguments.rate, table)


def measure(folder: Path, prometheus: str, scrape: int, rate: float, table: Table) -> None:
    link = folder / "gripper"
    for file in ("prometheus.yml", "rtee-alerts.yaml"):
        text = (DEPLOY / file).read_text().replace("9464", str(METRICS))
        text = text.replace("_interval: 15s", f"_interval: {scrape}s")
        (folder / file).write_text(text)
    server = (
        prometheus,
        f"--config.file={folder / 'prometheus.yml'}",
        f"--storage.tsdb.path={folder / 'data'}",
        f"--web.listen-address=127.0.0.1:{SERVER}",
    )
    emulator = (*RTEE, "emulate", "robotiq_2f", "--link", str(link))
    common = ("--no-log", "--rate", f"{rate:g}")
    port = ("--driver", "devices", "--option", f"port={link}")
    exporter = (*RTEE, "metrics", "--listen", f"127.0.0.1:{METRICS}")
    with ExitStack() as stack:
        start = partial(process, folder=folder)
        unplugged = stack.enter_context(ExitStack())
        unplugged.enter_context(start(*emulator, said="gripper"))
        stack.enter_context(start(*RTEE, "run", UNPLUGGED, *port, *common, said="network"))
        recovered()
        hands = stack.enter_context(start(*RTEE, "run", *OTHERS, *common, said=OTHERS[-1]))
        metrics = stack.enter_context(start(*exporter))
        time.sleep(SETTLED)
        quiet = shares(hands.pid, metrics.pid)
        stack.enter_context(start(*server))
        wait(lambda: counted("rtee_device_active") == 4, "four hands at Prometheus")
        scraped = shares(hands.pid, metrics.pid)
        table.row("core of three hands, unscraped → scraped", f"{quiet[0]:.2%} → {scraped[0]:.2%}")
        table.row("core of rtee metrics, unscraped → scraped", f"{quiet[1]:.2%} → {scraped[1]:.2%}")
        table.row("alerts before", str(sorted(firing())))
        unplugged.close()
        alert = ("HandDeviceInactive", UNPLUGGED)
        table.row("alert fires after", f"{wait(lambda: alert in firing(), str(alert)):.1f} s")
        with start(*emulator, said="gripper"):
            recovered()
            table.row("alert ends after", f"{wait(lambda: alert not in firing(), 'end'):.1f} s")


if __name__ == "__main__":
    main()
