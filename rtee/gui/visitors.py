"""Access control for the viser server: who may connect, and which messages a page may send.

viser 1.1 has no options for origins, hosts, tokens or TLS, but the function that it calls,
`websockets.asyncio.server.serve`, has them. While viser starts its server, a wrapper that adds them
replaces that function; `open_server` fails if viser did not call the wrapper.

viser also sets its sender's event from any thread, which fails if the sender stops waiting at that
moment. Its buffers therefore get an event that only viser's own thread can set.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import dataclasses
import io
import itertools
import logging
import math
import threading
from collections.abc import Awaitable, Callable
from typing import Any, Final, cast

import msgspec.msgpack
import viser
import websockets.asyncio.server
from viser._messages import GuiUpdateMessage
from viser.infra import _infra
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response
from websockets.protocol import State

from rtee.errors import LoopError
from rtee.gui import bar, headset
from rtee.gui.access import HEADERS, Access, PageRole, only_operators, page_of
from rtee.gui.headset import PAGE, PATH, Follow

PING_PERIOD: Final = 2.0
"""Interval of the pings to a page [s]: a computer that goes to sleep does not close its connection.
"""

PONG_WITHIN: Final = 8.0
"""Longest wait for a pong [s]: on a slow network, it takes seconds behind the data of a scene."""

_CLOSE_WITHIN: Final = 1.0
"""Longest wait for a page to confirm the end of its connection [s]: a sleeping page does not."""

_LARGEST: Final = 2**20
"""Longest message that a page may send [bytes]; a typed text has a few hundred."""

# Names of viser's message types.

_CAMERA: Final = "ViewerCameraMessage"
_UPDATE: Final = "GuiUpdateMessage"
_COMMAND: Final = "CommandTriggerMessage"

_LONGEST_TEXT: Final = 10_000
"""Longest text in a control [characters]: several pages, more than a person types."""

_WATCHING: Final = """<style>
.mantine-Paper-root :is(button, input, label, .mantine-Slider-root, .mantine-Input-wrapper)
  { pointer-events: none; opacity: 0.5; }
</style><div role="note" style="padding:0.25em 0.75em">View only. STOP works.</div>"""


class _Event(asyncio.Event):
    """An event that only the thread that created it can set."""

    def __init__(self) -> None:
        super().__init__()
        self._thread = threading.get_ident()

    def set(self) -> None:
        if threading.get_ident() == self._thread:
            super().set()


@dataclasses.dataclass
class Buffer(_infra.AsyncMessageBuffer):  # type: ignore[misc]
    """Messages on their way to a page; any thread may push one."""

    message_event: asyncio.Event = dataclasses.field(default_factory=_Event)


_infra.AsyncMessageBuffer = Buffer

_visitor: contextvars.ContextVar[Visitor] = contextvars.ContextVar("visitor")

Handler = Callable[[ServerConnection], Awaitable[None]]
Process = Callable[[ServerConnection, Request], Response | None]
Come = Callable[[viser.ClientHandle], object]
Gone = Callable[[int], object]


_LARGEST_WHOLE: Final = 2**53
"""Largest integer that a control may have: JavaScript represents integers exactly only up to it."""

_MOST_SILENT: Final = 256
"""Connections that may wait without a request at a time; browsers open a few spare ones each."""

_HANDSHAKE_WITHIN: Final = 5.0
"""Longest wait for a TLS handshake [s], which takes a few round trips."""

_Four = tuple[float, float, float, float]
_Three = tuple[float, float, float]

# The only messages that this GUI's page needs, with exactly their fields. viser accepts more:
# uploads, and requests for a public tunnel to this computer (``ShareUrlRequest``), which would open
# the hand to anybody. If viser cannot decode a message, it closes the page's connection.


class _Message(msgspec.Struct, forbid_unknown_fields=True):
    """A message from a page."""


class _Camera(_Message, tag=_CAMERA):
    """The camera's pose."""

    wxyz: _Four
    position: _Three
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: _Three
    up_direction: _Three

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        single = (self.fov, self.near, self.far, self.image_height, self.image_width)
        lists = (self.wxyz, self.position, self.look_at, self.up_direction)
        return all(map(math.isfinite, itertools.chain(single, *lists)))


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """The only property of a control that a page may change."""

    value: Any


class _Update(_Message, tag=_UPDATE):
    """A new value of a control."""

    uuid: str
    updates: _Value


