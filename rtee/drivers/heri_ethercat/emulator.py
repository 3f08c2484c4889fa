"""Emulates HERI II's two boards at the level of process data and objects.

A board's torque reference limits the torque of both motors in position control; 0 means no limit.
The hand's users describe their effort command in this way; there is no manual.

The boards' EtherCAT identity, gains, auxiliary operations, pressure scale and reaction to missing
frames are not public: here they are properties or are not emulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from rtee.buses.emulator import Emulator
from rtee.buses.ethercat import Slave, SlaveState
from rtee.buses.parser import CodecError
from rtee.drivers.axis import Axis
from rtee.drivers.heri_ethercat import codec
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Positive
from rtee.hand.validation import Section

_FAULTS = {"hardware": codec.Fault.HARDWARE, "encoder": codec.Fault.ENCODER_1}
"""Faults of the first board that cut its power."""
_START = 0.3
"""Position of the motors at power-up [rad]: a little closed."""


class BoardProperties(Section, frozen=True):
    """Properties of the emulated boards.

    Attributes:
        boards: Number of boards.
        product: EtherCAT product code; that of the two-motor board is not public.
        speed: Speed of a motor [rad/s].
        current: Largest current [A].
        pressure: Raw pressure per ampere on an object.
        lower: Lower mechanical stop [rad].
        upper: Upper mechanical stop [rad].
    """

    boards: Annotated[int, Meta(ge=1, le=65_535)] = 2  # as many as EtherCAT has addresses
    product: int = 0x0013
    speed: Positive = 3.0
    current: Positive = 1.0
    pressure: float = 2000.0
    lower: float = -0.05
    upper: float = 2.6


class _Board:
    def __init__(self, made: BoardProperties) -> None:
        self.motors = [
            Axis(
                _START,
                lower=made.lower,
                upper=made.upper,
                max_velocity=made.speed,
                max_effort=made.current,
                friction=0.05 * made.current,
                resolution=1e-4,
            )
            for _ in range(codec.MOTORS)
        ]
        self.power = False
        self.mode = 0
        self.fault = 0
        self.acknowledgement = b"\x00\x00"
        self.beat = 0
        self.stamp = 0
        self.sent = b""

    def obey(self, code: int) -> bool:
        if code == codec.Order.POWER_ON:
            # A board with a fault refuses power until the fault is acknowledged.
            self.power = not self.fault
        elif code == codec.Order.POWER_OFF:
            self.power = False
        elif code in (codec.Order.DIRECT, codec.Order.POSITION):
            self.mode = code
        else:
            return False
        self.drive()
        return code != codec.Order.POWER_ON or self.power

    def drive(self) -> None:
        for motor in self.motors:
            motor.enabled = self.power and self.mode == codec.Order.POSITION

    def fail(self, fault: int) -> None:
        self.fault |= fault
        self.power = False
        self.drive()


class HeriEthercatEmulator(Emulator, Grasps):
    """The boards of one hand.

    Attributes:
        boards: The boards by position.
        state: Their EtherCAT state.
        timeout: Process data watchdog [s]; 0: off.
    """

    PROPERTIES = BoardProperties
    FAULTS = Emulator.FAULTS | {"hardware", "encoder", "hot", "hung"}

    def __init__(self, properties: BoardProperties | None = None) -> None:
        super().__init__()
        self.properties = properties or BoardProperties()
        self.boards = [_Board(self.properties) for _ in range(self.properties.boards)]
        self.axes = [motor for board in self.boards for motor in board.motors]
        self.state = SlaveState.INIT
        self.timeout = 0.0
        self._heard: float | None = None
        self._dropped = False

    def power_cycle(self, now: float) -> None:
        """Restart; the motors stay where they are."""
        self.state = SlaveState.INIT
        for board in self.boards:
            board.power = False
            board.mode = board.fault = 0
            board.drive()

    def inject(self, fault: str) -> None:
        """Inject a fault; a fault of a board affects the first board."""
        super().inject(fault)
        if fault in _FAULTS:
            self.boards[0].fail(_FAULTS[fault])
        elif fault == "hot":
            self.boards[0].fault |= codec.Fault.CURRENT_LIMITED

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of all motors."""
        made = self.properties
        return [Closing(axis, 0.0, made.upper, made.current) for axis in self.axes]

    # --- requests of a master ------------------------------------------------------------------

    def slaves(self) -> list[Slave]:
        """Return the boards as a master finds them."""
        made = self.properties
        product = 0x0042 if "wrong_device" in self.faults else made.product
        return [Slave("heri", 0, product, 1) for _ in self.boards]

    def become(self, state: SlaveState, now: float) -> bool:
        """Bring the boards into a state."""
        self.state = state
        self._dropped = False
        self._heard = now
        # Below operational the outputs have no effect, so the motors stay.
        if state < SlaveState.OPERATIONAL:
            self.halt()
        return True

    def set_watchdog(self, position: int, seconds: float) -> None:
        """Set the process data watchdog [s]."""
        self.timeout = seconds

    def cycle(self, outputs: Sequence[bytes], now: float) -> list[bytes] | None:
        """Receive outputs and return inputs; ``None`` if the boards have left their state."""
        late = self._heard is not None and self.timeout and now - self._heard > self.timeout
        if self.state is SlaveState.OPERATIONAL and late:
            self.become(SlaveState.SAFE_OPERATIONAL, now)
            # Until the master requests a state again: frames alone do not revive the boards.
            self._dropped = True
        self._heard = now
        if self._dropped or self.state < SlaveState.SAFE_OPERATIONAL:
            return None
        inputs = []
        for board, data in zip(self.boards, outputs, strict=True):
            if "hung" not in self.faults or board is not self.boards[0]:
                self._take(board, data, now)
                board.sent = self._reply(board).to_bytes()
            inputs.append(board.sent)
        return inputs

    def _take(self, board: _Board, data: bytes, now: float) -> None:
        try:
            command = codec.Command.from_bytes(data)
        except CodecError:
            return
        if self.state is SlaveState.OPERATIONAL:
            board.stamp = command.stamp
            if command.acknowledge:
                # A fault returns at once as long as its cause persists, as on the device.
                board.fault &= ~command.acknowledge
                for fault, bit in _FAULTS.items():
                    if fault in self.faults and board is self.boards[0]:
                        board.fault |= bit
            for motor, reference in zip(board.motors, command.positions, strict=True):
                motor.target = reference
                limit = command.torque / codec.TORQUE_PER_AMPERE
                largest = self.properties.current
                motor.max_effort = min(limit, largest) if limit > 0.0 else largest
        for motor in board.motors:
            motor.step(now)

    def _reply(self, board: _Board) -> codec.Reply:
        board.beat ^= codec.Fault.ALIVE
        first, second = board.motors
        return codec.Reply(
            (first.measured, second.measured),
            (first.velocity, second.velocity),
            (*self._pressures(first), *self._pressures(second)),
            (first.effort, second.effort),
            board.fault | board.beat,
            board.stamp,
        )

    def _pressures(self, motor: Axis) -> tuple[int, int, int]:
        obstacle = motor.obstacle
        if obstacle is None or motor.position <= obstacle.contact:
            return 0, 0, 0
        raw = min(round(abs(motor.effort) * self.properties.pressure), 4095)
        # The outermost phalanx has most of the contact pressure.
        return raw // 4, raw // 2, raw

    def read_object(self, position: int, index: int, subindex: int) -> bytes | None:
        """Return the value of an object; ``None`` if there is none."""
        if (index, subindex) == codec.ACKNOWLEDGE_OBJECT:
            return self.boards[position].acknowledgement
        if (index, subindex) == codec.FIRMWARE_OBJECT:
            return b"emulated"
        return None

    def write_object(self, position: int, index: int, subindex: int, data: bytes) -> bool:
        """Write an object; return whether the board accepts it."""
        if (index, subindex) != codec.COMMAND_OBJECT or len(data) != codec.ORDER_SIZE:
            return False
        board = self.boards[position]
        code = data[0] | data[1] << 8
        board.acknowledgement = codec.acknowledgement(code, board.obey(code))
        return True
