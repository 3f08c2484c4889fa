"""Emulates an Ability Hand on the wire: stuffed frames, API mode with its timeout, touch words.

Properties set what differs between hands or is not known: fast mode, whether the hand has touch
sensors, and what it does by itself when it leaves API mode. The hand ignores frames with a wrong
checksum or for another address.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

from msgspec import Meta, structs

from rtee.buses.emulator import Duplex, Emulator
from rtee.buses.wear import TYPICAL, Wear
from rtee.drivers.ability_hand import codec
from rtee.drivers.ability_hand.control import EFFORTS, SPEEDS
from rtee.drivers.axis import Axis
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Byte, Duration, Positive, Rate
from rtee.hand.validation import Section

Share = Annotated[float, Meta(ge=0.0, le=1.0)]

_RANGES = ((0.0, 1.74),) * 5 + ((-1.74, 0.0),)
"""Ranges of the motors' joints [rad], from the maker's model."""
_IDLE = 0.02
"""Current of a motor that moves freely [A]: typical of one of this size; no source gives it."""
_CONTACT = 0.05
"""Time for which a motor must be blocked to count as a collision [s]; no source gives it."""
_ARM = 0.06
"""Distance from a digit's joint to its fingertip [m], about that of the maker's model."""
_SPREAD = (0.05, 0.35, 0.35, 0.15, 0.05, 0.05)
"""Shares of a fingertip's force on its six sensors: most on its inner side."""
_INDEX, _ROTATOR = 0, 5
"""Indices of two motors in `codec.MOTORS`; the thumb's rotator does not react to collisions."""


class AbilityProperties(Section, frozen=True):
    """Properties of the emulated hand.

    Attributes:
        start: Closure at power-up, 0 to 1.
        baudrate: Rate that its line is set to [baud].
        touch: Whether it has touch sensors.
        touch_rest: Words of the six sensors of each finger while nothing touches them.
        fast: Fast mode: a reply has the variant that the previous request selected.
        alone: What its own control does after it leaves API mode.
        after_contact: Share of a digit's effort limit that is left after a collision.
        haste: Factor by which it moves faster than a real one.
        turnaround: Time between a request and its reply [s].
    """

    address: Byte = codec.ADDRESS
    baudrate: Rate = codec.BAUDRATES[0]
    start: Share = 0.0
    touch: bool = True
    touch_rest: tuple[int, int, int, int, int, int] = (0, 0, 0, 0, 0, 0)
    fast: bool = False
    alone: Literal["hold", "open"] = "hold"
    after_contact: Share = 0.4
    haste: Positive = 1.0
    turnaround: Duration = 0.0


