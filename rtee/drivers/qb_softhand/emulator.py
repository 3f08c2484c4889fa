"""Emulates a qb SoftHand on the wire.

Behaviour that differs between generations of firmware, or is not known, is a property here: the
form of acknowledgements and long packets, the watchdog, the answer to GET_ACTIVATE.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from operator import xor
from typing import Annotated, Literal

from msgspec import Meta

from rtee.buses.emulator import Emulator
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Byte, Duration, Positive
from rtee.drivers.qb_softhand import codec
from rtee.hand.validation import Section

_LOWEST = -4_000
"""Lower limit of the motors of a two-motor hand [ticks]."""
_CURRENT_LIMIT = 1500.0
"""Current limit of a motor [mA], the setting from the factory."""
_FRICTION, _GAIN = 120.0, 0.25
"""Current of a motor that moves freely [mA], and per position error [mA/tick]; no document gives
them."""
_RATES = {13: 460_800}
"""Rates by the parameter of SET_BAUDRATE [baud]; other parameters set the factory's rate."""
_PUSHING = (1, 2)
"""Control modes in which references are voltages and currents."""
_TEXT_REQUEST = b"?\r\n"  # requests the information text without a frame


class QbOptions(Section, frozen=True):
    """Properties of the emulated hand.

    Attributes:
        device: Its number on the line.
        motors: 1 (SoftHand) or 2 (SoftHand 2).
        generation: Form of acknowledgements and long packets.
        limit: Upper limit of a motor [ticks]; the lower one is 0, or -4000 with two motors.
        activation_mask: Whether GET_ACTIVATE returns the true mask with one motor, too, as in some
            firmware; otherwise 3 or 0, as the vendor's library expects.
        watchdog: Whether SET_WATCHDOG is implemented: silence deactivates the motors.
        input_mode: Stored source of its references; 0: the host.
        control_mode: Stored meaning of its references; 0: positions.
        startup_active: Whether the motors are active after power-up, as from the factory.
        boot_time: Silence after power-up [s].
        speed: Speed of a motor [ticks/s].
        turnaround: Time between a request and its answer [s], mostly a USB adapter's latency.
        text: The information text that it reports.
    """

    device: Byte = 1
    motors: Literal[1, 2] = 1
    generation: Literal["legacy", "modern"] = "legacy"
    limit: int = 19_000
    activation_mask: bool = False
    watchdog: bool = False
    input_mode: Annotated[int, Meta(ge=0, le=6)] = 0
    control_mode: Annotated[int, Meta(ge=0, le=3)] = 0
    startup_active: bool = True
    boot_time: Duration = 0.0
    speed: Positive = 25_000.0
    turnaround: Duration = codec.TURNAROUND
    text: str = "Firmware: SoftHand (emulated)\r\nMotor control: position\r\n"

    @property
    def lower(self) -> int:
        """Lower limit of a motor [ticks]."""
        return _LOWEST if self.motors == 2 else 0

    @property
    def upper(self) -> int:
        """Upper limit of a motor [ticks]."""
        return self.limit - self.lower


