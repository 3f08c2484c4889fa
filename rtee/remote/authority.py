"""A hand's own certificate authority, which makes the certificates of the hand and its clients.

All keys are on the curve P-256, in PEM (PKCS #8), in files that only their owner can read.
"""

from __future__ import annotations

import datetime
import json
import re
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rtee.errors import ConfigError
from rtee.hand.files import cleared_on_failure, failing, write_together
from rtee.messages.requests import Role
from rtee.remote.credentials import (
    AUTHORITY,
    AUTHORITY_KEY,
    HAND,
    HAND_KEY,
    PEOPLE,
    Credentials,
    Person,
    check_private,
    identity_text,
    made_by,
    person,
)

DAYS = 825
"""Default validity of certificates [days]: two and a quarter years, the longest that browsers
accept."""

_AUTHORITY_DAYS = 3650
"""Validity of the authority [days]: ten years, the service life of a robot."""

_EARLIER = datetime.timedelta(hours=1)
"""Certificates are valid from this long ago, since the clocks of computers differ."""

_RANDOM = 8
"""Random bytes in a common name, so that no two certificates have the same one."""

_SPARE = 8
"""Spare common names for each role: the number of clients that can be added while a hand runs."""

_PERSON = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_\-]{0,30}\Z")

Key = ec.EllipticCurvePrivateKey
T = TypeVar("T")


def make_authority(folder: Path, hand: str, days: int = DAYS) -> None:
    """Make a hand's authority and its certificate, valid for some days, in a folder.

    The folder is that of `rtee.remote.credentials.secure_folder`. Raises `ConfigError` if there is
    an authority already, or the folder cannot be written.
    """
    if (folder / AUTHORITY_KEY).exists():
        raise ConfigError(
            "exists already, and the certificates of all clients depend on it; remove it yourself"
            " if you mean to start again",
            path=folder / AUTHORITY_KEY,
        )
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _name(f"authority of {hand}")
    builder = _builder(subject, subject, key, _AUTHORITY_DAYS)
    # It signs the certificates of the hand and its clients, but no further authority.
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs=True), critical=True)
    certificate = builder.sign(key, hashes.SHA256())
    own = {AUTHORITY_KEY: _key_text(key), AUTHORITY: _text(certificate)}
    files = own | _renewed(Credentials(folder), _Authority(key, certificate), hand, days)
    with cleared_on_failure(folder):
        with failing("cannot be created", folder):
            # One by one, since `parents` makes the upper ones with the umask's permissions.
            for place in (*reversed(folder.parents), folder):
                place.mkdir(mode=0o700, exist_ok=True)
        _write(folder, files)


def renew(folder: Path, hand: str, days: int = DAYS) -> None:
    """Make a new certificate of the hand, and new spare names; raises the same as `add_client`."""
    _write(folder, _renewed(_known(folder), _authority(folder), hand, days))


def _renewed(known: Credentials, authority: _Authority, hand: str, days: int) -> dict[str, str]:
    """Return the files of a new certificate of a hand, by name."""
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _issued(authority, hand, key, days, ExtendedKeyUsageOID.SERVER_AUTH)
    until = certificate.not_valid_after_utc.timestamp()
    people = _people(replace(known, until=until, spare=_spare({})))
    return {HAND_KEY: _key_text(key), HAND: _text(certificate), PEOPLE: people}


def add_client(folder: Path, who: str, role: Role, days: int = DAYS) -> tuple[Person, str]:
    """Make a certificate for a person, valid for some days, and admit it to a hand's folder.

    Returns the entry in the list, and the text of the person's file. The person's name has letters,
    digits, ``_`` and ``-``. Raises `ConfigError` if it, or the files of the authority, cannot be
    used.
    """
    if _PERSON.match(who) is None:
        raise ConfigError(
            f"{who[:50]!r} is not a valid name for a client; use up to 31 letters, digits, '_' and "
            "'-'"
        )
    known, authority = _known(folder), _authority(folder)
    common = next((spare for spare, of in known.spare.items() if of is role), None)
    # Without a spare name the person is admitted only from the hand's next start on: Zenoh reads
    # its access rules once.
    common = common or secrets.token_hex(_RANDOM)
    name = f"{who}.{common}"
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _issued(authority, common, key, days, ExtendedKeyUsageOID.CLIENT_AUTH)
    entry = Person(name, role, certificate.not_valid_after_utc.timestamp())
    left = {spare: of for spare, of in known.spare.items() if spare != common}
    people = _people(replace(known, people=(*known.people, entry), spare=_spare(left)))
    _write(folder, {PEOPLE: people})
    own = _text(authority.certificate)
    return entry, identity_text(name, _key_text(key), _text(certificate), own)


