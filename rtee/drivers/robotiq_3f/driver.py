"""Drives Robotiq's three-finger gripper over Modbus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

from msgspec import Meta, field

from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import GripForce
from rtee.drivers.options import Positive
from rtee.drivers.robotiq_3f import codec
from rtee.drivers.robotiq_common import INPUT, OUTPUT, SAME, RobotiqOptions, SteadyContact
from rtee.drivers.robotiq_driver import RobotiqDriver
from rtee.errors import ConfigError, DeviceFault
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

Role = Literal["fingers", "a", "b", "c", "scissor"]


class Robotiq3FOptions(RobotiqOptions, frozen=True):
    """Options of Robotiq's three-finger gripper."""

    mode: Literal["basic", "pinch", "wide", "scissor"] = "basic"
    """Arrangement of the fingers; changing it moves the scissor."""
    roles: dict[str, Role] = field(default_factory=dict)
    """Part that each actuator drives: fingers, a, b, c or scissor; guessed from names."""
    register_base: Literal[0, 1000] | None = None
    """Addresses of the blocks: 0, or 1000 and 2000; by default 0 on tcp://."""
    function: Literal[3, 4] | None = None
    """Modbus function to read with; by default 4 on tcp://, otherwise 3."""
    current_per_count: Annotated[float, Meta(gt=0, le=1)] = 0.01
    """Current per count [A]; the manuals contradict each other about it."""
    activation_timeout: Positive = 30.0
    """Longest time of an activation or a change of mode [s]."""


def roles_of(spec: DeviceSpec, options: Robotiq3FOptions) -> tuple[Role, ...]:
    """Return the part that each actuator drives: as configured, otherwise guessed from the names.

    Raises `ConfigError` if two drive the same motor, or a name is not one of the device's.
    """
    names = [actuator.name for actuator in spec.actuators]
    key = f"devices.{spec.name}.options.roles"
    for name in options.roles:
        if name not in names:
            raise ConfigError(
                f"device '{spec.name}': option 'roles' names '{name}', which is not one of its "
                "actuators",
                key=key,
            )
    fingers = [name for name in names if "palm" not in name and name not in options.roles]
    guessed: dict[str, Role] = {name: "scissor" for name in names if "palm" in name}
    if len(fingers) == 1 and not any(r in ("a", "b", "c") for r in options.roles.values()):
        guessed[fingers[0]] = "fingers"
    for name in fingers if len(fingers) > 1 else ():
        guessed[name] = "c" if "middle" in name else "b" if "_2" in name else "a"
    roles = tuple(options.roles.get(name, guessed.get(name, "fingers")) for name in names)
    if len(set(roles)) != len(roles) or ("fingers" in roles and {"a", "b", "c"} & set(roles)):
        raise ConfigError(
            f"device '{spec.name}': two actuators drive the same motor "
            f"({', '.join(f'{n}: {r}' for n, r in zip(names, roles, strict=True))}); "
            "set `roles` in its options",
            key=key,
        )
    if not roles:
        raise ConfigError(f"device '{spec.name}': it has no actuators", key=key)
    return roles


_PRESSING = (codec.Contact.OPENING, codec.Contact.CLOSING)
_OPEN, _CLOSED = 10, 250
"""A contact beyond these positions [count] is the end stop itself."""


