"""Emulates a line of X-series servos."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

from msgspec import Meta, field

from rtee.buses.emulator import Emulator
from rtee.drivers.dynamixel import codec, table
from rtee.drivers.dynamixel.servo import QUARTER_TURN, DynamixelServoProperties, EmulatedDynamixel
from rtee.drivers.options import Rate
from rtee.drivers.servo_emulator import ServoLine
from rtee.drivers.servo_lines import LATENCY
from rtee.hand.validation import Section

_SPAN = 4
"""Size of address and length, with which the parameters of most instructions begin [byte]."""
_ALWAYS = 2
"""Status return level at which a servo answers every instruction (address 68)."""
_CLEAR_TURNS = b"\x01DXL\x22"  # the only parameters with which Clear is accepted
_LEVELS = {int(codec.Instruction.PING): 0, int(codec.Instruction.READ): 1}
"""Status return level from which an instruction is answered; 2 for all other instructions."""
_READ = int(codec.Instruction.READ)
_HARDWARE = {
    "voltage": codec.Hardware.INPUT_VOLTAGE,
    "overheating": codec.Hardware.OVERHEATING,
    "encoder": codec.Hardware.ENCODER,
    "shock": codec.Hardware.ELECTRICAL_SHOCK,
    "overload": codec.Hardware.OVERLOAD,
}


class DynamixelProperties(Section, frozen=True):
    """Properties of an emulated line of servos.

    Attributes:
        ids: Ids of its servos.
        servo: Properties of all servos.
        special: Properties of individual servos, by id.
        latency: Latency of the adapter per answer [s]; 1 ms or 16 ms with an FTDI chip.
        fast: Whether they support the fast reads.
        baudrate: Rate of the line [baud].
    """

    ids: tuple[Annotated[int, Meta(ge=0, le=252)], ...] = (1,)
    servo: DynamixelServoProperties = field(default_factory=DynamixelServoProperties)
    special: dict[int, DynamixelServoProperties] = field(default_factory=dict)
    latency: float = LATENCY
    fast: bool = True
    baudrate: Rate = 57_600


class DynamixelEmulator(ServoLine[EmulatedDynamixel]):
    """X-series servos on one line.

    Attributes:
        properties: Properties of the line.
        counts: Number of received instructions, by instruction.
    """

    PROPERTIES = DynamixelProperties
    ERRORS = _HARDWARE
    FAULTS = Emulator.FAULTS | frozenset(_HARDWARE) | {"silent"}
    RATES = table.BAUD_RATES
    BAUDRATES = frozenset(RATES)
    STRANGER = 350  # an XL-320, which has another control table
    parser: codec.InstructionParser

    def __init__(self, properties: DynamixelProperties | None = None) -> None:
        made = self.properties = properties or DynamixelProperties()
        servos = [EmulatedDynamixel(i, made.special.get(i, made.servo)) for i in made.ids]
        super().__init__(servos, codec.InstructionParser())
        self.baudrate = made.baudrate
        self.counts: dict[int, int] = {}

    @classmethod
    def _places(cls, options: Mapping[str, Any]) -> dict[int, dict[str, Any]]:
        return {
            servo["id"]: {
                "start": servo.get("zero", table.CENTER),
                "closing": servo.get("direction", 1) * QUARTER_TURN,
            }
            for servo in map(dict, options["servos"].values())
        }

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive bytes from the host and return the answers."""
        return super().feed(data, now) + self._crc_errors(now)

    def _crc_errors(self, now: float) -> list[bytes]:
        """Return the answers of servos to damaged instructions that are addressed to them."""
        damaged, self.parser.damaged = self.parser.damaged, []
        if "silent" in self.faults:
            return []
        answers = []
        for number, instruction in damaged:
            for servo in self.listening([number], now):
                level = servo.get(table.STATUS_RETURN_LEVEL)
                if level >= _LEVELS.get(instruction, 2):
                    answers += self.delayed(
                        [self._status(servo, codec.Error.CRC).to_bytes()], [servo]
                    )
        return answers

    def answers(self, frame: codec.InstructionPacket, now: float) -> list[bytes]:
        """Let the servos carry out an instruction; return their answers."""
        self.counts[frame.instruction] = self.counts.get(frame.instruction, 0) + 1
        for servo in self.ordered:
            # Every instruction on the line resets the bus watchdogs of all servos.
            servo.heard(now)
        params = frame.params
        match frame.instruction:
            case codec.Instruction.SYNC_READ | codec.Instruction.FAST_SYNC_READ if (
                len(params) >= _SPAN
            ):
                address, length = struct.unpack_from("<HH", params)
                wanted = [(n, address, length) for n in params[_SPAN:]]
                fast = frame.instruction == codec.Instruction.FAST_SYNC_READ
                return self._read_many(wanted, fast, now)
            case codec.Instruction.BULK_READ | codec.Instruction.FAST_BULK_READ:
                # A truncated request may end within an entry.
                wanted = list(struct.iter_unpack("<BHH", params[: len(params) // 5 * 5]))
                fast = frame.instruction == codec.Instruction.FAST_BULK_READ
                return self._read_many(wanted, fast, now)
            case codec.Instruction.SYNC_WRITE if len(params) >= _SPAN:
                address, length = struct.unpack_from("<HH", params)
                self.write_each(address, length, params[_SPAN:], now)
                return []
            case codec.Instruction.BULK_WRITE:
                self._bulk_write(params, now)
                return []
        everybody = frame.device == codec.BROADCAST
        found = self.listening(sorted(self.servos) if everybody else [frame.device], now)
        answers = []
        for servo in found:
            number = servo.number
            answer = self._single(servo, frame, now)
            if answer is not None:
                # The answer has the id of the request, even if the packet has changed the id.
                answers.append(replace(answer, device=number).to_bytes())
        # All servos carry out a broadcast, but none answers it, except for a ping.
        if everybody and frame.instruction != codec.Instruction.PING:
            return []
        return self.delayed(answers, found)

    def _bulk_write(self, params: bytes, now: float) -> None:
        at = 0
        while at + 5 <= len(params):
            number, address, length = struct.unpack_from("<BHH", params, at)
            for servo in self.listening([number], now):
                servo.write(address, params[at + 5 : at + 5 + length])
            at += 5 + length

    def _status(
        self, servo: EmulatedDynamixel, error: int, params: bytes = b""
    ) -> codec.StatusPacket:
        return codec.StatusPacket(servo.number, error | (codec.ALERT if servo.alert else 0), params)

    def _single(
        self, servo: EmulatedDynamixel, packet: codec.InstructionPacket, now: float
    ) -> codec.StatusPacket | None:
        params = packet.params
        level = servo.get(table.STATUS_RETURN_LEVEL)
        match packet.instruction:
            case codec.Instruction.PING:
                reply = servo.read(0, 7) or bytes(7)
                return self._status(servo, 0, reply[0:2] + reply[6:7])
            case codec.Instruction.READ if len(params) < _SPAN:
                error = codec.Error.DATA_LENGTH
            case codec.Instruction.WRITE | codec.Instruction.REG_WRITE if len(params) < 3:
                error = codec.Error.DATA_LENGTH
            case codec.Instruction.READ:
                address, length = struct.unpack_from("<HH", params)
                data = servo.read(address, length)
                error = codec.Error.NONE if data is not None else codec.Error.DATA_RANGE
                return self._status(servo, error, data or b"") if level >= 1 else None
            case codec.Instruction.WRITE:
                error = servo.write(params[0] | params[1] << 8, params[2:])
            case codec.Instruction.REG_WRITE:
                servo.hold_back(params[0] | params[1] << 8, params[2:])
                error = codec.Error.NONE
            case codec.Instruction.ACTION:
                servo.action()
                error = codec.Error.NONE
            case codec.Instruction.REBOOT:
                # It answers before the reboot, after which it is silent for a while.
                answer = self._status(servo, 0)
                servo.reboot(now)
                return answer if level >= _ALWAYS else None
            case codec.Instruction.FACTORY_RESET if len(params) == 1:
                answer = self._status(servo, 0)
                servo.factory_reset(now, params[0])
                return answer if level >= _ALWAYS else None
            case codec.Instruction.CLEAR if params == _CLEAR_TURNS:
                servo.clear_turns()
                error = codec.Error.NONE
            case _:
                error = codec.Error.INSTRUCTION
        return self._status(servo, error) if level >= _ALWAYS else None

    def _read_many(self, wanted: list[tuple[int, int, int]], fast: bool, now: float) -> list[bytes]:
        answers, servos = [], []
        for number, address, length in wanted:
            # Each servo waits for the previous answer, so a missing servo silences the rest.
            found = self.listening([number], now)
            if not found or found[0].get(table.STATUS_RETURN_LEVEL) < _LEVELS[_READ]:
                break
            servos += found
            data = found[0].read(address, length)
            error = codec.Error.NONE if data is not None else codec.Error.DATA_RANGE
            answers.append(self._status(found[0], error, data or bytes(length)))
        if fast:
            if not self.properties.fast or not answers:
                return []
            packet = codec.fast_status(answers, [length for _, _, length in wanted])
            return self.delayed([packet], servos)
        return self.delayed([a.to_bytes() for a in answers], servos)
