"""A person's approval of a motion, in a terminal or the GUI, through a socket closed to agents.

The terminal or the GUI listens, and each server of an agent connects to it with one question at a
time. The socket is in the user's runtime folder; nothing that an agent can ask of its server opens
it.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Final

import anyio
from anyio.abc import SocketListener, SocketStream

from rtee.errors import ConfigError, GoalRejected, foreign
from rtee.remote.directory import own_folder

WITHIN: Final = 120.0
"""Time in which a person answers [s]: long enough to go and look at the hand."""

CALM: Final = 3.0
"""Time after a refusal before the next request [s]: endless questions make people say yes."""

_LONGEST: Final = 4096
"""Longest question or answer [bytes]: a few sentences."""


def _path() -> Path:
    return own_folder() / "agent-approval.sock"


async def approve(question: str) -> None:
    """Wait for a person's yes.

    Raises:
        GoalRejected: if the person refuses, or no one is available.
        ConfigError: if the runtime folder cannot be trusted.
    """
    try:
        with anyio.fail_after(WITHIN):
            async with await anyio.connect_unix(_path()) as stream:
                await stream.send(json.dumps(question[:_LONGEST]).encode() + b"\n")
                answer = await stream.receive(_LONGEST)
    except (OSError, anyio.EndOfStream, anyio.BrokenResourceError):
        raise GoalRejected(
            "the gate is 'approve', and no one is available to approve; open the GUI, or "
            "type 'rtee agent approve' in a terminal"
        ) from None
    except TimeoutError:
        raise GoalRejected(f"nobody approved it within {WITHIN:g} s") from None
    if answer != b"yes\n":
        raise GoalRejected("a person refused it")


@contextlib.asynccontextmanager
async def listening() -> AsyncIterator[SocketListener]:
    """Listen for questions, in this process alone.

    Raises:
        ConfigError: if another terminal, or the GUI, listens, or the runtime folder cannot be
            trusted.
    """
    path = _path()
    with contextlib.suppress(OSError):
        await (await anyio.connect_unix(path)).aclose()
        raise ConfigError("another terminal, or the GUI, is approving already", path=path)
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
    async with await anyio.create_unix_listener(path, mode=0o600) as listener:
        try:
            yield listener
        finally:
            path.unlink(missing_ok=True)


async def answer_all(listener: SocketListener, ask: Callable[[str], Awaitable[bool]]) -> None:
    """Answer questions, one after the other, until cancelled.

    Args:
        listener: From `listening`.
        ask: Asks a person; cancelled when the caller has given up.
    """
    one = anyio.Lock()

    async def answer(stream: SocketStream) -> None:
        async with stream, one:
            said = True
            async with anyio.create_task_group() as group:
                with contextlib.suppress(anyio.EndOfStream, anyio.BrokenResourceError, ValueError):
                    question = foreign(str(json.loads(await stream.receive(2 * _LONGEST))))
                    group.start_soon(leave_with, stream, group.cancel_scope)
                    said = await ask(question)
                    await stream.send(b"yes\n" if said else b"no\n")
                group.cancel_scope.cancel()
            if not said:
                await anyio.sleep(CALM)

    async def leave_with(stream: SocketStream, scope: anyio.CancelScope) -> None:
        with contextlib.suppress(anyio.EndOfStream, anyio.BrokenResourceError):
            await stream.receive(1)
        scope.cancel()

    await listener.serve(answer)
