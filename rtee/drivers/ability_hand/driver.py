"""Drives an Ability Hand: six motors and thirty touch sensors on a serial line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, field

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.buses.serial import SerialBus
from rtee.buses.timing import wire_time
from rtee.drivers import wiring
from rtee.drivers.ability_hand import codec
from rtee.drivers.ability_hand.control import SPEEDS, MotorControl
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.deadlines import RelaxedDeadline, cycle_deadline
from rtee.drivers.options import DeviceOptions, NotNegative, Pause, Positive
from rtee.drivers.tare import SensorTare
from rtee.errors import FrameError
from rtee.sample import ActuatorState, FloatArray
from rtee.touch import TouchReading, TouchSensor
from rtee.types import DeviceSpec, Reference

Motor = Literal["index", "middle", "ring", "pinky", "thumb_flexor", "thumb_rotator"]


class AbilityHandOptions(DeviceOptions, frozen=True):
    """Options of an Ability Hand."""

    port: str = "/dev/ttyUSB0"
    """A tty, socket:// or rfc2217://."""
    address: Annotated[int, Meta(ge=1, le=255)] = codec.ADDRESS
    """Address of the hand; 80 (hexadecimal 50) from the factory."""
    baudrate: Literal[
        460_800, 1200, 38_400, 56_000, 57_600, 76_800, 115_200, 230_400, 250_000, 921_600, 1_000_000
    ] = 460_800
    """As the hand is set; above 460800 on RS-485 only."""
    mode: Literal["position", "velocity", "current"] = "position"
    """Kind of set-points; with ``velocity`` it takes velocity limits, with ``current`` effort
    limits, and this computer controls the positions."""
    reply: Literal[1, 2, 3] | None = None
    """Variant of the replies: 1 positions, currents, touch (default); 2 positions, velocities,
    touch (default with ``mode: current``); 3 positions, currents, velocities."""
    touch: bool = True
    """Whether it has touch sensors; a hand without them reports no touch."""
    touch_threshold: Positive = 0.15
    """Force of a touch sensor above its value at rest that is a contact [N]."""
    motors: dict[str, Motor] = field(default_factory=dict)
    """The motor that drives each actuator; by default by its name."""
    reverse: frozenset[Motor] = frozenset({"thumb_rotator"})
    """Motors whose angles on the wire have the other sign than the actuator's."""
    approach: Positive = 20.0
    """With ``mode: velocity``: velocity by position error [1/s]."""
    stiffness: Positive = 8.0
    """With ``mode: current``: effort by position error [N·m/rad]."""
    damping: NotNegative = 0.05
    """With ``mode: current``: effort against velocity [N·m·s/rad]."""
    retries: Annotated[int, Meta(ge=0, le=10)] = 1
    turnaround: Pause = 0.0
    """Time per answer that the bytes do not explain [s]."""

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        if self.mode == "current" and self.reply == 1:
            raise ValueError("reply 1 has no velocities, which `mode: current` needs: 2 or 3")

    @property
    def variant(self) -> int:
        """The variant of its replies, 1 to 3."""
        return self.reply or (2 if self.mode == "current" else 1)

    @property
    def header(self) -> codec.Header:
        """The header of its set-points, without the variant of the reply."""
        return codec.Header[self.mode.upper()]


def motors_of(spec: DeviceSpec, options: AbilityHandOptions) -> tuple[int, ...]:
    """Return the motor of each actuator, by its index in `MOTORS`; raises `ConfigError`."""
    guess = partial(wiring.finger_motor, motors=codec.MOTORS)
    return wiring.motors_of(spec, "motors", options.motors, codec.MOTORS, guess)


