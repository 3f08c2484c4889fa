"""Drives HERI II's two-motor boards on EtherCAT; not yet tried on a real hand."""

from __future__ import annotations

import asyncio
import math
from functools import partial
from typing import Annotated

import numpy as np
from msgspec import Meta, field

from rtee import monotonic
from rtee.buses.ethercat import EthercatBus, Ring, SlaveState
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.heri_ethercat import codec
from rtee.drivers.options import DeviceOptions, Moment, Positive
from rtee.drivers.wiring import numbers_of
from rtee.errors import BusTimeout, DeviceFault, HandshakeError
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

_REFUSED = 0x10000
"""Fault code of a refused command, above the sixteen bits of the boards' fault word."""

_POLL = 0.005
"""Pause between two reads of an acknowledgement [s]; boards need about ten milliseconds."""

_PATIENCE = 0.5
"""Longest time for an exchange outside the cycle [s]."""

_BEST_RATE = 1000.0
"""Rate of the public program that ran on the hand [Hz]."""


_WIRING = {"motor_finger1": 0, "motor_finger2": 1, "motor_finger3": 2, "motor_thumb": 3}
"""Motor numbers by the names in the public description, counted across its two boards."""

Raw = Annotated[int, Meta(ge=0, le=0xFFFF)]

_ACKNOWLEDGED = 1.0
"""Longest time for a board to acknowledge a command [s]: hundreds of its cycles."""


class HeriEthercatOptions(DeviceOptions, frozen=True):
    """Options of a HERI II hand on EtherCAT.

    Attributes:
        interface: Network interface of the boards; no other program may use it.
        motors: Motor of each actuator, counted over the boards from 0; by default those of the
            public description (``motor_finger1`` and so on), otherwise in the actuators' order.
        vendor: Expected EtherCAT vendor id; by default any.
        product: Expected EtherCAT product code; by default any.
        gains: Five raw gains sent to every board; their meaning is not public.
        torque_per_ampere: Torque at the shaft per current [N·m/A].
        limit_torque: Whether to send the effort limit as the torque reference of a board: the
            smaller limit of its two motors. Otherwise that reference is 0.
        watchdog: Time without frames after which boards leave operation [s].
        deadline: Longest time for one exchange [s].
    """

    interface: str = "eth0"
    motors: dict[str, Annotated[int, Meta(ge=0, lt=4 * codec.MOTORS)]] = field(default_factory=dict)
    vendor: int | None = None
    product: int | None = None
    gains: tuple[Raw, Raw, Raw, Raw, Raw] = (0, 0, 0, 0, 0)
    torque_per_ampere: Positive = codec.TORQUE_PER_AMPERE
    limit_torque: bool = True
    watchdog: Annotated[float, Meta(ge=0.0, le=6.5)] = 0.25
    deadline: Moment = 0.02


