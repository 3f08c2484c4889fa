"""One emulated CiA 402 drive: its objects, its states, its motor.

How a real drive reacts to a lost heartbeat, a halt or a fault depends on its make. Here object 6007
selects the reaction to a lost heartbeat; a halt holds the position, and a fault disables the motor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from rtee.buses.emulator import CanFrame
from rtee.drivers.axis import Axis
from rtee.drivers.cia402 import cia301, codec
from rtee.drivers.cia402.cia301 import AbortCode, Emergency, NmtState
from rtee.drivers.cia402.codec import Object
from rtee.drivers.cia402.node import EmulatedNode, ObjectEntry
from rtee.drivers.options import Positive
from rtee.hand.validation import Section

Method = Literal[1, 2, 17, 18, 33, 34, 35, 37]
METHODS: tuple[Method, ...] = (1, 2, 17, 18, 33, 34, 35, 37)
"""Emulated homing methods (object 6098h)."""


# The next state, by the present state and the low four bits of the controlword.
_TRANSITIONS = {
    (codec.State.SWITCH_ON_DISABLED, 0x06): codec.State.READY,
    (codec.State.READY, 0x07): codec.State.SWITCHED_ON,
    (codec.State.READY, 0x0F): codec.State.ENABLED,
    (codec.State.SWITCHED_ON, 0x0F): codec.State.ENABLED,
    (codec.State.SWITCHED_ON, 0x06): codec.State.READY,
    (codec.State.ENABLED, 0x07): codec.State.SWITCHED_ON,
    (codec.State.ENABLED, 0x06): codec.State.READY,
}

_POWERED = (codec.StatusBit.VOLTAGE | codec.StatusBit.REMOTE).value
_REACHED = codec.StatusBit.REACHED.value
_ACKNOWLEDGED = codec.StatusBit.ACKNOWLEDGED.value
_HOMING_ERROR = codec.StatusBit.HOMING_ERROR.value
"""Bits of the statusword as integers: flags take long to combine, and it is made in each step."""
_LOST_HOST = 0x8130
"""Error code of a missing host heartbeat."""
_VENDOR = 0xFF
"""Vendor id; arbitrary."""
_RATED_CURRENT = 1000
"""Rated current [mA]; arbitrary."""
RATED = 1000.0
"""The rated torque in the drives' unit of torque [0.1 %]."""


@dataclass(frozen=True, slots=True)
class HomingLeg:
    """A part of a homing motion: its end [counts of the axis] and its speed [counts/s]."""

    end: float
    speed: float


class DriveProperties(Section, frozen=True):
    """Properties of the emulated drives.

    Attributes:
        nodes: Their node ids.
        device_type: Profile they report; 402 is that of drives.
        product: Product code.
        name: Device name.
        modes: Supported modes of operation, by number.
        increments: Encoder increments per motor turn.
        rated_torque: Rated torque [mN·m].
        start: Position at power-up [counts].
        lower: Lower mechanical stop [counts].
        upper: Upper mechanical stop [counts].
        switches: Positions of the negative and the positive limit switch [counts], inside the
            stops; they have an effect only on homing.
        speed: Largest speed [counts/s].
        closed: Position with closed fingers, which are open at 0, for objects [counts].
        homed: Whether it knows its position at power-up.
        homing_methods: Supported homing methods (object 6098h); any other is a homing error.
        sampled: Whether the answer to a SYNC reports the state ``before`` the drive applies the
            set-points of that SYNC, or ``after``.
    """

    nodes: tuple[int, ...] = (1,)
    device_type: int = 402
    product: int = 0x00000402
    name: str = "emulated CiA 402 drive"
    modes: tuple[int, ...] = (1, 6, 8)
    increments: int = 4096
    rated_torque: int = 500
    start: float = 0.0
    lower: float = -1e9
    upper: float = 1e9
    switches: tuple[float, float] = (-10_000.0, 50_000.0)
    speed: Positive = 40_000.0
    closed: float = 40_000.0
    homed: bool = True
    homing_methods: tuple[Method, ...] = METHODS
    sampled: Literal["before", "after"] = "before"


