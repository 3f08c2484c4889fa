"""`rtee secure`: make certificates for a hand on a network and for its clients, by role."""

from __future__ import annotations

import time
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import Commands
from rtee.cli._table import Column, table_of
from rtee.drivers.diagnosis.checks import ok, warning, wrong
from rtee.errors import ConfigError, needing_extra, suggestion
from rtee.hand.files import write_together
from rtee.hand.names import check_name

if TYPE_CHECKING:
    from rtee.deploy.needs import Needs
    from rtee.drivers.diagnosis.checks import Check
    from rtee.messages.requests import Role

app = Commands()

_DAY = 86400.0
"""Seconds in a day."""

_SOON = 30.0
"""Warn about certificates that expire within this time [days]: new ones must reach all clients."""

HandArgument = Annotated[str, typer.Argument(metavar="HAND", help="Name of the hand.")]
PersonArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="Who it is for: letters, digits, '_' and '-'.")
]
DaysOption = Annotated[
    int, typer.Option("--days", min=1, max=3650, help="How long the certificate holds.")
]


def _authority() -> ModuleType:
    with needing_extra("'rtee secure'", "secure"):
        from rtee.remote import authority

        return authority


def _folder(hand: str) -> Path:
    from rtee.remote.credentials import secure_folder

    return secure_folder(hand)


@app.command()
def init(hand: HandArgument, days: DaysOption = 825) -> None:
    """Make the authority and the certificate of a hand, or of the router of a site."""
    from rtee.hand.catalog import hand_names

    folder = _folder(hand)
    _authority().make_authority(folder, hand, days)
    print(f"made the authority of {hand} and its certificate in {folder}")
    if hand in hand_names():
        print("Add to its hand.yaml, with an address of this computer:")
        print("  remote:\n    listen: [tls/0.0.0.0:7447]")
    else:
        print(f"There is no hand '{hand}' here, so this is for the router of a site:")
        print(f"  rtee router {hand} --listen tls/0.0.0.0:7447")
        print(f"Make the certificates of each hand behind it: rtee secure add-hand {hand} HAND")
    print(f"Then make a certificate for each client: rtee secure add-client {hand} NAME")


@app.command()
def renew(hand: HandArgument, days: DaysOption = 825) -> None:
    """Make a new certificate of the hand; those of clients stay valid."""
    folder = _folder(hand)
    _authority().renew(folder, hand, days)
    print(f"made a new certificate of {hand}; it is used from the hand's next start")


@app.command(name="add-client")
def add_client(
    hand: HandArgument,
    name: PersonArgument,
    *,
    role: str = "operator",
    out: Path | None = None,
    days: DaysOption = 825,
) -> None:
    """Make a certificate for a client: watch (observer), move (operator), change (maintainer).

    Arguments and options:
        role: observer, operator or maintainer.
        out (FILE): Where to write it; NAME@HAND.pem by default.
    """
    path = out or Path(f"{name}@{hand}.pem")
    # Checked first: the hand would admit a certificate that could not be stored.
    if path.exists():
        raise ConfigError("exists already; give another file, or remove it first", path=path)
    authority, folder = _authority(), _folder(hand)
    person, text = authority.add_client(folder, name, _role(role), days)
    try:
        write_together({path: text}, private=True)
    except ConfigError:
        # The client never gets this certificate, so it must not stay admitted.
        authority.revoke(folder, person.name)
        raise
    print(f"{person.name}: {role}, until {_date(person.until)}, in {path}")
    print("Like a key, the file needs a safe way to the client's computer. Store it there as")
    print("~/.config/rtee/identity.pem or where RTEE_IDENTITY says, and delete it here.")
    print(
        "A running hand admits it within a second, and the next 8 of each role without a restart."
    )


