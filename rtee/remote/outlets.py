"""The topics that a hand publishes: once for this computer, and once for each certificate.

Zenoh reads its access rules only when a session is opened. Each certificate therefore has keys of
its own, which nobody else may subscribe to, and the hand stops publishing on them as soon as the
certificate is revoked.
"""

from __future__ import annotations

import threading
from collections.abc import Collection
from typing import Any

import zenoh

from rtee.messages import network_key
from rtee.messages.requests import HERE, topic_for
from rtee.remote.session import direct


class Outlet:
    """One topic; made by `Outlets.open`. Any thread may call its methods."""

    def __init__(
        self, session: zenoh.Session, hand: str, topic: str, watched: bool, options: dict[str, Any]
    ) -> None:
        self.topic = topic
        self._session, self._hand = session, hand
        self._watched, self._options = watched, options
        self._changing = threading.Lock()
        # Replaced rather than changed, because the loop's thread reads it.
        self._keys: dict[str, _Key] = {}

    @property
    def wanted(self) -> bool:
        """Whether the topic has subscribers; true if its subscribers are not watched."""
        return any(key.wanted for key in self._keys.values())

    def put(self, data: bytes) -> None:
        """Publish a message."""
        # Locked while publishing, so that no publisher is undeclared while it is in use.
        with self._changing:
            for key in self._keys.values():
                if key.wanted:
                    key.publisher.put(data)

    def admit(self, paths: Collection[str]) -> None:
        """Publish to the clients on some access paths, and to no others."""
        with self._changing:
            before = self._keys
            self._keys = {path: before.get(path) or self._key(path) for path in paths}
        for path, key in before.items():
            if path not in self._keys:
                key.close()

    def _key(self, path: str) -> _Key:
        name = network_key(self._hand, topic_for(path, self.topic))
        return _Key(self._session.declare_publisher(name, **self._options), self._watched)

    def close(self) -> None:
        """Stop publishing."""
        self.admit(())


class _Key:
    """One key of a topic; wanted if it has subscribers, or they are not watched."""

    def __init__(self, publisher: zenoh.Publisher, watched: bool) -> None:
        self.publisher, self.wanted = publisher, not watched
        self._listener = publisher.declare_matching_listener(direct(self._on)) if watched else None

    def _on(self, status: zenoh.MatchingStatus) -> None:
        self.wanted = status.matching

    def close(self) -> None:
        if self._listener is not None:
            self._listener.undeclare()  # type: ignore[no-untyped-call]
        self.publisher.undeclare()  # type: ignore[no-untyped-call]


class Outlets:
    """The topics of a hand, for people by the common names of their certificates."""

    def __init__(self, session: zenoh.Session, hand: str, people: Collection[str] = ()) -> None:
        self.hand = hand
        self._session = session
        self._changing = threading.Lock()
        self._ways = (HERE, *people)
        self._open: list[Outlet] = []

    def open(self, topic: str, *, watched: bool = False, **options: Any) -> Outlet:
        """Return a new topic, with options of Zenoh's publishers.

        If watched, it is published only on keys that have subscribers. That saves time for frequent
        messages, but a subscriber may miss those of its first milliseconds.
        """
        outlet = Outlet(self._session, self.hand, topic, watched, options)
        with self._changing:
            outlet.admit(self._ways)
            self._open.append(outlet)
        return outlet

    def close(self, outlet: Outlet) -> None:
        """Stop publishing a topic."""
        with self._changing:
            self._open.remove(outlet)
        outlet.close()

    def admit(self, people: Collection[str]) -> None:
        """Publish to clients with some certificates, and no longer to those with others."""
        with self._changing:
            self._ways = (HERE, *people)
            for outlet in self._open:
                outlet.admit(self._ways)
