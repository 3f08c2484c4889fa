"""The clients of a hand: their identities, presence, roles and rates.

A client declares a liveliness token with an unguessable name, and says hello with that
name. The answer contains a secret, with which the client signs its requests
(`rtee.messages.identity`). When the token vanishes, the client has left; no other client can
declare the same token.
"""

from __future__ import annotations

import re
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from typing import Any, Final, NamedTuple

from rtee.errors import RequestRejected, TooManyRequests, foreign
from rtee.hand.names import check_name
from rtee.messages.identity import LONGEST_CLAIM, SECRET, claim_of, key_of
from rtee.messages.requests import ASK, HERE, PLAIN, Request, Role
from rtee.remote.connections import user_of
from rtee.remote.incoming_request import Check, IncomingRequest, accepted
from rtee.remote.rates import CLIENTS_OF_SHARE, REFUSALS, RESERVED, TOGETHER, Ignored, Rates

_MOST_WAITING = 256
"""Most tokens that wait for their hello, hellos that wait for their token, and clients that may
come back; the oldest are forgotten. Token and hello are milliseconds apart."""

_TOKEN = re.compile(r"[0-9a-f]{32}\Z")


class Admitted(NamedTuple):
    """The role of the clients on an access path, and the required beginning of their names."""

    role: Role
    prefix: str = ""


def _nothing(*_: object) -> None:
    """Do nothing."""


Admit = Callable[[str], Admitted | None]
"""Returns the rights of the clients on an access path (see `HELLO`); ``None``: not admitted."""


_LOCAL: Final = Admitted(Role.MAINTAINER)


def admit_local(access_path: str) -> Admitted | None:
    """Admit clients without a certificate."""
    return _LOCAL if access_path in (HERE, PLAIN) else None


class IdentifiedClient:
    """A client that has said hello.

    Attributes:
        name: The client's unique name.
        access_path: Its access path to the hand, see `HELLO`.
        share: Its access path, and the user on this computer (-1: not known), who share limits.
        secret: The secret with which the client signs its requests.
        key: The same, ready to check signatures.
        token: Name of its liveliness token.
        rates: Limits the client's requests.
        reserved: Its allowance when others on its access path use up all.
    """

    __slots__ = (
        "_newest",
        "access_path",
        "key",
        "name",
        "rates",
        "reserved",
        "role",
        "secret",
        "share",
        "token",
    )

    def __init__(self, name: str, role: Role, access_path: str, token: str, user: int) -> None:
        self.name, self.role, self.access_path, self.token = name, role, access_path, token
        self.share = access_path, user
        self.secret = secrets.token_bytes(SECRET)
        self.key = key_of(self.secret)
        self.rates, self.reserved = Rates(), Rates(times=RESERVED)
        self._newest: dict[str, int] = {}

    def is_new(self, request: str, count: int) -> bool:
        """Return whether a request's number is larger than all before of this kind of request."""
        if count <= self._newest.get(request, 0):
            return False
        self._newest[request] = count
        return True