def add_hand(folder: Path, hand: str, to: Path, days: int = DAYS) -> None:
    """Make a folder with the certificates with which a hand connects to the router of a site.

    Args:
        folder: The site's folder.
        hand: The hand. A certificate that it had before is refused from now on.
        to: The folder that is made.
        days: Validity of the hand's certificate.

    Raises:
        ConfigError: if the folder exists, or the files of the authority cannot be used.
    """
    known, authority = _known(folder), _authority(folder)
    common = secrets.token_hex(_RANDOM)
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _issued(authority, common, key, days, ExtendedKeyUsageOID.CLIENT_AUTH)
    until = certificate.not_valid_after_utc.timestamp()
    files = {
        HAND_KEY: _key_text(key),
        HAND: _text(certificate),
        AUTHORITY: _text(authority.certificate),
        PEOPLE: _people(replace(known, until=until, hands={})),
    }
    others = {name: other for name, other in known.hands.items() if other != hand}
    with cleared_on_failure(to):
        with failing("cannot be created", to):
            to.mkdir(mode=0o700)
        # Both folders together, so that the old certificate stays valid until there is a new one.
        admitted = {folder / PEOPLE: _people(replace(known, hands={**others, common: hand}))}
        write_together({to / name: text for name, text in files.items()} | admitted, private=True)


def revoke(folder: Path, name: str) -> list[Person]:
    """Revoke certificates in a hand's folder; return those that were admitted before.

    The name is a person's, for all of their certificates, or that of a single certificate. Raises
    `ConfigError` if there is no such name.
    """
    known = _known(folder)
    matching = [client for client in known.people if name in (client.name, person(client.name))]
    if not matching:
        raise ConfigError(f"there is no client '{name[:50]}'", path=folder / PEOPLE)
    people = tuple(
        replace(client, revoked=True) if client in matching else client for client in known.people
    )
    _write(folder, {PEOPLE: _people(replace(known, people=people))})
    return [client for client in matching if not client.revoked]


def _known(folder: Path) -> Credentials:
    credentials = Credentials(folder)
    credentials.read()
    return credentials


@dataclass(frozen=True, slots=True)
class _Authority:
    """The key with which certificates are signed, and its own certificate."""

    key: Key
    certificate: x509.Certificate


def _authority(folder: Path) -> _Authority:
    """Return the authority in a folder; raises `ConfigError` if its files cannot be used."""
    path = folder / AUTHORITY_KEY
    if not path.is_file():
        raise ConfigError(f"is missing; {made_by(folder)}", path=path)
    check_private(path)
    key = _loaded(path, lambda data: serialization.load_pem_private_key(data, None))
    certificate = _loaded(folder / AUTHORITY, x509.load_pem_x509_certificate)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ConfigError("is not a key of 'rtee secure init'", path=path)
    return _Authority(key, certificate)


def _issued(
    authority: _Authority, name: str, key: Key, days: int, purpose: x509.ObjectIdentifier
) -> x509.Certificate:
    """Return a certificate signed by the authority."""
    builder = _builder(_name(name), authority.certificate.subject, key, days)
    not_an_authority = x509.BasicConstraints(ca=False, path_length=None)
    builder = builder.add_extension(not_an_authority, critical=True)
    builder = builder.add_extension(_usage(signs=False), critical=True)
    # A client's certificate cannot pass for the hand's, nor the reverse.
    builder = builder.add_extension(x509.ExtendedKeyUsage([purpose]), critical=True)
    # A placeholder, which clients do not check: see `Identity.settings`.
    names = x509.SubjectAlternativeName([x509.DNSName("rtee.invalid")])
    return builder.add_extension(names, critical=False).sign(authority.key, hashes.SHA256())


def _loaded(path: Path, load: Callable[[bytes], T]) -> T:
    with failing("cannot be read", path):
        content = path.read_bytes()
    try:
        return load(content)
    except (ValueError, TypeError):  # the latter for a key with a passphrase
        raise ConfigError("is not the file that 'rtee secure init' made", path=path) from None


def _builder(subject: x509.Name, issuer: x509.Name, key: Key, days: int) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        # With ECDSA keys TLS only signs; there is no key to encipher, as with RSA.
        digital_signature=not signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common: str) -> x509.Name:
    # X.509 allows 64 characters in a common name (RFC 5280, ub-common-name).
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common[:64])])


def _text(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(serialization.Encoding.PEM).decode("ascii")


def _key_text(key: Key) -> str:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    ).decode("ascii")


def _spare(left: Mapping[str, Role]) -> Mapping[str, Role]:
    """Return `_SPARE` spare names for each role: those left, then new ones."""
    names = dict(left)
    for role in Role:
        for _ in range(_SPARE - sum(of is role for of in left.values())):
            names[secrets.token_hex(_RANDOM)] = role
    return names


def _write(folder: Path, files: Mapping[str, str]) -> None:
    """Write private files by name; raises `ConfigError`, and then none of them has changed."""
    write_together({folder / name: text for name, text in files.items()}, private=True)


def _people(known: Credentials) -> str:
    """Return the list of people, the spare names and the expiry of the hand's certificate."""
    entries = [
        {
            "name": client.name,
            "role": client.role.name.lower(),
            "until": client.until,
            "revoked": client.revoked,
        }
        for client in known.people
    ]
    spare = {name: role.name.lower() for name, role in known.spare.items()}
    document = {"until": known.until, "people": entries, "spare": spare, "hands": dict(known.hands)}
    return json.dumps(document, indent=2) + "\n"