_LEFT = 1
"""Fault code of a hand that has left API mode; the hand itself reports no codes."""
_JUMP = codec.angle_counts(0.1)
"""Change of a position that is plausible at any speed [counts], from backlash or a push."""
_FASTEST = tuple(2.0 * codec.COUNTS * speed for speed in SPEEDS)
"""Largest plausible speed [counts/s], twice that of the joint: a reply beyond it is damaged."""
_MOVED = codec.angle_counts(0.05)
"""Smallest change that counts as a motion of a finger [counts]: 0.05 rad are 3 mm at its tip."""
_SENT = 17 + 1
"""Bytes of set-points on the wire, with one escaped byte on average."""
_RECEIVED = {1: 74 + 2, 2: 74 + 2, 3: 41 + 1}
"""Bytes of a reply on the wire by its variant, with escaped bytes."""
_FORCES: FloatArray = np.array([codec.touch_force(word) for word in range(4096)])
"""Force by the word of a touch sensor [N]; a table, since thirty are converted in every cycle."""
_SENSORS = tuple(
    TouchSensor(finger, taxels=codec.SITES, full=codec.touch_force(4095) - codec.touch_force(0))
    for finger in codec.TOUCHING
)
_GAINS = {"velocity": ("approach",), "current": ("stiffness", "damping")}


