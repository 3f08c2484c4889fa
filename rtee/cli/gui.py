"""`rtee gui`: show a running hand in the browser."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path

from rtee.cli._common import BesideOption, RunningOption, check_files, lower_priority
from rtee.errors import ConfigError, NoHand, needing_extra


def gui(
    *,
    hand: RunningOption = None,
    port: int = 8080,
    host: str = "127.0.0.1",
    endpoint: str | None = None,
    observer: bool = False,
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    behind_proxy: str | None = None,
    beside: BesideOption = None,
) -> None:
    """Open the hand in the browser; prints the address, with the token that opens it.

    Without a name, where several hands run, each has a card there.

    Arguments and options:
        port (0..65535): Port to listen on.
        host: Address to listen on; beyond loopback with --tls-cert or a proxy only.
        endpoint: Where the hand runs, such as tcp/robot:7447.
        observer: Print a second address, to watch and stop only.
        tls_cert (FILE): Certificate (PEM), to serve HTTPS.
        tls_key (FILE): Private key of the certificate (PEM).
        behind_proxy (ORIGIN): A proxy's address, such as https://hand.example.org.
    """
    import anyio

    check_files()
    # Report mistakes before loading the page's other libraries, which takes seconds.
    with needing_extra("the GUI", "gui"):
        from rtee.gui.access import Access, tls_context
    if (tls_cert is None) != (tls_key is None):
        raise ConfigError("--tls-cert and --tls-key go together")
    tls = None if tls_cert is None or tls_key is None else tls_context(tls_cert, tls_key)
    access = Access(host, tls=tls, behind=behind_proxy, observers=observer)
    lower_priority()  # before numpy and the network start threads, which inherit it
    from rtee.remote.directory import hands_running

    several = hand is None and len(_names(endpoint)) > 1
    if hand is not None or (endpoint is not None and not several):
        anyio.run(_check_running, hand, endpoint)
    elif not several and not hands_running():
        print("rtee: no hand runs here yet; the page will show the first one that does", flush=True)
    with needing_extra("the GUI", "gui"):
        from rtee.gui.app import serve, serve_chosen
    from rtee.cli.teleop import follow_headset
    from rtee.loop.shutdown_signals import work_beside

    follow = partial(follow_headset, hand=hand, endpoint=endpoint)
    chosen = serve_chosen if several else partial(serve, hand)
    # Ends with the run that started this command, if one did, even if that is killed.
    page = partial(chosen, access=access, port=port, endpoint=endpoint, follow=follow)
    anyio.run(work_beside, beside, page)


def _names(endpoint: str | None) -> Collection[str]:
    """Return the hands that run here, or at an endpoint."""
    from rtee.remote.directory import hands_running
    from rtee.remote.find import hands_at

    # Of an endpoint where nothing answers, the user learns afterwards, with the command to type.
    return hands_running() if endpoint is None else hands_at(endpoint)


async def _check_running(hand: str | None, endpoint: str | None) -> None:
    """Raise `ConfigError` if the hand does not run, rather than let a page wait for it."""
    import anyio.to_thread

    from rtee.remote.find import open_hand

    try:
        session = (await open_hand(hand, endpoint, 0.0)).session
    except NoHand as error:
        start = "" if "rtee run" in str(error) else f"; start it with 'rtee run {hand or 'HAND'}'"
        raise ConfigError(f"{error}{start}") from None
    # It was only opened to find the hand; the page opens sessions of its own.
    await anyio.to_thread.run_sync(session.close)
