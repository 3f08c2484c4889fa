"""`rtee mcp`: a hand for language models; `rtee agent`: a person's answers to them."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import (
    Commands,
    ConnectOption,
    RunningOption,
    complete_running,
    lower_priority,
    with_hand,
)
from rtee.errors import ConfigError, NoHand, needing_extra
from rtee.hand.catalog import hand_names
from rtee.hand.config_schema import AgentSettings, Gate

if TYPE_CHECKING:
    from rtee.remote.client import RemoteHand

app = Commands()

_ABOVE_0 = 1e-6
"""Least value of a limit: typer knows no bound that is excluded."""


def mcp(
    hands: Annotated[list[str] | None, typer.Argument(autocompletion=complete_running)] = None,
    *,
    gate: Gate | None = None,
    force: Annotated[
        float | None, typer.Option(min=_ABOVE_0, max=1000.0, help="Largest force [N]; 10.")
    ] = None,
    effort: Annotated[
        float | None,
        typer.Option(min=_ABOVE_0, max=1.0, help="Largest share of the effort limits; 0.4."),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(min=_ABOVE_0, max=1.0, help="Largest share of the velocity limits; 0.5."),
    ] = None,
    action: list[str] | None = None,
    connect: ConnectOption = None,
) -> None:
    """Offer hands to a language model by the Model Context Protocol, on stdin and stdout.

    By default the gate is "watch": the model only reads. The options can only narrow the limits of
    hand.yaml. The model's client starts this command; you decide what the model may do.

    Example: rtee mcp robotiq_2f_85 --gate simulate --force 20

    Arguments and options:
        hands ([HAND…]): Names of hands; all that run here unless given.
        gate: What stands between the model and the hand.
        action: An action that it may do, or grasp, or open; may be repeated; all unless given.
    """
    import anyio

    lower_priority()  # simulations compute, perhaps beside the hand's loop
    with needing_extra("'rtee mcp'", "mcp"):
        from rtee.agent.tools import serve
    from rtee.agent.agent import Agent
    from rtee.remote.agent_limits import AgentLimits
    from rtee.remote.directory import hands_running

    asked = AgentSettings(gate, force, effort, speed, tuple(action or ()))
    if not (names := hands or list(hands_running())):
        raise ConfigError("no hand is running here; name those that will: rtee mcp HAND")
    agents = [Agent(name, AgentLimits.of(_settings(name), asked), connect) for name in names]
    for name in names:
        anyio.run(_say_if_absent, name, connect)
    anyio.run(serve, agents)


async def _say_if_absent(name: str, connect: str | None) -> None:
    """Note on stderr that a hand is not running; raises `ConfigError` if there is no such hand."""
    import anyio.to_thread

    from rtee.remote.find import open_hand

    try:
        session = (await open_hand(name, connect, 0.0)).session
    except NoHand as error:
        if connect is None and name not in hand_names():
            raise ConfigError(str(error)) from None
        # stdout is for the protocol; a hand that starts later will do as well.
        print(f"rtee: {error}; its tools work as soon as it does", file=sys.stderr, flush=True)
    else:
        await anyio.to_thread.run_sync(session.close)


def _settings(name: str) -> AgentSettings:
    """Return the limits of agents in hand.yaml; defaults for a hand without files here."""
    from rtee.hand.load import hand_folder, load_configured

    if name not in hand_names():
        return AgentSettings()
    return load_configured(hand_folder(name)[0])[1].agent


@app.command()
def approve() -> None:
    """Answer in this terminal what language models ask for, until Ctrl-C.

    For hands whose gate is "approve"; nothing else answers for you.
    """
    import anyio
    import anyio.to_thread

    from rtee.remote.approval import answer_all, listening

    _check_terminal("approve")

    async def ask(question: str) -> bool:
        # The prompt stays after the time limit: otherwise the next typed line would count as the
        # answer.
        return await anyio.to_thread.run_sync(typer.confirm, question)

    async def main() -> None:
        async with listening() as listener:
            print("waiting for questions; Ctrl-C ends", flush=True)
            await answer_all(listener, ask)

    anyio.run(main)


@app.command()
def admit(hand: RunningOption = None, connect: ConnectOption = None) -> None:
    """Let language models move a hand again, after a stop."""
    _check_terminal("admit")
    name = with_hand(hand, connect, "admit", _admit)
    print(f"agents may move {name} again, as far as their gate lets them")


async def _admit(remote: RemoteHand) -> str:
    await remote.admit_agents()
    return remote.name


def _check_terminal(what: str) -> None:
    """Refuse to answer for a person: programs, and so agents, have no terminal."""
    if not sys.stdin.isatty():
        raise ConfigError(f"'rtee agent {what}' needs a person at a terminal, not a script")
