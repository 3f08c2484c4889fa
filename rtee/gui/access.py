"""Who may open the GUI: tokens, host names, origins and roles, and what a browser is told.

A browser sends its user's cookies with the requests of any page, and lets any page open a
WebSocket to this computer. So three things are asked of every request, and all must hold:

- its ``Host`` is a name by which this GUI is reached, so that a foreign name that was made to
  point here (DNS rebinding) is refused;
- a WebSocket comes from a page of this GUI, by its ``Origin``;
- it has the token that `rtee gui` printed, first in the address, then in a cookie.
"""

from __future__ import annotations

import http
import ipaddress
import secrets
import socket
import ssl
from collections.abc import Iterable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Final
from urllib.parse import parse_qsl, urlencode, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from rtee.errors import ConfigError
from rtee.hand.files import reason

_TOKEN_BYTES: Final = 24
"""Random bytes of a token [bytes]: 192 bits cannot be guessed."""

_LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")

_DIVERTING: Final = ("websocket", "playbackPath")
"""Parameters by which an address has viser's page show what another server sends."""

_POLICY: Final = "; ".join(
    (
        "default-src 'none'",
        # viser's page unpacks its script from one that is part of it, and that compiles others.
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
"""Headers of every answer: the page is not framed, embedded or stored, and calls nobody else."""

_COOKIE: Final = "rtee_"
"""The port follows, as browsers share cookies among all ports of a host."""

_ASK: Final = "Open the address that `rtee gui` printed, with its token."


class Role(StrEnum):
    """What a person at a page may do."""

    OPERATOR = "operator"
    """Everything."""
    OBSERVER = "observer"
    """Watch and stop."""


def addresses_of(host: str) -> list[str]:
    """Return the addresses of a host, which must be this computer's.

    Raises:
        ConfigError: if there are none, or this computer cannot listen on the first.
    """
    if not host.strip():
        raise ConfigError("--host is empty; give an address of this computer, such as 127.0.0.1")
    if host.replace(".", "").isdigit() and host.count("."):
        try:  # a misspelt address would be looked up as a name, for seconds
            ipaddress.ip_address(host)
        except ValueError:
            raise ConfigError(f"--host {host} is not an IP address") from None
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise ConfigError(f"--host {host}: there is no address of this name") from None
    family, _, _, _, place = found[0]
    try:
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            trial.bind(place)
    except OSError as error:
        raise ConfigError(f"--host {host}: cannot listen there: {reason(error)}") from None
    return [str(place[0]) for _, _, _, _, place in found]


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the TLS settings of a server.

    Args:
        certificate: PEM file of the certificate, and of those between it and its authority.
        key: PEM file of its private key, without a passphrase.

    Raises:
        ConfigError: if they cannot be read, or do not belong together.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    for path in (certificate, key):
        try:
            path.read_bytes()
        except OSError as error:
            raise ConfigError(f"cannot be read: {reason(error)}", path=path) from None
    try:
        # An empty passphrase, as OpenSSL would otherwise ask the terminal for one.
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, ValueError) as error:
        words = getattr(error, "reason", None) or str(error)
        raise ConfigError(
            f"is not the certificate of {key} ({words}); both must be PEM files", path=certificate
        ) from None
    return context


def public_origin(text: str) -> str:
    """Return the origin of a reverse proxy as browsers send it: ``https://hand.example.org``.

    Raises:
        ConfigError: if it is something else.
    """
    try:
        found = urlsplit(text)
        port = found.port
    except ValueError:
        found, port = urlsplit(""), None
    if found.scheme != "https" or not found.hostname or found.path not in ("", "/") or found.query:
        raise ConfigError(
            f"--behind-proxy {text} is not an origin; give the proxy's address as browsers see it, "
            "such as https://hand.example.org"
        )
    name = f"[{found.hostname}]" if ":" in found.hostname else found.hostname
    return f"https://{name}" + (f":{port}" if port not in (None, 443) else "")


class Access:
    """Who may open the GUI, and how it is reached.

    Attributes:
        address: The address on which it listens.
        tls: Its TLS settings, if it encrypts by itself.
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

        Args:
            host: Address or name of this computer to listen on.
            tls: TLS settings; needed beyond loopback, unless a proxy encrypts.
            behind: Origin of the reverse proxy by which browsers reach the GUI.
            observers: Whether there is a token for observers, too.

        Raises:
            ConfigError: if the host is none, or would be reached without encryption.
        """
        found = addresses_of(host)
        numbers = [ipaddress.ip_address(each.partition("%")[0]) for each in found]
        local = all(number.is_loopback for number in numbers)
        if not local and tls is None and behind is None:
            raise ConfigError(
                f"--host {host} opens the GUI to a network; encrypt it with --tls-cert and "
                "--tls-key, or let a proxy do so and give --behind-proxy https://ITS-NAME"
            )
        self.address = found[0]
        self.tls = tls
        self._host = host
        self._public = None if behind is None else public_origin(behind)
        self._any = any(number.is_unspecified for number in numbers)
        self._tokens = {secrets.token_urlsafe(_TOKEN_BYTES): Role.OPERATOR}
        if observers:
            self._tokens[secrets.token_urlsafe(_TOKEN_BYTES)] = Role.OBSERVER

    @property
    def behind_proxy(self) -> bool:
        """Whether browsers reach it through a proxy."""
        return self._public is not None

    # --- what is printed

    def links(self, port: int) -> dict[Role, str]:
        """Return the addresses to open, with their tokens, by role."""
        if self._public is not None:
            base = self._public
        else:
            host = socket.gethostname() if self._any else self._host
            name = f"[{host}]" if ":" in host else host
            base = f"{self._scheme}://{name}:{port}"
        return {role: f"{base}/?{urlencode({'token': t})}" for t, role in self._tokens.items()}

    @property
    def _scheme(self) -> str:
        return "http" if self.tls is None else "https"

    # --- what is asked of a request

    def judge(self, request: Request, port: int) -> Role | Response:
        """Judge a request.

        Args:
            request: From a browser, or whatever else connects.
            port: The port on which it came.

        Returns:
            The role of the person, or what is answered instead of the page.
        """
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._is_reached_by(hosts[0]):
            return _refusal(
                http.HTTPStatus.MISDIRECTED_REQUEST, "This GUI is not known by this name."
            )
        is_socket = bool(request.headers.get_all("Upgrade"))
        if is_socket and request.headers.get_all("Origin") != [self._origin(hosts[0])]:
            return _refusal(http.HTTPStatus.FORBIDDEN, "Only pages of this GUI may connect.")
        # Not `urlsplit`, which takes the path "//[" for a host, and a broken one.
        query = parse_qsl(request.path.partition("?")[2], keep_blank_values=True)
        if not is_socket and (given := dict(query).get("token")) is not None:
            if self._role(given) is None:
                return _refusal(http.HTTPStatus.FORBIDDEN, f"The token is not valid. {_ASK}")
            return self._welcome(request, given, _kept(query), port)
        role = self._role(*_cookies(request.headers.get_all("Cookie")))
        if role is None:
            return _refusal(http.HTTPStatus.FORBIDDEN, _ASK)
        if not is_socket and any(name in _DIVERTING for name, _ in query):
            return _refusal(http.HTTPStatus.SEE_OTHER, "", Location=_kept(query))
        return role

    def _is_reached_by(self, host: str) -> bool:
        try:
            found = urlsplit(f"//{host}")
            name = (found.hostname or "").lower()
        except ValueError:
            return False
        if not name or found.netloc != host or "@" in host:
            return False
        if self._public is not None and f"https://{host.lower()}" == self._public:
            return True
        if name in (*_LOOPBACK, self._host.lower(), self.address):
            return True  # at any port: that of a tunnel may be another one
        # With TLS the certificate decides by which names browsers believe to have reached it.
        return self.tls is not None

    def _origin(self, host: str) -> str:
        """Return the origin of this GUI's pages when it is reached by a host."""
        return self._public or f"{self._scheme}://{host.lower()}"

    def _role(self, *given: str) -> Role | None:
        for token, role in self._tokens.items():
            # In constant time, so that answers do not tell how much of a token is right. Encoded,
            # since a cookie may hold more than ASCII, which compare_digest refuses as text; such
            # bytes come as lone surrogates.
            sent = (each.encode(errors="surrogateescape") for each in given)
            if any(secrets.compare_digest(token.encode(), each) for each in sent):
                return role
        return None

    def _welcome(self, request: Request, token: str, path: str, port: int) -> Response:
        """Have the browser keep the token, and open the page without it in the address."""
        secure = "; Secure" if self._public is not None or self.tls is not None else ""
        cookie = f"{_COOKIE}{port}={token}; Path=/; HttpOnly; SameSite=Strict{secure}"
        if request.headers.get_all("Sec-Fetch-Site") == ["cross-site"]:
            # After a link elsewhere, as in a chat, the cookie is sent only by pages of this GUI.
            page = f'<!doctype html><meta http-equiv="refresh" content="0;url={path}">'
            return _answer(http.HTTPStatus.OK, page, "text/html", {"Set-Cookie": cookie})
        return _refusal(http.HTTPStatus.SEE_OTHER, "", Location=path, **{"Set-Cookie": cookie})


def _cookies(headers: Iterable[str]) -> Iterator[str]:
    for part in ";".join(headers).split(";"):
        name, _, value = part.strip().partition("=")
        if name.startswith(_COOKIE):
            yield value


def _kept(query: Iterable[tuple[str, str]]) -> str:
    """Return the path of the page with what is harmless of a query."""
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