class AbilityHandEmulator(Emulator, Grasps):
    """The hand.

    Attributes:
        axes: Its motors: angles of the joints on the wire [rad], efforts [N·m].
        moves: Number of set-points received.
        api: Whether it is in API mode.
        limited: Whether it limits a motor.
        rest: Words of the six touch sensors of each finger while nothing touches them.
    """

    PROPERTIES = AbilityProperties
    SHARED = ("address", "turnaround", "baudrate")
    # Words of the sensors of one finger of a real hand, while nothing touches them.
    WEAR = structs.replace(TYPICAL, touch=(138, 149, 188, 811, 102, 218), touch_noise=3.0)
    FAULTS = Emulator.FAULTS | {"silent", "hot"}
    BAUDRATES = frozenset(codec.BAUDRATES)
    duplex = Duplex.FULL  # a UART, or RS-485 with a pair of wires for each direction
    period = 0.05
    """Time between two steps [s]: it leaves API mode by itself, without any traffic."""

    def __init__(self, properties: AbilityProperties | None = None) -> None:
        super().__init__()
        self.properties = made = properties or AbilityProperties()
        self.baudrate, self.turnaround = made.baudrate, made.turnaround
        self.axes = []
        motors = zip(_RANGES, SPEEDS, EFFORTS, codec.TORQUES, strict=True)
        for (low, high), speed, effort, torque in motors:
            # Open is the end at 0; the thumb's rotator closes towards negative angles.
            opened, closed = sorted((low, high), key=abs)
            # Gears of several hundred to one are self-locking.
            axis = Axis(
                opened + made.start * (closed - opened),
                lower=low,
                upper=high,
                max_velocity=speed * made.haste,
                max_effort=effort,
                friction=_IDLE * torque,
                resolution=1e-4,
                enabled=True,
                self_locking=True,
            )
            self.axes.append(axis)
        self.moves = 0
        self.api = False
        self.limited = [False] * codec.COUNT
        self._blocked = [0.0] * codec.COUNT
        self._collided = [0.0] * codec.COUNT
        self._most = list(EFFORTS)
        self.rest: tuple[int, ...] = made.touch_rest
        self._random = random.Random(1)  # noqa: S311 - noise, the same in every run
        self._variant = 1
        self._heard = -math.inf
        self.parser = codec.CommandParser()

    def wear_down(self, wear: Wear) -> None:
        """Make the hand deviate from its data sheet; touch sensors get an offset and noise."""
        super().wear_down(wear)
        self.rest = wear.touch or self.rest

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the five digits' motors."""
        return [
            # Without the rotator, which turns the thumb and closes on nothing.
            Closing(axis, low, high, effort)
            for axis, (low, high), effort in zip(self.axes[:5], _RANGES, EFFORTS, strict=False)
        ]

    def power_cycle(self, now: float) -> None:
        """Restart the hand under its own control; the fingers stay where they are."""
        self.advance(now)
        self.line_reset()
        self.api = False
        self._variant = 1
        self._stay()

    # --- time --------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        if self.api and now - self._heard > codec.API_TIME:
            self.api = False
            self._stay()
            if self.properties.alone == "open":
                for axis, (low, high) in zip(self.axes, _RANGES, strict=True):
                    axis.target = min(low, high, key=abs)
        dt = self._elapsed(now)
        for motor in range(codec.COUNT):
            self._turn(motor, dt)

    def _stay(self) -> None:
        for axis, speed in zip(self.axes, SPEEDS, strict=True):
            axis.enabled = True
            axis.target = axis.position
            axis.max_velocity = speed * self.properties.haste
        self._most = list(EFFORTS)
        self._limit()

    def _turn(self, motor: int, dt: float) -> None:
        axis = self.axes[motor]
        axis.advance(dt)
        onward = math.copysign(1.0, axis.target - axis.position)
        if axis.blocked and axis.obstacle is not None and motor != _ROTATOR:
            self._blocked[motor] += dt
            if self._blocked[motor] > _CONTACT:
                self._collided[motor] = onward
        else:
            self._blocked[motor] = 0.0
            # A collision limits only motion further that way; a command back ends it.
            if onward != self._collided[motor] or axis.target == axis.position:
                self._collided[motor] = 0.0
        self._limit()

    def _limit(self) -> None:
        for motor, axis in enumerate(self.axes):
            hot = "hot" in self.faults and motor == _INDEX
            self.limited[motor] = bool(self._collided[motor]) or hot
            share = self.properties.after_contact if self._collided[motor] else 1.0
            axis.max_effort = self._most[motor] * share * (0.5 if hot else 1.0)

    # --- the wire ----------------------------------------------------------------------------

    def answers(self, frame: codec.Command, now: float) -> Iterable[bytes]:
        """Obey a command and return the reply, if any."""
        if frame.address == self.properties.address and self._obey(frame, now):
            if "wrong_device" in self.faults:
                # A valid frame with a length that no reply of an Ability Hand has.
                yield codec.Command(0x10, codec.Header.READ).to_bytes()
            else:
                yield self.reply(self._reply_variant(frame.header)).to_bytes()

    def _reply_variant(self, header: int) -> int:
        """Return the variant of the reply to a command."""
        asked = header & 0x0F
        # The reply to a header that selects no variant has the last variant.
        known = header & 0xF0 in (*codec.SET_POINTS, codec.Header.READ) and asked < codec.NO_TOUCH
        before, self._variant = self._variant, asked + 1 if known else self._variant
        return before if self.properties.fast else self._variant

    def _obey(self, command: codec.Command, now: float) -> bool:
        """Act on a command; return whether it is answered."""
        # Reading, too, keeps the hand in API mode.
        self._heard = now
        if command.header == codec.Header.LEAVE:
            self.api = False
            self._stay()
            return False
        if command.words:
            self.api = True
            self.moves += 1
            for motor, word in enumerate(command.words):
                self._aim(motor, command.header & 0xF0, word)
            self._limit()
        return True

    def _aim(self, motor: int, kind: int, word: int) -> None:
        axis, (low, high) = self.axes[motor], _RANGES[motor]
        fastest, strongest = SPEEDS[motor] * self.properties.haste, EFFORTS[motor]
        axis.enabled = kind != codec.Header.DUTY or word != 0
        axis.max_velocity, self._most[motor] = fastest, strongest
        if kind == codec.Header.POSITION:
            axis.target = min(max(codec.angle(word), low), high)
            return
        # An axis has only position targets: a velocity or torque aims at the end of the range.
        axis.target = axis.position if word == 0 else (high if word > 0 else low)
        if kind == codec.Header.VELOCITY:
            axis.max_velocity = min(abs(codec.rate(word)) * self.properties.haste, fastest)
            return
        torque = strongest * abs(word) / codec.DUTY
        if kind == codec.Header.CURRENT:
            torque = abs(codec.effort(word, motor))
        self._most[motor] = min(torque, strongest)
        # In proportion: the largest effort moves it at the largest speed.
        axis.max_velocity = fastest * self._most[motor] / strongest

    def reply(self, variant: int) -> codec.Reply:
        """Return the measurements as a reply of a variant."""
        currents = tuple(
            round(axis.effort / codec.TORQUES[motor] * codec.AMPERE)
            for motor, axis in enumerate(self.axes)
        )
        rates = tuple(codec.velocity_counts(a.velocity, motor) for motor, a in enumerate(self.axes))
        return codec.Reply(
            variant,
            tuple(codec.angle_counts(axis.measured) for axis in self.axes),
            () if variant == codec.VELOCITIES else currents,
            () if variant == 1 else rates,
            () if variant == codec.NO_TOUCH else self._touch(),
            tuple(self.limited),
        )

    def _touch(self) -> tuple[int, ...]:
        if not self.properties.touch:
            return (0,) * codec.SENSORS
        words: list[int] = []
        for axis in self.axes[:5]:
            obstacle = axis.obstacle
            depth = (
                0.0 if obstacle is None else (axis.position - obstacle.contact) * obstacle.closing
            )
            force = 0.0 if obstacle is None else max(0.0, depth) * obstacle.stiffness / _ARM
            noise = self.wear.touch_noise
            for part, rest in zip(_SPREAD, self.rest, strict=True):
                word = codec.touch_word(force * part + codec.touch_force(rest))
                if noise:
                    word = min(max(round(self._random.gauss(word, noise)), 0), 4095)
                words.append(word)
        return tuple(words)
