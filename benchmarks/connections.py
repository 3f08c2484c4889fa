"""Measure the memory that a closed connection leaves in the accepting process; print Markdown.

    python benchmarks/connections.py [--connections 10000] [--hand robotiq_2f_85] [--only Zenoh]

One client after the other connects and leaves: to a bare Zenoh session, which only listens; to one
with a hand's settings, including its access control; to a hand, without a request; and to a hand as
`rtee.connect` does, with a token and a hello. The remainder of a connection is the slope, by least
squares, of the accepting process's own memory over the number of connections, after a tenth of
them, and likewise of the number of memory blocks of its Python objects, which would include rtee's.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import processes
import zenoh
from common import Table, command_line, own

import rtee
from rtee.errors import NoHand
from rtee.remote.access import access_control
from rtee.remote.directory import hands_running
from rtee.remote.session import direct, open_client, open_server
from rtee.running.prepare import RunOptions

NOTES = 50
"""Number of measurements of the memory: enough for the error of a slope."""

KINDS = {
    "Zenoh": "a bare session of Zenoh",
    "settings": "a session with a hand's settings",
    "session": "a hand, without a word",
    "hello": "a hand, with `rtee.connect`",
}
"""The accepting processes, in words."""


def listen(kind: str, path: str) -> None:
    """Accept connections with a bare session of Zenoh until standard input ends."""
    if kind == "settings":
        rules = {"access_control": access_control("x", {}, plain=False)}
        session, _ = open_server(Path(path), further=rules)
        say_blocks_when_asked()
        session.close()
        return
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", f'["unixsock-stream/{path}"]')
    with zenoh.open(config):
        say_blocks_when_asked()


def say_blocks() -> None:
    """Print the number of memory blocks of Python's objects."""
    gc.collect()
    print(sys.getallocatedblocks(), flush=True)


def say_blocks_when_asked() -> None:
    """Call `say_blocks` for each line on standard input, until it ends."""
    while sys.stdin.readline():
        say_blocks()


def ask_blocks(process: subprocess.Popen[str]) -> int:
    """Return the number that `say_blocks` prints in another process."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return int(process.stdout.readline())


@contextlib.contextmanager
def accepting(kind: str, hand: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yield the process that accepts connections, and its endpoint."""
    bare = kind in ("Zenoh", "settings")
    socket = str(folder / "bare.sock")
    (started,) = processes.start([kind if bare else "serve"], "--socket", socket)
    with started as process:
        if bare:
            ask_blocks(process)  # once it answers, it listens
            yield process, f"unixsock-stream/{socket}"
        else:
            with rtee.connect_blocking(hand, wait=30.0) as remote:
                remote.ready()
            yield process, hands_running()[hand].endpoints[0]
        assert process.stdin is not None
        process.stdin.close()


def connect(kind: str, hand: str, endpoint: str) -> None:
    """Connect and leave."""
    if kind == "hello":
        # On a busy computer the answer may be too slow; the connection was made nevertheless.
        with contextlib.suppress(NoHand), rtee.connect_blocking(hand):
            pass
        return
    session = open_client([endpoint])
    # When this has returned, client and peer both know of each other.
    session.liveliness().get("rtee/**", direct(lambda _: None))
    session.close()


def slope(counts: list[float], values: list[float]) -> str:
    """Return the slope by least squares, with twice its standard error, in words."""
    line = statistics.linear_regression(counts, values)
    off = [value - line.intercept - line.slope * n for n, value in zip(counts, values, strict=True)]
    spread = sum((n - statistics.fmean(counts)) ** 2 for n in counts)
    error = (sum(x * x for x in off) / (len(off) - 2) / spread) ** 0.5
    return f"{line.slope:.4g} ± {2 * error:.3g}"


def measure(kind: str, args: argparse.Namespace) -> tuple[str, str, str]:
    """Return the remainder of a connection [byte] and [blocks], and of all connections [MB]."""
    counts: list[float] = []
    sizes: list[float] = []
    blocks: list[float] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        accepting(kind, args.hand, Path(folder)) as (process, endpoint),
    ):
        for number in range(1, args.connections + 1):
            connect(kind, args.hand, endpoint)
            if number % max(1, args.connections // NOTES) == 0 and number > args.connections / 10:
                counts.append(number)
                sizes.append(own(process.pid))
                blocks.append(ask_blocks(process))
    return slope(counts, sizes), slope(counts, blocks), f"{(sizes[-1] - sizes[0]) / 1e6:.1f}"


def main() -> None:
    """Measure and print."""
    parser = command_line(__doc__, hand="robotiq_2f_85", connections=10_000, only=str)
    parser.add_argument("--role", choices=("measure", "serve", *KINDS), default="measure")
    parser.add_argument("--socket", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role == "serve":
        options = RunOptions(driver="kinematic", rate=100.0, record=False)
        processes.serve(args.hand, options, on_line=say_blocks)
    elif args.role != "measure":
        listen(args.role, args.socket)
    else:
        head = ("connections to", "each leaves [B]", "Python's objects", "all together [MB]")
        table = Table(*head, widths=(32,))
        for kind in [kind for kind in KINDS if args.only in (None, kind)]:
            table.row(KINDS[kind], *measure(kind, args))


if __name__ == "__main__":
    main()