class _PageCommand(_Message, tag=_COMMAND):
    """A command, by its key."""

    uuid: str


_READER: Final = msgspec.msgpack.Decoder(_Camera | _Update | _PageCommand)


def _fits(value: object, control: Any) -> bool:
    """Return whether a page can set a control to a value."""
    present, options = control._impl.value, getattr(control, "options", None)  # noqa: SLF001
    if isinstance(present, tuple):
        same = isinstance(value, list) and len(value) == len(present)
        return same and all(map(_is_like, cast("list[object]", value), present))
    like = _is_like(value, present) and (options is None or value in options)
    if not like or not _is_number(control):
        return like
    # A slider rounds to steps, of which the last may lie beyond its end.
    number, low, high = cast("float", value), control.min, control.max
    return (low is None or number > low - control.step) and (
        high is None or number < high + control.step
    )


def _is_number(control: Any) -> bool:
    """Return whether a control is a slider or a number field."""
    return getattr(control, "step", None) is not None


def _show_again(control: Any) -> None:
    """Send a control's value to its pages; viser sends only values that have changed."""
    impl = control._impl  # noqa: SLF001
    impl.gui_api._websock_interface.queue_message(  # noqa: SLF001
        GuiUpdateMessage(impl.uuid, {"value": impl.value})
    )


def _is_like(value: object, present: object) -> bool:
    """Return whether a value is of the same type as the present one."""
    match present:
        case bool():
            return isinstance(value, bool)
        case int():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            whole = cast("float", value)
            return number and abs(whole) <= _LARGEST_WHOLE and whole % 1 == 0
        case float():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            return number and math.isfinite(cast("float", value))
        case str():
            return isinstance(value, str) and len(value) <= _LONGEST_TEXT
    return False


