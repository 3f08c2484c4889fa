"""Agents: clients that a language model steers. A stop locks them out; a person admits them."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Final

from rtee.errors import RequestRejected, foreign
from rtee.hand.files import NO_LINKS, reason

log = logging.getLogger(__name__)

AGENT: Final = "rtee-mcp"
"""Name of the client of `rtee mcp`, by which the hand knows that an agent is behind it."""

_SUFFIX: Final = ".agents-out"
"""Suffix of the file that locks agents out; the stem is that of the hand's file."""

_LONGEST: Final = 200
"""Longest reason that is kept [characters]: names of clients are shorter than 100."""


def is_agent(client: str) -> bool:
    """Return whether a client is an agent, by its name."""
    # A certificate's person precedes a dot, which clients' own names do not contain.
    return client.rpartition(".")[2].startswith(f"{AGENT}-")


class Agents:
    """Decides whether agents may move a hand; any thread may use it.

    The reason for locking them out is kept in a file beside the hand's own, so that it outlives
    the hand.

    Args:
        place: The hand's file in the runtime folder; its folder can be trusted.
    """

    def __init__(self, place: Path) -> None:
        self._file = place.with_suffix(_SUFFIX)
        self._out = self._read()
        self._kept = self._out
        self._met = False

    def meet(self, client: str) -> None:
        """Record a client: `status_text` is empty until an agent has connected."""
        self._met |= is_agent(client)

    @property
    def status_text(self) -> str:
        """The text in the status: `out` if an agent has connected since the hand started."""
        return self._out if self._met else ""

    @property
    def out(self) -> str:
        """Reason why agents may not move the hand, in words; empty if they may."""
        return self._out

    def shut_out(self, why: str) -> None:
        """Lock agents out at once, without waiting for a disk; call `keep` afterwards."""
        self._out = foreign(why)[:_LONGEST] or "stopped"

    def keep(self) -> None:
        """Write the reason for the exclusion of agents to the file, if there is none yet."""
        out = self._out
        if not out or self._kept:
            return
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | NO_LINKS
            descriptor = os.open(self._file, flags, 0o600)
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(out)
        except OSError as error:
            log.warning(
                "%s: agents are locked out, but only while this hand runs: %s", self._file, error
            )
        else:
            self._kept = out

    def admit(self, client: str) -> None:
        """Let agents move the hand again.

        Raises:
            RequestRejected: if the client is an agent, or the file cannot be removed.
        """
        if is_agent(client):
            raise RequestRejected(
                "an agent cannot admit itself; a person must type 'rtee agent admit'"
            )
        try:
            self._file.unlink(missing_ok=True)
        except OSError as error:
            raise RequestRejected(f"{self._file} cannot be removed: {reason(error)}") from None
        self._out = self._kept = ""

    def check(self, client: str) -> None:
        """Raise `RequestRejected` if the client is an agent and agents are not admitted."""
        if self._out and is_agent(client):
            raise RequestRejected(
                f"agents may not move the hand since it was {self._out}; a person admits them with "
                "'rtee agent admit'"
            )

    def _read(self) -> str:
        try:
            descriptor = os.open(self._file, os.O_RDONLY | NO_LINKS)
        except FileNotFoundError:
            return ""
        except OSError:  # any content means that they are locked out
            return "stopped"
        with os.fdopen(descriptor, "rb") as file:
            text = file.read(_LONGEST).decode("utf-8", "replace")
        return foreign(text) or "stopped"
