"""The force calibration of an RH56, and what its sensors tell of an idle hand afterwards."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rtee.buses.retry import patiently
from rtee.drivers.inspire_rh56.codec import (
    COUNT,
    FINGERS,
    KEEP,
    Register,
    Report,
    State,
    table,
)
from rtee.drivers.inspire_rh56.link import Rh56Link
from rtee.errors import CalibrationError
from rtee.hand.files import make_folder, write_atomically

_SPEED = 250
"""Speed with which the hand opens before, a quarter of the largest."""
_OPENING = 5.0  # longest time for that [s]
_LASTS = 8.0
"""Time that published clients wait for the calibration [s]; it takes about 6 s."""
_SAMPLES = 20
"""Readings whose mean is a zero."""
_IDLE = 100
"""Largest force that an idle finger may tell [g]: from there on published force lines hold."""


@dataclass(frozen=True, slots=True)
class ForceZeros:
    """What the force sensors of an idle hand tell.

    Attributes:
        unit: Number of the hand.
        grams: In the order of `FINGERS` [g].
    """

    unit: int
    grams: tuple[int, ...]

    def __str__(self) -> str:
        pairs = zip(FINGERS, self.grams, strict=True)
        return "idle, " + ", ".join(f"{finger} tells {grams} g" for finger, grams in pairs)


def read_zeros(path: Path, device: str, unit: int) -> tuple[int, ...]:
    """Return the stored zeros of a hand [g].

    Raises:
        CalibrationError: if they are missing, of another hand, or no calibration.
    """
    try:
        stored = json.loads(path.read_text("utf-8"))
        zeros = ForceZeros(int(stored["unit"]), tuple(int(g) for g in stored["grams"]))
        if len(zeros.grams) != COUNT:
            raise ValueError(f"it has {len(zeros.grams)} forces instead of {COUNT}")
    except FileNotFoundError:
        raise CalibrationError(
            device, f"there is no calibration at {path}; `rtee calibrate` makes one"
        ) from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CalibrationError(device, f"{path} is not a calibration: {error}") from error
    # Every hand has sensors of its own, so another number's zeros are wrong here.
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
    """Open the hand, let it calibrate its force sensors, and store what they then tell.

    Args:
        link: The hand.
        measured: Returns what it measures.
        device: The device's name.
        unit: The hand's number.
        angles: Set-points of the open hand, in the order of `FINGERS`; `KEEP`: as it is.
        path: File to write.

    Raises:
        BusError: if the line fails.
        CalibrationError: if a finger does not open, or an idle one tells a force.
        ConfigError: if the file cannot be written.
    """
    before = await patiently(lambda: link.read(Register.SPEED_SET, 2 * COUNT))
    await patiently(lambda: link.write(Register.SPEED_SET, table([_SPEED] * COUNT)))
    try:
        await patiently(lambda: link.write(Register.ANGLE_SET, table(angles)))
        await _opened(measured, device, angles)
    finally:
        # Also when a finger did not open: the hand would keep the slow speed.
        await patiently(lambda: link.write(Register.SPEED_SET, before))
    await patiently(lambda: link.write(Register.FORCE_CALIBRATION, b"\x01"))
    await asyncio.sleep(_LASTS)
    sums = [0] * COUNT
    for _ in range(_SAMPLES):
        report = await patiently(measured)
        sums = [total + grams for total, grams in zip(sums, report.forces, strict=True)]
    zeros = ForceZeros(unit, tuple(round(total / _SAMPLES) for total in sums))
    for finger, grams, angle in zip(FINGERS, zeros.grams, angles, strict=True):
        # A finger that was not told to open may rest on something, so its force proves nothing.
        if angle != KEEP and abs(grams) > _IDLE:
            raise CalibrationError(
                device,
                f"{finger} tells {grams} g although the hand is idle: does it touch something?",
            )
    make_folder(path.parent)
    write_atomically(path, json.dumps(asdict(zeros), indent=2) + "\n")
    return zeros


async def _opened(
    measured: Callable[[], Awaitable[Report]], device: str, angles: Sequence[int]
) -> None:
    """Wait until the motors that were told an angle are there; raises `CalibrationError`."""
    end = time.monotonic() + _OPENING
    while True:
        report = await patiently(measured)
        away = [
            FINGERS[m]
            for m, angle in enumerate(angles)
            if angle != KEEP and report.states[m] is not State.AT_TARGET
        ]
        if not away:
            return
        if time.monotonic() > end:
            raise CalibrationError(device, f"it does not open: {', '.join(away)}")
        await asyncio.sleep(0.05)
