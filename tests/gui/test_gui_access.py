"""Who may open the GUI: names, origins, tokens, roles and messages, without a browser."""

from __future__ import annotations

import contextlib
import http.client
import shutil
import socket as stdlib_socket
import ssl
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import msgspec.msgpack
import pytest
import viser
import websockets.asyncio.server
from websockets.asyncio.client import connect
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request, Response
from websockets.typing import Origin, Subprotocol

from rtee.errors import ConfigError, LoopError
from rtee.gui.access import Access, PageRole, tls_context
from rtee.gui.app import serve
from rtee.gui.visitors import Visitors

PORT = 8080


def asked(access: Access, host: str, path: str = "/", **headers: str) -> PageRole | int:
    """Return the role that a request has, or the status of the answer."""
    fields = Headers({"Host": host, **{k.replace("_", "-"): v for k, v in headers.items()}})
    found = access.judge(Request(path, fields), PORT)
    if isinstance(found, Response):
        assert found.headers["X-Frame-Options"] == "DENY"
        assert "frame-ancestors 'none'" in found.headers["Content-Security-Policy"]
        return found.status_code
    return found


def token(access: Access, role: PageRole = PageRole.OPERATOR) -> str:
    return access.links(PORT)[role].partition("token=")[2]


def visited(
    access: Access, role: PageRole = PageRole.OPERATOR, path: str = "", **more: str
) -> Response:
    """Open the address of a role by one of its names."""
    headers = Headers({"Host": "localhost:8080", **more})
    found = access.judge(Request(f"/?token={token(access, role)}{path}", headers), PORT)
    assert isinstance(found, Response)
    return found


def cookie_of(answer: Response) -> str:
    """Return name and value of the cookie that an answer sets."""
    return answer.headers["Set-Cookie"].partition(";")[0]


def socket(
    access: Access, host: str, origin: str, role: PageRole = PageRole.OPERATOR
) -> PageRole | int:
    cookie = f"other=1; {cookie_of(visited(access, role))}"
    return asked(access, host, Upgrade="websocket", Origin=origin, Cookie=cookie)


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "LOCALHOST:9"])
def test_loopback_has_these_names(host: str) -> None:
    access = Access()
    assert socket(access, host, f"http://{host.lower()}") is PageRole.OPERATOR
    assert socket(access, host, f"https://{host.lower()}") == 403
    assert socket(access, host, "http://localhost:1") == 403
    assert socket(access, host, "null") == 403


@pytest.mark.parametrize(
    "host", ["evil.test:8080", "127.0.0.1.evil.test", "evil.test@127.0.0.1", "", "[::1", "10.0.0.1"]
)
def test_it_has_no_other_names(host: str) -> None:
    access = Access()
    assert socket(access, host, f"http://{host}") == 421
    assert asked(access, host, f"/?token={token(access)}") == 421


def test_a_socket_needs_an_origin_and_one_host() -> None:
    access = Access()
    cookie = cookie_of(visited(access))
    assert asked(access, "localhost:8080", Upgrade="websocket", Cookie=cookie) == 403
    fields = Headers({"Cookie": cookie})
    for host in ("localhost:8080", "localhost:8080"):
        fields["Host"] = host
    twice = access.judge(Request("/", fields), PORT)
    assert isinstance(twice, Response)
    assert twice.status_code == 421


def test_the_token_becomes_a_cookie() -> None:
    access = Access(observers=True)
    assert asked(access, "localhost:8080") == 403
    assert asked(access, "localhost:8080", "/?token=wrong") == 403
    for role in PageRole:
        found = visited(access, role, "&darkMode=1")
        assert (found.status_code, found.headers["Location"]) == (303, "/?darkMode=1")
        cookie, *attributes = found.headers["Set-Cookie"].split("; ")
        assert attributes == ["Path=/", "HttpOnly", "SameSite=Strict"]
        assert asked(access, "localhost:8080", Cookie=cookie) is role
        # Browsers send it to every port of a host, so that each GUI takes its own alone.
        assert asked(access, "localhost:8080", Cookie=cookie.replace("8080", "8081")) == 403
    assert token(access) != token(Access()), "tokens are made at each start"


def test_a_token_opens_one_browser() -> None:
    access = Access(observers=True)
    announced: list[tuple[PageRole, str]] = []
    access.announce = lambda role, link: announced.append((role, link))
    used = dict(access.links(PORT))
    cookies = {role: cookie_of(visited(access, role)) for role in PageRole}
    assert announced == list(access.links(PORT).items())
    for role, link in used.items():
        path = f"/?{urlsplit(link).query}"
        assert asked(access, "localhost:8080", path) == 403
        # Neither is the cookie the token, nor does the token do as a cookie.
        query = urlsplit(link).query
        assert asked(access, "localhost:8080", Cookie=query.replace("token", f"rtee_{PORT}")) == 403
        assert asked(access, "localhost:8080", path, Cookie=cookies[role]) == 303
        assert asked(access, "localhost:8080", Cookie=cookies[role]) is role
    assert announced == list(access.links(PORT).items()), "what is refused uses up nothing"


