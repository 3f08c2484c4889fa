"""`rtee ros2`: serve hands in a ROS 2 graph, and inspect the graph without ROS installed."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import anyio
import typer

from rtee.cli._common import (
    BesideOption,
    Commands,
    ConnectOption,
    HandsArgument,
    JsonOption,
    VerboseOption,
    check_files,
    log_to_stderr,
    to_json,
    waiting,
)
from rtee.cli._table import Column, Row, table_of
from rtee.errors import ConfigError, MessageError, RemoteError, needing_extra, suggestion
from rtee.hand.catalog import hand_names
from rtee.hand.names import check_name
from rtee.hand.yamlfile import parse_yaml

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rtee.ros2 import Context
    from rtee.ros2.listing import Listed, Sort
    from rtee.ros2.message import Message
    from rtee.ros2.serving import Shown

T = TypeVar("T")

app = Commands()

_NICE = 5
"""Nice value beside a run: on a busy processor its loop gets three times this process's share."""


@app.command()
def serve(
    hands: HandsArgument,
    *,
    domain: int | None = None,
    namespace: str | None = None,
    router: str | None = None,
    distro: str | None = None,
    endpoint: ConnectOption = None,
    beside: BesideOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Offer running hands as ROS 2 nodes until Ctrl-C; hands may also start later.

    Options count before the section ros2 of each hand.yaml. 'rtee run HAND --ros2' does the same
    beside a run.

    Arguments and options:
        domain (0..232): The domain, instead of ROS_DOMAIN_ID.
        namespace (NAME): Namespace of the nodes, such as left.
        router (ENDPOINT): Where the router of ROS 2 is.
        distro: Distribution of the other nodes: jazzy, kilted, rolling or humble.
    """
    import anyio

    from rtee.loop.shutdown_signals import work_beside
    from rtee.ros2.serving import serve as serve_hands
    from rtee.ros2.serving import warnings
    from rtee.ros2.session import check_session

    check_files()
    with needing_extra("ROS 2", "ros2"):
        import xxhash  # noqa: F401 - report a missing extra before opening anything
    log_to_stderr(verbose)
    given = {"domain": domain, "namespace": namespace, "router": router, "distro": distro}
    # All hands first, so that a wrong one ends the command before any node is made.
    shown = [_shown(hand, given, endpoint) for hand in hands]
    environment = environment_without(domain)
    for each in shown:  # a mistake is one sentence, without warnings about its consequences
        check_session(each.settings, environment, insecure=each.insecure)
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
    from rtee.hand.config_schema import Ros2Settings
    from rtee.hand.load import load_configured
    from rtee.remote.directory import hands_running
    from rtee.ros2.serving import Shown
    from rtee.ros2.session import overridden

    # A hand that runs elsewhere may be unknown here; its description comes over the network.
    if not Path(hand).exists() and hand not in hand_names():
        if endpoint is None and hand not in hands_running():
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


NODE = "rtee_cli"
"""Prefix of the name of these commands' node, followed by the process id."""

PLACE = "tcp/localhost:7447"
"""Default endpoint of the router, where rmw_zenohd listens."""

_NEW = 1.0
"""Longest time until a node that has just started appears in the graph [s]."""

_FOUND = 10.0
"""Longest time until all topics and services of an action appear in the graph [s]."""

DomainOption = Annotated[
    int | None, typer.Option(min=0, max=232, help="The domain; that of ROS_DOMAIN_ID, or 0.")
]
RouterOption = Annotated[str, typer.Option(metavar="ENDPOINT", help="Where the router is.")]
DistroOption = Annotated[
    str, typer.Option(help="Distribution of the other nodes: jazzy, kilted, rolling or humble.")
]
TypeArgument = Annotated[
    str | None,
    typer.Argument(metavar="[TYPE]", help="Its type, where the graph does not tell it."),
]
TimeoutOption = Annotated[float, typer.Option(min=0.0, help="Longest time to wait [s].")]


def _in_graph(
    domain: int | None,
    router: str,
    distro: str,
    work: Callable[[Context], Coroutine[Any, Any, T]],
) -> T:
    """Open a context, wait for the graph, call a function with it and return its result."""
    from rtee.hand.config_schema import Ros2Settings
    from rtee.ros2 import Context
    from rtee.ros2.session import overridden

    given = {"router": router, "domain": domain, "distro": distro}
    settings, environment = overridden(Ros2Settings(), given), environment_without(domain)

    async def main() -> T:
        # These commands reveal nothing of a hand, so that an unsecured router will do.
        opened = Context.open(settings, environment, insecure=True, router_needed=True)
        async with opened as context:
            # Before any look at the graph, which is empty just after the session opens.
            await context.graph.ready()
            return await work(context)

    return anyio.run(main)


async def _the_type(context: Context, sort: Sort, name: str, given: str | None) -> str:
    """Return the type given for a topic, service or action, otherwise its type in the graph.

    Raises `ConfigError` if no type is given and the graph has none, or several, or if a service or
    action has another one.
    """
    from rtee.ros2.listing import Sort, listed

    if given is not None and sort is Sort.TOPIC:  # whose publishers may come later
        return given

    def offered() -> list[Listed]:
        rows = listed(context.graph.entities(), parts=True)
        return [row for row in rows if row.sort is sort and row.offered]

    def kinds() -> list[str]:
        return sorted({row.type for row in offered() if row.name == name})

    # A node that has just started may not be in the graph yet.
    with anyio.move_on_after(_NEW):
        await context.graph.wait_until(lambda: bool(kinds()))
    types = kinds()
    if given is not None:
        if types and given not in types:
            raise ConfigError(f"the {sort} {name} has the type {' and '.join(types)}, not {given}")
        if not types:
            waiting(f"no node offers the {sort} {name}")
        return given
    if not types:
        names = [row.name for row in offered()]
        raise ConfigError(f"no node offers the {sort} {name}; {suggestion(name, names)}")
    if len(types) > 1:
        raise ConfigError(
            f"the {sort} {name} has the types {' and '.join(types)}; give one after its name"
        )
    return types[0]


def _message(kind: type[Message], text: str | None, what: str) -> Any:
    """Return a message with the fields given as YAML.

    Raises `ConfigError` if the text is not YAML, or has a field that the message lacks.
    """
    fields = parse_yaml(text, Path(what), f"the {what}").data if text and text.strip() else {}
    try:
        return kind.from_dict(fields)
    except MessageError as error:
        raise ConfigError(str(error)) from None


def _print(message: Message, as_json: bool) -> None:
    fields = message.to_dict()
    if as_json:
        print(to_json(fields), flush=True)
        return
    from ruamel.yaml import YAML

    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None  # lists of numbers in one line
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment] # its stub says None
    yaml.dump(fields, sys.stdout)
    # Flushed after each message, since `echo` goes on and a program may read it.
    print("---", flush=True)


