"""An emulated CANopen node: object dictionary, SDO server, NMT, heartbeats, PDOs."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

import canopen
from canopen.sdo.server import SdoServer

from rtee.buses.emulator import CanFrame
from rtee.drivers.cia402 import cia301

_RECEIVE, _TRANSMIT = 0x1400, 0x1800  # communication parameters of the first PDO
_MAP = 0x200  # distance from these to the mapping parameters of the same PDO
_COUNT = 4  # number of PDOs in each direction
_SYNCHRONOUS = 240
"""Largest transmission type of a synchronous PDO, which is applied with the next SYNC."""


@dataclass(slots=True)
class ObjectEntry:
    """One value of an object dictionary.

    Attributes:
        value: Its bytes.
        writable: Whether a host may write it.
        changed: Called with its value after a host has written it; may return an abort code.
    """

    value: bytes
    writable: bool = True
    changed: Callable[[int], cia301.AbortCode | None] | None = None


class _SdoServer(SdoServer):
    """The SDO server of a node's objects, with one answer to each request."""

    def __init__(self, node: EmulatedNode) -> None:
        super().__init__(cia301.SDO_REQUEST, cia301.SDO_ANSWER, node)  # type: ignore[no-untyped-call]
        # As after a transfer, so that a segment request without a transfer gets an answer.
        self._index = self._subindex = 0
        self._buffer = bytearray()

    def answered(self, request: bytes) -> bytes:
        """Return the answer to a request; empty if there is none."""
        self._answer = b""
        self.on_request(self.rx_cobid, request, None)  # type: ignore[no-untyped-call]
        return self._answer

    def send_response(self, response: bytes) -> None:
        """Keep the answer, which is one frame."""
        self._answer = bytes(response)


