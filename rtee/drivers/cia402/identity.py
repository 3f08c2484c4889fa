"""Check that a node is the expected drive, and read its units."""

from __future__ import annotations

import math

from rtee.drivers.cia402 import codec
from rtee.drivers.cia402.codec import Mode, Object, Scale
from rtee.drivers.cia402.drive import DriveLink
from rtee.errors import BusTimeout, HandshakeError, NotConnected


def identify(drive: DriveLink, device: str, channel: str, mode: Mode) -> tuple[str, str]:
    """Check a node and read its units; return its name and its serial number.

    In the worker thread; writes nothing. Device and channel are named in messages.

    Raises:
        NotConnected: if it does not answer.
        HandshakeError: if it is another device, or does not support the mode of operation.
        BusError: if the bus fails.
    """
    try:
        kind = drive.number(Object.DEVICE_TYPE) & 0xFFFF
    except BusTimeout as error:
        raise NotConnected(
            device,
            f"node {drive.id} ({drive.name}) does not answer on {channel}",
            hint="check supply, wiring, termination, node id and bit rate; `rtee scan` helps",
        ) from error
    if kind != codec.DEVICE_TYPE:
        raise HandshakeError(
            device,
            f"a CiA 402 drive as node {drive.id}",
            f"a device of profile {kind}",
            hint="is it another node's id?",
        )
    product = drive.number(Object.IDENTITY, 2, default=0)
    wanted = drive.options.product
    if wanted is not None and product != wanted:
        raise HandshakeError(
            device, f"product {wanted:#x} as node {drive.id}", f"product {product:#x}"
        )
    # The object is optional; a drive without it is assumed to support all modes.
    modes = drive.number(Object.SUPPORTED_MODES, default=0xFFFF_FFFF)
    if not modes & mode.bit:
        known = ", ".join(str(bit + 1) for bit in range(16) if modes >> bit & 1)
        raise HandshakeError(
            device,
            f"mode {mode.value} in node {drive.id}",
            f"modes {known}",
            hint="choose another 'mode'",
        )
    drive.scale = read_scale(drive, device)
    name = drive.text(Object.DEVICE_NAME) or f"product {product:#x}"
    return name, str(drive.number(Object.IDENTITY, 4, default=0))


def read_scale(drive: DriveLink, device: str) -> Scale:
    """Return a drive's units from its options or its objects; in the worker thread.

    Raises `HandshakeError` if its objects are inconsistent, and `BusError`.
    """
    given = drive.options
    motor = drive.number(Object.GEAR_RATIO, 1, default=1)
    shaft = drive.number(Object.GEAR_RATIO, 2, default=1)
    if given.counts is not None:
        counts = given.counts
    else:
        increments = drive.number(Object.ENCODER_RESOLUTION, 1)
        turns = drive.number(Object.ENCODER_RESOLUTION, 2)
        try:
            counts = given.direction * codec.counts_per_rad(increments, turns, motor, shaft)
        except ValueError as error:
            raise HandshakeError(
                device,
                f"resolution and gear ratio in node {drive.id}",
                str(error),
                hint="give 'counts' per rad",
            ) from error
    torque = given.rated_torque
    if torque is None:
        # Objects 6075 and 6076 are in mA and mN·m.
        rated = drive.number(Object.RATED_TORQUE, default=0) / 1000.0
        torque = rated * motor / shaft if rated > 0.0 and shaft > 0 else math.nan
    current = drive.number(Object.RATED_CURRENT, default=0) / 1000.0
    return Scale(counts, given.zero, torque, current or math.nan, given.velocity_unit)