class HeriEthercatDriver(Driver):
    """The boards of a HERI II hand, with this program as their master.

    The driver brings the boards to safe-operational to read the motors' positions, then to
    operational with these positions as references, and powers them only then, so that nothing
    jumps. A new master takes over the network, so the driver cannot attach to a hand that another
    master controls.
    """

    Options = HeriEthercatOptions
    options: HeriEthercatOptions
    link: EthercatBus

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._motors = _motors_of(spec, self.options)
        self._boards = max(self._motors) // codec.MOTORS + 1
        self._references = [0.0] * (self._boards * codec.MOTORS)
        self._limits = [math.inf] * (self._boards * codec.MOTORS)
        self._replies: list[codec.Reply] = []
        self._echoes: list[int] = []
        self._echoing: set[int] = set()
        self._stamp = self._returned = 0.0
        self._fresh = False
        self._acknowledge = 0
        limits = self.options.limit_torque
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort", "current", "pressure"}),
            accepts=frozenset({"position", "max_effort"} if limits else {"position"}),
            refuses={} if limits else {"max_effort": "its option 'limit_torque' is off"},
            best_rate=_BEST_RATE,
            watchdog=self.options.watchdog > 0.0,
            recoverable=True,
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Take over the network, identify the boards and read the motors' positions."""
        # On reconnection, the old master has to end first: a network has only one.
        await self.close()
        options = self.options
        bus = await self.open(self.buses.ethercat, options.interface, lambda bus: bus)
        _identify(bus, self._boards, options, self.spec.name)
        self._echoes, self._echoing = [], set()
        self.refine(
            identity={
                "model": f"HERI II, {self._boards} boards (unverified on hardware)",
                "firmware": await _firmware(bus, self._boards),
            },
        )
        await self._operate()

    async def _operate(self) -> None:
        """Bring the boards into operation, with their present positions as references.

        A board leaves operation if the frames stop for longer than its watchdog time, as on a
        computer that is busy for a moment. While the motors are not powered, this is repeated.
        """

        async def begin() -> None:
            await self.link.run(self._to_safe, 5.0)
            await self._exchange()
            self._seed()
            await self.link.run(lambda ring: ring.request(SlaveState.OPERATIONAL, 2.0), 5.0)
            # The first outputs in operation are the positions just measured.
            await self._exchange()

        await patiently(begin)

    def _to_safe(self, ring: Ring) -> None:
        for position in range(self._boards):
            ring.watchdog(position, self.options.watchdog)
        ring.request(SlaveState.SAFE_OPERATIONAL, 2.0)

    async def _exchange(self) -> None:
        # 16 bits of microseconds wrap after 65 ms, which is the time of many exchanges.
        stamp = int(monotonic.now() * 1e6) & 0xFFFF
        outputs = [
            codec.Command(
                (self._references[codec.MOTORS * b], self._references[codec.MOTORS * b + 1]),
                torque=self._torque(b),
                gains=self.options.gains,
                acknowledge=self._acknowledge,
                stamp=stamp,
            ).to_bytes()
            for b in range(self._boards)
        ]
        # Slaves after the hand's boards get no outputs.
        deadline = self.options.deadline if self.active else _PATIENCE
        bus, read = self.link, codec.Reply.from_bytes
        inputs = await bus.exchange(outputs, deadline)
        self._replies = [bus.decoded(read, data) for data in inputs[: self._boards]]
        if self._are_new():
            self._stamp = monotonic.now()
        self._fresh = True

    def _are_new(self) -> bool:
        """Return whether the measurements of all boards are new.

        A board returns the stamp of the last command that it has read. If its program hangs, its
        EtherCAT controller keeps sending the old process data.
        """
        before, self._echoes = self._echoes, [reply.round_trip for reply in self._replies]
        if not before:
            return True
        changed = {b for b, echo in enumerate(self._echoes) if echo != before[b]}
        # Some firmware may return no stamp.
        self._echoing |= changed
        return self._echoing <= changed

    def _torque(self, board: int) -> float:
        """Return a board's torque reference [N·m]: the smaller limit of its motors; 0: none."""
        limit = min(self._limits[codec.MOTORS * board : codec.MOTORS * (board + 1)])
        # A limit too small for the wire must not become 0, which means none.
        return max(limit, codec.LEAST_TORQUE) if math.isfinite(limit) else 0.0

    def _seed(self) -> None:
        self._references = [q for reply in self._replies for q in reply.positions]

    async def activate(self) -> None:
        """Power the motors at their positions."""
        await self._in_operation()
        self._seed()
        # Power on in direct mode, which has no reference; then begin position control at the
        # positions just measured.
        for code in (
            codec.Order.POWER_OFF,
            codec.Order.DIRECT,
            codec.Order.POWER_ON,
            codec.Order.POSITION,
        ):
            for position in range(self._boards):
                await self._order(position, code)
            # Faults from before are cleared before position control holds anything.
            if code is codec.Order.POWER_ON:
                await self._clear_faults()
        self.active = True

    async def examine(self) -> str:
        """Raise `DeviceFault` if a board reports a fault."""
        await self._in_operation()
        self._refuse()
        return ""

    async def _in_operation(self) -> None:
        """Exchange process data; bring boards that have left operation back to it."""
        try:
            await self._exchange()
        except BusTimeout:
            await self._operate()

    async def _order(self, position: int, code: codec.Order) -> None:
        """Command a board's controller and exchange frames until it acknowledges the command.

        Raises `DeviceFault` if the board refuses or does not answer, and `BusError`.
        """
        bus = self.link
        await bus.run(
            lambda ring: ring.write(position, *codec.COMMAND_OBJECT, codec.order(code)), 1.0
        )
        end = monotonic.now() + _ACKNOWLEDGED
        done: bool | None = None
        # Without frames, the board's watchdog would take it out of operation meanwhile.
        while done is None and monotonic.now() < end:
            await self._exchange()
            raw = await bus.run(lambda ring: ring.read(position, *codec.ACKNOWLEDGE_OBJECT), 1.0)
            done = bus.decoded(partial(codec.acknowledged, code=code), raw)
            if done is None:
                await asyncio.sleep(_POLL)
        if not done:
            fault = codec.faults_of(self._replies[position].fault)
            if fault:
                raise self._fault(position, fault)
            raise self.fault(
                _REFUSED,
                f"board {position} refuses '{code.name.lower().replace('_', ' ')}'",
                hint="is its motor supply on?",
            )

    async def _clear_faults(self) -> None:
        # Acknowledge only the bits that are set, so that no new fault is cleared unseen.
        for reply in self._replies:
            self._acknowledge |= reply.fault & codec.ACKNOWLEDGE
        try:
            # The bits are in the process data: one frame may be lost, and one is in transit.
            for _ in range(3):
                await self._exchange()
        finally:
            # Also after a failed exchange: otherwise later frames would clear every new fault.
            self._acknowledge = 0
        await self._exchange()
        self._refuse()

    async def disable(self) -> None:
        """Disable the motors; tendons without power go slack."""
        self.active = False
        refused: DeviceFault | None = None
        for position in range(self._boards):
            try:
                await self._order(position, codec.Order.POWER_OFF)
            except DeviceFault as error:  # the other boards must lose their power all the same
                refused = error
        if refused is not None:
            raise refused

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the measurements of the last exchange, or make one."""
        self.link.check()
        if not self._fresh:
            await self._exchange()
        self._fresh = False
        if self.active:
            self._refuse()
        replies = [self._replies[m // codec.MOTORS] for m in self._motors]
        sides = [m % codec.MOTORS for m in self._motors]
        current = np.array([r.currents[s] for r, s in zip(replies, sides, strict=True)])
        pressure = np.array(
            [
                r.pressures[codec.PHALANXES * s : codec.PHALANXES * (s + 1)]
                for r, s in zip(replies, sides, strict=True)
            ],
            dtype=np.float64,
        ).reshape(-1)
        fresh, self._returned = self._stamp != self._returned, self._stamp
        return ActuatorState.measured(
            [r.positions[s] for r, s in zip(replies, sides, strict=True)],
            self._stamp,
            velocity=[r.velocities[s] for r, s in zip(replies, sides, strict=True)],
            effort=current * self.options.torque_per_ampere,
            current=current,
            extras={"pressure": pressure},
            warnings=tuple(
                f"board {b} limits its current because it is hot"
                for b, reply in enumerate(self._replies)
                if codec.Fault(reply.fault & codec.ACKNOWLEDGE) & codec.WARNINGS
            ),
            fresh=fresh,
        )

    async def move(self, reference: Reference) -> None:
        """Exchange process data with the new references."""
        for i, motor in enumerate(self._motors):
            if reference.mask[i]:
                # Not hand.yaml's limits: a finger may stand outside them, and must not jump.
                limits = self.spec.mechanism(self.spec.actuators[i])
                wanted = float(reference.position[i])
                self._references[motor] = min(max(wanted, limits.lower), limits.upper)
                if self.options.limit_torque:
                    limit = max(float(reference.max_effort[i]), 0.0)
                    # The full effort is sent as no limit; the board has its own.
                    self._limits[motor] = limit if limit < limits.effort else math.inf
        await self._exchange()

    def _refuse(self) -> None:
        for position, reply in enumerate(self._replies):
            fault = codec.faults_of(reply.fault)
            if fault:
                raise self._fault(position, fault)

    def _fault(self, position: int, fault: codec.Fault) -> DeviceFault:
        return self.fault(
            int(fault),
            f"board {position}: {codec.words(fault)}",
            hint=f"{codec.cure(fault)}, then `rtee recover` acknowledges it",
        )

    async def hold(self) -> None:
        """Command the measured posture."""
        await patiently(self._exchange)
        self._seed()
        here = [self._references[motor] for motor in self._motors]
        for i, position in self.standstill.instead(here).items():
            self._references[self._motors[i]] = position
        await patiently(self._exchange)

    async def recover(self) -> None:
        """Acknowledge faults; `activate` powers the motors again."""
        self.active = False
        await self._in_operation()
        await self._clear_faults()


def _identify(bus: EthercatBus, boards: int, options: HeriEthercatOptions, device: str) -> None:
    """Check vendor and product of the first slaves; raises `HandshakeError` if they differ."""
    if len(bus.slaves) < boards:
        raise HandshakeError(
            device,
            f"{boards} boards at {options.interface}",
            f"{len(bus.slaves)} slaves",
            hint="check cables and supply",
        )
    for position, slave in enumerate(bus.slaves[:boards]):
        for what, wanted, found in (
            ("vendor", options.vendor, slave.vendor),
            ("product", options.product, slave.product),
        ):
            if wanted is not None and wanted != found:
                raise HandshakeError(
                    device,
                    f"{what} {wanted:#x} as slave {position}",
                    f"{what} {found:#x} ({slave.name})",
                )


async def _firmware(bus: EthercatBus, boards: int) -> str:
    """Return the boards' firmware, each version once; raises `BusError`."""
    versions = [await bus.run(partial(_firmware_of, position), 1.0) for position in range(boards)]
    return ", ".join(dict.fromkeys(versions))


def _firmware_of(position: int, ring: Ring) -> str:
    try:
        return ring.read(position, *codec.FIRMWARE_OBJECT).decode("ascii", "replace").strip("\x00 ")
    except OSError:
        return "unknown"


def _motors_of(spec: DeviceSpec, options: HeriEthercatOptions) -> list[int]:
    """Return the motor of each actuator; raises `ConfigError`."""
    names = [a.name for a in spec.actuators]
    if not options.motors:
        wired = all(name in _WIRING for name in names)
        return [_WIRING[name] for name in names] if wired else list(range(len(names)))
    return numbers_of(spec, "motors", options.motors, "motor")
