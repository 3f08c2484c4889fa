"""`rtee ros2 serve`: show running hands as nodes of ROS 2."""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import (
    BesideOption,
    ConnectOption,
    HandsArgument,
    VerboseOption,
    check_files,
    log_to_stderr,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rtee.ros2.serving import Shown

_NICE = 5
"""Nice value beside a run: on a busy processor its loop gets three times this process's share."""


def serve(
    hands: HandsArgument,
    domain: Annotated[
        int | None, typer.Option(min=0, max=232, help="The domain, before ROS_DOMAIN_ID.")
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(metavar="NAME", help="Namespace of the nodes, such as left.")
    ] = None,
    router: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Where the router of ROS 2 is.")
    ] = None,
    distro: Annotated[
        str | None,
        typer.Option(help="Distribution of the other nodes: jazzy, kilted, rolling or humble."),
    ] = None,
    endpoint: ConnectOption = None,
    beside: BesideOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Show running hands as nodes of ROS 2, until Ctrl-C; each whenever it runs.

    Options count before the section ros2 of each hand.yaml. 'rtee run HAND --ros2' does the same
    beside a run.
    """
    import anyio

    from rtee.errors import needing_extra
    from rtee.loop.shutdown_signals import work_beside
    from rtee.ros2.serving import serve as serve_hands
    from rtee.ros2.serving import warnings

    check_files()
    with needing_extra("ROS 2", "ros2"):
        import xxhash  # noqa: F401 - report a missing extra before opening anything
    log_to_stderr(verbose)
    given = {"domain": domain, "namespace": namespace, "router": router, "distro": distro}
    # All hands first, so that a wrong one ends the command before any node is made.
    shown = [_shown(hand, given, endpoint) for hand in hands]
    environment = environment_without(domain)
    for warning in warnings(shown):
        print(f"rtee: warning: {warning}", file=sys.stderr, flush=True)

    if beside is not None:
        # os.nice() takes an increment, and the run may have started this with one already.
        os.nice(max(0, _NICE - os.nice(0)))

    anyio.run(work_beside, beside, partial(serve_hands, shown, environment))


def environment_without(domain: int | None) -> dict[str, str]:
    """Return the environment, without ``ROS_DOMAIN_ID`` if the option gives a domain."""
    environment = dict(os.environ)
    if domain is not None:
        environment.pop("ROS_DOMAIN_ID", None)
    return environment


def _shown(hand: str, given: Mapping[str, object], endpoint: str | None) -> Shown:
    """Return a hand with its settings; options take precedence over those in hand.yaml."""
    from rtee.errors import ConfigError
    from rtee.hand.catalog import hand_names
    from rtee.hand.config_schema import Ros2Settings
    from rtee.hand.load import load_configured
    from rtee.hand.names import check_name
    from rtee.ros2.serving import Shown
    from rtee.ros2.session import overridden

    # A hand that runs elsewhere may be unknown here; its description comes over the network.
    if not Path(hand).exists() and hand not in hand_names():
        if endpoint is None and hand not in _running():
            raise ConfigError(f"there is no hand '{hand}': neither configured nor running here")
        settings = overridden(Ros2Settings(), given)
        return Shown(check_name(hand, "hand"), settings, endpoint=endpoint)
    model, config = load_configured(hand)
    return Shown(
        config.name,
        overridden(config.ros2, given),
        config.remote.security.insecure,
        model,
        config.thermal,
        endpoint,
    )


def _running() -> set[str]:
    from rtee.remote.find import hands_running

    return set(hands_running())
