"""Emulates a line of Feetech servos, all of one family.

A property sets what sources leave open: whether servos answer a sync read in families for which
that is not known. Families that answer a sync read answer a broadcast ping in turn; the answers of
others collide: a bit is 0 if any servo sends a 0.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from msgspec import Meta, field

from rtee.buses.emulator import Emulator
from rtee.drivers.feetech import table
from rtee.drivers.feetech.codec import BROADCAST, Frame, Instruction, RequestParser, Status
from rtee.drivers.feetech.options import Differential, DifferentialOptions
from rtee.drivers.feetech.servo import MIDDLE, EmulatedFeetech, FeetechServoProperties
from rtee.drivers.feetech.table import FAMILIES, FamilyName
from rtee.drivers.options import Duration, Rate
from rtee.drivers.servo_emulator import ServoLine
from rtee.drivers.servo_lines import LATENCY, ServoScale
from rtee.hand.validation import Section, validated

_ERRORS = {str(error.name).lower(): error for error in Status}
_READS = (Instruction.PING, Instruction.READ)
"""Instructions that servos answer at any response level."""


class FeetechProperties(Section, frozen=True):
    """Properties of an emulated line of servos.

    Attributes:
        servo: Properties of all servos.
        special: Properties of individual servos, by id.
        latency: Latency of the adapter per answer [s].
        sync_read: Whether they answer a sync read; ``None``: as known of their family.
        baudrate: Rate of the line [baud].
    """

    family: FamilyName = "sts"
    ids: tuple[Annotated[int, Meta(ge=0, le=253)], ...] = (1,)
    servo: FeetechServoProperties = field(default_factory=FeetechServoProperties)
    special: dict[int, FeetechServoProperties] = field(default_factory=dict)
    latency: Duration = LATENCY
    sync_read: bool | None = None
    baudrate: Rate = table.BAUD_RATES[0]


class FeetechEmulator(ServoLine[EmulatedFeetech]):
    """Feetech servos on one line.

    Attributes:
        properties: Properties of the line.
        family: The servos' family.
    """

    PROPERTIES = FeetechProperties
    SHARED = ("family", "baudrate")
    ERRORS = _ERRORS
    FAULTS = Emulator.FAULTS | frozenset(_ERRORS) | {"silent"}
    RATES = table.BAUD_RATES
    BAUDRATES = frozenset(RATES)
    STRANGER = 0x0101

    def __init__(self, properties: FeetechProperties | None = None) -> None:
        made = self.properties = properties or FeetechProperties()
        family = self.family = FAMILIES[made.family]
        servos = [EmulatedFeetech(family, i, made.special.get(i, made.servo)) for i in made.ids]
        super().__init__(servos, RequestParser())
        self.baudrate = made.baudrate

    @classmethod
    def _places(cls, options: Mapping[str, Any]) -> dict[int, dict[str, Any]]:
        family = FAMILIES[options.get("family", "sts")]
        angles: dict[str, tuple[float, float]] = {}
        if options.get("differential"):
            pairing = validated(DifferentialOptions, options["differential"])
            differential = Differential(pairing)
            bent = max(pairing.flexion[-1][1], pairing.flexion[0][1])
            for pair in pairing.pairs.values():
                opened, closed = differential.servos(0.0, 0.0), differential.servos(bent, 0.0)
                for name, start, end in zip(pair.servos, opened, closed, strict=True):
                    angles[name] = start, end
        places = {}
        for name, servo in options["servos"].items():
            given = dict(servo)
            zero = given.get("zero")
            scale = ServoScale(
                family.rad_per_count,
                float(family.center if zero is None else zero),
                given.get("direction", 1),
                given.get("gear", 1.0),
            )
            # A quarter turn of the joint, unless the differential gives the travel.
            start, end = angles.get(name, (0.0, 1.57 / scale.gear))
            first, last = scale.to_counts(start), scale.to_counts(end)
            places[given["id"]] = {"start": float(first), "closing": float(last - first)}
        return places

    # --- the line ----------------------------------------------------------------------------

    def answers(self, frame: Frame, now: float) -> list[bytes]:
        """Let the servos carry out a request; return their answers."""
        params = frame.params
        if frame.code == Instruction.SYNC_WRITE and len(params) > 2:
            self.write_each(params[0], params[1], params[2:], now)
            return []
        if frame.code == Instruction.SYNC_READ and len(params) > 2:
            knows = self.properties.sync_read
            if not (self.family.sync_read if knows is None else knows):
                return []
            # Each servo answers in turn; a missing servo leaves a gap.
            found = self.listening(params[2:], now)
            replies = [
                Frame(servo.number, servo.status, servo.read(*params[:2]) or b"").to_bytes()
                for servo in found
            ]
            return self.delayed(replies, found)
        everybody = frame.device == BROADCAST
        found = self.listening(sorted(self.servos) if everybody else [frame.device], now)
        replies = []
        for servo in found:
            number = servo.number
            answer = self._single(servo, frame, now)
            if answer is None:
                continue
            if frame.code in _READS or servo.get(table.RESPONSE_LEVEL):
                # The answer has the id of the request, even if the request has changed the id.
                replies.append(Frame(number, servo.status, answer).to_bytes())
        if everybody and frame.code != Instruction.PING:
            return []
        # Families that answer a sync read in turn do so here, too; the answers of others collide.
        collide = len(replies) > 1 and not self.family.sync_read
        return self.delayed([_collided(replies)] if collide else replies, found)

    def _single(self, servo: EmulatedFeetech, request: Frame, now: float) -> bytes | None:
        """Let a servo carry out a request; return its answer's data, ``None`` if it has none."""
        params = request.params
        match request.code:
            case Instruction.READ if len(params) == 2:
                return servo.read(params[0], params[1]) or b""
            case Instruction.WRITE if len(params) > 1:
                servo.write(params[0], params[1:])
            case Instruction.REG_WRITE if len(params) > 1:
                servo.hold_back(params[0], params[1:])
            case Instruction.ACTION:
                servo.action()
            case Instruction.RESTORE:
                servo.memory.restore()
            case Instruction.REBOOT:
                servo.reboot(now)
                return None
            case Instruction.CALIBRATE if len(params) in (0, 2):
                where = int.from_bytes(params, self.family.order) if params else MIDDLE
                servo.make_present(where)
            # A position has two bytes; the meaning of other lengths is not known.
            case Instruction.PING | Instruction.BACK_UP | Instruction.RESET | Instruction.CALIBRATE:
                pass
            case _:
                return None
        return b""


def _collided(answers: Sequence[bytes]) -> bytes:
    """Return the bytes on the wire when several servos send at once."""
    # 0xFF: a servo that has finished leaves the line idle, which is high.
    columns = itertools.zip_longest(*answers, fillvalue=0xFF)
    return bytes(functools.reduce(operator.and_, column) for column in columns)
