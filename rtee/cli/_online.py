"""Connecting to a running hand, and printing JSON, for all online commands."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Coroutine
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar

from rtee import monotonic

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
    """Connect to a running hand, call a function with it and return the function's result.

    Args:
        hand: Name of the hand; not needed if only one hand runs.
        endpoint: Address of the hand; ``None``: that in ``RTEE_CONNECT``, else this computer.
        what: Name of the command; the client is called ``rtee-`` and this name.
        function: The function.
        wait: Longest time to wait until the hand runs and is ready [s]; ``None``: do not wait.
    """
    import anyio

    from rtee.remote.client import connect

    async def main() -> T:
        began, within = monotonic.now(), wait or 0.0
        name = f"rtee-{what}"
        async with connect(
            hand, endpoint=endpoint, client=name, wait=within, on_wait=_waiting if wait else None
        ) as remote:
            if wait is not None:
                # Connecting has used up part of the time.
                await remote.ready(max(0.0, began + wait - monotonic.now()), _waiting)
            return await function(remote)

    return anyio.run(main)


def _waiting(text: str) -> None:
    print(f"rtee: waiting: {text}", file=sys.stderr, flush=True)


def to_json(values: Any, indent: int | None = None) -> str:
    """Return data as JSON; arrays become lists, and numbers that are not finite ``null``."""
    return json.dumps(_plain(values), indent=indent)


def result_json(result: Result) -> str:
    """Return the result of a goal as a JSON object."""
    return to_json(asdict(result) | {"outcome": result.outcome, "succeeded": result.succeeded})


def _plain(values: Any) -> Any:
    if hasattr(values, "tolist"):  # an array or a number of NumPy
        values = values.tolist()
    if isinstance(values, float):
        # JSON has no NaN, but Python's module would write it.
        return values if math.isfinite(values) else None
    if isinstance(values, dict):
        return {str(key): _plain(value) for key, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [_plain(value) for value in values]
    return values


async def effort_limits(remote: RemoteHand, efforts: Efforts) -> dict[str, float]:
    """Return the effort limits given on the command line, by actuator [N·m | N]."""
    limits = dict(efforts.limits)
    for name, share in efforts.shares.items():
        limits |= await remote.effort_limits(share, only=[name])
    if efforts.share is not None:
        # A limit given for one actuator takes precedence over the limit for all.
        limits = await remote.effort_limits(efforts.share, besides=list(limits)) | limits
    return limits
