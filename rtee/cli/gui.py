"""`rtee gui`: the hand in the browser."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Annotated

import typer

_NICE = 10
"""How far the GUI's priority is below that of an ordinary program, see nice(2)."""


def gui(
    hand: Annotated[str | None, typer.Argument(help="The running hand; by default any.")] = None,
    port: Annotated[int, typer.Option(help="Port to listen on.", min=0, max=65535)] = 8080,
    host: Annotated[
        str, typer.Option(help="Address to listen on; any but loopback opens it to a network.")
    ] = "127.0.0.1",
    endpoint: Annotated[
        str | None, typer.Option(help="Where the hand runs, such as tcp/robot:7447.")
    ] = None,
) -> None:
    """Open the hand in the browser; prints the address."""
    import anyio

    from rtee.errors import needing_extra

    _lower_priority()  # before numpy and the network start threads, which inherit it
    from rtee.remote.find import hands_running

    with needing_extra("the GUI", "gui"):
        from rtee.gui.app import serve
    if hand is not None or endpoint is not None:
        anyio.run(_check_running, hand, endpoint)
    elif not hands_running():
        print("rtee: no hand runs here yet; the page will show the first one that does", flush=True)
    anyio.run(lambda: serve(hand, host=host, port=port, endpoint=endpoint))


def _lower_priority() -> None:
    """Lower the priority of the calling thread and of all that it starts.

    On a robot PC the loop has precedence: the GUI never interrupts another program when it wakes
    (SCHED_BATCH), and where processors are short it gets a tenth of an ordinary program's share.
    """
    with contextlib.suppress(OSError):  # some containers permit neither
        os.nice(max(0, _NICE - os.nice(0)))
        if sys.platform.startswith("linux") and os.sched_getscheduler(0) == os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


async def _check_running(hand: str | None, endpoint: str | None) -> None:
    """Check that the hand runs, before a page waits for it; raises `ConfigError` if it does not."""
    import anyio.to_thread

    from rtee.errors import ConfigError, NoHand
    from rtee.remote.find import open_hand

    try:
        session, _ = await open_hand(hand, endpoint, 0.0)
    except NoHand as error:
        start = "" if "rtee run" in str(error) else f"; start it with 'rtee run {hand or 'HAND'}'"
        raise ConfigError(f"{error}{start}") from None
    await anyio.to_thread.run_sync(session.close)