def test_the_oldest_of_too_many_browsers_has_to_open_a_new_address() -> None:
    access = Access()
    first, *_, last = (cookie_of(visited(access)) for _ in range(257))
    assert asked(access, "localhost:8080", Cookie=first) == 403
    assert asked(access, "localhost:8080", Cookie=last) is PageRole.OPERATOR


@pytest.mark.parametrize(
    "head",
    [
        b"GET /?token=\xe9 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nCookie: rtee_%d=\xc3\xa9\r\n\r\n",
        b"GET //[ HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ],
)
def test_any_bytes_are_refused_as_what_they_are(head: bytes) -> None:
    visitors = Visitors(Access())
    server = visitors.open_server(0)
    try:
        with stdlib_socket.create_connection(("127.0.0.1", server.get_port())) as client:
            client.sendall(head.replace(b"%d", b"%d" % server.get_port()))
            answer = client.makefile("rb").read()
    finally:
        server.stop()
    assert answer.startswith(b"HTTP/1.1 403 ")
    assert b"X-Frame-Options: DENY" in answer


def test_a_connection_that_asks_for_nothing_does_not_delay_the_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    server = Visitors(Access()).open_server(0)
    place = ("127.0.0.1", server.get_port())
    with stdlib_socket.create_connection(place), stdlib_socket.create_connection(place) as asks:
        asks.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert asks.recv(20).startswith(b"HTTP/1.1 403 ")  # so that the other one is accepted, too
        server.stop()
        thread = server._websock_server._server_thread
        assert thread is not None
        assert not thread.is_alive()
    assert not caplog.records


def test_connections_that_ask_for_nothing_are_few_and_keep_nobody_out() -> None:
    visitors = Visitors(Access())
    server = visitors.open_server(0)
    address = ("127.0.0.1", server.get_port())
    with contextlib.ExitStack() as opened:
        try:
            silent = [
                opened.enter_context(stdlib_socket.create_connection(address)) for _ in range(300)
            ]
            # The oldest is closed, the newest is not.
            assert silent[0].recv(1) == b""
            silent[-1].sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert silent[-1].recv(100).startswith(b"HTTP/1.1 403")
        finally:
            server.stop()


def test_without_observers_there_is_no_token_for_them() -> None:
    assert list(Access().links(PORT)) == [PageRole.OPERATOR]


def test_behind_a_proxy_pages_come_from_there() -> None:
    access = Access(behind="https://Hand.example.org/")
    assert access.links(PORT)[PageRole.OPERATOR].startswith("https://hand.example.org/?token=")
    own = "https://hand.example.org"
    for host in ("hand.example.org", "127.0.0.1:8080"):  # as Caddy and as nginx pass it on
        assert socket(access, host, own) is PageRole.OPERATOR
        assert socket(access, host, f"http://{host}") == 403
    assert socket(access, "evil.test", own) == 421
    found = visited(access, Host="hand.example.org")
    assert found.headers["Set-Cookie"].endswith("; Secure")


@pytest.mark.parametrize("message", [b"", b"\xff", b"\x81\xa4type", b"\x01", "text", b"\x90"])
def test_junk_is_dropped(message: str | bytes) -> None:
    assert not Visitors(Access()).admits(PageRole.OPERATOR, message)


CAMERA: dict[str, object] = {
    **dict.fromkeys(("fov", "near", "far"), 1.0),
    **dict.fromkeys(("image_height", "image_width"), 800),
    **dict.fromkeys(("position", "look_at", "up_direction"), (0, 0.0, 1.0)),
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "type": "ViewerCameraMessage",
}


@pytest.mark.parametrize(
    ("message", "operator", "observer"),
    [
        (CAMERA, True, True),
        ({**CAMERA, "fov": float("nan")}, False, False),
        ({**CAMERA, "fov": "wide"}, False, False),
        ({**CAMERA, "more": 1}, False, False),
        ({"type": "ViewerCameraMessage"}, False, False),
        ({"type": "GuiUpdateMessage", "uuid": "open", "updates": {}}, False, False),
        ({"type": "GuiUpdateMessage", "uuid": "open", "updates": {"removed": True}}, False, False),
        ({"type": "GuiUpdateMessage", "uuid": "open", "updates": {"update_cb": []}}, False, False),
        ({"type": "GuiUpdateMessage", "uuid": "open", "updates": {"value": True}}, True, False),
        ({"type": "GuiUpdateMessage", "uuid": "none", "updates": {"value": True}}, False, False),
        ({"type": "GuiUpdateMessage", "uuid": ["open"], "updates": {}}, False, False),
        ({"type": "CommandTriggerMessage", "uuid": "open"}, True, False),
        ({"type": "ShareUrlRequest"}, False, False),
        ({"type": "ShareUrlDisconnect"}, False, False),
        ({"type": "FileTransferStartUpload"}, False, False),
        ({"type": ["GuiUpdateMessage"]}, False, False),
    ],
)
def test_what_a_page_may_send(message: dict[str, object], operator: bool, observer: bool) -> None:
    visitors = Visitors(Access())
    server = visitors.open_server(0)
    try:
        button = server.gui.add_button("open")
        if message.get("uuid") == "open":
            message = {**message, "uuid": button._impl.uuid}
        data = msgspec.msgpack.encode(message)
        assert visitors.admits(PageRole.OPERATOR, data) is operator
        assert visitors.admits(PageRole.OBSERVER, data) is observer
        assert not visitors.admits(None, data)
    finally:
        server.stop()


# --- the server


def test_viser_opens_its_server_by_way_of_us() -> None:
    visitors = Visitors(Access())
    serve = websockets.asyncio.server.serve
    visitors.open_server(0).stop()
    assert visitors.guarded
    assert websockets.asyncio.server.serve is serve


def test_a_viser_that_opens_it_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(viser.ViserServer):
        def __init__(self, **_: object) -> None:
            super().__init__(host="127.0.0.1", port=0, verbose=False)

    serve = websockets.asyncio.server.serve
    import viser.infra._infra as infra

    class Bound:
        """The library's names as they were when viser was imported."""

        class asyncio:  # noqa: N801
            class server:  # noqa: N801
                ServerConnection = websockets.asyncio.server.ServerConnection

        Headers = websockets.Headers
        datastructures = websockets.datastructures
        exceptions = websockets.exceptions

    Bound.asyncio.server.serve = serve  # type: ignore[attr-defined]
    monkeypatch.setattr(infra, "websockets", Bound)
    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(LoopError, match="cannot be guarded"):
        Visitors(Access()).open_server(0)


@pytest.fixture(scope="module")
def pem(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate for localhost, and its key."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    folder = tmp_path_factory.mktemp("pem")
    certificate, key = folder / "hand.pem", folder / "hand.key"
    made = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    about = ("-days", "2", "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost")
    command = ["openssl", *made, *about, "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(command, check=True, capture_output=True)
    return certificate, key


@pytest.fixture
def encrypted(pem: tuple[Path, Path]) -> Iterator[tuple[Access, int]]:
    access = Access("0.0.0.0", tls=tls_context(*pem), observers=True)
    server = Visitors(access).open_server(0)
    yield access, server.get_port()
    server.stop()


@pytest.mark.anyio
async def test_with_a_certificate_it_may_be_on_a_network(
    encrypted: tuple[Access, int], pem: tuple[Path, Path]
) -> None:
    access, port = encrypted
    link = urlsplit(access.links(port)[PageRole.OPERATOR])
    assert link.scheme == "https"
    trusting = ssl.create_default_context(cafile=str(pem[0]))
    place = f"localhost:{port}"
    with contextlib.closing(http.client.HTTPSConnection(place, context=trusting)) as browser:
        browser.request("GET", f"/?{link.query}")
        cookie = str(browser.getresponse().getheader("Set-Cookie")).partition(";")[0]

    # With threads, this library reads and writes an encrypted socket at the same time, which
    # OpenSSL does not allow: one handshake in some hundred never ends.
    def opened(origin: str) -> connect:
        return connect(
            f"wss://{place}/",
            ssl=trusting,
            origin=Origin(origin),
            additional_headers={"Cookie": cookie},
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            proxy=None,
            max_size=None,
        )

    async with opened(f"https://{place}") as connection:
        assert await connection.recv()
    for origin in (f"http://{place}", "https://evil.test"):
        with pytest.raises(InvalidStatus, match="403"):
            await opened(origin)


def test_a_key_of_another_certificate_is_refused(pem: tuple[Path, Path], tmp_path: Path) -> None:
    other = tmp_path / "other.key"
    command = ("openssl", "genpkey", "-algorithm", "ED25519", "-out", str(other))
    subprocess.run(command, check=True, capture_output=True)
    with pytest.raises(ConfigError, match="is not the certificate of"):
        tls_context(pem[0], other)


@pytest.mark.anyio
async def test_behind_a_proxy_it_takes_no_other_port() -> None:
    """The proxy would lead people to whatever has the port."""
    access = Access(behind="https://hand.example.org")
    with stdlib_socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(ConfigError, match="to which the proxy forwards, is not free"):
            await serve(None, access=access, port=other.getsockname()[1])
    with pytest.raises(ConfigError, match="needs --port"):
        await serve(None, access=access, port=0)


@pytest.mark.anyio
async def test_an_address_that_is_used_as_soon_as_it_is_printed_has_a_next_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def opened(_visitors: object, access: Access, _port: int) -> object:
        access.announce(PageRole.OPERATOR, "http://next")
        raise ConfigError("this is all")

    monkeypatch.setattr("rtee.gui.app._opened", opened)
    with pytest.raises(ConfigError, match="this is all"):
        await serve(None, access=Access())
    assert capsys.readouterr().out == "rtee: for another browser: GUI at http://next\n"