class _NoRefusals(logging.Filter):
    """Drops the log records that websockets writes for each request refused before a WebSocket."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith(
            ("opening handshake failed", "connection rejected")
        )


_LOGGER: Final = logging.getLogger("websockets.server")
_LOGGER.addFilter(_NoRefusals())


class _Serve(websockets.asyncio.server.serve):
    """A server that does not wait for connections without a request when it closes.

    Browsers open spare connections, and websockets gives each 10 s to send its request.
    """

    async def __aexit__(self, *raised: Any) -> None:
        for connection in tuple(self.server.handlers):
            if connection.protocol.state is State.CONNECTING:
                connection.transport.abort()
        await super().__aexit__(*raised)


class Visitors:
    """The people who have the page open, and their permissions.

    ``guarded`` is set once viser has called the wrapper that checks access. ``desk`` provides the
    text and buttons of the bar above the page, if it has one.
    """

    def __init__(self, access: Access, follow: Follow | None = None) -> None:
        """Admit the holders of the tokens of ``access``; a headset's frames go to ``follow``."""
        self.guarded = False
        self.desk: bar.Desk | None = None
        self._follow = follow
        self._access = access
        self._server: viser.ViserServer | None = None
        self._operators: set[int] = set()
        self._silent: list[Visitor] = []
        self._come: Come = lambda client: None
        self._gone: Gone = lambda number: None

    def open_server(self, port: int) -> viser.ViserServer:
        """Start the web server at a port, or at the next free one if the port is in use.

        Raises `LoopError` if this version of viser starts its server without the access checks.
        """
        serve = websockets.asyncio.server.serve

        def guarded(
            handler: Handler,
            *args: Any,
            process_request: Process | None = None,
            **options: Any,
        ) -> Any:
            self.guarded = True
            options |= {"max_size": _LARGEST, "ssl": self._access.tls}
            options |= {"ping_interval": PING_PERIOD, "ping_timeout": PONG_WITHIN}
            options["close_timeout"] = _CLOSE_WITHIN
            if self._access.tls is not None:
                options["ssl_handshake_timeout"] = _HANDSHAKE_WITHIN
            return _Serve(
                self._in_role(handler),
                *args,
                process_request=self._judged(process_request),
                create_connection=self._connection_class(),
                **options,
            )

        websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
                server = viser.ViserServer(host=self._access.address, port=port, verbose=False)
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]
        if not self.guarded:
            server.stop()
            raise LoopError(
                f"viser {viser.__version__} opens its server in a way that cannot be guarded; "
                "install viser 1.1"
            )
        self._server = server
        server.on_client_connect(self._greet)
        server.on_client_disconnect(self._forget)
        return server

    @property
    def attended(self) -> bool:
        """Whether a window of an operator is open."""
        return bool(self._operators)

    def tell(self, come: Come, gone: Gone) -> None:
        """Call ``come`` for each open or new window and ``gone`` for each closed one.

        The calls for new and closed windows come from viser's thread.
        """
        self._come, self._gone = come, gone
        for client in tuple(self._server.get_clients().values()) if self._server else ():
            come(client)

    async def _greet(self, client: viser.ClientHandle) -> None:
        """Disable and dim the controls in an observer's page."""
        visitor = _visitor.get(None)
        if visitor is None or visitor.role is not PageRole.OPERATOR:
            client.gui.add_html(_WATCHING, order=-2)
        else:
            self._operators.add(client.client_id)
        if visitor is not None:
            visitor.window = client
        self._come(client)

    async def _forget(self, client: viser.ClientHandle) -> None:
        self._operators.discard(client.client_id)
        self._gone(client.client_id)

    def await_request(self, connection: Visitor) -> None:
        """Note a new connection; close the oldest of too many that have sent no request.

        Each takes a file descriptor for 10 s, and in a flood the newest are the likeliest to be a
        browser's.
        """
        waiting = [each for each in self._silent if each.protocol.state is State.CONNECTING]
        for each in waiting[: -_MOST_SILENT + 1]:
            each.transport.abort()
        self._silent = [*waiting[-_MOST_SILENT + 1 :], connection]

    def admits(
        self, role: PageRole | None, message: str | bytes, window: viser.ClientHandle | None = None
    ) -> bool:
        """Return whether a person of this role may send a message from a page.

        ``window`` is the page's window, which may have controls of its own. A page whose number is
        refused gets the value in force, with which a goal would run.
        """
        try:
            # viser's page sends only binary messages; text is not from it.
            read = _READER.decode(message if isinstance(message, bytes) else b"")
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError):
            return False
        if role is None or isinstance(read, _Camera):
            return role is not None and read.is_finite
        if role is not PageRole.OPERATOR:
            return False
        if isinstance(read, _PageCommand):
            return True
        # viser has no public way to find a control by the id in a page's messages.
        pages = [page for page in (window, self._server) if page is not None]
        found = (page.gui._gui_input_handle_from_uuid.get(read.uuid) for page in pages)  # noqa: SLF001
        control = next((each for each in found if each is not None), None)
        if control is None:
            return False
        fits = _fits(read.updates.value, control)
        if not fits and _is_number(control):
            _show_again(control)
        return fits

    def _judged(self, process: Process | None) -> Process:
        def judge(connection: ServerConnection, request: Request) -> Response | None:
            judged = self._access.judge(request, connection.local_address[1])
            if isinstance(judged, Response):
                return judged
            if isinstance(connection, Visitor):
                connection.role = judged
                if self._follow is not None and request.path.partition("?")[0] == PATH:
                    connection.headset = judged is PageRole.OPERATOR
                    if not (connection.headset and request.headers.get_all("Upgrade")):
                        return page_of(PAGE) if connection.headset else only_operators()
                connection.bar = request.path == bar.PATH and self.desk is not None
            response = None if process is None else process(connection, request)
            if response is not None:
                if self.desk is not None:
                    bar.put_into(response)
                for name, value in HEADERS.items():
                    response.headers[name] = value
            return response

        return judge

    def _in_role(self, handler: Handler) -> Handler:
        async def handle(connection: ServerConnection) -> None:
            if self._follow is not None and getattr(connection, "headset", False):
                await headset.handle(connection, self._follow)
            elif self.desk is not None and getattr(connection, "bar", False):
                await bar.handle(connection, self.desk)
            else:
                # viser calls `_greet` for this connection in this task or a child of it, which
                # inherits the context variable.
                if isinstance(connection, Visitor):
                    _visitor.set(connection)
                await handler(connection)

        return handle

    def _connection_class(self) -> type[Visitor]:
        class Guarded(Visitor):
            visitors = self

        return Guarded


class Visitor(ServerConnection):
    """The connection of a page, which drops messages that the person may not send.

    ``role`` is ``None`` until the request is checked.
    """

    visitors: Visitors
    role: PageRole | None = None
    headset = False
    bar = False
    window: viser.ClientHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait for the request."""
        super().connection_made(transport)
        self.visitors.await_request(self)

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that the page may send."""
        while True:
            message = await super().recv(decode)
            if self.headset or self.bar or self.visitors.admits(self.role, message, self.window):
                return message