class QbSoftHandEmulator(Emulator, Grasps):
    """The hand: one or two motors with encoders in ticks.

    Attributes:
        options: Its properties.
        axes: Its motors.
        baudrate: Rate that the line is set to [baud].
        watchdog: Period of the watchdog [s]; 0: off.
        frames: Number of frames received, by command.
    """

    PROPERTIES = QbOptions
    SHARED = ("device", "motors", "turnaround")
    FAULTS = Emulator.FAULTS | {"silent", "low_supply"}
    BAUDRATES = frozenset(codec.BAUDRATES)

    def __init__(self, options: QbOptions | None = None) -> None:
        super().__init__()
        self.options = options or QbOptions()
        made = self.options
        self.turnaround = made.turnaround
        self.axes = [
            Axis(
                lower=made.lower,
                upper=made.upper,
                max_velocity=made.speed,
                max_effort=_CURRENT_LIMIT,
                gain=_GAIN,
                friction=_FRICTION,
                resolution=0.5,
            )
            for _ in range(made.motors)
        ]
        self.frames: dict[int, int] = {}
        self._accelerations = [0.0] * made.motors
        self.power_cycle(0.0)

    def power_cycle(self, now: float) -> None:
        """Restart; the fingers stay where they are."""
        self.parser = codec.Parser()
        self._boot = now
        self._heard = now
        self.baudrate = codec.BAUDRATE
        self.watchdog = 0.0
        self._references = [0.0, 0.0]
        self._text = bytearray()
        # First off, since only a motor that becomes active makes its position the reference.
        self._activate(0)
        self._activate(0x03 if self.options.startup_active else 0)

    def on_faults(self) -> None:
        """Apply the faults: a stuck motor is blocked, and a low supply deactivates all motors."""
        if "low_supply" in self.faults:
            self._activate(0)
        super().on_faults()

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the motors."""
        made = self.options
        return [Closing(axis, 0.0, made.limit, _CURRENT_LIMIT) for axis in self.axes]

    def _activate(self, mask: int) -> None:
        for index, axis in enumerate(self.axes):
            active = bool(mask >> index & 1) and "low_supply" not in self.faults
            if active and not axis.enabled:
                # On activation the firmware makes the present position the reference: no jump.
                axis.target = axis.position
                self._references[index] = axis.position
            axis.enabled = active

    @property
    def active(self) -> int:
        """Mask of the active motors."""
        return sum(axis.enabled << index for index, axis in enumerate(self.axes))

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        passed = self._elapsed(now)
        for index, axis in enumerate(self.axes):
            before = axis.velocity
            axis.advance(passed)
            if passed > 0.0:
                self._accelerations[index] = (axis.velocity - before) / passed
        if self.watchdog and now - self._heard > self.watchdog:
            self._activate(0)

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive bytes from the host and return the hand's replies."""
        replies = super().feed(data, now)
        # The request has no frame and may come in pieces, so the last bytes are kept.
        self._text = (self._text + data)[-len(_TEXT_REQUEST) :]
        if self._text.endswith(_TEXT_REQUEST) and "silent" not in self.faults:
            replies.append(self.options.text.encode("ascii"))
        return [] if now - self._boot < self.options.boot_time else replies

    def answers(self, frame: codec.Frame, now: float) -> Iterable[bytes]:
        """Obey a frame and return the reply, if any."""
        if frame.device in {self._number, codec.BROADCAST}:
            self._heard = now
            self.frames[frame.command] = self.frames.get(frame.command, 0) + 1
            if (reply := self._answer(frame)) is not None:
                yield reply

    @property
    def _number(self) -> int:
        return self.options.device ^ (0x40 if "wrong_device" in self.faults else 0)

    def _reply(self, command: int, data: bytes = b"") -> bytes:
        return codec.Frame(self._number, command, data).to_bytes()

    def _acknowledge(self, command: int) -> bytes:
        legacy = self.options.generation == "legacy"
        return self._reply(1) if legacy else self._reply(command, b"\x01")

    def _answer(self, frame: codec.Frame) -> bytes | None:
        """Return the reply to a frame; ``None`` for a command without an acknowledgement."""
        values = self._query(frame.command)
        if values is not None:
            return self._reply(frame.command, values)
        if frame.command == codec.Command.GET_INFO:
            return self._long(frame.command, self.options.text.encode("ascii"))
        if frame.command == codec.Command.GET_PARAM_LIST and frame.data == b"\x00\x00":
            return self._long(frame.command, self._parameters())
        return self._obey(frame.command, frame.data)

    def _query(self, command: int) -> bytes | None:
        """Return the data of the answer to a short query; ``None``: not a query."""
        currents = [self.axes[0].effort, self.axes[1].effort if len(self.axes) == 2 else 0.0]
        positions = self._by_encoder([axis.measured for axis in self.axes])
        match command:
            case codec.Command.PING:
                return b""
            case codec.Command.GET_ACTIVATE:
                true_mask = self.options.activation_mask or len(self.axes) > 1
                # Older firmware reports both bits although there is one motor.
                return bytes([self.active if true_mask else 3 * self.active])
            case codec.Command.GET_INPUTS:
                return codec.pack_int16(*self._references)
            case codec.Command.GET_MEASUREMENTS:
                return codec.pack_int16(*positions)
            case codec.Command.GET_CURRENTS:
                return codec.pack_int16(*currents)
            case codec.Command.GET_CURR_AND_MEAS:
                return codec.pack_int16(*currents, *positions)
            case codec.Command.GET_VELOCITIES:
                return codec.pack_int16(*self._by_encoder([axis.velocity for axis in self.axes]))
            case codec.Command.GET_ACCELERATIONS:
                return codec.pack_int16(*self._by_encoder(self._accelerations))
        return None

    def _obey(self, command: int, data: bytes) -> bytes | None:
        """Carry out a command; return its acknowledgement, ``None`` if it has none."""
        match command:
            case codec.Command.ACTIVATE if data:
                self._activate(data[0])
            case codec.Command.SET_INPUTS if len(data) == 4:
                self._inputs(data)
            case codec.Command.SET_WATCHDOG if data and self.options.watchdog:
                self.watchdog = codec.watchdog_seconds(data[0])
            case codec.Command.SET_BAUDRATE if data:
                self.baudrate = _RATES.get(data[0], codec.BAUDRATE)
            case (
                codec.Command.STORE_PARAMS | codec.Command.SET_ZEROS | codec.Command.GET_PARAM_LIST
            ):
                return self._acknowledge(command)
        return None

    def _inputs(self, data: bytes) -> None:
        self._references = [float(v) for v in codec.read_int16(data)]
        made = self.options
        if made.input_mode:
            return  # another source has the motors
        if made.control_mode in _PUSHING:
            # A voltage or a current drives a motor to the end of its travel.
            for axis, push in zip(self.axes, self._references, strict=False):
                end = axis.upper if push > 0.0 else axis.lower
                axis.target = end if push else axis.position
            return
        # A command always has two references; a hand with one motor ignores the second.
        for axis, reference in zip(self.axes, self._references, strict=False):
            axis.target = min(max(reference, axis.lower), axis.upper)

    @staticmethod
    def _by_encoder(values: Sequence[float]) -> list[float]:
        """Return the motors' values in the order of the encoders."""
        # Three encoders with one motor and four with two, as the firmware reports them.
        if len(values) == 1:
            return [values[0], 0.0, 0.0]
        first, second = values
        return [first, first, second, second]

    def _parameters(self) -> bytes:
        made = self.options
        travel = (made.lower, made.upper) * made.motors
        known = {
            1: codec.Parameter(2, (made.device,), "1 - Device ID:"),
            4: codec.Parameter(0, (int(made.startup_active),), "4 - Startup Activation:"),
            5: codec.Parameter(2, (made.input_mode,), "5 - Input mode:"),
            6: codec.Parameter(2, (made.control_mode,), "6 - Control mode:"),
            7: codec.Parameter(2, (3, 3, 3), "7 - Resolutions:"),
            10: codec.Parameter(0, (1,), "10 - Pos. limits active:"),
            11: codec.Parameter(5, travel, "11 - Pos. limits [tick]:"),
            13: codec.Parameter(3, (_CURRENT_LIMIT,), "13 - Current limit [mA]:"),
        }
        slots = [
            known.get(i, codec.Parameter(2, (0,), f"{i} - (not emulated)")) for i in range(1, 14)
        ]
        return bytes([len(slots)]) + b"".join(slot.to_bytes().ljust(codec.SLOT) for slot in slots)

    def _long(self, command: int, data: bytes) -> bytes:
        body = bytes([command]) + data
        if self.options.generation == "modern":
            # The length byte counts blocks of 32 bytes, so the packet is padded to one.
            body += b"\x00" * (-(len(body) + 1) % 32)
            length = (len(body) + 1) // 32
        else:
            # Longer than a byte can hold; the real hand truncates it in the same way.
            length = (len(body) + 1) & 0xFF
        return codec.HEADER + bytes([self._number, length]) + body + bytes([reduce(xor, body)])
