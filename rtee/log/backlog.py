"""Ticks that wait for the writer, packed into a tenth of their memory, all of which is returned."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Mapping
from operator import attrgetter
from typing import Any, Final

import numpy as np

from rtee.sample import COLUMNS, NOTHING, FloatArray, TickRecord
from rtee.touch import TouchState

_HEAD: Final = struct.Struct("<qdq")
"""What precedes the arrays of a tick: its number, its stamp [s] and the time since 1970 [ns]."""

_MEMORY: Final = 256 * 1024
"""Memory for the ticks of one piece [byte]: a third of a second of nine actuators at 1 kHz, and
little enough to be given back within some ten microseconds."""

_arrays = attrgetter(*COLUMNS)


class PackedTicks:
    """A piece of a backlog: some ticks, which are added by one thread and taken by another.

    As records, the ticks of some seconds are a hundred thousand objects. Other objects settle
    between them, so that the process would never return their memory to the system. Here they are
    rows of one separate mapping, which is returned with this object. All have arrays of the same
    lengths as the tick ``like``.
    """

    def __init__(self, like: TickRecord) -> None:
        self._types = [np.dtype(quantity.dtype) for quantity in COLUMNS.values()]
        self._actuators = len(like.position)
        self._size = _HEAD.size + self._actuators * sum(kind.itemsize for kind in self._types)
        self._room = max(1, _MEMORY // self._size)
        # Private, so that it counts as this process's own memory.
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
        self._memory = mmap.mmap(-1, self._room * self._size, flags)
        # Kept as they are, since many ticks share one object.
        self._channels: list[Mapping[str, FloatArray]] = [NOTHING] * self._room
        self._touch: list[Mapping[str, TouchState]] = [NOTHING] * self._room
        self._added = 0
        self._taken = 0

    def add(self, record: TickRecord) -> bool:
        """Add a tick; return whether there was room for it."""
        place = self._added
        if place == self._room:
            return False
        head = _HEAD.pack(record.tick, record.stamp, record.wall_ns)
        row = head + b"".join([array.tobytes() for array in _arrays(record)])
        # Rows must have one size; the arrays of a tick that does not fit the hand may have others.
        if len(row) != self._size:
            return False
        self._memory[place * self._size : (place + 1) * self._size] = row
        self._channels[place], self._touch[place] = record.channels, record.touch
        self._added = place + 1
        return True

    def take(self) -> TickRecord:
        """Return the tick that was added first of those that were not yet taken."""
        place, self._taken = self._taken, self._taken + 1
        # A copy, so that arrays of this tick do not keep the whole mapping.
        row = self._memory[place * self._size : (place + 1) * self._size]
        tick, stamp, wall_ns = _HEAD.unpack_from(row)
        arrays: dict[str, Any] = {}
        begin = _HEAD.size
        for name, kind in zip(COLUMNS, self._types, strict=True):
            arrays[name] = np.frombuffer(row, kind, self._actuators, begin)
            begin += self._actuators * kind.itemsize
        channels, touch = self._channels[place], self._touch[place]
        self._channels[place], self._touch[place] = NOTHING, NOTHING
        return TickRecord(
            **arrays, tick=tick, stamp=stamp, wall_ns=wall_ns, channels=channels, touch=touch
        )
