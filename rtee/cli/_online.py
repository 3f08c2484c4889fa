"""What the commands for running hands share: connecting, and printing results."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Coroutine
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from rtee.actions.cli_syntax import Efforts
    from rtee.remote.client import RemoteHand
    from rtee.types import Result

T = TypeVar("T")


def with_hand(
    hand: str | None,
    endpoint: str | None,
    what: str,
    function: Callable[[RemoteHand], Coroutine[Any, Any, T]],
    *,
    wait: float | None = None,
) -> T:
    """Connect to a running hand, call a function with it and return its result.

    Args:
        hand: Its name; not needed if only one hand runs.
        endpoint: Its address; ``None`` for that in ``RTEE_CONNECT``, else this computer.
        what: The command, as part of this client's name.
        function: What to do with the hand.
        wait: Time to wait until the hand runs and is ready [s]; ``None`` not to wait at all.
    """
    import anyio

    from rtee.remote.client import connect

    async def main() -> T:
        began, within = time.monotonic(), wait or 0.0
        name = f"rtee-{what}"
        async with connect(
            hand, endpoint=endpoint, client=name, wait=within, on_wait=_waiting if wait else None
        ) as remote:
            if wait is not None:
                # Connecting has used up a part of the time.
                await remote.ready(max(0.0, began + wait - time.monotonic()), _waiting)
            return await function(remote)

    return anyio.run(main)


def _waiting(text: str) -> None:
    print(f"rtee: waiting: {text}", file=sys.stderr, flush=True)


def to_json(values: Any, indent: int | None = None) -> str:
    """Return plain data as JSON; numbers that are not finite become ``null``."""
    return json.dumps(_plain(values), indent=indent)


def result_json(result: Result) -> str:
    """Return the result of a goal as a JSON object."""
    return to_json(asdict(result) | {"succeeded": result.succeeded})


def _plain(values: Any) -> Any:
    if isinstance(values, float):
        # JSON has no NaN, but Python's module would write it.
        return values if math.isfinite(values) else None
    if isinstance(values, dict):
        return {str(key): _plain(value) for key, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [_plain(value) for value in values]
    return values


async def effort_limits(remote: RemoteHand, efforts: Efforts) -> dict[str, float]:
    """Return the effort limits that a command line asks for, by actuator [N·m | N]."""
    limits = dict(efforts.limits)
    for name, share in efforts.shares.items():
        limits |= await remote.effort_limits(share, only=[name])
    if efforts.share is not None:
        # What is said of one actuator counts before what is said of all.
        limits = await remote.effort_limits(efforts.share, besides=list(limits)) | limits
    return limits