class Identities:
    """The clients of a hand. Any thread may call its methods.

    ``admit`` returns the rights of the clients on an access path; `present` is called with the name
    and access path of each client that arrives, or comes back.
    """

    def __init__(self, admit: Admit = admit_local) -> None:
        self._admitted = admit
        self.present: Callable[[str, str], object] = _nothing
        self._lock = threading.Lock()
        # One allowance for all: a stranger could change its name and so get a new one.
        self._strangers = Rates()
        self._shares: dict[tuple[str, int], Rates] = {}
        self._there: dict[str, IdentifiedClient] = {}
        self._by_token: dict[str, IdentifiedClient] = {}
        self._gone: OrderedDict[str, IdentifiedClient] = OrderedDict()
        self._tokens: OrderedDict[str, None] = OrderedDict()
        self._greeting: OrderedDict[str, tuple[IdentifiedClient, IncomingRequest]] = OrderedDict()

    def __contains__(self, name: str) -> bool:
        """Return whether a client of this name is present."""
        return name in self._there

    def __len__(self) -> int:
        """Return the number of clients that are present."""
        return len(self._there)

    # --- arrival and departure

    def hello(self, request: IncomingRequest, access_path: str) -> None:
        """Admit a client, now or once its token is seen, and answer with its secret and role.

        Raises `RequestRejected` if the client is not admitted, with the reason.
        """
        name, token = check_name(request.fields["client"], "client"), request.fields["what"]
        admitted = self._admitted(access_path)
        if admitted is None:
            raise RequestRejected(
                f"the certificate '{access_path[:50]}' is not admitted here: it was revoked, or "
                "this hand's people.json is older than it"
            )
        if not name.startswith(admitted.prefix):
            raise RequestRejected(
                f"with this certificate, a client's name must begin with '{admitted.prefix}'"
            )
        # Otherwise a client could pass for one of another person, whose name ends at the dot.
        if "." in name.removeprefix(admitted.prefix):
            raise RequestRejected(
                "a client's name may have a dot only after the person of its certificate"
            )
        if _TOKEN.match(token) is None:
            raise RequestRejected("a token's name must have 32 random hexadecimal digits")
        client = IdentifiedClient(
            name, admitted.role, access_path, token, user_of(token) if access_path == HERE else -1
        )
        with self._lock:
            if name in self._there or token in self._by_token:
                raise RequestRejected(f"a client '{name}' exists already")
            if sum(each.share == client.share for each in self._there.values()) >= CLIENTS_OF_SHARE:
                raise RequestRejected(
                    f"this user or certificate has {CLIENTS_OF_SHARE} clients already"
                )
            if token in self._tokens:
                del self._tokens[token]
                self._admit(client, request)
            else:
                self._greeting[token] = client, request
                _shorten(self._greeting)

    def _admit(self, client: IdentifiedClient, request: IncomingRequest) -> None:
        # A former client of this name must not come back beside the new one.
        self._gone = OrderedDict((k, v) for k, v in self._gone.items() if v.name != client.name)
        self._there[client.name] = self._by_token[client.token] = client
        self.present(client.name, client.access_path)
        request.answer(accepted(f"{client.secret.hex()} {client.role.name.lower()}"))

    def came(self, token: str) -> None:
        """Record that a token was declared."""
        if _TOKEN.match(token) is None:
            return
        with self._lock:
            client, request = self._greeting.pop(token, (None, None))
            if client is not None and request is not None:
                # Another client may have taken the name while this one waited for its token.
                if client.name not in self._there:
                    self._admit(client, request)
            elif (back := self._gone.pop(token, None)) is not None:
                self._there[back.name] = self._by_token[token] = back
                self.present(back.name, back.access_path)
            elif token not in self._by_token:
                self._tokens[token] = None
                _shorten(self._tokens)

    def left(self, token: str) -> str:
        """Record that a token has vanished; return the name of the client that has left, or ""."""
        with self._lock:
            # It may have waited for a hello that never came.
            self._tokens.pop(token, None)
            client = self._by_token.pop(token, None)
            if client is None:
                return ""
            del self._there[client.name]
            # The connection may only be interrupted; then the same token comes back.
            self._gone[token] = client
            _shorten(self._gone)
            return client.name

    # --- the clients of requests

    def check(self, request: Request, attachment: bytes | None, question: bytes) -> str:
        """Return the name of the client that has sent a request.

        Raises `RequestRejected` if the request is not signed or was sent before, or its client
        lacks the role or sends too many, and `Ignored` if there are too many even to refuse them.
        """
        client = self._signed(request, attachment, question)
        if isinstance(client, str):
            self._strangers.refuse(client)
        return self.permit(client, request)

    def signer(
        self, request: Request, attachment: bytes | None, question: bytes
    ) -> IdentifiedClient | None:
        """Return the client that has signed a request; ``None``: no client, or a repeated one."""
        client = self._signed(request, attachment, question)
        return None if isinstance(client, str) else client

    def _signed(
        self, request: Request, attachment: bytes | None, question: bytes
    ) -> IdentifiedClient | str:
        """Return the client that has signed a request, or in a sentence why none has."""
        claim = claim_of(attachment)
        # Cheap checks come first: requests of strangers cost no HMAC.
        if claim is None:
            return (
                f"'{request.name}' needs the attachment '<number> <client> <signature>', in ASCII"
                f" and at most {LONGEST_CLAIM} bytes"
            )
        client = self._there.get(claim.client)
        if client is None:
            return f"there is no client '{foreign(claim.client[:50])}' here; say hello first"
        # Before the number is recorded: otherwise anybody could use up a client's numbers.
        if not claim.signed_by(client.key, request.name, question):
            return (
                f"'{client.name}' has not signed this: a signature is the first 32 hexadecimal"
                f" digits of HMAC-SHA256 of '{request.name} <number> ' and the payload, with the"
                " 32 bytes of the client's secret as the key"
            )
        with self._lock:
            if client.is_new(request.name, claim.count):
                return client
        return f"the number of a '{request.name}' should be larger than those before, from 1 on"

    def admits(self, client: IdentifiedClient) -> bool:
        """Return whether a client's access path is still admitted."""
        return self._admitted(client.access_path) is not None

    def permit(self, client: IdentifiedClient, request: Request) -> str:
        """Return a client's name if it may send a request now; raises the errors of `check`."""
        # Looked up for each request: the certificate may have been revoked since hello.
        rates, admitted = client.rates, self._admitted(client.access_path)
        if admitted is None:
            rates.refuse("the certificate of this client was revoked")
        if text := request.refusal(admitted.role):
            rates.refuse(text)
        name, together, reserved = request.name, self._together(client.share), client.reserved
        if not (rates.allow(name) and (together.allow(name) or reserved.allow(name))):
            rates.refuse(f"too many requests '{name}' in a short time", TooManyRequests)
        if request.group == ASK and not (
            rates.has_bytes() and (together.has_bytes() or reserved.has_bytes())
        ):
            rates.refuse("too many long answers in a short time", TooManyRequests)
        return client.name

    def _together(self, share: tuple[str, int]) -> Rates:
        """Return the limiter shared by one user's clients on an access path.

        A flood on one path, or by one user, does not keep others out.
        """
        rates = self._shares.get(share)
        if rates is None:
            with self._lock:
                rates = self._shares.setdefault(share, Rates(times=TOGETHER))
        return rates

    def charge(self, name: str, size: int) -> None:
        """Count the bytes of an answer to a client's question."""
        if (client := self._there.get(name)) is not None:
            for rates in (client.rates, client.reserved, self._together(client.share)):
                rates.charge(size)

    def welcome(self, access_path: str) -> Check:
        """Return the check of a client that says hello on an access path; its name is empty."""

        def check(request: Request, attachment: bytes | None, question: bytes) -> str:
            known = access_path if self._admitted(access_path) is not None else ""
            if not self._together((known, -1)).allow(request.name):
                raise Ignored
            return ""

        return check

    def answers_junk(self) -> bool:
        """Return whether one more message that is not a request may be answered with the reason."""
        # Such messages are not signed, so they count for all strangers together.
        return self._strangers.allow(REFUSALS)

    def access_path(self, name: str) -> str:
        """Return a client's access path, see `HELLO`."""
        client = self._there.get(name)
        return HERE if client is None else client.access_path

    def of(self, access_paths: Collection[str]) -> list[str]:
        """Return the names of the present clients on some access paths."""
        with self._lock:
            return [
                client.name for client in self._there.values() if client.access_path in access_paths
            ]

    def name(self, request: Request, attachment: bytes | None, question: bytes) -> str:
        """Return the name of the client that has signed a request; empty if none has."""
        client = self.signer(request, attachment, question)
        return "" if client is None else client.name

    def answers_stop_at_once(self, name: str) -> bool:
        """Return whether one more stop of a client is answered at once; it takes effect anyway."""
        client = self._there.get(name)
        return (self._strangers if client is None else client.rates).allow("stop")


def _shorten(waiting: OrderedDict[str, Any]) -> None:
    while len(waiting) > _MOST_WAITING:
        waiting.popitem(last=False)
