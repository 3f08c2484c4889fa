"""The clients of a hand as it knows them: who they are, whether they are there, what they may do.

A client declares a liveliness token with a name that nobody can guess, and says hello with that
name. It gets a secret in answer, and signs its requests with it (`rtee.messages.identity`). When
the token vanishes, the client is gone; no other client can declare the same one.
"""

from __future__ import annotations

import re
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from rtee.errors import RequestRejected, TooManyRequests
from rtee.hand.names import check_name
from rtee.messages.identity import SECRET, claim_of
from rtee.messages.requests import ASK, HERE, PLAIN, Request, Role
from rtee.remote.incoming_request import IncomingRequest, accepted
from rtee.remote.rates import REFUSALS, Ignored, Rates

_MOST_CLIENTS = 64
"""Clients that may come the same way, such as with the same certificate: far more than work."""

_MOST_WAITING = 256
"""Tokens that may wait for their hello, and the reverse, and clients that may come back: the
oldest are forgotten. Token and hello are milliseconds apart."""

_TOKEN = re.compile(r"[0-9a-f]{32}\Z")


class Admitted(NamedTuple):
    """What those may do who come to the hand in a way.

    Attributes:
        role: Their role.
        prefix: What the names of their clients begin with.
    """

    role: Role
    prefix: str = ""


def _nothing(*_: object) -> None:
    """Do nothing."""


Admit = Callable[[str], Admitted | None]
"""Tells what a way to the hand (see `HELLO`) admits to; ``None``: to nothing."""


def admit_local(way: str) -> Admitted | None:
    """Admit those who come without a certificate."""
    return Admitted(Role.MAINTAINER) if way in (HERE, PLAIN) else None


class Client:
    """A client that has said hello.

    Attributes:
        name: Its name, which no other client has.
        role: What it may do.
        way: How it came to the hand, see `HELLO`.
        secret: What it signs its requests with.
        token: Name of its liveliness token.
        rates: How fast it may send requests.
    """

    __slots__ = ("_newest", "name", "rates", "role", "secret", "token", "way")

    def __init__(self, name: str, role: Role, way: str, token: str) -> None:
        self.name, self.role, self.way, self.token = name, role, way, token
        self.secret = secrets.token_bytes(SECRET)
        self.rates = Rates()
        self._newest: dict[str, int] = {}

    def is_new(self, request: str, count: int) -> bool:
        """Return whether a request's number is larger than those before it of its kind."""
        if count <= self._newest.get(request, 0):
            return False
        self._newest[request] = count
        return True


