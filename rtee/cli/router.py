"""`rtee router`: the router of a site, between hands and clients."""

from __future__ import annotations

from typing import Annotated

import typer

from rtee.cli._common import check_files
from rtee.errors import ConfigError


def router(
    site: Annotated[
        str | None,
        typer.Argument(
            metavar="[SITE]", help="Name of the site, as 'rtee secure init SITE' had it."
        ),
    ] = None,
    listen: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Where to listen; tls/0.0.0.0:7447 unless given."),
    ] = None,
    insecure: Annotated[
        bool,
        typer.Option(help="Without certificates: whoever reaches it can move the hands."),
    ] = False,
    zenohd: Annotated[
        bool, typer.Option("--zenohd", help="Print the configuration for zenohd instead.")
    ] = False,
) -> None:
    """Run a router between hands and their clients, until Ctrl-C.

    Example: rtee router factory --listen tls/0.0.0.0:7447
    """
    import anyio

    from rtee.loop.shutdown_signals import receive_signals, wait_for_end
    from rtee.remote.credentials import Credentials, secure_folder
    from rtee.remote.router import route, router_settings
    from rtee.remote.session import listening

    check_files()
    if (site is None) is not insecure:
        raise ConfigError("name the site of 'rtee secure init SITE', or give --insecure")
    credentials = None if site is None else Credentials(secure_folder(site))
    endpoints = listen or ["tcp/0.0.0.0:7447" if insecure else "tls/0.0.0.0:7447"]
    if zenohd:
        print(listening(endpoints, (), router_settings(credentials, endpoints)))
        return

    def tell(admitted: str) -> None:
        where = ", ".join(endpoints)
        print(f"router: {site or 'without certificates'}; {where}; hands: {admitted}", flush=True)

    async def run() -> None:
        with receive_signals() as signals:
            async with anyio.create_task_group() as group:
                group.start_soon(route, credentials, endpoints, tell)
                await wait_for_end(None, anyio.Event(), signals)
                group.cancel_scope.cancel()

    anyio.run(run)
