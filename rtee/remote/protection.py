"""How a hand protects its endpoints: certificates and access control, or a refusal to listen."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Protocol

from rtee.errors import ConfigError
from rtee.hand.config_schema import SecuritySettings
from rtee.messages.requests import HERE, PLAIN, Role
from rtee.remote.access import access_control
from rtee.remote.credentials import Credentials, secure_folder
from rtee.remote.session import TLS, is_safe

log = logging.getLogger(__name__)


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
        security = endpoints.security
        everywhere = [*endpoints.listen, *endpoints.connect]
        exposed = [endpoint for endpoint in everywhere if not is_safe(endpoint)]
        # A router that the hand connects to passes on the messages of whoever reaches it.
        exposed += [each for each in endpoints.connect if each.startswith(TLS)]
        if exposed and not security.insecure:
            raise ConfigError(
                f"whoever reaches {', '.join(exposed)} could move the hand: listen on"
                " tls/HOST:PORT with certificates ('rtee secure init'), or allow it with"
                " 'insecure: true'",
                key="remote.security",
            )
        if exposed:
            log.warning(
                "%s: whoever reaches %s can move the hand (remote.security.insecure)",
                hand,
                ", ".join(exposed),
            )
        self._plain = any(not each.startswith(TLS) for each in everywhere) or bool(exposed)
        self.settings: dict[str, Any] = {}
        people: dict[str, Role] = {}
        self._credentials = credentials_of(hand, endpoints)
        if self._credentials is not None:
            self.settings |= self._credentials.settings()
            people = dict(self._credentials.admitted)
        self.settings["access_control"] = access_control(hand, people, plain=self._plain)

    def role_of(self, way: str) -> Role | None:
        """Return what those who come in a way may do; ``None`` if they are not admitted."""
        if way == HERE or (way == PLAIN and self._plain):
            return Role.MAINTAINER
        return self._credentials.role_of(way) if self._credentials is not None else None
