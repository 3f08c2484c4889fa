"""The GUI behind Caddy and nginx, with the very configuration that the docs give."""

from __future__ import annotations

import base64
import http.client
import os
import re
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pytest
import viser

from rtee.remote.blocking import BlockingHand

from .conftest import PROXIED
from .marks import in_a_browser
from .running import GRIPPER, Program, free_port
from .window import Window

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

pytestmark = in_a_browser

PAGE = "docs/how-to/gui-on-a-network.md"
OWN = f"https://{PROXIED}"


class Proxied(NamedTuple):
    """A GUI behind a proxy.

    Attributes:
        gui: The GUI's process.
        link: The address that it has printed.
        port: Where the proxy listens.
        trusting: TLS settings of a client that believes the proxy's certificate only.
    """

    gui: Program
    link: str
    port: int
    trusting: ssl.SSLContext

    def status(self, path: str = "/", **headers: str) -> tuple[int, bytes]:
        """Return what the proxy answers to a request."""
        status, _, body = self.answer(path, **headers)
        return status, body

    def answer(self, path: str, **headers: str) -> tuple[int, str, bytes]:
        """Return status, cookie and body, as for a browser that looks the proxy up by name."""
        connection = http.client.HTTPSConnection(PROXIED, context=self.trusting)
        plain = socket.create_connection(("127.0.0.1", self.port), timeout=30)
        connection.sock = self.trusting.wrap_socket(plain, server_hostname=PROXIED)
        fields = {"Host": PROXIED, **{k.replace("_", "-"): v for k, v in headers.items()}}
        connection.request("GET", path, headers=fields)
        answer = connection.getresponse()
        cookie = (answer.getheader("Set-Cookie") or "").partition(";")[0]
        found = answer.status, cookie, answer.read()
        connection.close()
        return found

    def opened(self, origin: str, cookie: str, host: str = PROXIED) -> int:
        """Return the status with which a WebSocket is opened or refused."""
        key = base64.b64encode(os.urandom(16)).decode()
        return self.status(
            Host=host,
            Origin=origin,
            Cookie=cookie,
            Connection="Upgrade",
            Upgrade="websocket",
            Sec_WebSocket_Key=key,
            Sec_WebSocket_Version="13",
            Sec_WebSocket_Protocol=f"viser-v{viser.__version__}",
        )[0]


def documented(repository: Path, begin: str) -> str:
    """Return the block of the docs' page that begins with some words."""
    blocks = re.findall(r"^```\n(.*?)^```$", (repository / PAGE).read_text(), re.DOTALL | re.M)
    [found] = [block for block in blocks if block.startswith(begin)]
    return str(found)


def replaced(text: str, *pairs: tuple[str, str]) -> str:
    """Replace what is this computer's; every piece must be there."""
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text


def nginx(folder: Path, repository: Path, port: int, gui: int) -> tuple[str, ...]:
    """Write nginx's files; return the command."""
    site = replaced(
        documented(repository, "server {"),
        ("listen 443 ", f"listen 127.0.0.1:{port} "),
        ("/etc/ssl", str(folder)),
        ("127.0.0.1:8080", f"127.0.0.1:{gui}"),
    )
    # What a distribution's nginx.conf says around it; its folders belong to root.
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    places = " ".join(f"{kind}_temp_path {folder}/{kind};" for kind in kinds)
    head = f"daemon off; pid {folder}/pid; error_log stderr; events {{}}\n"
    (folder / "nginx.conf").write_text(f"{head}http {{ {places}\n{site} }}\n")
    return ("nginx", "-p", str(folder), "-e", "stderr", "-c", str(folder / "nginx.conf"))


def caddy(folder: Path, repository: Path, port: int, gui: int) -> tuple[str, ...]:
    """Write Caddy's file; return the command."""
    site = replaced(
        documented(repository, f"{PROXIED} {{"),
        ("/etc/ssl", str(folder)),
        ("127.0.0.1:8080", f"127.0.0.1:{gui}"),
    )
    options = ("admin off", "default_bind 127.0.0.1", f"https_port {port}")
    # No second port, which redirects to the first.
    places = ("auto_https disable_redirects", f"storage file_system {folder}")
    lines = "\n".join(f"    {line}" for line in (*options, *places))
    (folder / "Caddyfile").write_text(f"{{\n{lines}\n}}\n{site}")
    # It writes there what it was last configured with.
    kept = f"XDG_CONFIG_HOME={folder}"
    return (
        "env",
        kept,
        "caddy",
        "run",
        "--config",
        str(folder / "Caddyfile"),
        "--adapter",
        "caddyfile",
    )