@app.command(name="list")
def list_(
    kind: str | None = None,
    *,
    parts: bool = False,
    domain: DomainOption = None,
    router: RouterOption = PLACE,
    distro: DistroOption = "jazzy",
    as_json: JsonOption = False,
) -> None:
    """List the entities of the ROS graph.

    Endpoints that cannot hear each other, since type or hash differ, are listed separately.

    Arguments and options:
        kind ([KIND]): Only these: nodes, topics, services or actions.
        parts (--all): Also the topics and services that actions are made of.
    """
    from rtee.ros2.listing import Sort, listed, unheard
    from rtee.ros2.types import PREFIX

    sort = kind.removesuffix("s") if kind is not None else None
    if sort is not None and sort not in list(Sort):
        raise ConfigError(f"'{kind}' should be nodes, topics, services or actions")

    async def work(context: Context) -> list[Listed]:
        return listed(context.graph.entities(), parts=parts)

    everything = _in_graph(domain, router, distro, work)
    rows = [row for row in everything if sort in (None, row.sort)]
    if as_json:
        print(to_json([_as_dict(row) for row in rows]))
        return
    columns = (Column("name", whole=True), "type", "offered by", "used by", "hash")
    cells = []
    for row in rows:
        # The beginning of a hash is enough to see that two differ.
        names, short = (
            map(" ".join, (row.offered, row.used)),
            row.type_hash.removeprefix(PREFIX)[:8],
        )
        cells.append(Row((row.name, row.type, *names, short), heading=f"{row.sort}s"))
    table_of(columns, cells, heading="kind").show()
    for sentence in unheard(everything):
        print(f"rtee: warning: {sentence}", file=sys.stderr)


def _as_dict(row: Listed) -> dict[str, Any]:
    return {
        "kind": row.sort.value,
        "name": row.name,
        "type": row.type,
        "hash": row.type_hash,
        "offered": list(row.offered),
        "used": list(row.used),
    }


@app.command()
def echo(
    topic: str,
    type_: TypeArgument = None,
    *,
    count: int | None = None,
    timeout: float | None = None,
    domain: DomainOption = None,
    router: RouterOption = PLACE,
    distro: DistroOption = "jazzy",
    as_json: JsonOption = False,
) -> None:
    """Print the messages of a topic, as YAML.

    Arguments and options:
        topic: Name of the topic.
        count (1..): End after this many messages.
        timeout (0.0..): End when no message arrives for this time [s].
    """
    from rtee.ros2 import DEFAULT, LATCHED
    from rtee.ros2.keys import Kind
    from rtee.ros2.listing import Sort

    full = f"/{topic.lstrip('/')}"

    async def work(context: Context) -> None:
        kind = await _the_type(context, Sort.TOPIC, full, type_)
        publishers = context.graph.of(Kind.PUBLISHER, full)
        # Earlier messages are resent only to a subscription that is latched, too.
        latched = any(publisher.qos.transient_local for publisher in publishers)
        left, last, ended = count, anyio.current_time(), anyio.Event()

        def show(message: Message) -> None:
            nonlocal left, last
            # Messages may still arrive until the node is closed.
            if ended.is_set():
                return
            _print(message, as_json)
            last = anyio.current_time()
            if left is not None:
                left -= 1
                if not left:
                    ended.set()

        # Several of these commands may run at once; ROS wants unique names of nodes.
        node = context.node(f"{NODE}_{os.getpid()}")
        node.subscription(full, kind, show, LATCHED if latched else DEFAULT)
        while not ended.is_set():
            # Each message restarts the wait.
            until = math.inf if timeout is None else last + timeout
            if anyio.current_time() > until:
                raise RemoteError(f"no message came on {full} for {timeout:g} s")
            with anyio.move_on_at(until):
                await ended.wait()

    _in_graph(domain, router, distro, work)


