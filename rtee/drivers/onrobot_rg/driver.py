"""Drives an OnRobot RG2 or RG6 over Modbus, through the Compute Box or directly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta

from rtee.buses.modbus import ModbusBus
from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import Capabilities, GripForce
from rtee.drivers.onrobot_common import PRODUCT, PRODUCTS, TENTH_MM, OnRobotOptions, signed
from rtee.drivers.onrobot_driver import CONNECTING, OnRobotDriver
from rtee.drivers.onrobot_rg import codec
from rtee.drivers.options import Length
from rtee.drivers.step_follower import Order, StepFollower
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

_REACHED = 3
"""Difference to the measured width within which a target counts as reached [0.1 mm]: resolution and
rounding."""

_SAME = 10
"""Difference to the measured width within which a target commands no motion just after connecting
[0.1 mm].

It is ten times the resolution, since a held object yields a little.
"""

_EMPTY = 10
"""Fingertips within this distance of each other hold nothing [0.1 mm]: they press on each other."""


class OnRobotRGOptions(OnRobotOptions, frozen=True):
    """Options of an RG2 or RG6."""

    model: Literal["rg2", "rg6"] = "rg2"
    fingertip_offset: Annotated[float, Meta(ge=0.0, le=0.05)] | None = None
    """Thickness of the fingertips [m], set in the gripper when it is activated; by default its own
    setting is kept."""
    step: Length = 0.005
    """A moving reference is followed in steps of at least this width [m]."""


class OnRobotRGDriver(OnRobotDriver[codec.Status]):
    """An RG2 or RG6.

    The gripper has one command, *grip to a width with a force*, which it ignores while it is busy,
    and takes no speed. So references are followed in steps: see `StepFollower`.
    """

    Options = OnRobotRGOptions
    options: OnRobotRGOptions
    MODEL = "an OnRobot RG"
    STATUS = codec.Status
    COMMAND = codec.Command
    SOURCE = codec.STATE

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        actuator = spec.actuators[0]
        self._model = codec.MODELS[self.options.model]
        ends = spec.mechanism(actuator)
        self.scale = codec.LinkageScale(self._model, ends.lower, ends.upper)
        self._closed = self.scale.width(ends.lower)
        step = self.options.step / TENTH_MM
        self._follower = StepFollower(self.options.settle, step, _SAME, _REACHED)
        grip = GripForce(self.scale.effort.si, (0.0,), (self._model.force,))
        self.capabilities = Capabilities(
            measures=frozenset({"position", "grasped"}),
            accepts=frozenset({"position", "max_effort"}),
            refuses={"max_velocity": "it takes no speed; limit the velocity in hand.yaml"},
            best_rate=self.options.rate,
            recoverable=True,
            grip={actuator.name: grip},
            identity={"model": f"OnRobot {self._model.name}"},
        )

    # --- life --------------------------------------------------------------------------------

    async def _described(self, bus: ModbusBus) -> dict[str, str]:
        unit = self.options.unit
        [product] = await bus.read(unit, PRODUCT, 1, deadline=CONNECTING)
        model = PRODUCTS.get(product)
        # Older lists use other codes, so with an unknown code the option is trusted.
        if model is not None and model != self._model.name:
            ours = model.lower() in codec.MODELS
            raise self.stranger(
                f"an OnRobot {self._model.name}",
                f"an OnRobot {model}",
                hint=f"set 'model: {model.lower()}'" if ours else "is another tool mounted?",
            )
        offset = await self._offset(bus)
        return {"fingertip offset": f"{offset * TENTH_MM * 1000:.1f} mm"}

    async def _offset(self, bus: ModbusBus) -> int:
        [offset] = await bus.read(self.options.unit, codec.OFFSET, 1, deadline=CONNECTING)
        return signed(offset)

    async def activate(self) -> None:
        """Check that no safety switch prevents motion; set the fingertips' offset if given."""
        await super().activate()
        wanted = self.options.fingertip_offset
        if wanted is None:
            return
        bus, tenths = self.link.bus, round(wanted / TENTH_MM)
        # Only if it differs, so that activation changes no setting needlessly.
        if await self._offset(bus) != tenths:
            await bus.write(self.options.unit, codec.SET_OFFSET, (tenths,), deadline=CONNECTING)

    # --- every cycle -------------------------------------------------------------------------

    def _measured(self, status: codec.Status, stamp: float) -> ActuatorState:
        pushed = [f"safety switch {i + 1} is pushed" for i in range(2) if status.pushed[i]]
        return ActuatorState.measured(
            [self.scale.position(status.width)],
            stamp,
            grasped=(self._holds,),
            warnings=tuple(pushed),
        )

    @property
    def _holds(self) -> bool:
        return self._status.grip_detected and self._status.width > self._closed + _EMPTY

    async def move(self, reference: Reference) -> None:
        """Follow a reference in steps."""
        if not reference.mask[0]:
            return
        status = self._status
        width = self.scale.width(float(reference.position[0]))
        force = self.scale.effort.to_count(float(reference.max_effort[0]))
        order = self._follower.next(
            width, force, status.width, busy=status.busy, held=status.grip_detected
        )
        if order is not Order.NOTHING:
            go = codec.Command(force, width, codec.Control.GRIP).to_registers()
            await self.link.exchange(self._stopping() if order is Order.STOP else go)
            self._follower.sent()

    def _forget(self) -> None:
        self._follower.forget()

    # --- stop and faults ---------------------------------------------------------------------

    def _stopping(self) -> Sequence[int]:
        force = round(self._follower.force or 0.0)
        # Stop needs a target, too. A measured width may be negative, but the register is unsigned.
        return codec.Command(force, max(self._status.width, 0), codec.Control.STOP).to_registers()

    async def recover(self) -> None:
        """Stop, and check that no safety switch is pushed or has tripped."""
        await super().recover()
        for i, pushed in enumerate(self._status.pushed):
            if pushed:
                # The code is the number of the switch's bit in the status.
                raise self.fault(2 + 2 * i, f"safety switch {i + 1} is pushed", "release it")

    def _refuse(self, status: codec.Status) -> None:
        restart = "restart the tool, from the Compute Box's web page or by its power, then recover"
        for i, triggered in enumerate(status.triggered):
            if triggered:
                name = f"safety switch {i + 1} was pushed during a motion"
                raise self.fault(3 + 2 * i, name, f"free the switch, {restart}")
        if status.safety_error:
            name = "a safety switch was pushed at power-up"
            raise self.fault(6, name, f"free the switches, {restart}")