@app.command(name="add-hand")
def add_hand(
    site: str,
    hand: HandArgument,
    *,
    out: Path | None = None,
    days: DaysOption = 825,
) -> None:
    """Make the certificates with which a hand connects to the router of a site.

    Arguments and options:
        site (SITE): Name of the router's site.
        out (FOLDER): Where to write them; HAND@SITE by default.
    """
    folder = out or Path(f"{check_name(hand, 'hand')}@{check_name(site, 'site')}")
    _authority().add_hand(_folder(site), hand, folder, days)
    print(f"made the certificates of {hand} at {site} in {folder}")
    print("Bring the folder to the hand's computer in a safe way, and delete it here. hand.yaml:")
    print("  remote:\n    connect: [tls/ROUTER:7447]\n    security: {folder: THE FOLDER THERE}")
    print(f"A running 'rtee router {site}' admits it as soon as no client is connected.")


@app.command()
def revoke(hand: HandArgument, name: PersonArgument) -> None:
    """Refuse the certificates of a client from now on; those of others stay valid."""
    revoked = _authority().revoke(_folder(hand), name)
    for person in revoked:
        print(f"{person.name} is refused")
    if not revoked:
        print(f"{name} was refused already")
    print("Within a second, a running hand closes its connections and accepts no new ones.")


@app.command(name="list")
def list_(hand: HandArgument) -> None:
    """List the clients for whom certificates were made."""
    from rtee.remote.credentials import Credentials

    known = Credentials(_folder(hand))
    known.read()
    rows = [
        (p.name, p.role.name.lower(), _date(p.until), _state(p.until, p.revoked))
        for p in known.people
    ]
    print(f"{hand}: certificate until {_date(known.until)}, in {known.folder}")
    table_of((Column("client", whole=True), "role", "until", ""), rows).show()


def checks(name: str, service: Needs | None = None) -> list[Check]:
    """Return the checks of a hand's certificates for `rtee doctor`; none if it needs none.

    If the hand's service has needs here, its certificates are checked instead of the user's.
    """
    from rtee.deploy.files import secure_command
    from rtee.hand.load import load_configured
    from rtee.remote.credentials import Credentials, person
    from rtee.remote.protection import credentials_of, exposed

    hand, config = load_configured(name)
    command = "rtee secure" if service is None else secure_command(service)
    try:
        exposed(config.remote)
        known = credentials_of(hand.name, config.remote)
        if known is None:
            return []
        if service is not None and service.certificates is not None:
            known = Credentials(service.certificates)
        # Checked first, since files that cannot be read would count as missing.
        if known.hidden:
            text = f"in {known.folder}, which is not yours to read"
            return [warning("certificate", text, f"sudo rtee doctor {name}")]
        known.files()
    except ConfigError as error:
        return [wrong("network", str(error), f"{command} init {hand.name}")]
    left = (known.until - time.time()) / _DAY
    renew = f"{command} renew {hand.name}"
    if left <= 0:
        results = [wrong("certificate", f"expired on {_date(known.until)}", renew)]
    elif left < _SOON:
        results = [warning("certificate", f"expires on {_date(known.until)}", renew)]
    else:
        results = [ok("certificate", f"until {_date(known.until)}")]
    for entry in known.people:
        if not entry.revoked and entry.until - time.time() < _SOON * _DAY:
            who, role = person(entry.name), entry.role.name.lower()
            remedy = f"{command} add-client {hand.name} {who} --role {role}"
            results.append(warning(f"client {entry.name}", f"until {_date(entry.until)}", remedy))
    return results


def _role(word: str) -> Role:
    from rtee.messages.requests import Role

    names = {role.name.lower(): role for role in Role}
    if word not in names:
        raise ConfigError(f"unknown role '{word[:50]}'; {suggestion(word, names)}")
    return names[word]


def _state(until: float, revoked: bool) -> str:
    if revoked:
        return "refused"
    left = (until - time.time()) / _DAY
    return "expired" if left <= 0 else f"{left:.0f} days left"


def _date(when: float) -> str:
    return time.strftime("%Y-%m-%d", time.localtime(when))
