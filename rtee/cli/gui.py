"""``rtee gui``: the hand in the browser."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(add_completion=False)


@app.command()
def gui(
    hand: Annotated[str | None, typer.Argument(help="The running hand; any if left out.")] = None,
    port: Annotated[int, typer.Option(help="Port to listen on.", min=0, max=65535)] = 8080,
    host: Annotated[
        str, typer.Option(help="Address to listen on; anything but loopback opens it to a network.")
    ] = "127.0.0.1",
    endpoint: Annotated[
        str | None, typer.Option(help="Where the hand is, such as tcp/robot:7447.")
    ] = None,
) -> None:
    """Open the hand in the browser: prints the address."""
    import anyio

    from rtee.errors import needing_extra
    from rtee.gui.priority import stand_back

    stand_back()  # before numpy and the network start threads of their own
    from rtee.remote.find import hands_running

    with needing_extra("the GUI", "gui"):
        from rtee.gui.app import serve
    if hand is not None or endpoint is not None:
        anyio.run(_look, hand, endpoint)
    elif not hands_running():
        print("rtee: no hand runs here yet; the page will show the first one that does", flush=True)
    anyio.run(lambda: serve(hand, host=host, port=port, endpoint=endpoint))


async def _look(hand: str | None, endpoint: str | None) -> None:
    """Find the hand that is asked for before a page is served that would wait for it.

    Raises:
        ConfigError: if it does not run.
    """
    import anyio.to_thread

    from rtee.errors import ConfigError, NoHand
    from rtee.remote.find import open_hand

    try:
        session, _ = await open_hand(hand, endpoint, 0.0)
    except NoHand as error:
        start = "" if "rtee run" in str(error) else f"; start it with 'rtee run {hand or 'HAND'}'"
        raise ConfigError(f"{error}{start}") from None
    await anyio.to_thread.run_sync(session.close)
