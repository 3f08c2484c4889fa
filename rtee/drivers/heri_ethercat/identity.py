"""Which boards are on the network."""

from __future__ import annotations

from functools import partial

from rtee.buses.ethercat import EthercatBus, Ring
from rtee.drivers.heri_ethercat.codec import FIRMWARE_OBJECT
from rtee.drivers.heri_ethercat.options import HeriEthercatOptions
from rtee.errors import HandshakeError


def identify(bus: EthercatBus, boards: int, options: HeriEthercatOptions, device: str) -> None:
    """See that the first slaves are as many boards as needed, of the vendor and product given.

    Raises:
        HandshakeError: if they are not.
    """
    if len(bus.slaves) < boards:
        raise HandshakeError(
            device,
            f"{boards} boards at {options.interface}",
            f"{len(bus.slaves)} slaves",
            hint="check cables and supply",
        )
    for position, slave in enumerate(bus.slaves[:boards]):
        for what, wanted, found in (
            ("vendor", options.vendor, slave.vendor),
            ("product", options.product, slave.product),
        ):
            if wanted is not None and wanted != found:
                raise HandshakeError(
                    device,
                    f"{what} {wanted:#x} as slave {position}",
                    f"{what} {found:#x} ({slave.name})",
                )


async def firmware(bus: EthercatBus, boards: int) -> str:
    """Return the boards' firmware, each version once; raises `BusError`."""
    found = [await bus.run(partial(_firmware, position), 1.0) for position in range(boards)]
    return ", ".join(dict.fromkeys(found))


def _firmware(position: int, ring: Ring) -> str:
    try:
        return ring.read(position, *FIRMWARE_OBJECT).decode("ascii", "replace").strip("\x00 ")
    except OSError:
        return "not told"
