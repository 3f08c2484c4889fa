"""What a hand requires from its computer, according to its hand.yaml."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rtee.drivers.lookup import DRIVERS
from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError
from rtee.hand.config_schema import RemoteSettings
from rtee.hand.validation import defaults
from rtee.remote.protection import credentials_of, exposed
from rtee.running.prepare import PreparedHand
from rtee.types import DeviceSpec

CAN_BITRATE = 1_000_000
"""Bit rate of a CAN bus whose driver has no setting for it [bit/s]."""

SECURE = Path("/var/lib/rtee/secure")
"""Default folder of the certificates of hands that run as a service."""

_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108
"""Folders that ``ProtectHome`` and ``PrivateTmp`` hide from the service."""

Options = Mapping[str, Mapping[str, Any]]
"""Options of the devices, by device name."""

# Valid in a udev rule or systemd unit: no characters that end a line, a value or a word.
_WORD = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.:+@-]*\Z")
_PATH = re.compile(r"(/[A-Za-z0-9_.][A-Za-z0-9_.:+@-]*)+\Z")
_KERNEL_NAME = re.compile(r"/dev/(tty[A-Za-z]*?)\d+\Z")
_OWN_NAME = re.compile(r"/dev/(?!serial/|tty)[A-Za-z0-9_][A-Za-z0-9_./-]*\Z")


def checked_word(value: str, what: str) -> str:
    """Return a word, unchanged, if it is valid in a system file.

    Raises `ConfigError` if it contains anything but letters, digits and ``_ . : + @ -``.
    """
    if not _WORD.match(value):
        raise ConfigError(f"{what} must consist of letters, digits and _ . : + @ -, not '{value}'")
    return value


def checked_path(value: Path | str, what: str) -> str:
    """Return an absolute path, unchanged, if it is valid in a system file.

    Raises `ConfigError` if it is relative, or contains special characters.
    """
    text = str(value)
    if not _PATH.match(text) or ".." in Path(text).parts:
        raise ConfigError(
            f"{what} must be an absolute path of letters, digits and _ . : + @ -, not '{text}'"
        )
    return text


@dataclass(frozen=True, slots=True)
class Port:
    """A device's serial port: its path in hand.yaml and, if given, the adapter's serial number."""

    device: str
    path: str
    serial: str = ""

    @property
    def kind(self) -> str:
        """Kernel name without the number, such as ``ttyUSB``; empty if the path is not one."""
        name = _KERNEL_NAME.match(self.path)
        return name[1] if name else ""

    @property
    def has_own_name(self) -> bool:
        """Whether a udev rule must create the name, since neither the kernel nor udev does."""
        return bool(_OWN_NAME.match(self.path))


@dataclass(frozen=True, slots=True)
class Needs:
    """What a hand requires from its computer.

    Attributes:
        hand: Name of the hand.
        folder: Folder of the hand.
        ports: Serial ports of the devices.
        can: Bit rates of CAN interfaces by name [bit/s].
        ethercat: Whether a device is on an EtherCAT bus, which requires raw frames.
        unknown: Devices with drivers from other packages, whose needs are unknown.
        certificates: Folder of the network certificates; ``None`` if the hand needs none.
        addresses: Other computers or networks that the hand talks to; ``any`` for all.
        cpus: CPUs of the loop; empty for all.
        log: Folder of the recordings.
        log_size: Maximum disk space of the recordings [bytes].
    """

    hand: str
    folder: Path
    ports: tuple[Port, ...]
    can: Mapping[str, int]
    ethercat: bool
    unknown: tuple[str, ...]
    certificates: Path | None
    addresses: tuple[str, ...]
    cpus: tuple[int, ...]
    log: Path
    log_size: float

    @classmethod
    def of(cls, prepared: PreparedHand, serials: Mapping[str, str]) -> Needs:
        """Return the needs of a hand that was prepared with the driver ``devices``.

        Args:
            prepared: The hand.
            serials: Serial numbers of adapters by device name.

        Raises:
            ConfigError: if a device with a serial number has no serial port, or a value is not
                valid in a system file or for the service.
        """
        options = {device.spec.name: _options(device.spec) for device in prepared.devices}
        exposed(prepared.config.remote)  # the service would refuse to start
        return cls(
            hand=prepared.hand.name,
            folder=prepared.folder,
            ports=_ports(options, serials),
            can=_can(options),
            # Devices on a CAN bus also have a channel; those on EtherCAT only an interface.
            ethercat=any(o.get("interface") and o.get("channel") is None for o in options.values()),
            unknown=tuple(d.spec.name for d in prepared.devices if d.spec.driver not in DRIVERS),
            certificates=_certificates(prepared),
            addresses=_addresses(options, prepared.config.remote),
            cpus=tuple(prepared.config.realtime.cpus),
            log=prepared.config.log.common_directory or prepared.config.log.folder,
            log_size=prepared.config.log.max_total_size,
        )


def _ports(options: Options, serials: Mapping[str, str]) -> tuple[Port, ...]:
    ports = {}
    for device, given in options.items():
        path = given.get("port")
        # Other ports are URLs, such as socket://host:port.
        if isinstance(path, str) and path.startswith("/"):
            serial = serials.get(device, "")
            if serial:
                checked_word(serial, f"the serial number of '{device}'")
            ports[device] = Port(device, checked_path(path, f"the port of '{device}'"), serial)
    wrong = serials.keys() - ports
    if wrong:
        names = ", ".join(ports) or "none"
        raise ConfigError(
            f"--serial {min(wrong)}: is not a device with a serial port; valid: {names}"
        )
    return tuple(ports.values())


def _can(options: Options) -> dict[str, int]:
    return {
        checked_word(str(given["channel"]), f"the CAN channel of '{device}'"): int(
            given.get("bitrate") or CAN_BITRATE
        )
        for device, given in options.items()
        if given.get("channel") and given.get("interface") == "socketcan"
    }


def _addresses(options: Options, remote: RemoteSettings) -> tuple[str, ...]:
    addresses: set[str] = set()
    for given in options.values():
        host, port = given.get("host") or given.get("address"), given.get("port")
        if isinstance(port, str) and not port.startswith("/"):
            host = port
        if isinstance(host, str):
            addresses |= _beyond(host)
    for endpoint in (*remote.listen, *remote.connect):
        addresses |= _beyond(endpoint.partition("/")[2], listens=True)
    return ("any",) if "any" in addresses else tuple(sorted(addresses))


def _certificates(prepared: PreparedHand) -> Path | None:
    """Return the folder of the service's certificates; ``None`` if the hand needs none."""
    remote = prepared.config.remote
    if credentials_of(prepared.hand.name, remote) is None:
        return None
    folder = remote.security.folder or SECURE / prepared.hand.name
    text = checked_path(folder, "remote: security: folder")
    if any(folder.is_relative_to(hidden) for hidden in _HIDDEN):
        raise ConfigError(
            f"the service cannot see {text}; leave out 'folder', or use one such as"
            f" {SECURE / prepared.hand.name}",
            key="remote.security.folder",
        )
    return folder


def _options(spec: DeviceSpec) -> dict[str, Any]:
    """Return a device's options, with the driver's defaults if the driver is part of rtee.

    Drivers from other packages are not imported, since their code would run as root.
    """
    if spec.driver not in DRIVERS:
        return dict(spec.options)
    return defaults(find_driver(spec.driver, source=spec.source).Options) | dict(spec.options)


def _beyond(address: str, *, listens: bool = False) -> set[str]:
    """Return the address of another computer, or ``any`` for a host name; empty for this computer.

    With ``listens``, an address of another computer becomes ``any``. Raises `ConfigError` if the
    text is not an address.
    """
    try:
        host = urlsplit(address if "://" in address else f"//{address}").hostname or ""
    except ValueError as error:  # brackets of an IPv6 address that do not close
        raise ConfigError(f"'{address}' is not an address: {error}") from None
    if host == "localhost":
        return set()
    try:
        number = ipaddress.ip_address(host)
    except ValueError:
        # systemd permits networks only by number, and the address of a name may change.
        return {"any"}
    if number.is_loopback:
        return set()
    # The addresses of clients are unknown.
    return {"any" if listens else str(number)}
