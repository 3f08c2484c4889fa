"""The description of a device for the contract suite."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rtee.types import ActuatorSpec, DeviceSpec, JointKind

CYCLES = "RTEE_CONTRACT_CYCLES"
"""Environment variable with the number of cycles for which every fault of the wire lasts; a device
is unplugged once in a hundred of them."""


def cycles(default: int = 10_000) -> int:
    """Return the number of cycles with faults of the wire: from the environment, or the default."""
    return int(os.environ.get(CYCLES, default))


def actuator(
    name: str,
    lower: float,
    upper: float,
    *,
    kind: JointKind = JointKind.REVOLUTE,
    velocity: float = 2.0,
    effort: float = 10.0,
    rest: float | None = None,
) -> ActuatorSpec:
    """Return an actuator for a test, with typical limits.

    Args:
        name: Its name.
        lower: Lower position limit [rad | m].
        upper: Upper position limit [rad | m].
        kind: Whether it rotates or translates.
        velocity: Velocity limit [rad/s | m/s].
        effort: Effort limit [N·m | N].
        rest: Rest position [rad | m]; by default the lower limit.
    """
    return ActuatorSpec(
        name,
        kind,
        lower,
        upper,
        velocity,
        acceleration=20.0,
        jerk=400.0,
        effort=effort,
        rest=lower if rest is None else rest,
    )


_APART: Final = 4.0
"""Least distance between the postures of an actuator, in tolerances: they must not be mistaken for
each other."""


@dataclass(frozen=True)
class DeviceCase:
    """A device for the contract suite, which tests its driver against its emulator.

    An attribute that is ``None`` skips the tests that need it; the skip names the attribute.

    Attributes:
        driver: Registry name, entry point or ``module:Class`` of the driver.
        actuators: The actuators of the device; empty for a device that only measures, which skips
            the tests of motion.
        options: The driver's options; they should allow homing on connect, quickly.
        emulator: Name of the emulator, if it differs from the driver's.
        rate: Rate of the loop [Hz].
        deadline: Longest time of one exchange [s]; ``None``: the driver's default.
        postures: Two postures to move between [rad | m]; by default a quarter and three quarters
            of the way from the lower to the upper limits.
        tolerance: Error within which a posture counts as reached [rad | m], at most a fourth of
            the distance between the postures.
        within: Longest time to reach a posture [s].
        stopping: Time after which a stopped device must be at rest [s].
        grip_object: Makes the emulated device active and holding an object, as found at start-up.
        commands: Returns the number of motion commands that the emulator has received.
        efforts: Returns the effort limits that applied when the last motion began, in SI units.
        max_efforts: Effort limits for the test of effort limits, within the device's range.
        fault: A fault of the emulator that the driver must report as `DeviceFault`.
        homes: Whether the device must home again after a power cycle.
        worn: Whether the emulator differs from the sheet as real devices do: lag, backlash, noise.
        wire: Whether the device is connected by a wire with its emulator at the other end; without
            one, tests that need the wire or the emulator are skipped.
        answers: Whether it answers requests; what a device sends by itself is not missed when it is
            lost once.
        checksums: Whether frames have checksums, so that corrupted ones are detected.
        wire_faults: Faults that its wire can have; by default all. Whole frames (CAN) or messages
            cannot be split, and no noise comes between them.
        cycles: Number of cycles for which every fault of the wire lasts; the device is unplugged a
            hundredth as often, and five times at least.
        share: Fraction of the cycles that must succeed at 5 % faults.
    """

    driver: str
    actuators: tuple[ActuatorSpec, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    emulator: str | None = None
    rate: float = 100.0
    deadline: float | None = None
    postures: tuple[Sequence[float], Sequence[float]] | None = None
    tolerance: float = 0.02
    within: float = 5.0
    stopping: float = 0.1
    grip_object: Callable[[Any], None] | None = None
    commands: Callable[[Any], int] | None = None
    efforts: Callable[[Any], Sequence[float]] | None = None
    max_efforts: Sequence[float] | None = None
    fault: str | None = None
    homes: bool = True
    worn: bool = False
    wire: bool = True
    answers: bool = True
    checksums: bool = True
    wire_faults: frozenset[str] | None = None
    cycles: int = field(default_factory=cycles)
    share: float = 0.5

    def __post_init__(self) -> None:
        """Refuse a tolerance within which a device that does not move would seem to arrive."""
        for actuator, near, far in zip(self.actuators, *self.between(), strict=True):
            apart = abs(far - near)
            if 0.0 < apart < _APART * self.tolerance:
                raise ValueError(
                    f"the postures of '{actuator.name}' are {apart:g} apart, too little for a "
                    f"tolerance of {self.tolerance:g}; give 'tolerance', such as {apart / 20:.1g}"
                )

    def spec(self, name: str = "device") -> DeviceSpec:
        """Return the device's specification, emulated."""
        return DeviceSpec(
            name=name,
            hand="contract",
            driver=self.driver,
            actuators=self.actuators,
            options=self.options,
            rate=self.rate,
            deadline=self.deadline,
            emulated=True,
            worn=self.worn,
            source="contract",
        )

    def between(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the two postures."""
        if self.postures is not None:
            return tuple(self.postures[0]), tuple(self.postures[1])
        near = tuple(a.lower + 0.25 * (a.upper - a.lower) for a in self.actuators)
        far = tuple(a.lower + 0.75 * (a.upper - a.lower) for a in self.actuators)
        return near, far
