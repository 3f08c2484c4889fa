"""The other processes of a benchmark: a hand, and a peer that only answers."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import zenoh
from witness import child

from rtee.loop.realtime import backend_options
from rtee.remote.server import Server
from rtee.remote.session import direct, open_server
from rtee.running.run import RunOptions, run_hands


def serve(
    hand: str,
    options: RunOptions,
    server: Any = Server.open,
    on_line: Callable[[], object] = lambda: None,
) -> None:
    """Run a hand on the network until standard input ends.

    Args:
        hand: Its name.
        options: How it runs.
        server: Makes its network server.
        on_line: Called for each line on standard input, in a thread.
    """

    async def main() -> None:
        until = anyio.Event()

        def read() -> None:
            while sys.stdin.readline():
                on_line()

        async def wait() -> None:
            await anyio.to_thread.run_sync(read)
            until.set()

        async with anyio.create_task_group() as group:
            group.start_soon(wait)

            def said(line: str) -> None:
                print(line, file=sys.stderr)

            await run_hands([hand], options, serve=server, until=until, say=said)

    anyio.run(main, backend_options=backend_options())


def echo(answer: Callable[[], bytes] = bytes) -> None:
    """Answer every query at once until standard input ends; print the endpoint first.

    Args:
        answer: Returns what is answered.
    """
    with tempfile.TemporaryDirectory() as folder:
        session, endpoint = open_server(Path(folder) / "echo.sock")

        def reply(query: zenoh.Query) -> None:
            data = answer()  # first: it may be the time
            with query:
                query.reply(query.key_expr, data, express=True)

        session.declare_queryable("rtee/**", direct(reply))
        session.declare_subscriber("rtee/**", direct(lambda _: None))
        print(endpoint, flush=True)
        sys.stdin.read()
        session.close()


def start(
    roles: Sequence[str], *more: str, words: Sequence[str] | None = None
) -> list[subprocess.Popen[str]]:
    """Start this benchmark again in some roles, with pipes to each.

    Args:
        roles: The roles.
        more: Further arguments.
        words: All arguments, instead of those of this process and ``more``.
    """
    given = [*sys.argv[1:], *more] if words is None else words
    script = [sys.executable, sys.argv[0], *given, "--role"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return [child([*script, role], **pipes) for role in roles]
