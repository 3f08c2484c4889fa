"""The driver's side of one drive: set-up by SDO, process data, reports."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rtee import monotonic
from rtee.buses.canopen import CanopenBus
from rtee.buses.emulator import CanFrame
from rtee.buses.parser import CodecError
from rtee.drivers.cia402 import cia301, codec
from rtee.drivers.cia402.cia301 import RPDO, TPDO, Emergency, NmtState, emergency_name
from rtee.drivers.cia402.codec import (
    Command,
    Limits,
    Mode,
    Motion,
    Object,
    State,
    Status,
    StatusBit,
)
from rtee.drivers.cia402.options import NodeOptions
from rtee.errors import BusBroken, BusTimeout, DriverError

_SYNCHRONOUS = 1
"""Transmission type of a PDO that is sent or applied with every SYNC (CiA 301)."""

_TRIES = 3
"""Attempts per SDO transfer: a frame may be lost, or this computer may be busy for a moment."""

_SILENT_STATES: Mapping[NmtState | None, str] = {
    NmtState.PRE_OPERATIONAL: "pre-operational",
    NmtState.STOPPED: "stopped by another master",
}
"""States in which a node sends no process data. Only a master stops a node; a lost heartbeat makes
some nodes pre-operational."""

_LATE = 0.01
"""Pause before the next attempt [s], in which a late answer still arrives and is dropped."""


@dataclass
class DriveLink:
    """One drive.

    Attributes:
        bus: The network.
        name: The actuator that it drives.
        scale: Its units.
        status: Its newest status, ``None`` before the first.
        motion: Its newest velocity, torque and error.
        stamp: When the status arrived [s].
        nmt: Its newest NMT state.
        booted: Whether it has restarted since this was last set to ``False``.
        emergency: Its newest emergency that has not ended.
        controlword: The controlword to send next.
        target: The target position to send next [counts].
        pending: Whether the drive has not acknowledged the last set-point yet.
        found_target: Target before set-up [counts]; ``None``: the drive does not return it.
        limits: The limits that were sent last.
    """

    bus: CanopenBus
    options: NodeOptions
    name: str
    scale: codec.DriveScale = field(default_factory=lambda: codec.DriveScale(1.0))
    status: Status | None = None
    motion: Motion = field(default_factory=lambda: Motion(0, 0, 0))
    stamp: float = 0.0
    nmt: NmtState | None = None
    booted: bool = False
    emergency: Emergency | None = None
    controlword: int = codec.Control.DISABLE_VOLTAGE
    target: int = 0
    pending: bool = False
    found_target: int | None = None
    limits: Limits | None = None
    _sent_target: int | None = None
    _undo: list[Callable[[], None]] = field(default_factory=list)
    _remote: Any = None
    _notify: Callable[[], None] = lambda: None

    @property
    def id(self) -> int:
        """Its node id."""
        return self.options.id

    @property
    def state(self) -> State:
        """Its state, as reported last."""
        return State.NOT_READY if self.status is None else self.status.state

    @property
    def warnings(self) -> tuple[str, ...]:
        """What it reports without being in fault."""
        found = []
        if self.status is not None and self.status.statusword & StatusBit.WARNING:
            found.append("it reports a warning")
        if self.emergency is not None and self.state not in (State.FAULT, State.FAULT_REACTION):
            code = self.emergency.code
            found.append(f"emergency {code:04X}h, {emergency_name(code)}")
        return tuple(found)

    @property
    def absence(self) -> str:
        """Why it sends no process data, in words; empty if nothing is known about it."""
        if self.nmt not in _SILENT_STATES:
            return ""
        why = f": {emergency_name(self.emergency.code)}" if self.emergency else ""
        return f"it has left the operational state ({_SILENT_STATES[self.nmt]}{why})"

    @property
    def position(self) -> int:
        """Its position, as reported last [counts]; 0 before the first report."""
        return 0 if self.status is None else self.status.position

    # --- SDO -----------------------------------------------------------------------------------

    def attach(self, timeout: float, notify: Callable[[], None]) -> None:
        """Listen to the drive; call ``notify`` when it reports its status or a restart.

        An SDO transfer may take up to ``timeout`` [s].
        """
        import canopen

        self._notify = notify
        self._remote = canopen.RemoteNode(self.id, canopen.ObjectDictionary())  # type: ignore[no-untyped-call]
        self.bus.join(self._remote)
        self._remote.sdo.RESPONSE_TIMEOUT = timeout
        for cob, receive in (
            (TPDO[0] + self.id, self._receive_status),
            (TPDO[1] + self.id, self._receive_motion),
            (cia301.HEARTBEAT + self.id, self._receive_heartbeat),
            (cia301.EMERGENCY + self.id, self._receive_emergency),
        ):
            self._undo.append(self.bus.subscribe(partial(self._receive, receive), cob))
        # A broken bus, too, has to end the wait for answers.
        self._undo.append(self.bus.watch(notify))

    def detach(self) -> None:
        """Stop listening; idempotent."""
        for undo in self._undo:
            undo()
        self._undo.clear()
        if self._remote is not None:
            self.bus.network.pop(self.id, None)
            self._remote = None

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Read an object, in the worker thread.

        Raises:
            DriverError: if the drive refuses.
            BusTimeout: if the drive answers no attempt.
        """
        return bytes(self._transfer(lambda: self._remote.sdo.upload(index, subindex), index))

    def download(
        self, index: int, subindex: int, form: str, value: int, *, tries: int = _TRIES
    ) -> None:
        """Write an object with at most ``tries`` attempts, in the worker thread.

        Raises the errors of `upload`.
        """
        data = struct.pack(f"<{form}", value)
        self._transfer(lambda: self._remote.sdo.download(index, subindex, data), index, tries)

    def _transfer(self, transfer: Callable[[], Any], index: int, tries: int = _TRIES) -> Any:
        import can
        import canopen

        try:
            while True:
                tries -= 1
                try:
                    return transfer()
                except canopen.SdoCommunicationError:
                    if tries <= 0:
                        raise
                    # This is the worker thread, so sleeping does not block the event loop.
                    self.bus.counters.retries += 1
                    monotonic.sleep(_LATE)
        except canopen.SdoAbortedError as error:
            raise DriverError(
                self.name, f"node {self.id} refuses object {index:04X}h: {error}"
            ) from error
        except canopen.SdoCommunicationError as error:
            raise BusTimeout(self.bus.name, f"node {self.id}: {error}") from error
        except can.CanError as error:
            raise BusBroken(self.bus.name, f"cannot send: {error}") from error

    def number(self, index: int, subindex: int = 0, *, default: int | None = None) -> int:
        """Read an object as an unsigned integer; a missing one returns ``default``, if given."""
        try:
            return int.from_bytes(self.upload(index, subindex), "little")
        except DriverError:
            if default is None:
                raise
            return default

    def text(self, index: int) -> str:
        """Read an object as text; empty if the object is missing."""
        try:
            return self.upload(index).decode("utf-8", "replace").strip("\x00 ")
        except DriverError:
            return ""

    def set_up(
        self, mode: Mode, *, watch: tuple[int, float, int], beat: float, period: float
    ) -> None:
        """Set up heartbeats and process data of a pre-operational drive, in the worker thread.

        Args:
            mode: Mode of operation.
            watch: The host's node id, its longest silence [s], and the reaction (object 6007).
            beat: Period of the drive's heartbeat [s].
            period: Period of the SYNC [s].
        """
        host, silence, reaction = watch
        try:
            # Before anything is written, since a drive that holds an object keeps its target.
            raw = self.upload(Object.TARGET_POSITION)
            self.found_target = int.from_bytes(raw, "little", signed=True)
        except DriverError:
            self.found_target = None
        self.download(Object.PRODUCER_HEARTBEAT, 0, "H", max(1, round(beat * 1000.0)))
        # CiA 301, object 1016h: node id and time [ms] in one value; 0 stops the monitoring.
        limit = host << 16 | round(silence * 1000.0) if silence > 0.0 else 0
        self.download(Object.CONSUMER_HEARTBEAT, 1, "I", limit)
        if silence > 0.0:
            self.download(Object.ABORT_CONNECTION, 0, "h", reaction)
        self._map(0x1400, RPDO[0], Command.MAP)
        self._map(0x1401, RPDO[1], Limits.MAP)
        self._map(0x1800, TPDO[0], Status.MAP)
        self._map(0x1801, TPDO[1], Motion.MAP)
        if mode is Mode.CYCLIC_POSITION:
            # The exponent first, so that the period is in milliseconds.
            self.download(Object.INTERPOLATION_TIME, 2, "b", -3)
            self.download(Object.INTERPOLATION_TIME, 1, "B", min(max(round(period * 1e3), 1), 255))

    def _map(self, index: int, cob: int, objects: tuple[int, ...]) -> None:
        identifier = cob + self.id
        # CiA 301, section 7.5.2.36: a mapping can be changed only while the PDO is disabled and has
        # no entries.
        self.download(index, 1, "I", cia301.DISABLED | identifier)
        self.download(index + 0x200, 0, "B", 0)
        for slot, mapped in enumerate(objects, start=1):
            self.download(index + 0x200, slot, "I", mapped)
        self.download(index + 0x200, 0, "B", len(objects))
        self.download(index, 2, "B", _SYNCHRONOUS)
        self.download(index, 1, "I", identifier)

    # --- process data --------------------------------------------------------------------------

    def send_limits(self, limits: Limits) -> None:
        """Send limits if they have changed."""
        if limits != self.limits:
            self.bus.send_now(CanFrame(RPDO[1] + self.id, limits.to_bytes()))
            self.limits = limits

    def send_command(self, mode: Mode) -> None:
        """Send controlword, target and mode; in profile mode, with the set-point handshake.

        The drive accepts a set-point on the rising edge of the new-set-point bit and acknowledges
        it. The next set-point may follow once bit and acknowledgement are cleared.
        """
        word = self.controlword
        if mode is Mode.PROFILE_POSITION and self.state is State.ENABLED:
            acknowledged = bool(
                self.status is not None and self.status.statusword & codec.StatusBit.ACKNOWLEDGED
            )
            if self.pending and not acknowledged:
                word |= codec.NEW_SET_POINT | codec.CHANGE_NOW
            elif self.pending:
                self.pending = False
            elif not acknowledged and self.target != self._sent_target:
                word |= codec.NEW_SET_POINT | codec.CHANGE_NOW
                self.pending = True
                self._sent_target = self.target
        # A set-point must not change before it is acknowledged.
        target = self.target if not self.pending else self._sent_target or 0
        self.bus.send_now(CanFrame(RPDO[0] + self.id, Command(word, target, mode).to_bytes()))

    def acknowledged(self, mode: Mode) -> bool:
        """Return whether the drive has acknowledged the target; true if it need not."""
        if mode is not Mode.PROFILE_POSITION or self.state is not State.ENABLED:
            return True
        return not self.pending and self._sent_target == self.target

    def forget(self) -> None:
        """Discard the sent values, after the drive was disabled or restarted."""
        self.pending = False
        self._sent_target = None
        self.limits = None

    def assume(self, counts: int) -> None:
        """Set the target to the drive's present position or target, so that it is not sent."""
        self.target = counts
        self._sent_target = counts
        self.pending = False

    def attach_as_found(self, mode: Mode) -> None:
        """Attach to the drive in its reported state: an enabled one keeps its power and target."""
        enabled = self.state is State.ENABLED
        self.controlword = codec.Control.ENABLE if enabled else codec.Control.DISABLE_VOLTAGE
        target = self.position
        # A target is valid only in the mode in which it was set.
        if enabled and self.status is not None and self.status.mode == mode:
            target = target if self.found_target is None else self.found_target
        self.assume(target)

    # --- reports -------------------------------------------------------------------------------

    def _receive(self, receive: Callable[[CanFrame], None], frame: CanFrame) -> None:
        """Pass on a report; ignore one of a wrong length or content."""
        with contextlib.suppress(CodecError):
            receive(frame)

    def _receive_status(self, frame: CanFrame) -> None:
        self.status = Status.from_bytes(frame.data)
        self.stamp = frame.stamp or monotonic.now()
        self._notify()

    def _receive_motion(self, frame: CanFrame) -> None:
        self.motion = Motion.from_bytes(frame.data)

    def _receive_heartbeat(self, frame: CanFrame) -> None:
        self.nmt = cia301.read_heartbeat(frame.data)
        if self.nmt is NmtState.BOOT:
            self.booted = True
            self._notify()

    def _receive_emergency(self, frame: CanFrame) -> None:
        emergency = Emergency.from_bytes(frame.data)
        # Code 0 means that the error has ended.
        self.emergency = emergency if emergency.code else None
