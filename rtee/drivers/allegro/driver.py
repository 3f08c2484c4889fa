"""Drives a Wonik Allegro Hand over CAN: the hand takes torques, so the joint control is here."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame
from rtee.drivers.allegro import codec
from rtee.drivers.allegro.codec import (
    FINGERS,
    JOINTS,
    NAMES,
    SCALES,
    AllegroFrameError,
    Command,
    HandInfo,
    Periods,
    Status,
    identifier,
)
from rtee.drivers.allegro.control import JointControl
from rtee.drivers.allegro.emulator import AllegroEmulator
from rtee.drivers.allegro.options import AllegroOptions
from rtee.drivers.base import Driver
from rtee.drivers.emulators import emulator_of, owner_of
from rtee.drivers.options import read_options
from rtee.errors import (
    BusError,
    BusTimeout,
    ConfigError,
    DeviceFault,
    HandshakeError,
    NotConnected,
    RteeError,
)
from rtee.types import ActuatorState, Capabilities, DeviceSpec, Reference

if TYPE_CHECKING:
    from rtee.buses.pool import BusPool

_STALE = 0.25
_SERVO_OFF = 0x100
_PAUSE = 0.0005
_PATIENCE = 6.0


class AllegroDriver(Driver):
    """An Allegro Hand, version 4 or 5.

    The hand tells its positions by itself every 2 or 3 ms and drives its joints with the torques it
    was sent last. So the joint control (PD about the reference) runs here, once per set of position
    frames, in the event loop and apart from the cycle of sense and move: `move` changes its
    reference, `sense` tells what it measured last. The hand cannot hold anything by itself; without
    the control it is switched off.

    Attributes:
        control: The joint control.
    """

    Options: ClassVar[type[AllegroOptions]] = AllegroOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(AllegroOptions, spec)
        self._joints = _wire_order(spec, self.options)
        self._bus: CanBus | None = None
        self._undo: list[Callable[[], None]] = []
        self._info: HandInfo | None = None
        self._count = 0
        self._driving = False
        self._told = -1
        self.control = self._controller(self.options.version or 4)
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort", "temperature"}),
            accepts=frozenset({"position", "max_effort"}),
            best_rate=1000.0 / self._period(self.options.version or 4),
            recoverable=True,
            gains=("kp", "ki", "kd"),
        )

    def _controller(self, version: int) -> JointControl:
        options = self.options
        return JointControl(
            SCALES[version],
            kp=options.kp,
            kd=options.kd,
            ki=options.ki,
            most_integral=options.max_integral,
            max_torque=options.max_torque,
            smoothing=options.smoothing,
            period=self._period(version) * 1e-3,
        )

    def _period(self, version: int) -> int:
        return self.options.period or SCALES[version].period_ms

    @property
    def _can(self) -> CanBus:
        if self._bus is None:
            raise NotConnected(self.spec.name, "is not connected")
        return self._bus

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the bus, identify the hand and have it tell its positions; no torque is sent."""
        await self.close()
        options = self.options
        self._bus = await self.buses.can(
            options.channel,
            owner=owner_of(self.spec),
            interface=options.interface,
            bitrate=codec.BITRATE,
            emulator=emulator_of(self.spec, AllegroEmulator),
        )
        info = await self._identify()
        version = info.version if options.version is None else options.version
        self.control = self._controller(version)
        for finger in range(FINGERS):
            self._undo.append(
                self._bus.subscribe(
                    self._listener(finger),
                    identifier(Command.FINGER_POSE + finger, options.hand),
                )
            )
        await self._bus.send(Periods(self._period(version)).to_frame(options.hand))
        await self._first_set()
        serial = await self._ask(Command.SERIAL, least=1, within=_PATIENCE * options.deadline)
        self.capabilities = replace(
            self.capabilities,
            best_rate=1000.0 / self._period(version),
            identity={
                "model": f"Allegro Hand V{info.version}",
                "firmware": f"{info.firmware:#06x}",
                "serial": serial.data.decode("ascii", "replace").strip("\x00 "),
            },
        )

    async def _identify(self) -> HandInfo:
        options = self.options
        try:
            info = await self._read_info(_PATIENCE * options.deadline)
        except BusTimeout as error:
            raise NotConnected(
                self.spec.name,
                f"no Allegro Hand answers as number {options.hand} on {options.channel}",
                hint="is its supply on, the bus terminated and at 1 Mbit/s, and `hand` right?",
            ) from error
        expected = {options.version} if options.version else set(SCALES)
        if info.version not in expected:
            raise HandshakeError(
                self.spec.name,
                " or ".join(f"version {v}" for v in sorted(expected)),
                f"version {info.version}",
                hint="the scales of other versions are not known",
            )
        side = "left" if info.handedness else "right"
        if options.side is not None and info.version == 4 and side != options.side:
            raise HandshakeError(self.spec.name, f"a {options.side} hand", f"a {side} one")
        return info

    async def _ask(self, command: Command, *, least: int, within: float) -> CanFrame:
        wanted = identifier(command, self.options.hand)

        def answers(frame: CanFrame) -> bool:
            return frame.id == wanted and not frame.remote and len(frame.data) >= least

        return await self._can.request(
            codec.request(command, self.options.hand), answers, within, retries=2
        )

    async def _read_info(self, within: float | None = None) -> HandInfo:
        frame = await self._ask(Command.HAND_INFO, least=7, within=within or self.options.deadline)
        self._info = HandInfo.from_bytes(frame.data)
        return self._info

    async def _first_set(self) -> None:
        end = time.monotonic() + _PATIENCE * self.options.deadline
        while not self.control.sets:
            if time.monotonic() > end:
                raise NotConnected(self.spec.name, "the hand does not tell its positions")
            await asyncio.sleep(0.002)

    async def activate(self) -> None:
        """Switch the motors on and hold the measured pose."""
        self._hold()
        await self._can.send(codec.order(Command.SYSTEM_ON, self.options.hand))
        await asyncio.sleep(_PAUSE)
        self._driving = True
        self._refuse(await self._read_info(_PATIENCE * self.options.deadline))
        self._hold()

    def _hold(self) -> None:
        for joint in self._joints:
            self.control.refer(joint, self.control.position[joint])

    async def deactivate(self) -> None:
        """Send no torque, then switch the motors off."""
        self._driving = False
        self.control.limp()
        if self._bus is not None:
            self._send([[0] * (JOINTS // FINGERS)] * FINGERS)
            await self._bus.send(codec.order(Command.SYSTEM_OFF, self.options.hand))

    async def close(self) -> None:
        """Switch the hand off, silence it and give the bus back."""
        bus = self._bus
        for undo in self._undo:
            undo()
        self._undo.clear()
        if bus is None:
            return
        with contextlib.suppress(BusError):
            if self._driving:
                await self.deactivate()
            await bus.send(Periods().to_frame(self.options.hand))
        self._bus = None
        self._driving = False
        await bus.release(owner_of(self.spec))

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the bus."""
        return {} if self._bus is None else self._bus.counters.as_mapping()

    # --- the joint control -------------------------------------------------------------------

    def _listener(self, finger: int) -> Callable[[CanFrame], None]:
        def take(frame: CanFrame) -> None:
            if frame.remote:
                return
            try:
                counts = codec.read_counts(frame.data)
            except AllegroFrameError:
                return
            torques = self.control.take(finger, counts, frame.stamp)
            if torques is not None and self._driving:
                with contextlib.suppress(BusError):
                    self._send(torques)

        return take

    def _send(self, torques: list[list[int]]) -> None:
        for finger, counts in enumerate(torques):
            frame = CanFrame(
                identifier(Command.SET_TORQUE + finger, self.options.hand),
                codec.pack_counts(counts),
            )
            self._can.send_now(frame)

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the newest complete set of positions; effort is the torque sent."""
        self._can.check()
        self._count += 1
        if self._count % self.options.info_every == 0:
            self._refuse(await self._read_info())
        control = self.control
        if time.monotonic() - control.stamp > _STALE:
            raise BusTimeout(self._can.name, f"no positions for more than {_STALE:g} s")
        fresh, self._told = control.sets != self._told, control.sets
        info = self._info
        temperature = math.nan if info is None else float(info.temperature)
        state = ActuatorState.measured(
            [control.position[j] for j in self._joints],
            control.stamp,
            velocity=[control.velocity[j] for j in self._joints],
            effort=[control.torque[j] for j in self._joints],
            temperature=np.full(len(self._joints), temperature),
        )
        return state if fresh else replace(state, fresh=False)

    async def move(self, reference: Reference) -> None:
        """Change the reference and the limits of the joint control."""
        self._can.check()
        for i, joint in enumerate(self._joints):
            if reference.mask[i]:
                self.control.limit(joint, float(reference.max_effort[i]))
                self.control.refer(
                    joint, float(reference.position[i]), float(reference.velocity[i])
                )

    def _refuse(self, info: HandInfo) -> None:
        faults = [
            (Status.OVER_TEMPERATURE, "over-temperature", "let it cool down, then `rtee recover`"),
            (Status.COMMUNICATION, "internal communication", "`rtee recover`, or a power cycle"),
        ]
        for bit, name, hint in faults:
            if info.status & bit:
                self._driving = False
                raise DeviceFault(self.spec.name, int(bit), name, hint=hint)
        if self._driving and not info.status & Status.SERVO_ON:
            self._driving = False
            raise DeviceFault(
                self.spec.name,
                _SERVO_OFF,
                "motors off",
                hint="was its supply cut? `rtee recover` switches them on again",
            )

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change stiffness ``kp`` [N·m/rad], damping ``kd`` [N·m·s/rad] and integral ``ki``."""
        self.control.kp = max(0.0, gains.get("kp", self.control.kp))
        self.control.ki = max(0.0, gains.get("ki", self.control.ki))
        self.control.kd = max(0.0, gains.get("kd", self.control.kd))

    async def stop(self) -> None:
        """Hold the measured pose."""
        self._hold()

    async def release(self) -> None:
        """Send no torque and switch the motors off."""
        with contextlib.suppress(RteeError, OSError):
            await self.deactivate()

    async def recover(self) -> None:
        """Switch the hand off and on, which clears what can be cleared; it stays limp."""
        self._driving = False
        self.control.limp()
        hand = self.options.hand
        await self._can.send(codec.order(Command.SYSTEM_OFF, hand))
        await asyncio.sleep(_PAUSE)
        await self._can.send(Periods(self._period(self.control.scale.version)).to_frame(hand))
        await self._can.send(codec.order(Command.SYSTEM_ON, hand))
        await asyncio.sleep(_PAUSE)
        self._refuse(await self._read_info(_PATIENCE * self.options.deadline))


def _wire_order(spec: DeviceSpec, options: AllegroOptions) -> list[int]:
    """Return the joint on the wire of each actuator; raises `ConfigError`."""
    names = [a.name for a in spec.actuators]
    if not options.joints:
        if len(names) != JOINTS:
            raise ConfigError(
                f"device '{spec.name}': an Allegro Hand has {JOINTS} actuators "
                f"({', '.join(NAMES)}, four each), not {len(names)}; name those there are by the "
                "option 'joints'"
            )
        return list(range(JOINTS))
    missing = [name for name in names if name not in options.joints]
    found = [options.joints[name] for name in names if name not in missing]
    if missing or len(set(found)) != len(found):
        raise ConfigError(
            f"device '{spec.name}': option 'joints' must give each actuator a joint of its own; "
            f"{'missing: ' + ', '.join(missing) if missing else 'two have the same'}"
        )
    return found