@app.command()
def call(
    service: str,
    type_: TypeArgument = None,
    request: str | None = None,
    *,
    timeout: TimeoutOption = 10.0,
    domain: DomainOption = None,
    router: RouterOption = PLACE,
    distro: DistroOption = "jazzy",
    as_json: JsonOption = False,
) -> None:
    """Call a service and print its response, as YAML.

    Example: rtee ros2 call /schunk_svh/stop

    Arguments and options:
        service: Name of the service.
        request ([REQUEST]): Its fields, as YAML.
    """
    from rtee.ros2.listing import Sort

    full = f"/{service.lstrip('/')}"

    async def work(context: Context) -> None:
        kind, fields = _swapped(type_, request)
        service_type = context.interfaces.service(
            await _the_type(context, Sort.SERVICE, full, kind)
        )
        message = _message(service_type.request, fields, "request")
        client = context.node(f"{NODE}_{os.getpid()}").client(full, service_type)
        try:
            await client.wait(timeout)
            _print(await client.call(message, timeout), as_json)
        except TimeoutError as error:
            raise RemoteError(str(error)) from None

    _in_graph(domain, router, distro, work)


@app.command(name="send-goal")
def send_goal(
    action: str,
    type_: TypeArgument = None,
    goal: str | None = None,
    *,
    feedback: bool = False,
    timeout: TimeoutOption = 60.0,
    domain: DomainOption = None,
    router: RouterOption = PLACE,
    distro: DistroOption = "jazzy",
    as_json: JsonOption = False,
) -> None:
    """Send a goal and print its result, as YAML; Ctrl-C or the timeout cancels it.

    Example: rtee ros2 send-goal /robotiq_2f_85/gripper_cmd control_msgs/action/GripperCommand
    '{command: {position: 0.03}}'

    Arguments and options:
        action: Name of the action.
        goal ([GOAL]): Its fields, as YAML.
        feedback: Print its feedback, too.
    """
    from rtee.ros2.action_client import ActionClient
    from rtee.ros2.actions import GoalState
    from rtee.ros2.listing import Sort

    full = f"/{action.lstrip('/')}"

    async def work(context: Context) -> GoalState:
        kind, fields = _swapped(type_, goal)
        action_type = await _the_type(context, Sort.ACTION, full, kind)
        client = ActionClient(context.node(f"{NODE}_{os.getpid()}"), full, action_type)
        message = _message(client.type.goal, fields, "goal")
        show = (lambda message: _print(message, as_json)) if feedback else None
        try:
            await client.wait_for_server(_FOUND)
            sent = await client.send_goal(message, show)
            try:
                outcome = await sent.result(timeout)
            # Ctrl-C cancels this task: without the shield, the request would not be sent.
            except BaseException:
                with anyio.CancelScope(shield=True), suppress(TimeoutError):
                    await sent.cancel()
                raise
        except TimeoutError as error:
            raise RemoteError(str(error)) from None
        _print(outcome.result, as_json)
        return outcome.state

    state = _in_graph(domain, router, distro, work)
    if state is not GoalState.SUCCEEDED:
        print(f"rtee: the goal was {state.name.lower()}", file=sys.stderr)
        raise typer.Exit(1)


def _swapped(kind: str | None, fields: str | None) -> tuple[str | None, str | None]:
    """Return type and fields of a call whose type may have been omitted."""
    if kind is None or fields is not None:
        return kind, fields
    # Types are pkg/Name or pkg/srv/Name; fields in YAML have a colon or a brace.
    is_type = kind.count("/") in (1, 2) and not set(kind) & set(" {:")
    return (kind, None) if is_type else (None, kind)


@app.command()
def router(
    *,
    listen: str = PLACE,
    insecure: bool = False,
) -> None:
    """Run a router of a ROS graph until Ctrl-C: a replacement for rmw_zenohd.

    Arguments and options:
        listen (ENDPOINT): Where to listen.
        insecure: Let others on the network connect without certificates.
    """
    from rtee.ros2.session import open_router

    async def main() -> None:
        async with open_router(listen, insecure=insecure):
            print(f"router of ROS 2 at {listen}", flush=True)
            await anyio.sleep_forever()

    anyio.run(main)


@app.command()
def messages(
    folder: Path,
) -> None:
    """Write the ament package rtee_msgs, for programs that are compiled against it.

    Arguments and options:
        folder (DIR): Where to write the package.
    """
    from rtee.ros2.package import write_package

    print(f"wrote {write_package(folder)}")