class Robotiq3FDriver(RobotiqDriver[codec.Status, codec.Command]):
    """The three-finger gripper: all fingers together or each by itself, and the scissor.

    A motor that presses on an object keeps pressing while its reference is the measured position.
    """

    Options = Robotiq3FOptions
    options: Robotiq3FOptions
    MODEL = "Robotiq 3-Finger"
    STATUS = codec.Status
    COMMAND = codec.Command
    FAULTS = codec.FAULTS
    HINT = (
        "`rtee recover`, or `rtee run --home`, activates it: all fingers and the scissor then "
        "move, so nothing may be between them"
    )

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.roles = roles_of(spec, self.options)
        self._individual = any(role in ("a", "b", "c") for role in self.roles)
        self._scissor = "scissor" in self.roles
        self._grips = tuple(SteadyContact() for _ in codec.AXES)

    async def _identify(self) -> None:
        await super()._identify()
        # The scissor rests in the middle and open fingers at some counts, so zeros mean that there
        # are no such motors. No manual says what an inactive gripper reports: hence the option.
        if self.options.check_fingers and not any(axis.position for axis in self._status.axes[1:]):
            raise self.stranger(
                f"a {self.MODEL}",
                "one with fewer motors",
                hint="for a 2-finger gripper set 'driver: robotiq_2f'; if it has three fingers, "
                "'check_fingers: false'",
            )

    async def configure(self) -> None:
        """Open the line and check that such a gripper answers; moves nothing."""
        await super().configure()
        # All fingers by one actuator: the force of one side is balanced by the other side.
        grip = GripForce(codec.SCALES["fingers"].effort.si, codec.FORCE[:1], codec.FORCE[1:])
        fingers = [
            a.name
            for a, role in zip(self.spec.actuators, self.roles, strict=True)
            if role == "fingers"
        ]
        self.refine(grip=dict.fromkeys(fingers, grip))

    def _places(self) -> tuple[int, int, int]:
        network, base = self.options.port.startswith("tcp://"), self.options.register_base
        zero = network if base is None else base == 0
        places = (0, 0) if zero else (OUTPUT, INPUT)
        # On TCP both blocks begin at 0, and the function distinguishes them.
        return *places, self.options.function or (4 if network else 3)

    def _identity(self) -> Mapping[str, str]:
        return {
            "model": self.MODEL,
            "address": f"unit {self.options.unit}",
            "mode": self.options.mode,
        }

    @property
    def _mode(self) -> codec.Mode:
        return codec.Mode[self.options.mode.upper()]

    async def _prepare(self, allowed: bool) -> None:
        """Change the mode if another one is configured, which moves the scissor."""
        if self._scissor or self._status.mode is self._mode:
            return
        if not allowed:
            raise self.fault(
                0x06,
                f"in mode '{self._status.mode.name.lower()}', not '{self.options.mode}'",
                hint="`rtee recover` changes the mode, which moves the scissor",
            )
        await self._within("changing its mode", self._change_mode, self._mode_too_slow)

    async def _change_mode(self) -> None:
        await self._write(codec.Command(activate=True, mode=self._mode).to_registers()[: self.USED])
        await self._until(lambda status: status.ready and status.mode is self._mode)

    def _mode_too_slow(self) -> DeviceFault:
        hint = "free the scissor, then `rtee recover`"
        return self.fault(0x0E, "the change of mode did not finish in time", hint=hint)

    # --- every cycle -------------------------------------------------------------------------

    def _measured(self, status: codec.Status, stamp: float) -> ActuatorState:
        return ActuatorState.measured(
            [codec.SCALES[role].position.within(self._position(role)) for role in self.roles],
            stamp,
            current=[self._current(role) for role in self.roles],
            grasped=tuple(self._grasped(role) for role in self.roles),
            warnings=self._warnings(status),
        )

    def _axes(self, role: str) -> tuple[codec.AxisStatus, ...]:
        """Return the motors that an actuator drives."""
        axes = self._status.axes
        return axes[:3] if role == "fingers" else (axes[codec.AXES.index(role)],)

    def _position(self, role: str) -> float:
        """Return an actuator's count: for all fingers together, their mean."""
        axes = self._axes(role)
        return sum(axis.position for axis in axes) / len(axes)

    def _current(self, role: str) -> float:
        # The largest of the three motors: each motor heats up and overloads by itself.
        return max(axis.raw_current for axis in self._axes(role)) * self.options.current_per_count

    def _grasped(self, role: str) -> bool | None:
        """Return whether an actuator's motors press on something, short of their end stops."""
        if role == "scissor" and self._status.mode is not codec.Mode.SCISSOR:
            return None
        if role == "fingers":
            touching = [self._touches(at) for at in (0, 1, 2)]  # all, since each has a memory
            return any(touching)
        return self._touches(codec.AXES.index(role))

    def _touches(self, at: int) -> bool:
        """Return whether a motor presses on something, short of its end stops."""
        axis, going = self._status.axes[at], self._status.going
        contact = going and (
            (axis.contact is codec.Contact.CLOSING and axis.position < _CLOSED)
            or (axis.contact is codec.Contact.OPENING and axis.position > _OPEN)
        )
        # Motors without individual commands echo no request of their own.
        requested = axis.requested if self._sent is None else self._sent.axes[at].position
        moving = going and axis.contact is codec.Contact.MOVING
        return self._grips[at].steady(contact, moving, axis.position, requested)

    def _registers_for(self, reference: Reference) -> Sequence[int] | None:
        axes = [self._kept(at) for at in range(4)]
        moving = self._sent is not None
        for index, role in enumerate(self.roles):
            if not reference.mask[index]:
                continue
            scale = codec.SCALES[role]
            request = codec.Request(
                scale.position.to_count(float(reference.position[index])),
                scale.velocity.to_count(float(reference.max_velocity[index])),
                scale.effort.to_count(float(reference.max_effort[index])),
            )
            # A reference at the measured position would end a grip; see `_request`.
            stays = abs(request.position - self._position(role)) <= SAME
            moving |= not stays
            for at in (0, 1, 2) if role == "fingers" else (codec.AXES.index(role),):
                axes[at] = self._request(at, request, stays)
        if not moving:
            return None
        self._sent = self._command(axes, self._status.mode if self._scissor else self._mode, True)
        return self._registers(self._sent)

    def _command(self, axes: Sequence[codec.Request], mode: codec.Mode, go: bool) -> codec.Command:
        return codec.Command(
            activate=go or self._status.activated,
            mode=mode,
            go=go,
            individual=self._individual,
            scissor=self._scissor,
            axes=tuple(axes),
        )

    def _registers(self, command: codec.Command) -> Sequence[int]:
        registers = command.to_registers()
        return registers if self._individual or self._scissor else registers[: self.USED]

    def _request(self, at: int, request: codec.Request, stays: bool) -> codec.Request:
        pressing = self._status.axes[at].contact in _PRESSING
        if not (stays and (self._sent is None or pressing)):
            return request
        return codec.Request(self._kept(at).position, request.speed, request.force)

    def _kept(self, at: int) -> codec.Request:
        """Return the request that changes nothing for a motor."""
        if self._sent is not None:
            return self._sent.axes[at]
        axis = self._status.axes[at]
        if axis.contact in _PRESSING:
            first = self._status.axes[0].requested
            # Of fingers moved together, only finger a echoes a request; the others follow it.
            echo = axis.requested or (first if at < codec.FINGERS else 0)
            return codec.Request(echo or axis.position, 255, 255)
        return codec.Request(axis.position, 255, 255)

    def _stopping(self) -> Sequence[int]:
        axes = [self._kept(at) for at in range(4)]
        return self._registers(self._command(axes, self._status.mode, False))