class Identities:
    """The clients of a hand. Any thread may call its methods.

    Args:
        admit: Tells what those who come in some way may do.

    Attributes:
        present: Called with the name of each client that comes, now or again, and its way.
    """

    def __init__(self, admit: Admit = admit_local) -> None:
        self._admitted = admit
        self.present: Callable[[str, str], object] = _nothing
        self._lock = threading.Lock()
        # One allowance for all: a stranger could change its name and so get a new one.
        self._strangers = Rates()
        self._there: dict[str, Client] = {}
        self._by_token: dict[str, Client] = {}
        self._gone: OrderedDict[str, Client] = OrderedDict()
        self._tokens: OrderedDict[str, None] = OrderedDict()
        self._greeting: OrderedDict[str, tuple[Client, IncomingRequest]] = OrderedDict()

    def __contains__(self, name: str) -> bool:
        """Return whether a client of this name is there."""
        return name in self._there

    def __len__(self) -> int:
        """Return the number of clients that are there."""
        return len(self._there)

    # --- who comes and goes

    def hello(self, request: IncomingRequest, way: str) -> None:
        """Admit a client, now or as soon as its token is seen, and answer with its secret and role.

        Raises:
            RequestRejected: if it is not admitted, with the reason.
        """
        name, token = check_name(request.fields["client"], "client"), request.fields["what"]
        admitted = self._admitted(way)
        if admitted is None:
            raise RequestRejected(f"the certificate '{way[:50]}' is not admitted here")
        if not name.startswith(admitted.prefix):
            raise RequestRejected(
                f"the names of clients of this certificate begin '{admitted.prefix}'"
            )
        if _TOKEN.match(token) is None:
            raise RequestRejected("a token's name has 32 hexadecimal digits, chosen at random")
        with self._lock:
            if name in self._there or token in self._by_token:
                raise RequestRejected(f"there is a client '{name}' already")
            if sum(one.way == way for one in self._there.values()) >= _MOST_CLIENTS:
                raise RequestRejected(f"there are {_MOST_CLIENTS} clients of this kind already")
            client = Client(name, admitted.role, way, token)
            if token in self._tokens:
                del self._tokens[token]
                self._admit(client, request)
            else:
                self._greeting[token] = client, request
                _shorten(self._greeting)

    def _admit(self, client: Client, request: IncomingRequest) -> None:
        # One that is gone under this name must not come back beside the new one.
        self._gone = OrderedDict((k, v) for k, v in self._gone.items() if v.name != client.name)
        self._there[client.name] = self._by_token[client.token] = client
        self.present(client.name, client.way)
        request.answer(accepted(f"{client.secret.hex()} {client.role.name.lower()}"))

    def came(self, token: str) -> None:
        """Note that a token was declared."""
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
                self.present(back.name, back.way)
            elif token not in self._by_token:
                self._tokens[token] = None
                _shorten(self._tokens)

    def left(self, token: str) -> str:
        """Note that a token has vanished; return the name of the client that has left, or ""."""
        with self._lock:
            self._tokens.pop(token, None)
            client = self._by_token.pop(token, None)
            if client is None:
                return ""
            del self._there[client.name]
            # Its connection may only have been interrupted; then the same token comes back.
            self._gone[token] = client
            _shorten(self._gone)
            return client.name

    # --- whose request it is

    def check(self, request: Request, attachment: bytes | None, question: bytes) -> str:
        """Return the name of the client that has sent a request.

        Raises:
            RequestRejected: if nobody has signed it, it was sent before, its client may not send
                it, or sends too many.
            Ignored: if there are too many even to be refused.
        """
        client = self.signer(request, attachment, question)
        if client is None:
            self._strangers.refuse("this client is not known here; say hello first")
        return self.permit(client, request)

    def signer(self, request: Request, attachment: bytes | None, question: bytes) -> Client | None:
        """Return the client that has signed a request; ``None`` if none has, or if it is old."""
        claim = claim_of(attachment)
        client = None if claim is None else self._there.get(claim.client)
        # Cheap checks come first: requests of strangers cost no HMAC.
        if claim is None or client is None:
            return None
        # Before the number is noted: otherwise anybody could use up the numbers of a client.
        if not claim.signed_by(client.secret, request.name, question):
            return None
        with self._lock:
            return client if client.is_new(request.name, claim.count) else None

    def admits(self, client: Client) -> bool:
        """Return whether the way in which a client came is still admitted."""
        return self._admitted(client.way) is not None

    def permit(self, client: Client, request: Request) -> str:
        """Return the name of a client if it may send a request now; raises as `check` does."""
        # Looked up for each request: the certificate may have been revoked since hello.
        rates, admitted = client.rates, self._admitted(client.way)
        if admitted is None:
            rates.refuse("the certificate of this client was revoked")
        if admitted.role < request.role:
            rates.refuse(
                f"'{request.name}' needs the role {request.role.name.lower()}; this client has"
                f" the role {admitted.role.name.lower()}"
            )
        if not rates.allow(request.name):
            rates.refuse(f"too many requests '{request.name}' in a short time", TooManyRequests)
        if request.group == ASK and not rates.has_bytes():
            rates.refuse("too many long answers in a short time", TooManyRequests)
        return client.name

    def charge(self, name: str, size: int) -> None:
        """Count the bytes of an answer to a client's question."""
        if (client := self._there.get(name)) is not None:
            client.rates.charge(size)

    def welcome(self, request: Request, attachment: bytes | None, question: bytes) -> str:
        """Return the empty name of somebody who says hello; raises `Ignored` if too many do."""
        if not self._strangers.allow(request.name):
            raise Ignored
        return ""

    def answers_junk(self) -> bool:
        """Return whether one more message that is no request is answered with the reason."""
        # Nobody has signed it, so it counts for all.
        return self._strangers.allow(REFUSALS)

    def way(self, name: str) -> str:
        """Return how the client of a name came to the hand, see `HELLO`."""
        client = self._there.get(name)
        return HERE if client is None else client.way

    def of(self, ways: Collection[str]) -> list[str]:
        """Return the names of the clients that came in some ways."""
        with self._lock:
            return [client.name for client in self._there.values() if client.way in ways]

    def name(self, request: Request, attachment: bytes | None, question: bytes) -> str:
        """Return the name of the client that has sent a request; empty if nobody has signed it."""
        client = self.signer(request, attachment, question)
        return "" if client is None else client.name

    def answers_stop_at_once(self, name: str) -> bool:
        """Return whether one more stop of a client is answered at once; it takes effect at once."""
        client = self._there.get(name)
        return (self._strangers if client is None else client.rates).allow("stop")


def _shorten(waiting: OrderedDict[str, Any]) -> None:
    while len(waiting) > _MOST_WAITING:
        waiting.popitem(last=False)
