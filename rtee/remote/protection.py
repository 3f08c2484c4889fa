"""Protection of a hand's endpoints: certificates and access control, or a refusal to listen."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

from rtee.errors import ConfigError
from rtee.hand.config_schema import RemoteSettings
from rtee.messages.requests import HERE, PLAIN, Role
from rtee.remote.access import access_control, gate_access_control
from rtee.remote.credentials import Credentials, person, router_link, secure_folder
from rtee.remote.identities import Admitted, admit_local
from rtee.remote.session import TLS, is_safe

log = logging.getLogger(__name__)

_LOOK_EVERY = 1.0
"""Interval of the checks of the list of people [s]: a revocation takes effect within a second."""

Changed = Callable[[Collection[str], Collection[str]], object]
"""Called with the common names of the certificates that are admitted now, and of those that no
longer are."""


def credentials_of(hand: str, endpoints: RemoteSettings) -> Credentials | None:
    """Return the certificates of a hand, not yet read; ``None`` if its endpoints need none."""
    everywhere = [*endpoints.listen, *endpoints.connect]
    if not any(endpoint.startswith(TLS) for endpoint in everywhere):
        return None
    return Credentials(endpoints.security.folder or secure_folder(hand))


def exposed(endpoints: RemoteSettings) -> list[str]:
    """Return the endpoints without access control.

    Raises `ConfigError` if there are any and hand.yaml does not allow it.
    """
    everywhere = [*endpoints.listen, *endpoints.connect]
    unsafe = [endpoint for endpoint in everywhere if not is_safe(endpoint)]
    if unsafe and not endpoints.security.insecure:
        raise ConfigError(
            f"anyone who reaches {', '.join(unsafe)} could move the hand; listen on"
            " tls/HOST:PORT with certificates ('rtee secure init'), or allow it with"
            " 'insecure: true'",
            key="remote.security",
        )
    return unsafe


class Protection:
    """The rights of a hand's clients, by their access path, and Zenoh's settings.

    Attributes:
        settings: Zenoh's settings for the hand.
        link: Those of them with which it connects to a router.
        certificates: Files with ``authority``, ``certificate`` and ``key`` for its door or its link
            to a router, if it uses TLS.

    Raises `ConfigError` if an endpoint admits everybody and hand.yaml does not allow it, or there
    are no certificates.
    """

    def __init__(self, hand: str, endpoints: RemoteSettings) -> None:
        unsafe = exposed(endpoints)
        if unsafe:
            log.warning(
                "%s: anyone who reaches %s can move the hand (remote.security.insecure)",
                hand,
                ", ".join(unsafe),
            )
        everywhere = [*endpoints.listen, *endpoints.connect]
        self._plain = any(not each.startswith(TLS) for each in everywhere)
        routed = any(each.startswith(TLS) for each in endpoints.connect)
        if routed and any(each.startswith(TLS) for each in endpoints.listen):
            raise ConfigError(
                "a hand listens on tls/… or connects to a router by tls/…, not both:"
                " they need different certificates",
                key="remote",
            )
        self._hand = hand
        self._credentials = credentials_of(hand, endpoints)
        self.certificates: Mapping[str, str] = {}
        self._known: dict[str, Role] = {}
        self._admitted: dict[str, Admitted] = {}
        if self._credentials is not None:
            self.certificates = self._credentials.files()
            self._look_up(self._credentials)
            admitted = {name: rights.role for name, rights in self._admitted.items()}
            # Zenoh reads its rules once, so they must include the names of later certificates.
            self._known = {**self._credentials.spare, **admitted}
        access = access_control(hand, self._known, plain=self._plain, routed=routed)
        self.settings: dict[str, Any] = {"access_control": access}
        self.link = router_link(self.certificates) if routed else {}
        self.settings |= self.link

    def rules(self, zid: str) -> dict[str, Any]:
        """Return Zenoh's rules for the gateways of the hand's door, by common name.

        ``zid`` identifies the hand's session of Zenoh.
        """
        return {
            name: gate_access_control(self._hand, zid, name, role)
            for name, role in self._known.items()
        }

    @property
    def people(self) -> Collection[str]:
        """Common names of the certificates that are admitted."""
        return self._admitted.keys()

    def admit(self, access_path: str) -> Admitted | None:
        """Return the rights of the clients on an access path; ``None`` if they are not admitted."""
        if access_path == HERE or (access_path == PLAIN and self._plain):
            return admit_local(access_path)
        return self._admitted.get(access_path)

    @contextlib.contextmanager
    def watched(self, changed: Changed) -> Iterator[None]:
        """Follow the list of people in a thread, which calls a function when the list has changed.

        Ends with the context.
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

        Nobody is admitted while the list cannot be read.
        """
        try:
            return credentials.read()
        except ConfigError as error:
            # Nobody was admitted before either: this is reported once, not every second.
            if not credentials.people:
                return False
            log.error("%s: nobody is admitted from the network: %s", self._hand, error)
            credentials.forget()
            return True

    def _look_up(self, credentials: Credentials) -> None:
        admitted = credentials.admitted
        for name in admitted.keys() - self._known.keys() - self._admitted.keys():
            # Empty at the start, when all listed names become known.
            if self._known:
                log.warning(
                    "%s: %s is admitted from the next start: no spare name was left for it",
                    self._hand,
                    admitted[name].name,
                )
        self._admitted = {
            name: Admitted(entry.role, f"{person(entry.name)}.") for name, entry in admitted.items()
        }