class Drive:
    """One drive: the state machine and the motion behind a node's objects.

    Attributes:
        node: Its CANopen side.
        axis: Its motor [counts]; effort in 0.1 % of the rated torque.
        zero: Position at which its counter is 0 [counts of the axis]; set by homing.
        cause: Error code whose cause persists, so that the fault returns after a reset; 0: none.
    """

    def __init__(self, number: int, properties: DriveProperties) -> None:
        self.properties = properties
        self.node = EmulatedNode(number)
        self.axis = Axis(
            properties.start,
            lower=properties.lower,
            upper=properties.upper,
            max_velocity=properties.speed,
            max_effort=RATED,
            time_constant=0.005,
            friction=40.0,
            resolution=0.5,
        )
        self.state = codec.State.SWITCH_ON_DISABLED
        self.emergencies: list[Emergency] = []
        self.homed = properties.homed
        self.zero = 0.0
        self.cause = 0
        self._control = 0
        self._acknowledged = False
        self._goal = properties.start
        self._halted = False
        self._legs: list[HomingLeg] = []
        self._homing_error = False
        self._describe()
        self.node.on_reset = self.reset
        self.node.on_silence = self._silence
        self.reset()

    def _describe(self) -> None:
        made, node = self.properties, self.node
        node.add(Object.DEVICE_TYPE, 0, "I", 0x0002_0000 | made.device_type, writable=False)
        node.add(Object.ERROR_REGISTER, 0, "B", 0, writable=False)
        node.objects[Object.DEVICE_NAME, 0] = ObjectEntry(made.name.encode(), writable=False)
        node.add(Object.CONSUMER_HEARTBEAT, 0, "B", 1, writable=False)
        node.add(Object.CONSUMER_HEARTBEAT, 1, "I", 0, changed=node.restart_watch)
        node.add(Object.PRODUCER_HEARTBEAT, 0, "H", 0)
        node.add(Object.IDENTITY, 0, "B", 4, writable=False)
        for subindex, value in enumerate((_VENDOR, made.product, 1, 4711), start=1):
            node.add(Object.IDENTITY, subindex, "I", value, writable=False)
        node.add_pdos()
        node.add(Object.ABORT_CONNECTION, 0, "h", 1)
        node.add(Object.ERROR_CODE, 0, "H", 0, writable=False)
        node.add(Object.CONTROLWORD, 0, "H", 0, changed=self._controlled)
        node.add(Object.STATUSWORD, 0, "H", 0, writable=False)
        node.add(Object.MODE, 0, "b", 0, changed=self._mode_set)
        node.add(Object.MODE_DISPLAY, 0, "b", 0, writable=False)
        node.add(Object.POSITION, 0, "i", 0, writable=False)
        node.add(Object.VELOCITY, 0, "i", 0, writable=False)
        node.add(Object.MAX_TORQUE, 0, "H", 1000)
        node.add(Object.RATED_CURRENT, 0, "I", _RATED_CURRENT)
        node.add(Object.RATED_TORQUE, 0, "I", made.rated_torque)
        node.add(Object.TORQUE, 0, "h", 0, writable=False)
        node.add(Object.CURRENT, 0, "h", 0, writable=False)
        node.add(Object.TARGET_POSITION, 0, "i", 0)
        node.add(Object.PROFILE_VELOCITY, 0, "I", int(made.speed))
        node.add(Object.PROFILE_ACCELERATION, 0, "I", 1_000_000)
        node.add(Object.PROFILE_DECELERATION, 0, "I", 1_000_000)
        for index, value in (
            (Object.ENCODER_RESOLUTION, made.increments),
            (Object.GEAR_RATIO, 1),
            (Object.FEED_CONSTANT, made.increments),
        ):
            node.add(index, 0, "B", 2, writable=False)
            node.add(index, 1, "I", value)
            node.add(index, 2, "I", 1)
        node.add(Object.HOMING_METHOD, 0, "b", 0)
        node.add(Object.HOMING_SPEEDS, 0, "B", 2, writable=False)
        node.add(Object.HOMING_SPEEDS, 1, "I", int(made.speed))
        node.add(Object.HOMING_SPEEDS, 2, "I", max(1, int(made.speed / 10)))
        node.add(Object.HOMING_ACCELERATION, 0, "I", 1_000_000)
        node.add(Object.INTERPOLATION_TIME, 0, "B", 2, writable=False)
        node.add(Object.INTERPOLATION_TIME, 1, "B", 1)
        node.add(Object.INTERPOLATION_TIME, 2, "b", -3)
        modes = sum(1 << (mode - 1) for mode in made.modes)
        node.add(Object.SUPPORTED_MODES, 0, "I", modes, writable=False)

    def reset(self) -> None:
        """Restart with the drive, heartbeats and PDOs disabled."""
        self.state = codec.State.SWITCH_ON_DISABLED
        self.emergencies = []
        self._control = 0
        self._acknowledged = self._halted = self._homing_error = False
        self._legs = []
        self.axis.enabled = False
        for index, value in (
            (Object.ERROR_CODE, 0), (Object.ERROR_REGISTER, 0), (Object.MODE, 0),
            (Object.MODE_DISPLAY, 0), (Object.PRODUCER_HEARTBEAT, 0), (Object.MAX_TORQUE, 1000),
            (Object.CONTROLWORD, 0), (Object.PROFILE_VELOCITY, int(self.properties.speed)),
        ):  # fmt: skip
            self.node.set(index, value)
        self.node.set(Object.CONSUMER_HEARTBEAT, 0, 1)
        for n in range(4):
            for base, cob in ((0x1400, cia301.RPDO[n]), (0x1800, cia301.TPDO[n])):
                self.node.set(base + n, cia301.DISABLED | cob + self.node.number, 1)

    # --- state machine -----------------------------------------------------------------------

    def _mode_set(self, value: int) -> AbortCode | None:
        if value and value not in self.properties.modes:
            return AbortCode.RANGE
        if value != self.node.get(Object.MODE_DISPLAY):
            self._stay()
        self.node.set(Object.MODE_DISPLAY, value)
        return None

    def _controlled(self, word: int) -> AbortCode | None:
        before, self._control = self._control, word
        if self.state is codec.State.FAULT:
            # Only the rising edge resets a fault (CiA 402-2).
            if word & 0x80 and not before & 0x80:
                self._recover()
            return None
        # "Disable voltage" takes precedence over all other bits.
        if not word & 0x02:
            self._become(codec.State.SWITCH_ON_DISABLED)
        elif not word & 0x04:
            if self.state is codec.State.ENABLED:
                self._stay()
                self._become(codec.State.QUICK_STOP)
        else:
            found = _TRANSITIONS.get((self.state, word & 0x0F))
            if found is not None:
                self._become(found)
        if self.state is codec.State.ENABLED:
            self._halt(bool(word & codec.HALT))
            self._set_point(word, before)
        return None

    def _become(self, state: codec.State) -> None:
        if (state is codec.State.ENABLED) is not (self.state is codec.State.ENABLED):
            self._stay()
            self._acknowledged = self._halted = False
        self.state = state
        self.axis.enabled = state in (codec.State.ENABLED, codec.State.QUICK_STOP)

    def _stay(self) -> None:
        """Make the present position the goal, and end homing."""
        self._legs = []
        self._homing_error = False
        self._aim(self.axis.position)

    def _aim(self, goal: float) -> None:
        """Set the goal [counts of the axis], which the axis follows unless halted."""
        self._goal = goal
        if not self._halted:
            self.axis.target = goal

    def _halt(self, halted: bool) -> None:
        """Halt the axis, or continue to the goal after a halt."""
        if halted is not self._halted:
            self._halted = halted
            self.axis.target = self.axis.position if halted else self._goal

    def _set_point(self, word: int, before: int) -> None:
        mode = self.node.get(Object.MODE_DISPLAY)
        rising = bool(word & codec.NEW_SET_POINT) and not before & codec.NEW_SET_POINT
        if mode == codec.Mode.PROFILE_POSITION:
            if rising:
                target = float(self.node.get(Object.TARGET_POSITION, signed=True))
                # A relative target adds to the previous target, not to the position.
                self._aim(target + (self._goal if word & codec.RELATIVE else self.zero))
                self._acknowledged = True
            elif not word & codec.NEW_SET_POINT:
                self._acknowledged = False
        elif mode == codec.Mode.HOMING:
            if rising:
                self._begin_homing()
            elif not word & codec.HOMING_START and self._legs:
                self._stay()

    # --- homing ------------------------------------------------------------------------------

    def _begin_homing(self) -> None:
        method = self.node.get(Object.HOMING_METHOD, signed=True)
        self._stay()
        self.homed = False
        self._homing_error = method not in self.properties.homing_methods
        if not self._homing_error:
            fast, slow = (float(max(1, self.node.get(Object.HOMING_SPEEDS, n))) for n in (1, 2))
            switches = sorted(self.properties.switches)
            self._legs = homing_legs(
                method,
                self.axis.position,
                negative=HomingLeg(max(self.axis.lower, switches[0]), fast),
                positive=HomingLeg(min(self.axis.upper, switches[1]), fast),
                turn=max(1, self.properties.increments),
                slow=slow,
            )

    def _search(self) -> None:
        """End a leg of homing, and begin the next."""
        axis, leg = self.axis, self._legs[0]
        if axis.position == leg.end:
            self._legs.pop(0)
            if not self._legs:
                self.zero = axis.position
                self.homed = True
            self._aim(self._legs[0].end if self._legs else axis.position)
        elif not self._halted and axis.target == leg.end and not axis.moving:
            blocked = axis.position in (axis.lower, axis.upper)
            if blocked:  # at a stop, before the switch or index pulse
                self._stay()
                self._homing_error = True
        else:
            self._aim(leg.end)

    def fail(self, code: int) -> None:
        """Enter the fault state and send an emergency message."""
        register = cia301.error_register(code)
        self.node.set(Object.ERROR_CODE, code)
        self.node.set(Object.ERROR_REGISTER, register)
        self.emergencies.append(Emergency(code, register))
        self.axis.enabled = False
        self._legs = []
        self.state = codec.State.FAULT

    def _recover(self) -> None:
        if self.cause:
            self.fail(self.cause)
            return
        self.node.set(Object.ERROR_CODE, 0)
        self.node.set(Object.ERROR_REGISTER, 0)
        self.emergencies.append(Emergency(0))
        self.state = codec.State.SWITCH_ON_DISABLED

    def _silence(self) -> None:
        self.emergencies.append(Emergency(_LOST_HOST, cia301.error_register(_LOST_HOST)))
        self.node.state = NmtState.PRE_OPERATIONAL
        reaction = self.node.get(Object.ABORT_CONNECTION, signed=True)
        if reaction == 1:
            # The fault sends the same emergency message.
            self.emergencies.pop()
            self.fail(_LOST_HOST)
        elif reaction in (2, 3):
            self._become(codec.State.SWITCH_ON_DISABLED)

    # --- motion ------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Apply a SYNC: in cyclic mode, follow the target."""
        if self.state is not codec.State.ENABLED:
            return
        if self.node.get(Object.MODE_DISPLAY) == codec.Mode.CYCLIC_POSITION:
            self._aim(float(self.node.get(Object.TARGET_POSITION, signed=True)) + self.zero)

    def step(self, now: float) -> list[CanFrame]:
        """Let time pass; return the frames that the drive sends by itself."""
        axis, node = self.axis, self.node
        limit = node.get(Object.MAX_TORQUE)
        axis.max_effort = float(limit)
        profile = node.get(Object.MODE_DISPLAY) == codec.Mode.PROFILE_POSITION
        speed = float(node.get(Object.PROFILE_VELOCITY)) if profile else self.properties.speed
        if self._legs:
            speed = self._legs[0].speed
        axis.max_velocity = min(speed, self.properties.speed)
        axis.step(now)
        if self._legs:
            self._search()
        self._report()
        frames = node.step(now)
        if not node.inhibited:
            frames = [e.to_frame(node.number) for e in self.emergencies] + frames
        self.emergencies = []
        return frames

    def _report(self) -> None:
        """Update the objects with the state of the drive."""
        axis, node = self.axis, self.node
        word = self.state.value[1] | _POWERED
        mode = node.get(Object.MODE_DISPLAY)
        stands = not axis.moving
        if mode == codec.Mode.HOMING:
            under_way = bool(self._legs) and not self._halted
            word |= _REACHED if not under_way and stands else 0
            word |= _ACKNOWLEDGED if self.homed else 0
            word |= _HOMING_ERROR if self._homing_error else 0
        else:
            reached = stands if self._halted else axis.position == self._goal
            word |= _REACHED if reached else 0
            cyclic = mode == codec.Mode.CYCLIC_POSITION and self.state is codec.State.ENABLED
            word |= _ACKNOWLEDGED if self._acknowledged or cyclic else 0
        node.set(Object.STATUSWORD, word)
        node.set(Object.POSITION, round(axis.measured - self.zero))
        node.set(Object.VELOCITY, round(axis.velocity))
        node.set(Object.TORQUE, round(axis.effort))
        node.set(Object.CURRENT, round(axis.effort))


def homing_legs(
    method: int, here: float, *, negative: HomingLeg, positive: HomingLeg, turn: int, slow: float
) -> list[HomingLeg]:
    """Return the legs of one of the homing `METHODS`; the last one ends at home.

    Args:
        method: 1, 2 (limit switch and index pulse), 17, 18 (limit switch), 33, 34 (index pulse),
            35 or 37 (present position).
        here: Position of the axis [counts].
        negative: The leg to the negative limit switch.
        positive: The leg to the positive limit switch.
        turn: Counts between two index pulses.
        slow: Speed of the search for an index pulse [counts/s].
    """

    def pulse(start: float, direction: int) -> HomingLeg:
        # A search that starts on a pulse ends at the next one.
        return HomingLeg((math.floor(direction * start / turn) + 1) * turn * direction, slow)

    return {
        1: [negative, pulse(negative.end, 1)],
        2: [positive, pulse(positive.end, -1)],
        17: [negative],
        18: [positive],
        33: [pulse(here, -1)],
        34: [pulse(here, 1)],
        35: [HomingLeg(here, slow)],
        37: [HomingLeg(here, slow)],
    }[method]
