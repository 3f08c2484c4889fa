"""The force calibration of an RH56, and the offsets that its sensors keep after it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Annotated

from msgspec import Meta, structs

from rtee import monotonic
from rtee.buses.retry import patiently
from rtee.drivers.inspire_rh56.codec import COUNT, FINGERS, KEEP, Register, Report, State, table
from rtee.drivers.inspire_rh56.link import Rh56Link
from rtee.drivers.json_files import read_calibration_file, write_json
from rtee.errors import CalibrationError
from rtee.hand.validation import Section

_SPEED = 250
"""Speed at which the hand opens first [0.1 %]: a quarter of the largest."""
_OPENING = 5.0  # longest time to open [s]
_LASTS = 8.0
"""Time that published clients wait for the calibration [s]; it takes about 6 s."""
_SAMPLES = 20
"""Number of readings that are averaged for a zero."""
_IDLE = 100
"""Largest plausible reading of an idle finger [g]: published force curves begin there."""


class ForceZeros(Section, frozen=True):
    """Readings of the force sensors of an idle hand.

    Attributes:
        unit: Number of the hand.
        grams: The readings, in the order of `FINGERS` [g].
    """

    unit: int
    grams: Annotated[tuple[int, ...], Meta(min_length=COUNT, max_length=COUNT)]

    def __str__(self) -> str:
        pairs = zip(FINGERS, self.grams, strict=True)
        return "idle, " + ", ".join(f"{finger} reads {grams} g" for finger, grams in pairs)


def read_zeros(path: Path, device: str, unit: int) -> tuple[int, ...]:
    """Return the stored zeros of a hand [g]; raises `CalibrationError`."""
    zeros = read_calibration_file(path, device, ForceZeros)
    # Sensors differ from hand to hand, so the zeros of another hand are wrong here.
    if zeros.unit != unit:
        raise CalibrationError(
            device, f"{path} was made with unit {zeros.unit}, not {unit}; calibrate again"
        )
    return zeros.grams


async def calibrate(
    link: Rh56Link,
    measured: Callable[[], Awaitable[Report]],
    device: str,
    unit: int,
    angles: Sequence[int],
    path: Path,
) -> ForceZeros:
    """Open the hand, let it calibrate its force sensors, and store their readings afterwards.

    Args:
        link: The hand.
        measured: Reads the hand's measurements.
        device: The device's name.
        unit: The hand's number.
        angles: Set-points of the open hand, in the order of `FINGERS`; `KEEP`: unchanged.
        path: File to write.

    Raises:
        BusError: if the line fails.
        CalibrationError: if a finger does not open, or an idle one reads a force.
        ConfigError: if the file cannot be written.
    """
    # Restored below, since the hand keeps set-points until its supply is cut.
    before = await patiently(lambda: link.read(Register.SPEED_SET, 2 * COUNT))
    await patiently(lambda: link.write(Register.SPEED_SET, table([_SPEED] * COUNT)))
    try:
        await patiently(lambda: link.write(Register.ANGLE_SET, table(angles)))
        await _opened(measured, device, angles)
    finally:
        # Even if a finger did not open: otherwise the hand would keep the slow speed.
        await patiently(lambda: link.write(Register.SPEED_SET, before))
    await patiently(lambda: link.write(Register.FORCE_CALIBRATION, b"\x01"))
    await asyncio.sleep(_LASTS)
    sums = [0] * COUNT
    for _ in range(_SAMPLES):
        report = await patiently(measured)
        sums = [total + grams for total, grams in zip(sums, report.forces, strict=True)]
    zeros = ForceZeros(unit, tuple(round(total / _SAMPLES) for total in sums))
    for finger, grams, angle in zip(FINGERS, zeros.grams, angles, strict=True):
        # A finger that was not opened may rest on something, so its force proves nothing.
        if angle != KEEP and abs(grams) > _IDLE:
            raise CalibrationError(
                device,
                f"{finger} reads {grams} g although the hand is idle: does it touch something?",
            )
    write_json(path, structs.asdict(zeros))
    return zeros


async def _opened(
    measured: Callable[[], Awaitable[Report]], device: str, angles: Sequence[int]
) -> None:
    """Wait until the motors that got a set-point have reached it; raises `CalibrationError`."""
    end = monotonic.now() + _OPENING
    while True:
        report = await patiently(measured)
        away = [
            FINGERS[m]
            for m, angle in enumerate(angles)
            if angle != KEEP and report.states[m] is not State.AT_TARGET
        ]
        if not away:
            return
        if monotonic.now() > end:
            raise CalibrationError(device, f"it does not open: {', '.join(away)}")
        await asyncio.sleep(0.05)
