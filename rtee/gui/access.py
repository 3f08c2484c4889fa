"""Access to the GUI: tokens, host names, origins and roles, and the headers of its responses.

A browser sends its user's cookies with the requests of any page, and lets any page open a
WebSocket to this computer. Every request must therefore pass three checks:

- ``Host`` is a name of this GUI; the GUI refuses a foreign name that was made to point here (DNS
  rebinding);
- ``Origin``, for a WebSocket, is that of this GUI's pages;
- the address contains the token that `rtee gui` printed, or the request carries a cookie that was
  issued for one.

A token opens one browser: it is exchanged for a cookie at once and never valid again, so that an
address in a history, a log or a chat opens nothing. `rtee gui` prints the next one then.
"""

from __future__ import annotations

import hashlib
import http
import ipaddress
import secrets
import socket
import ssl
from collections.abc import Callable, Iterable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Final
from urllib.parse import parse_qsl, urlencode, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from rtee.errors import ConfigError
from rtee.hand.files import failing, reason

_TOKEN_BYTES: Final = 24
"""Random bytes of a token or a cookie [bytes]: 192 bits cannot be guessed."""

_BROWSERS: Final = 256
"""Maximum number of browsers with a valid cookie: more than ever watch a hand at the same time. The
oldest is dropped first."""

_LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")

_DIVERTING: Final = ("websocket", "playbackPath")
"""Query parameters that make viser's page show the content of another server."""

_POLICY: Final = "; ".join(
    (
        "default-src 'none'",
        # An inline script of viser's page unpacks the main one, which compiles further scripts.
        "script-src 'unsafe-inline' 'unsafe-eval'",
        "script-src-attr 'none'",  # so that HTML in a panel cannot run anything
        "style-src 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "font-src 'self' data:",
        "connect-src 'self' data: blob:",
        "worker-src 'self' data: blob:",
        "frame-ancestors 'none'",
        "base-uri 'none'",
        "form-action 'none'",
    )
)

HEADERS: Final = {
    "Content-Security-Policy": _POLICY,
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every response: no one may frame, embed or store the page; it connects only here."""

_COOKIE: Final = "rtee_"
"""Prefix of the cookie's name; the port follows, since all ports of a host share cookies."""

_ASK: Final = "Open the address that `rtee gui` printed last; each opens one browser."
"""Remedy in the refusal of a request without a valid token."""


class PageRole(StrEnum):
    """Role of the person at a page."""

    OPERATOR = "operator"
    """May do everything."""
    OBSERVER = "observer"
    """May watch and stop."""


def addresses_of(host: str) -> list[str]:
    """Return the IP addresses of a host name of this computer.

    Raises `ConfigError` if it has none, or this computer cannot listen on the first.
    """
    if not host.strip():
        raise ConfigError("--host is empty; give an address of this computer, such as 127.0.0.1")
    if host.replace(".", "").isdigit() and host.count("."):
        try:  # a misspelt address would be looked up as a name, for seconds
            ipaddress.ip_address(host)
        except ValueError:
            raise ConfigError(f"--host {host} is not an IP address") from None
    try:
        addresses = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise ConfigError(f"--host {host}: cannot find an address for this name") from None
    family, _, _, _, place = addresses[0]
    try:
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            trial.bind(place)
    except OSError as error:
        raise ConfigError(f"--host {host}: cannot listen there: {reason(error)}") from None
    return [str(place[0]) for _, _, _, _, place in addresses]


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the TLS settings of a server for two PEM files, the key without a passphrase.

    Raises `ConfigError` if a file cannot be read, or the key is not that of the certificate.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    for path in (certificate, key):
        with failing("cannot be read", path):
            path.read_bytes()
    try:
        # Without an empty passphrase, OpenSSL would ask for one on the terminal.
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, ValueError) as error:
        words = getattr(error, "reason", None) or str(error)
        raise ConfigError(
            f"is not the certificate of {key} ({words}); both must be PEM files", path=certificate
        ) from None
    return context


