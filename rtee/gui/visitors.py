"""The browser's server with a door: who connects, and which messages a page may send.

viser 1.1 has no option for origins, hosts, tokens or TLS: it passes all that it knows to
`websockets.asyncio.server.serve`, which has them. While viser starts its server, that function is
replaced by one that adds them; `open_server` fails if viser did not call it.
"""

from __future__ import annotations

import contextlib
import contextvars
import io
import logging
from collections.abc import Awaitable, Callable
from typing import Any, Final

import msgspec.msgpack
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from rtee.errors import LoopError
from rtee.gui.access import HEADERS, Access, Role
from rtee.gui.colours import STOP

_LARGEST: Final = 2**20
"""Longest message that a page may send [bytes]; a text that a person typed has some hundred."""

_CAMERA: Final = "ViewerCameraMessage"
_UPDATE: Final = "GuiUpdateMessage"
_COMMAND: Final = "CommandTriggerMessage"

_USED: Final = frozenset({_CAMERA, _UPDATE, _COMMAND})
"""What this GUI's page sends: where it looks from, controls that are used, and keys.

viser's server takes more: uploads, and requests for a public tunnel to this computer
(``ShareUrlRequest``), which would open the hand to anybody.
"""

_STOP_BUTTON: Final = f'.mantine-Paper-root button[style*="#{bytes(STOP).hex()}"]'
"""How the page's style finds STOP: by its colour, which no other button has."""

_WATCHING: Final = f"""<style>
.mantine-Paper-root :is(button, input, label, .mantine-Slider-root, .mantine-Input-wrapper)
  {{ pointer-events: none; opacity: 0.5; }}
{_STOP_BUTTON}, {_STOP_BUTTON} * {{ pointer-events: auto; opacity: 1; }}
</style><div role="note" style="padding:0.25em 0.75em">You watch: only STOP works here.</div>"""

_role: contextvars.ContextVar[Role] = contextvars.ContextVar("role")

Handler = Callable[[ServerConnection], Awaitable[None]]
Process = Callable[[ServerConnection, Request], Response | None]


class _Message(msgspec.Struct):
    """What tells about a message whether it is passed on; other fields are skipped."""

    type: str
    uuid: str = ""


class Visitors:
    """Those who have the page open, and what they may do.

    Attributes:
        met: Whether viser opened its server by way of this; `open_server` checks it.
    """

    def __init__(self, access: Access) -> None:
        """Take who may open the page."""
        self.met = False
        self._access = access
        self._for_everybody: frozenset[str] = frozenset()

    def open_server(self, port: int) -> viser.ViserServer:
        """Start the browser's server.

        Args:
            port: Port to listen on; the next free one if it is in use.

        Raises:
            LoopError: if this version of viser opens its server in another way, unguarded.
        """
        serve = websockets.asyncio.server.serve

        def guarded(
            handler: Handler,
            *args: Any,
            process_request: Process | None = None,
            **options: Any,
        ) -> Any:
            self.met = True
            options |= {"max_size": _LARGEST, "ssl": self._access.tls}
            return serve(
                _in_role(handler),
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
        if not self.met:
            server.stop()
            raise LoopError(
                f"viser {viser.__version__} opens its server in a way that cannot be guarded; "
                "install viser 1.1"
            )
        server.on_client_connect(_greet)
        return server

    def leave_to_everybody(self, *controls: Any) -> None:
        """Let observers, too, use these buttons and commands, and no others."""
        # viser has no public name for what identifies a control in the messages of a page.
        self._for_everybody = frozenset(control._impl.uuid for control in controls)  # noqa: SLF001

    def admits(self, role: Role | None, message: str | bytes) -> bool:
        """Return whether a message of a page is passed on."""
        try:
            # viser's page sends binary messages only, so that a text is nothing that it sent.
            found = msgspec.msgpack.decode(
                message if isinstance(message, bytes) else b"", type=_Message
            )
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError):
            return False
        if role is None or found.type not in _USED:
            return False
        return role is Role.OPERATOR or found.type == _CAMERA or found.uuid in self._for_everybody

    def _judged(self, process: Process | None) -> Process:
        def judge(connection: ServerConnection, request: Request) -> Response | None:
            _be_quiet(connection)
            judged = self._access.judge(request, connection.local_address[1])
            if isinstance(judged, Response):
                return judged
            if isinstance(connection, Visitor):
                connection.role = judged
            response = None if process is None else process(connection, request)
            if response is not None:
                for name, value in HEADERS.items():
                    response.headers[name] = value
            return response

        return judge

    def _connection_class(self) -> type[Visitor]:
        class Guarded(Visitor):
            visitors = self

        return Guarded


class Visitor(ServerConnection):
    """A page's connection, which receives what the person may do only.

    Attributes:
        role: The person's role, once it is known.
    """

    visitors: Visitors
    role: Role | None = None

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that the page may send."""
        while True:
            message = await super().recv(decode)
            if self.visitors.admits(self.role, message):
                return message


def _in_role(handler: Handler) -> Handler:
    async def handle(connection: ServerConnection) -> None:
        # What viser calls for this connection runs in this task or its children: `_greet`.
        # Without a known role, a page is told only what everybody may do.
        _role.set(getattr(connection, "role", None) or Role.OBSERVER)
        await handler(connection)

    return handle


async def _greet(client: viser.ClientHandle) -> None:
    """Show an observer what does not work."""
    if _role.get(Role.OBSERVER) is Role.OBSERVER:
        client.gui.add_html(_WATCHING, order=-2)


class _NoRefusals(logging.Filter):
    """Leaves out what websockets logs of every request that is answered without a WebSocket."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith(
            ("opening handshake failed", "connection rejected")
        )


_NO_REFUSALS: Final = _NoRefusals()


def _be_quiet(connection: ServerConnection) -> None:
    logger = connection.logger
    # Called for every request: a logger keeps the same filter only once.
    (logger.logger if isinstance(logger, logging.LoggerAdapter) else logger).addFilter(_NO_REFUSALS)