PROXIES: dict[str, Callable[[Path, Path, int, int], tuple[str, ...]]] = {
    "nginx": nginx,
    "caddy": caddy,
}


@pytest.fixture(params=PROXIES)
def proxied(
    request: pytest.FixtureRequest,
    repository: Path,
    place: Path,
    other: BlockingHand,
    proxy_port: int,
    tmp_path: Path,
) -> Iterator[Proxied]:
    program = shutil.which(request.param, path=f"{os.environ['PATH']}:/usr/sbin")
    for need in (program, shutil.which("openssl")):
        if need is None:
            pytest.skip(f"{request.param} or openssl is not installed")
    made = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    about = ("-days", "2", "-subj", "/CN=hand", "-addext", f"subjectAltName=DNS:{PROXIED}")
    files = ("-keyout", str(tmp_path / "hand.key"), "-out", str(tmp_path / "hand.pem"))
    subprocess.run(["openssl", *made, *about, *files], check=True, capture_output=True)
    port = free_port()
    gui = Program(place, "gui", GRIPPER, "--port", str(port), "--behind-proxy", OWN)
    words = PROXIES[request.param](tmp_path, repository, proxy_port, port)
    command = tuple(str(program) if word == request.param else word for word in words)
    proxy = Program(place, command=command)
    try:
        link = gui.line(r"rtee: GUI at (https://\S+)")[1]
        wait_for(proxy_port, proxy)
        yield Proxied(
            gui, link, proxy_port, ssl.create_default_context(cafile=tmp_path / "hand.pem")
        )
    finally:
        proxy.end()
        gui.end()
    assert "Traceback" not in gui.rest()


def wait_for(port: int, program: Program) -> None:
    """Wait until a program listens."""
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=30).close()
        except OSError:
            assert program.process.poll() is None, program.rest()
            time.sleep(0.05)


def test_the_page_works_behind_it_as_the_docs_say(
    proxied: Proxied, context: BrowserContext, only_window: Window, other: BlockingHand
) -> None:
    assert proxied.link.startswith(f"{OWN}/?token=")
    assert other.do("PinchTight", intensity=0.5).reached
    before = other.state().position
    context.clear_cookies(domain=PROXIED)  # those of the proxy before
    page = context.new_page()
    try:
        page.goto(proxied.link)
        page.get_by_text(f"{GRIPPER}: connected").wait_for()
        assert page.url == f"{OWN}/"
        [kept] = [each for each in context.cookies(OWN) if each["name"].startswith("rtee_")]
        assert (kept["secure"], kept["httpOnly"], kept["sameSite"]) == (True, True, "Strict")
        page.get_by_role("button", name="Open hand", exact=True).first.click()
        while abs(other.state().position - before).max() < 1e-2:
            page.wait_for_timeout(50)
        page.reload()
        page.get_by_text(f"{GRIPPER}: connected").wait_for()
    finally:
        page.close()
        only_window.page.bring_to_front()


def test_it_asks_for_token_origin_and_host_behind_it(proxied: Proxied) -> None:
    # Another name leads to no page, whether the proxy says so or the GUI, and uses up no token.
    path = proxied.link.removeprefix(OWN)
    status, body = proxied.status(path, Host="evil.test")
    assert status == 421 or not body
    status, cookie, _ = proxied.answer(path)
    assert status == 303
    assert proxied.opened(OWN, cookie) == 101
    assert proxied.opened(OWN, "wrong") == 403
    for origin in ("https://evil.test", f"http://{PROXIED}", f"{OWN}:8443", "null"):
        assert proxied.opened(origin, cookie) == 403
    assert proxied.opened("https://evil.test", cookie, host="evil.test") != 101
    for refused in ("/", "/?token=wrong", path):
        assert proxied.status(refused)[0] == 403
    following = proxied.gui.line(rf"rtee: for another browser: GUI at {OWN}(\S+)")[1]
    assert proxied.status(following)[0] == 303