class AbilityHandDriver(Driver):
    """An Ability Hand.

    The hand answers every command with its measurements, so a cycle is one exchange: `move` sends
    the set-points of all six motors, and `sense` returns the reply, or reads the hand if there was
    no command. Until a reference asks for motion the hand is only read, which leaves its own
    control in charge.

    A hand that receives nothing for 0.3 s leaves API mode and may move by itself. If it has moved,
    that is a fault; recovery starts from the measured positions.
    """

    Options = AbilityHandOptions
    options: AbilityHandOptions
    link: SerialBus

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        options = self.options
        self._motors = motors_of(spec, options)
        self._signs = [-1.0 if codec.MOTORS[m] in options.reverse else 1.0 for m in self._motors]
        self._control = MotorControl(
            options.header,
            approach=options.approach,
            stiffness=options.stiffness,
            damping=options.damping,
        )
        self._tare = SensorTare(options.touch_threshold)
        self._parser = codec.ReplyParser()
        self._pace = RelaxedDeadline()
        self._pace.deadline = RelaxedDeadline.PATIENCE
        self._reply: codec.Reply | None = None
        self._doubted: codec.Reply | None = None
        self._waiting = False
        self._stamp = -math.inf
        self._in_api = False
        self._moved = False
        self._here: FloatArray = np.full(len(self._motors), math.nan)
        accepts, refuses = {"position"}, {}
        if options.mode == "velocity":
            accepts.add("max_velocity")
        if options.mode == "current":
            accepts.add("max_effort")
        else:
            refuses["max_effort"] = "'mode: current' in its options takes one"
        self.capabilities = Capabilities(
            measures=frozenset({"position", *self._reported()}),
            accepts=frozenset(accepts),
            refuses=refuses,
            recoverable=True,
            gains=_GAINS.get(options.mode, ()),
            touch=_SENSORS if options.touch and options.variant != codec.NO_TOUCH else (),
        )

    def _reported(self) -> tuple[str, ...]:
        currents, velocities = ("effort", "current"), ("velocity",)
        return {1: currents, 2: velocities, 3: currents + velocities}[self.options.variant]

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and check that an Ability Hand answers; moves nothing."""
        options = self.options
        self._in_api = self._moved = self._waiting = False
        self._reply = self._doubted = None
        self._tare.reset()
        self._pace.deadline = RelaxedDeadline.PATIENCE
        bus = await self.open(
            self.buses.serial,
            options.port,
            lambda bus: bus,
            baudrate=options.baudrate,
            # A reply does not identify its request, so a late one could be taken for the next.
            fresh=True,
        )
        with self.identifying(
            "an Ability Hand",
            f"no Ability Hand answers at address {options.address} on {options.port}",
            "check supply, wires, `address` and `baudrate`, and that the hand is set to UART or "
            "RS-485 with byte stuffing: from the factory it is set to I2C",
        ):
            # Twice: in fast mode, a reply has the variant that the previous request selected.
            await self._read()
            reply = await self._read()
        best = self._best_rate(bus)
        self._pace.deadline = cycle_deadline(self.spec, best)
        self.refine(
            best_rate=best,
            identity={
                "model": "PSYONIC Ability Hand",
                "address": f"{options.address:#04x}",
                "reply": f"variant {reply.variant}",
                "touch": "reported" if any(reply.touch) else "silent, or without sensors",
            },
        )

    def _best_rate(self, bus: SerialBus) -> float:
        count = _SENT + _RECEIVED[self.options.variant]
        once = wire_time(count, bus.line.baudrate) + self.options.turnaround
        # 1000 Hz is the highest rate that the maker's client reaches.
        return 1.0 / max(once, 1e-3)

    async def activate(self) -> None:
        """Attach to the hand as it is: only a reference that asks for motion enters API mode."""
        await self._check()
        with self._pace.relaxed_deadline():
            self._control.hold(await self._read())
        self.attached.begin(range(len(self._motors)))

    # --- every cycle -------------------------------------------------------------------------

    async def _read(self) -> codec.Reply:
        """Read the hand without a command; raises `BusError`."""
        return await self._exchange(codec.Header.READ)

    async def _exchange(self, header: codec.Header, words: tuple[int, ...] = ()) -> codec.Reply:
        """Send a command and return the reply; raises `BusError`."""
        command = codec.Command(self.options.address, header + self.options.variant - 1, words)
        if words:
            # Before the exchange: the hand may accept a command whose reply is lost.
            self._in_api = True
        reply = await self.link.transact(
            command.to_bytes(),
            self._parser,
            self._pace.deadline,
            self.options.retries,
            whom=f"address {self.options.address}",
        )
        # The time of arrival also shows how long the hand has received nothing.
        now = monotonic.now()
        if not self._plausible(reply, now):
            self._doubted = reply
            raise FrameError(
                self.options.port,
                "the reported position of a finger jumps; is there noise on the line?",
            )
        self._reply, self._doubted, self._stamp = reply, None, now
        return reply

    def _plausible(self, reply: codec.Reply, now: float) -> bool:
        """Return whether no joint has moved impossibly fast since the previous reply.

        A one-byte checksum does not detect all damage, and the control depends on the positions. A
        doubted reply counts as the previous one, so a jump that is reported twice is accepted.
        """
        before = self._doubted or self._reply
        if before is None:
            return True
        elapsed = now - self._stamp
        ways = [abs(n - o) for n, o in zip(reply.positions, before.positions, strict=True)]
        return all(way <= _JUMP + fast * elapsed for way, fast in zip(ways, _FASTEST, strict=True))

    async def _check(self) -> None:
        """Raise `DeviceFault` if the hand left API mode after a silence and has moved by itself.

        Its previous set-points would make it jump back.
        """
        if self._in_api and monotonic.now() - self._stamp > codec.API_TIME:
            before, self._waiting = self._reply, False
            reply = await self._read()
            self._in_api = False
            # Its own control may hold an object: nothing is sent until a reference asks for motion.
            self.attached.begin(range(len(self._motors)))
            if before is not None:
                pairs = zip(before.positions, reply.positions, strict=True)
                self._moved = any(abs(old - new) > _MOVED for old, new in pairs)
        if self._moved:
            raise self.fault(
                _LEFT,
                f"the hand received nothing for {codec.API_TIME:g} s, left API mode, and moved by "
                "itself",
                hint="check that nothing was dropped, then `rtee recover`",
            )

    async def sense(self) -> ActuatorState:
        """Return the reply to the last command, if there was one, or read the hand."""
        await self._check()
        waiting, self._waiting = self._waiting, False
        reply = self._reply if waiting and self._reply is not None else await self._read()
        both = tuple(zip(self._motors, self._signs, strict=True))
        position = [sign * codec.angle(reply.positions[m]) for m, sign in both]
        self._here = np.array(position)
        velocity = effort = current = None
        if reply.velocities:
            velocity = [sign * codec.velocity(reply.velocities[m], m) for m, sign in both]
        if reply.currents:
            effort = [sign * codec.effort(reply.currents[m], m) for m, sign in both]
            current = [abs(reply.currents[m]) / codec.AMPERE for m, _ in both]
        touch = None
        if reply.touch and self.capabilities.touch:
            forces = self._tare.above(_FORCES[list(reply.touch)], self._stamp)
            touch = TouchReading(forces, self._stamp)
        limited = [codec.MOTORS[m] for m in self._motors if reply.limited[m]]
        warnings = (f"limited by the hand (heat or contact): {', '.join(limited)}",)
        return ActuatorState.measured(
            position,
            self._stamp,
            velocity=velocity,
            effort=effort,
            current=current,
            warnings=warnings if limited else (),
            touch=touch,
        )

    async def move(self, reference: Reference) -> None:
        """Send the set-points of all motors and keep the reply for `sense`."""
        await self._check()
        # One command sets all motors, and their present set-points cannot be read.
        if self.attached.all_holding(reference, self._here):
            return
        mask = reference.mask.tolist()
        for i, (motor, sign) in enumerate(zip(self._motors, self._signs, strict=True)):
            if mask[i]:
                # Not hand.yaml's limits: a finger may stand outside them, and must not jump.
                limits = self.spec.mechanism(self.spec.actuators[i])
                position = min(max(float(reference.position[i]), limits.lower), limits.upper)
                self._control.aim(
                    motor,
                    sign * position,
                    sign * float(reference.velocity[i]),
                    float(reference.max_velocity[i]),
                    float(reference.max_effort[i]),
                )
        # Set-points of velocity and current depend on the positions.
        known = self._reply or await self._read()
        await self._exchange(self._control.header, self._control.words(known))
        self._waiting = True

    async def hold(self) -> None:
        """Command the measured pose."""
        # Within the cycle's deadline: a lost answer must not use up the time of a stop.
        await patiently(self._hold)

    async def _hold(self) -> None:
        reply = await self._read()
        self._control.hold(reply)
        both = tuple(zip(self._motors, self._signs, strict=True))
        here = [sign * codec.angle(reply.positions[m]) for m, sign in both]
        for i, position in self.standstill.instead(here).items():
            motor, sign = both[i]
            self._control.targets[motor] = sign * position
        # By positions in every mode: a velocity or current would go on until the next command.
        words = tuple(map(codec.angle_counts, self._control.targets))
        await self._exchange(codec.Header.POSITION, words)
        self._waiting = False

    async def disable(self) -> None:
        """Set the voltage of all motors to 0, and return the hand to its own control."""
        # The next command powers all motors again, so it waits for a reference with a motion.
        self.attached.begin(range(len(self._motors)))
        with self._pace.relaxed_deadline():
            await patiently(lambda: self._exchange(codec.Header.DUTY, (0,) * codec.COUNT))
        command = codec.Command(self.options.address, codec.Header.LEAVE)
        await self.link.send(command.to_bytes())
        self._in_api = self._waiting = False

    async def recover(self) -> None:
        """Restart from the measured positions; send nothing until a reference asks for motion."""
        with self._pace.relaxed_deadline():
            self._control.hold(await self._read())
        self._in_api = self._moved = self._waiting = False
        self.attached.begin(range(len(self._motors)))

    # --- gains -------------------------------------------------------------------------------

    def gains(self) -> Mapping[str, float]:
        """Return the gains of the position control in this computer."""
        return {name: getattr(self._control, name) for name in self.capabilities.gains}

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change gains of the position control in this computer."""
        for name, gain in gains.items():
            setattr(self._control, name, gain)