@dataclass(slots=True)
class EmulatedNode:
    """A node; the emulated drive reads and writes its `objects`.

    Attributes:
        number: Its node id.
        objects: Its dictionary by index and subindex.
        state: Its NMT state.
        on_reset: Called when it restarts.
        on_silence: Called when the host's heartbeat is missing.
        inhibited: Whether it sends nothing.
    """

    number: int
    objects: dict[tuple[int, int], ObjectEntry] = field(default_factory=dict)
    state: cia301.NmtState = cia301.NmtState.BOOT
    on_reset: Callable[[], None] = lambda: None
    on_silence: Callable[[], None] = lambda: None
    inhibited: bool = False
    object_dictionary: canopen.ObjectDictionary = field(default_factory=canopen.ObjectDictionary)
    _server: _SdoServer = field(init=False)
    _beat_at: float = 0.0
    _host_at: float | None = None
    _received: dict[int, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._server = _SdoServer(self)

    def add(self, index: int, subindex: int, form: str, value: int, **access: object) -> None:
        """Add an object with a value, packed in the struct format ``form``."""
        self.objects[index, subindex] = ObjectEntry(struct.pack(f"<{form}", value), **access)  # type: ignore[arg-type]

    def get(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        """Return a value as an integer; 0 if it does not exist."""
        entry = self.objects.get((index, subindex))
        return int.from_bytes(entry.value, "little", signed=signed) if entry else 0

    def set(self, index: int, value: int, subindex: int = 0) -> None:
        """Set a value, even if a host may not write it."""
        entry = self.objects[index, subindex]
        size = len(entry.value)
        entry.value = (value & (1 << 8 * size) - 1).to_bytes(size, "little")

    def add_pdos(self) -> None:
        """Add four receive and four transmit PDOs, all empty and disabled."""
        for n in range(_COUNT):
            for base, cob in ((_RECEIVE, cia301.RPDO[n]), (_TRANSMIT, cia301.TPDO[n])):
                mapping = base + _MAP + n
                self.add(base + n, 0, "B", 2, writable=False)
                self.add(base + n, 1, "I", cia301.DISABLED | cob + self.number)
                self.add(base + n, 2, "B", 255)
                self.add(mapping, 0, "B", 0, changed=self._check_map(mapping))
                for slot in range(1, 9):
                    self.add(mapping, slot, "I", 0, changed=self._while_empty(mapping))

    def _check_map(self, index: int) -> Callable[[int], cia301.AbortCode | None]:
        def check(count: int) -> cia301.AbortCode | None:
            size = 0
            for slot in range(1, count + 1):
                mapped = self.get(index, slot)
                if (mapped >> 16, mapped >> 8 & 0xFF) not in self.objects:
                    return cia301.AbortCode.NOT_MAPPABLE
                size += mapped & 0xFF
            return cia301.AbortCode.PDO_LENGTH if size > 8 * cia301.FULL else None

        return check

    def _while_empty(self, index: int) -> Callable[[int], cia301.AbortCode | None]:
        def check(mapped: int) -> cia301.AbortCode | None:
            # An active mapping must not change: it was checked with its count (CiA 301, 7.5.2.36).
            return cia301.AbortCode.UNSUPPORTED if self.get(index, 0) else None

        return check

    def restart_watch(self, value: int) -> cia301.AbortCode | None:
        """Watch the host from its next heartbeat on; called when a host configures the watch."""
        self._host_at = None
        return None

    # --- time and frames -----------------------------------------------------------------------

    def start(self, now: float) -> list[CanFrame]:
        """Boot into pre-operational; return the boot-up message."""
        self._server = _SdoServer(self)
        self._received.clear()
        self._host_at = None
        self.state = cia301.NmtState.PRE_OPERATIONAL
        self._beat_at = now
        self.on_reset()
        return [cia301.heartbeat(self.number, cia301.NmtState.BOOT)]

    def step(self, now: float) -> list[CanFrame]:
        """Let time pass; return the heartbeat when it is due."""
        if self.inhibited:
            return []
        watched = self.get(0x1016, 1)
        limit = (watched & 0xFFFF) / 1000.0
        # The watch begins with the first heartbeat, as CiA 301 requires.
        if self._host_at is not None and limit and now - self._host_at > limit:
            self._host_at = None
            self.on_silence()
        period = self.get(0x1017) / 1000.0
        if not period or now - self._beat_at < period:
            return []
        self._beat_at = max(self._beat_at + period, now - period)
        return [cia301.heartbeat(self.number, self.state)]

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        """Receive a frame and return the frames that the node sends at once."""
        if frame.extended or frame.remote or self.inhibited:
            return []
        if frame.id == cia301.NMT and len(frame.data) == 2:
            return self._command(frame.data, now)
        watched = self.get(0x1016, 1)
        if frame.id == cia301.HEARTBEAT + (watched >> 16 & 0x7F) and watched & 0xFFFF:
            self._host_at = now
        if (
            frame.id == cia301.SDO_REQUEST + self.number
            and self.state is not cia301.NmtState.STOPPED
        ):
            answer = self._server.answered(frame.data) if len(frame.data) == cia301.FULL else b""
            return [CanFrame(cia301.SDO_ANSWER + self.number, answer)] if answer else []
        if self.state is cia301.NmtState.OPERATIONAL:
            self._receive(frame)
        return []

    def _command(self, data: bytes, now: float) -> list[CanFrame]:
        if data[1] not in (0, self.number):
            return []
        match data[0]:
            case cia301.NmtCommand.START:
                self.state = cia301.NmtState.OPERATIONAL
            case cia301.NmtCommand.STOP:
                self.state = cia301.NmtState.STOPPED
            case cia301.NmtCommand.PRE_OPERATIONAL:
                self.state = cia301.NmtState.PRE_OPERATIONAL
            case cia301.NmtCommand.RESET_NODE | cia301.NmtCommand.RESET_COMMUNICATION:
                return self.start(now)
        return []

    # --- SDO -----------------------------------------------------------------------------------

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """Return the bytes of a value for the SDO server; raises `SdoAbortedError`."""
        return self._entry(index, subindex).value

    def set_data(
        self, index: int, subindex: int, data: bytes, check_writable: bool = False
    ) -> None:
        """Set a value for the SDO server; raises `SdoAbortedError`."""
        entry = self._entry(index, subindex)
        if not entry.writable:
            raise canopen.SdoAbortedError(cia301.AbortCode.READ_ONLY)
        if len(data) != len(entry.value):
            raise canopen.SdoAbortedError(cia301.AbortCode.LENGTH)
        before, entry.value = entry.value, bytes(data)
        refused = entry.changed(int.from_bytes(data, "little")) if entry.changed else None
        if refused is not None:
            entry.value = before
            raise canopen.SdoAbortedError(refused)

    def _entry(self, index: int, subindex: int) -> ObjectEntry:
        if (index, subindex) in self.objects:
            return self.objects[index, subindex]
        known = any(index == known for known, _ in self.objects)
        raise canopen.SdoAbortedError(
            cia301.AbortCode.NO_SUBINDEX if known else cia301.AbortCode.NO_OBJECT
        )

    # --- PDO -----------------------------------------------------------------------------------

    def _receive(self, frame: CanFrame) -> None:
        for n in range(_COUNT):
            cob = self.get(_RECEIVE + n, 1)
            if not cob & cia301.DISABLED and cob & 0x7FF == frame.id:
                if self.get(_RECEIVE + n, 2) <= _SYNCHRONOUS:
                    self._received[n] = frame.data
                else:
                    self._unpack(n, frame.data)

    def sync(self) -> None:
        """Apply the synchronous receive PDOs."""
        if self.state is cia301.NmtState.OPERATIONAL:
            for n, data in sorted(self._received.items()):
                self._unpack(n, data)
        self._received.clear()

    def _unpack(self, n: int, data: bytes) -> None:
        at, taken = 0, []
        for slot in range(1, self.get(_RECEIVE + _MAP + n, 0) + 1):
            mapped = self.get(_RECEIVE + _MAP + n, slot)
            size = (mapped & 0xFF) // 8
            entry = self.objects.get((mapped >> 16, mapped >> 8 & 0xFF))
            if entry is not None and at + size <= len(data):
                entry.value = data[at : at + size]
                taken.append(entry)
            at += size
        # After all values are set, since a controlword acts on the target of the same PDO.
        for entry in taken:
            if entry.changed is not None:
                entry.changed(int.from_bytes(entry.value, "little"))

    def transmit(self) -> list[CanFrame]:
        """Return the synchronous transmit PDOs that follow a SYNC."""
        if self.state is not cia301.NmtState.OPERATIONAL or self.inhibited:
            return []
        frames = []
        for n in range(_COUNT):
            cob = self.get(_TRANSMIT + n, 1)
            count = self.get(_TRANSMIT + _MAP + n, 0)
            if cob & cia301.DISABLED or not count or self.get(_TRANSMIT + n, 2) > _SYNCHRONOUS:
                continue
            data = b""
            for slot in range(1, count + 1):
                mapped = self.get(_TRANSMIT + _MAP + n, slot)
                data += self.objects[mapped >> 16, mapped >> 8 & 0xFF].value
            frames.append(CanFrame(cob & 0x7FF, data))
        return frames
