"""The taxels of an RH56DFTP: their arrays, their registers, and a reader.

Source: the register map in a published client that quotes the maker's manual. Addresses step by two
from value to value, as in all tables of the hand, and one request reads at most 125 values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee import monotonic
from rtee.drivers.inspire_rh56.link import Rh56Link
from rtee.sample import FloatArray
from rtee.touch import TouchReading, TouchSensor

FIRST: Final = 3000
LAST: Final = 5124
"""Address of the first taxel's register, and the first address after the last taxel."""

FULL: Final = 4095
"""Largest value of a taxel; its unit is not published."""

_FINGER: Final = 370  # address offset from finger to finger


@dataclass(frozen=True, slots=True)
class Area:
    """An array of taxels.

    Attributes:
        address: Its first register.
        grid: Rows and columns.
    """

    name: str
    address: int
    grid: tuple[int, int]

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return self.grid[0] * self.grid[1]


def _areas() -> tuple[Area, ...]:
    areas = []
    for number, finger in enumerate(("little", "ring", "middle", "index")):
        start = FIRST + _FINGER * number
        areas += [
            Area(f"{finger}_tip", start, (3, 3)),
            Area(f"{finger}_top", start + 18, (12, 8)),
            Area(f"{finger}_pad", start + 210, (10, 8)),
        ]
    areas += [
        Area("thumb_tip", 4480, (3, 3)),
        Area("thumb_top", 4498, (12, 8)),
        Area("thumb_middle", 4690, (3, 3)),
        Area("thumb_pad", 4708, (12, 8)),
        Area("palm", 4900, (8, 14)),
    ]
    return tuple(areas)


AREAS: Final = _areas()
"""All arrays of taxels, in the order of their registers."""

_MOST = 125  # values of one request, a limit of Modbus


def sensors(areas: Sequence[Area]) -> tuple[TouchSensor, ...]:
    """Return areas as touch sensors."""
    return tuple(
        TouchSensor(area.name, area.taxels, "counts", float(FULL), grid=area.grid) for area in areas
    )


def blocks(areas: Sequence[Area]) -> tuple[tuple[int, int], ...]:
    """Return the requests that read some areas: the address and the number of values of each.

    One request reads consecutive areas together, as far as its limit allows.
    """
    found: list[tuple[int, int]] = []
    for area in areas:
        if found:
            start, count = found[-1]
            if start + 2 * count == area.address and count + area.taxels <= _MOST:
                found[-1] = start, count + area.taxels
                continue
        found.append((area.address, area.taxels))
    return tuple(found)


class TactileReader:
    """Reads taxels in turn, one request per cycle, so that the cycle of the motors stays short.

    Args:
        areas: The areas to read.

    Attributes:
        blocks: Address and number of values of each request.
    """

    def __init__(self, areas: Sequence[Area]) -> None:
        self.blocks = blocks(areas)
        self._values: FloatArray = np.full(sum(area.taxels for area in areas), math.nan)
        self._stamps = [-math.inf] * len(self.blocks)
        self._turn = 0

    @property
    def largest(self) -> int:
        """Size of the largest answer [byte]."""
        return max(2 * count for _, count in self.blocks)

    async def read(self, link: Rh56Link) -> TouchReading | None:
        """Read the next part; return all taxels once each has been read; raises `BusError`.

        An impossible value becomes ``NaN``.
        """
        turn = self._turn
        address, count = self.blocks[turn]
        # Taken before the request: values must not seem newer than they are.
        stamp = monotonic.now()
        data = await link.read(address, 2 * count)
        raw = np.frombuffer(data, dtype="<u2").astype(np.float64)
        begin = sum(n for _, n in self.blocks[:turn])
        # A copy, since a reading that was returned must not change.
        self._values = self._values.copy()
        self._values[begin : begin + count] = np.where(raw <= FULL, raw, math.nan)
        self._stamps[turn] = stamp
        self._turn = (turn + 1) % len(self.blocks)
        # The reading is as old as its oldest part.
        oldest = min(self._stamps)
        return TouchReading(self._values, oldest) if math.isfinite(oldest) else None
