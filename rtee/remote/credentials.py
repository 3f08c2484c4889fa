"""The certificates of a hand and its clients on a network, which `rtee secure` makes.

A hand has its own authority, which signs the certificates of the hand and of the people who may use
it. Each certificate has a random common name, so that a lost one can be revoked alone. The list of
admitted people is kept beside the hand's certificate. It contains spare names, too: Zenoh must know
the common names of later certificates when a hand starts.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rtee.errors import ConfigError
from rtee.hand.files import is_trusted, reason
from rtee.hand.names import check_name
from rtee.messages.requests import Role

FOLDER_VARIABLE = "RTEE_SECURE_DIR"
"""Environment variable with another folder of hands' certificates."""

IDENTITY_VARIABLE = "RTEE_IDENTITY"
"""Environment variable with the file of a client's certificate."""

PEOPLE = "people.json"
"""File with the list of admitted people."""

AUTHORITY, AUTHORITY_KEY = "authority.crt", "authority.key"
HAND, HAND_KEY = "hand.crt", "hand.key"

_TLS = "transport/link/tls/"
"""Beginning of Zenoh's settings of TLS."""

_FILES = (PEOPLE, AUTHORITY, AUTHORITY_KEY, HAND, HAND_KEY)

_LONGEST = 65536
"""Most bytes that are read of a client's file [bytes]: a valid one has two thousand."""

_PARTS = ("key", "certificate", "authority")
"""The PEM blocks of a client's file, in this order."""

_BLOCK = re.compile(r"-----BEGIN ([A-Z ]+)-----\n.*?-----END \1-----\n", re.DOTALL)
_NAME = re.compile(r"^rtee client: ([A-Za-z0-9_\-]+\.[0-9a-f]+)$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Person:
    """A person's certificate, maybe revoked, and its expiry [s since 1970].

    The name is the person's, a dot, and the common name in the certificate.
    """

    name: str
    role: Role
    until: float
    revoked: bool = False


def person(name: str) -> str:
    """Return the person's name from the name of a certificate."""
    return name.rpartition(".")[0]


def common_name(name: str) -> str:
    """Return the random common name from the name of a certificate."""
    return name.rpartition(".")[2]


def config_folder() -> Path:
    """Return the user's folder for rtee's settings."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path.home() / ".config") / "rtee"


def made_by(folder: Path) -> str:
    """Return the words for the command that makes a file in a hand's folder of certificates."""
    return f"'rtee secure init {folder.name}' makes it"


def secure_folder(hand: str) -> Path:
    """Return the folder with a hand's certificates.

    It is a folder of the hand's name in ``RTEE_SECURE_DIR``, otherwise in ``secure`` in the user's
    folder for rtee's settings.
    """
    given = os.environ.get(FOLDER_VARIABLE)
    folder = Path(given) if given else config_folder() / "secure"
    return folder / check_name(hand, "hand")


@dataclass
class Credentials:
    """A hand's certificates and its list of people, including those with a revoked certificate.

    Attributes:
        until: Expiry of the hand's certificate [s since 1970].
        spare: Roles by common name of the next certificates to be made, in this order.
        hands: Hands by common name of their certificates, for the list of a router.
    """

    folder: Path
    people: tuple[Person, ...] = ()
    until: float = 0.0
    spare: Mapping[str, Role] = field(default_factory=dict)
    hands: Mapping[str, str] = field(default_factory=dict)
    _stamp: tuple[int, int] = field(default=(-1, -1), repr=False)

    def read(self) -> bool:
        """Read the list of people if it has changed; return whether it has.

        Raises `ConfigError` if it cannot be read.
        """
        path = self.folder / PEOPLE
        try:
            self._check_owner()
            status = path.stat()
            # With the inode, since a new list may have the same time.
            stamp = (status.st_mtime_ns, status.st_ino)
            if stamp == self._stamp:
                return False
            # The stamp is older than the text: a list replaced in between is read again.
            self.people, self.until, self.spare, self.hands = _people(path)
            self._stamp = stamp
            return True
        except OSError as error:
            raise ConfigError(
                f"cannot be read: {reason(error)}; {made_by(self.folder)}", path=path
            ) from None

    def _check_owner(self) -> None:
        """Raise `ConfigError` if another user could have made the folder or its files.

        Root may have made them for a service. The folder around this one matters, too: who can
        write there puts another folder in its place.
        """
        for place in (self.folder.parent, self.folder, *map(self.folder.joinpath, _FILES)):
            with contextlib.suppress(FileNotFoundError):
                status = place.lstat()
                # As in /tmp, users can only rename their own files there.
                sticky = place == self.folder.parent and status.st_mode & stat.S_ISVTX
                if not (sticky or is_trusted(status, os.getuid(), 0)):
                    raise ConfigError(
                        "must belong to you or root, and only the owner may write to it; remove "
                        "it, or"
                        f" type: chmod go-w {place}",
                        path=place,
                    )

    @property
    def hidden(self) -> bool:
        """Whether this user may not read the list of people."""
        try:
            with (self.folder / PEOPLE).open("rb"):
                return False
        except PermissionError:
            return True
        except OSError:
            return False

    def forget(self) -> None:
        """Admit no client until the list can be read."""
        # Without the stamp, the list counts as changed as soon as it can be read again.
        self.people, self._stamp = (), (-1, -1)

    @property
    def admitted(self) -> Mapping[str, Person]:
        """The admitted people, by the common names in their certificates."""
        return {common_name(entry.name): entry for entry in self.people if not entry.revoked}

    def files(self) -> dict[str, str]:
        """Return the files to listen with: ``authority``, ``certificate`` and ``key``.

        Raises `ConfigError` if a file is missing, or others can read the key.
        """
        self.read()
        for name in (AUTHORITY, HAND, HAND_KEY):
            if not (self.folder / name).is_file():
                raise ConfigError(f"is missing; {made_by(self.folder)}", path=self.folder / name)
        check_private(self.folder / HAND_KEY)
        return {
            "authority": str(self.folder / AUTHORITY),
            "certificate": str(self.folder / HAND),
            "key": str(self.folder / HAND_KEY),
        }


def _people(
    path: Path,
) -> tuple[tuple[Person, ...], float, Mapping[str, Role], Mapping[str, str]]:
    try:
        document = json.loads(path.read_text("utf-8"))
        people = tuple(
            Person(
                str(entry["name"]),
                Role[str(entry["role"]).upper()],
                float(entry["until"]),
                bool(entry["revoked"]),
            )
            for entry in document["people"]
        )
        spare = {str(k): Role[str(v).upper()] for k, v in document["spare"].items()}
        hands = {
            str(name): check_name(str(hand), "hand") for name, hand in document["hands"].items()
        }
        return people, float(document["until"]), spare, hands
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"is not a list of people: {error!r}", path=path) from None