def public_origin(text: str) -> str:
    """Return the origin of a reverse proxy as browsers send it: ``https://hand.example.org``.

    Raises `ConfigError` if the text is not an HTTPS origin.
    """
    try:
        url = urlsplit(text)
        port = url.port
    except ValueError:
        url, port = urlsplit(""), None
    if url.scheme != "https" or not url.hostname or url.path not in ("", "/") or url.query:
        raise ConfigError(
            f"--behind-proxy {text} is not an origin; give the address under which browsers reach "
            "the proxy, such as https://hand.example.org"
        )
    name = f"[{url.hostname}]" if ":" in url.hostname else url.hostname
    return f"https://{name}" + (f":{port}" if port not in (None, 443) else "")


class Access:
    """Tokens, IP address and encryption of the GUI; `tls` is set if the GUI itself encrypts.

    Attributes:
        announce: Called with a role and its next address once its previous address was used.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        *,
        tls: ssl.SSLContext | None = None,
        behind: str | None = None,
        observers: bool = False,
    ) -> None:
        """Make new tokens.

        TLS settings are needed beyond loopback, unless the reverse proxy at the origin ``behind``
        encrypts. Raises `ConfigError` if the host has no address here, or would be open without
        encryption.
        """
        addresses = addresses_of(host)
        numbers = [ipaddress.ip_address(each.partition("%")[0]) for each in addresses]
        local = all(number.is_loopback for number in numbers)
        if not local and tls is None and behind is None:
            raise ConfigError(
                f"--host {host} opens the GUI to a network; encrypt it with --tls-cert and "
                "--tls-key, or let a proxy do so and give --behind-proxy https://ITS-NAME"
            )
        self.address = addresses[0]
        self.tls = tls
        self._host = host
        self._public = None if behind is None else public_origin(behind)
        self._any = any(number.is_unspecified for number in numbers)
        self.announce: Callable[[PageRole, str], object] = lambda _role, _link: None
        roles = tuple(PageRole) if observers else (PageRole.OPERATOR,)
        self._tokens = {role: secrets.token_urlsafe(_TOKEN_BYTES) for role in roles}
        # Keyed by hash, so that the time of a lookup reveals nothing about a cookie.
        self._browsers: dict[bytes, PageRole] = {}

    @property
    def behind_proxy(self) -> bool:
        """Whether browsers reach the GUI through a proxy."""
        return self._public is not None

    # --- addresses

    def links(self, port: int) -> dict[PageRole, str]:
        """Return the addresses to open, with their tokens, by role; each opens one browser."""
        if self._public is not None:
            base = self._public
        else:
            host = socket.gethostname() if self._any else self._host
            name = f"[{host}]" if ":" in host else host
            base = f"{self._scheme}://{name}:{port}"
        return {role: f"{base}/?{urlencode({'token': t})}" for role, t in self._tokens.items()}

    @property
    def _scheme(self) -> str:
        return "http" if self.tls is None else "https"

    # --- checks of a request

    def judge(self, request: Request, port: int) -> PageRole | Response:
        """Return the role of a request's sender, or the response to send instead."""
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._is_reached_by(hosts[0]):
            return _refusal(
                http.HTTPStatus.MISDIRECTED_REQUEST, "This GUI is not known by this name."
            )
        is_socket = bool(request.headers.get_all("Upgrade"))
        if is_socket and request.headers.get_all("Origin") != [self._origin(hosts[0])]:
            return _refusal(http.HTTPStatus.FORBIDDEN, "Only pages of this GUI may connect.")
        # `urlsplit` would take the path "//[" for a malformed host.
        query = parse_qsl(request.path.partition("?")[2], keep_blank_values=True)
        token = None if is_socket else dict(query).get("token")
        if token is not None and (role := self._role_of(token)) is not None:
            return self._welcome(request, role, _kept(query), port)
        given = _cookies(request.headers.get_all("Cookie"), f"{_COOKIE}{port}")
        known = (self._browsers.get(_digest(each)) for each in given)
        role = next((each for each in known if each is not None), None)
        if role is None:
            wrong = "" if token is None else "The token is not valid, or was used already. "
            return _refusal(http.HTTPStatus.FORBIDDEN, f"{wrong}{_ASK}")
        if not is_socket and any(name in ("token", *_DIVERTING) for name, _ in query):
            return _refusal(http.HTTPStatus.SEE_OTHER, "", Location=_kept(query))
        return role

    def _is_reached_by(self, host: str) -> bool:
        try:
            url = urlsplit(f"//{host}")
            name = (url.hostname or "").lower()
        except ValueError:
            return False
        if not name or url.netloc != host or "@" in host:
            return False
        if self._public is not None and f"https://{host.lower()}" == self._public:
            return True
        if name in (*_LOOPBACK, self._host.lower(), self.address):
            return True  # at any port, since a tunnel may have another one
        # With TLS, browsers check the name against the certificate.
        return self.tls is not None

    def _origin(self, host: str) -> str:
        """Return the origin of this GUI's pages when browsers reach it by this host name."""
        return self._public or f"{self._scheme}://{host.lower()}"

    def _role_of(self, given: str) -> PageRole | None:
        """Return the role that an unused token gives."""
        for role, token in self._tokens.items():
            # Compare in constant time, so that the time of a response does not reveal how much of
            # a token is right.
            if secrets.compare_digest(_digest(token), _digest(given)):
                return role
        return None

    def _welcome(self, request: Request, role: PageRole, path: str, port: int) -> Response:
        """Return a response that sets a cookie and reopens the page without the token.

        After a link on another site, the browser would not send the strict cookie with a
        redirection; the response is then an HTML page that reloads.
        """
        self._tokens[role] = secrets.token_urlsafe(_TOKEN_BYTES)
        value = secrets.token_urlsafe(_TOKEN_BYTES)
        while len(self._browsers) >= _BROWSERS:
            del self._browsers[next(iter(self._browsers))]
        self._browsers[_digest(value)] = role
        self.announce(role, self.links(port)[role])
        secure = "; Secure" if self._public is not None or self.tls is not None else ""
        cookie = f"{_COOKIE}{port}={value}; Path=/; HttpOnly; SameSite=Strict{secure}"
        if request.headers.get_all("Sec-Fetch-Site") == ["cross-site"]:
            page = f'<!doctype html><meta http-equiv="refresh" content="0;url={path}">'
            return _answer(http.HTTPStatus.OK, page, "text/html", {"Set-Cookie": cookie})
        return _refusal(http.HTTPStatus.SEE_OTHER, "", Location=path, **{"Set-Cookie": cookie})


