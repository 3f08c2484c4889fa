"""`rtee router`: the router of a site, between hands and clients."""

from __future__ import annotations

from rtee.cli._common import check_files
from rtee.errors import ConfigError


def router(
    site: str | None = None,
    *,
    listen: list[str] | None = None,
    insecure: bool = False,
    zenohd: bool = False,
) -> None:
    """Run a router between hands and their clients, until Ctrl-C.

    Example: rtee router factory --listen tls/0.0.0.0:7447

    Arguments and options:
        site ([SITE]): Name of the site, as given to 'rtee secure init SITE'.
        listen (ENDPOINT): Where to listen; tls/0.0.0.0:7447 unless given.
        insecure (--insecure/--no-insecure): Without certificates: anyone who reaches it can move
            the hands.
        zenohd: Print the configuration for zenohd instead.
    """
    import os

    import anyio

    from rtee.loop.shutdown_signals import receive_signals, wait_for_end
    from rtee.remote.credentials import Credentials, secure_folder
    from rtee.remote.router import route, router_settings
    from rtee.remote.session import listening, relay_environment

    check_files()
    if (site is None) is not insecure:
        raise ConfigError("give the SITE that 'rtee secure init SITE' made, or --insecure")
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

    os.environ.update(relay_environment())
    anyio.run(run)