def check_private(path: Path) -> None:
    """Raise `ConfigError` unless a file with a key is readable by its owner alone."""
    if path.stat().st_mode & 0o077:
        raise ConfigError(
            "contains a key that others can read; type: chmod 600 " + str(path), path=path
        )


def _tls(certificates: Mapping[str, str], side: str, form: str = "") -> dict[str, Any]:
    """Return Zenoh's settings to ``connect`` or ``listen`` with certificates: files, or a form."""
    return {
        f"{_TLS}root_ca_certificate{form}": certificates["authority"],
        f"{_TLS}{side}_private_key{form}": certificates["key"],
        f"{_TLS}{side}_certificate{form}": certificates["certificate"],
        f"{_TLS}enable_mtls": True,
        # The hand's own authority has made a single server certificate, which is valid at any
        # address of the hand or the router.
        f"{_TLS}verify_name_on_connect": False,
    }


def router_link(certificates: Mapping[str, str]) -> dict[str, Any]:
    """Return Zenoh's settings for connecting to a router with the files of `Credentials.files`."""
    return _tls(certificates, "connect")


def router_certificates(certificates: Mapping[str, str]) -> dict[str, Any]:
    """Return Zenoh's settings for a router with the files of `Credentials.files`."""
    return _tls(certificates, "listen") | {f"{_TLS}close_link_on_expiration": True}


@dataclass(frozen=True, slots=True)
class Identity:
    """A client's certificate: its name, see `Person`, and the PEM blocks of its file.

    These are ``key``, ``certificate`` and ``authority``.
    """

    name: str
    blocks: Mapping[str, str]

    def settings(self) -> dict[str, Any]:
        """Return Zenoh's settings for connecting with this certificate."""
        inline = {name: b64encode(pem.encode()).decode() for name, pem in self.blocks.items()}
        return _tls(inline, "connect", "_base64")


def identity() -> Identity:
    """Return this user's certificate: the file in ``RTEE_IDENTITY``, otherwise ``identity.pem``.

    Raises `ConfigError` if there is none, it cannot be used, or others can read it.
    """
    given = os.environ.get(IDENTITY_VARIABLE)
    path = Path(given) if given else config_folder() / "identity.pem"
    try:
        with path.open(encoding="ascii") as file:
            text = file.read(_LONGEST)
        check_private(path)
    # A file in another format than PEM, such as DER, is not ASCII.
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"cannot be read: {reason(error)}; TLS needs the file that 'rtee secure add-client' has"
            f" made, here or in {IDENTITY_VARIABLE}",
            path=path,
        ) from None
    name = _NAME.search(text)
    blocks = [match[0] for match in _BLOCK.finditer(text)]
    if name is None or len(blocks) != len(_PARTS):
        raise ConfigError("is not a file that 'rtee secure add-client' has made", path=path)
    return Identity(name[1], dict(zip(_PARTS, blocks, strict=True)))


def identity_text(name: str, key: str, certificate: str, authority: str) -> str:
    """Return the text of a client's file."""
    return f"rtee client: {name}\n\n{key}{certificate}{authority}"