def _cookies(headers: Iterable[str], wanted: str) -> Iterator[str]:
    for part in ";".join(headers).split(";"):
        name, _, value = part.strip().partition("=")
        if name == wanted:
            yield value


def _digest(secret: str) -> bytes:
    # A cookie may hold non-ASCII bytes, as lone surrogates.
    return hashlib.sha256(secret.encode(errors="surrogateescape")).digest()


def _kept(query: Iterable[tuple[str, str]]) -> str:
    """Return the path of the page with the harmless parameters of a query."""
    rest = urlencode([(k, v) for k, v in query if k not in ("token", *_DIVERTING)])
    return f"/?{rest}" if rest else "/"


def _refusal(status: http.HTTPStatus, text: str, **headers: str) -> Response:
    return _answer(status, f"{text}\n", "text/plain", headers)


def _answer(
    status: http.HTTPStatus, text: str, kind: str, headers: dict[str, str] | None = None
) -> Response:
    body = text.encode()
    fields = {
        "Content-Type": f"{kind}; charset=utf-8",
        "Content-Length": str(len(body)),
        "Connection": "close",
        **HEADERS,
        **(headers or {}),
    }
    return Response(status.value, status.phrase, Headers(fields), body)


def page_of(text: str) -> Response:
    """Return a response with a page of this GUI."""
    return _answer(http.HTTPStatus.OK, text, "text/html")


def only_operators() -> Response:
    """Return the refusal that observers get for commands that move the hand."""
    return _refusal(http.HTTPStatus.FORBIDDEN, "View only. STOP works.")
