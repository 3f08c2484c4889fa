"""`rtee metrics`: the metrics of running hands, for Prometheus."""

from __future__ import annotations

from typing import Annotated

import typer

from rtee.cli._common import BesideOption, check_files, complete_running, lower_priority
from rtee.cli._fleet import ConnectOptions
from rtee.errors import needing_extra


def metrics(
    hands: Annotated[list[str] | None, typer.Argument(autocompletion=complete_running)] = None,
    *,
    connect: ConnectOptions = None,
    listen: str = "127.0.0.1:9464",
    beside: BesideOption = None,
) -> None:
    """Serve the metrics of running hands over HTTP for Prometheus, until Ctrl-C.

    'rtee run HAND --metrics HOST:PORT' does the same beside a run. Example: rtee metrics --connect
    tls/router:7447

    Arguments and options:
        hands ([HAND…]): Names of hands; all that are found unless given.
        listen (HOST:PORT): Where Prometheus scrapes them.
    """
    import anyio

    check_files()
    lower_priority()  # before the network starts threads, which inherit it
    with needing_extra("'rtee metrics'", "metrics"):
        from rtee.remote.metrics import serving
    from rtee.loop.shutdown_signals import work_beside
    from rtee.remote.fleet import following
    from rtee.remote.session import address_of

    address_of(listen, "--listen")
    # With a run, the metrics are those of its own hands, whatever the environment says.
    endpoints = [] if beside is not None else connect or []

    async def run() -> None:
        async with following(endpoints, hands or (), here=not endpoints) as fleet:
            await fleet.known()
            with serving(fleet, listen) as url:
                print(f"rtee: metrics at {url}", flush=True)
                await anyio.sleep_forever()

    anyio.run(work_beside, beside, run)
