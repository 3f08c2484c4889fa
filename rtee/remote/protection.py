"""How a hand protects its endpoints: certificates and access control, or a refusal to listen."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Protocol

from rtee.errors import ConfigError
from rtee.hand.config_schema import SecuritySettings
from rtee.messages.requests import HERE, PLAIN, Role
from rtee.remote.access import access_control
from rtee.remote.credentials import Credentials, person, secure_folder
from rtee.remote.identities import Admitted, admit_local
from rtee.remote.session import TLS, is_safe

log = logging.getLogger(__name__)

_LOOK_EVERY = 1.0
"""Time between two looks at the list of who is admitted [s]: so soon does a change take effect."""

Changed = Callable[[Collection[str], Collection[str]], object]
"""Called with the common names of the certificates that are admitted now, and of those that are no
longer."""


class Endpoints(Protocol):
    """The network settings of a hand that matter here."""

    @property
    def listen(self) -> Sequence[str]:
        """Zenoh endpoints to listen on."""

    @property
    def connect(self) -> Sequence[str]:
        """Zenoh endpoints to connect to."""

    @property
    def security(self) -> SecuritySettings:
        """Who may use the hand on a network."""


def credentials_of(hand: str, endpoints: Endpoints) -> Credentials | None:
    """Return the certificates of a hand, not yet read; ``None`` if its endpoints need none."""
    if not any(endpoint.startswith(TLS) for endpoint in endpoints.listen):
        return None
    return Credentials(endpoints.security.folder or secure_folder(hand))


def exposed(endpoints: Endpoints) -> list[str]:
    """Return the endpoints through which whoever reaches them can move the hand.

    Raises:
        ConfigError: if there are some and hand.yaml does not allow it.
    """
    everywhere = [*endpoints.listen, *endpoints.connect]
    found = [endpoint for endpoint in everywhere if not is_safe(endpoint)]
    # A router that the hand connects to passes on the messages of whoever reaches it.
    found += [each for each in endpoints.connect if each.startswith(TLS)]
    if found and not endpoints.security.insecure:
        raise ConfigError(
            f"whoever reaches {', '.join(found)} could move the hand: listen on"
            " tls/HOST:PORT with certificates ('rtee secure init'), or allow it with"
            " 'insecure: true'",
            key="remote.security",
        )
    return found


class Protection:
    """Who may do what with a hand, by how they come to it.

    Args:
        hand: The hand's name.
        endpoints: Its network settings.

    Attributes:
        settings: Zenoh's settings.

    Raises:
        ConfigError: if an endpoint would let everybody in and hand.yaml does not say so, or there
            are no certificates.
    """

    def __init__(self, hand: str, endpoints: Endpoints) -> None:
        everybody = exposed(endpoints)
        if everybody:
            log.warning(
                "%s: whoever reaches %s can move the hand (remote.security.insecure)",
                hand,
                ", ".join(everybody),
            )
        plain = [each for each in endpoints.listen if not each.startswith(TLS)]
        # What comes through a router carries no certificate of the client behind it.
        self._plain = bool(plain or endpoints.connect)
        self.settings: dict[str, Any] = {}
        self._hand = hand
        self._credentials = credentials_of(hand, endpoints)
        self._known: dict[str, Role] = {}
        self._admitted: dict[str, Admitted] = {}
        if self._credentials is not None:
            self.settings |= self._credentials.settings()
            self._look_up(self._credentials)
            admitted = {name: one.role for name, one in self._admitted.items()}
            # Zenoh reads its rules once: they must name certificates that are made later, too.
            self._known = {**self._credentials.spare, **admitted}
        self.settings["access_control"] = access_control(hand, self._known, plain=self._plain)

    @property
    def people(self) -> Collection[str]:
        """Common names of the certificates that are admitted."""
        return self._admitted.keys()

    def admit(self, way: str) -> Admitted | None:
        """Return what those may do who come in a way; ``None`` if they are not admitted."""
        if way == HERE or (way == PLAIN and self._plain):
            return admit_local(way)
        return self._admitted.get(way)

    @contextlib.contextmanager
    def watched(self, changed: Changed) -> Iterator[None]:
        """Follow the list of who is admitted, in a thread, for as long as the context lasts.

        Args:
            changed: Called in that thread when the list has changed.
        """
        credentials = self._credentials
        if credentials is None:
            yield
            return
        ended = threading.Event()

        def watch() -> None:
            while not ended.wait(_LOOK_EVERY):
                before = self._admitted
                if self._read_again(credentials):
                    self._look_up(credentials)
                    changed(self._admitted.keys(), before.keys() - self._admitted.keys())

        thread = threading.Thread(target=watch, name=f"admit {self._hand}", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _read_again(self, credentials: Credentials) -> bool:
        """Read the list if it has changed, and return whether it has.

        Nobody is admitted while it cannot be read.
        """
        try:
            return credentials.read()
        except ConfigError as error:
            # Nobody is admitted as it is: reported once, not every second.
            if not credentials.people:
                return False
            log.error("%s: nobody is admitted from the network: %s", self._hand, error)
            credentials.forget()
            return True

    def _look_up(self, credentials: Credentials) -> None:
        admitted = credentials.admitted
        for name in admitted.keys() - self._known.keys() - self._admitted.keys():
            # Empty at the start, when all who are listed become known.
            if self._known:
                log.warning(
                    "%s: %s is admitted from the next start on: no spare name was left for it",
                    self._hand,
                    admitted[name].name,
                )
        self._admitted = {
            name: Admitted(one.role, f"{person(one.name)}-") for name, one in admitted.items()
        }
