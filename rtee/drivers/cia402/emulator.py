"""Emulates grippers whose motors are CiA 402 drives on a CAN bus."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import structs

from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.wear import TYPICAL
from rtee.drivers.cia402 import cia301
from rtee.drivers.cia402.codec import Object
from rtee.drivers.cia402.emulated_drive import RATED, Drive, DriveProperties
from rtee.drivers.objects import Closing, Grasps

_CODES = {"overcurrent": 0x2310, "over_temperature": 0x4310, "following_error": 0x8611}
"""Error codes of the faults that the first drive can have."""


class Cia402Emulator(Emulator, Grasps):
    """One or several drives on a CAN bus.

    Attributes:
        drives: The drives by node id.
    """

    PROPERTIES = DriveProperties
    # The encoder of a drive is on its motor and is homed: it sees neither backlash nor an offset.
    WEAR = structs.replace(TYPICAL, backlash=0.0, offset=0.0, noise=0.0)
    FAULTS = Emulator.FAULTS | frozenset(_CODES) | {"silent"}
    period = 0.001

    def __init__(self, properties: DriveProperties | None = None) -> None:
        super().__init__()
        self.properties = properties or DriveProperties()
        self.drives = {n: Drive(n, self.properties) for n in self.properties.nodes}
        self.axes = [drive.axis for drive in self.drives.values()]
        self._booted = False

    @classmethod
    def fitting(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the node ids that a device's options name."""
        ids = tuple(dict(n)["id"] for n in (options.get("nodes") or {}).values())
        return {"nodes": ids} if ids else {}

    def power_cycle(self, now: float) -> None:
        """Restart; drives without an absolute encoder lose their positions."""
        self._booted = False
        for drive in self.drives.values():
            drive.homed = self.properties.homed
            if not drive.homed:
                drive.zero = 0.0

    def inject(self, fault: str) -> None:
        """Inject a fault: a drive fault into the first drive, any other into all drives."""
        super().inject(fault)
        code = _CODES.get(fault)
        if code is not None:
            first = next(iter(self.drives.values()))
            first.cause = code
            first.fail(code)

    def clear(self, fault: str | None = None) -> None:
        """Remove a fault; a drive stays in fault until it is reset."""
        super().clear(fault)
        for drive in self.drives.values():
            drive.cause = 0

    def on_faults(self) -> None:
        """Apply the injected faults: block or silence the drives, and set their device type."""
        super().on_faults()
        for drive in self.drives.values():
            drive.node.inhibited = "silent" in self.faults
            # The low half of the device type is the profile; 2 in the high half is a servo drive.
            kind = 401 if "wrong_device" in self.faults else self.properties.device_type
            drive.node.objects[Object.DEVICE_TYPE, 0].value = struct.pack("<I", 0x20000 | kind)

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the drives."""
        closed = self.properties.closed
        return [Closing(d.axis, 0.0, closed, RATED) for d in self.drives.values()]

    def step(self, now: float) -> list[CanFrame]:
        """Let time pass; return boot-up, heartbeats and emergencies."""
        frames = []
        if not self._booted:
            self._booted = True
            for drive in self.drives.values():
                frames += drive.node.start(now)
        for drive in self.drives.values():
            frames += drive.step(now)
        return frames

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        """Receive a frame from the bus and return the answers."""
        frames = self.step(now)
        if frame.id == cia301.SYNC and not frame.data and not frame.remote:
            for drive in self.drives.values():
                # Makes differ: an answer shows the state before or after the set-point.
                before = drive.node.transmit()
                drive.node.sync()
                drive.cycle()
                frames += drive.step(now)
                frames += before if self.properties.sampled == "before" else drive.node.transmit()
            return frames
        for drive in self.drives.values():
            frames += drive.node.on_frame(frame, now)
        return frames
