"""Motors and constraints of a MuJoCo model, and the motion of its joints that follows from them.

Positions are MuJoCo's minus the model's own (``qpos0``), and so 0 in the model's posture. MuJoCo's
equalities use these positions, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from rtee.errors import ModelError
from rtee.sample import FloatArray

TINY = 1e-9
"""Size below which slopes and remainders count as rounding [rad, m and their quotients]."""

_NARROW = 0.1
"""Share of a tendon's travel that its limits permit, below which they couple its joints. The limits
permit 0.08 in hands whose two tendons cross at the last joint, and 1 if they only end a motion."""

_RIGID = 1e9
"""Stiffness of such a coupling, whose largest factor is 1 [N·m/rad | N/m]: a billion times that of
the springs of fingers."""


@dataclass(frozen=True, slots=True)
class Motor:
    """An actuator of the model.

    Attributes:
        name: Name of the actuator; may be empty.
        joint: The joint that it moves; ``None`` if it pulls a tendon.
        tendon: The tendon that it pulls.
        lower: Lower limit of the joint's position or the tendon's length [rad | m]; ``-inf``: none.
        upper: Upper limit.
        effort: Largest torque or force at the joint or tendon [N·m | N]; 0 if unknown.
    """

    name: str
    joint: int | None
    tendon: int | None
    lower: float = -math.inf
    upper: float = math.inf
    effort: float = 0.0


@dataclass(frozen=True, slots=True)
class LinearCoupling:
    """A linear coupling of joint positions: ``Σ factor · q = value``.

    Attributes:
        factors: The factors by joint.
        value: The value.
        weight: Stiffness of the spring; 0 for a rigid coupling.
        equality: Number of the model's equality, if it comes from one.
    """

    factors: Mapping[int, float]
    value: float
    weight: float = 0.0
    equality: int = -1


@dataclass(frozen=True, slots=True)
class PolynomialCoupling:
    """A joint that follows another one by a polynomial.

    Attributes:
        joint: The joint.
        of: The joint that it follows.
        coefficients: ``c₀ … c₄``.
        equality: Number of the model's equality.
    """

    joint: int
    of: int
    coefficients: tuple[float, ...]
    equality: int

    @property
    def straight(self) -> bool:
        """Whether the polynomial is linear."""
        return not any(self.coefficients[2:])


@dataclass(frozen=True, slots=True)
class Loop:
    """A constraint that is solved numerically: ``connect``, ``weld``, a spatial tendon.

    Attributes:
        what: Name of the constraint for messages.
        joints: The joints involved.
        equality: Number of the model's equality; -1 for a tendon that a motor pulls.
    """

    what: str
    joints: frozenset[int]
    equality: int = -1


@dataclass(frozen=True, slots=True)
class Follow:
    """Coupling of a joint of the hand to another one.

    Attributes:
        of: The joint that it follows.
        factor: Factor of a linear coupling.
        offset: Offset of a linear coupling [rad | m].
        expression: Expression in ``x`` that replaces factor and offset.
    """

    of: int
    factor: float = 1.0
    offset: float = 0.0
    expression: str | None = None


@dataclass(frozen=True, slots=True)
class Driven:
    """A joint with a motor.

    Attributes:
        lower: Lower limit [rad | m]; ``-inf`` for none.
        upper: Upper limit [rad | m].
        effort: Effort limit [N·m | N]; 0 if unknown.
    """

    lower: float
    upper: float
    effort: float


@dataclass(slots=True)
class ModelMotion:
    """Motion of the joints of a hand.

    Attributes:
        driven: The joints with motors.
        follows: The joints that follow others.
        fixed: Positions of the joints that do not move [rad | m].
        passive: The joints that no motor moves.
        dropped: Joints of motors that are not part of the hand.
        notes: Sentences about the choices made.
    """

    driven: dict[int, Driven] = field(default_factory=dict)
    follows: dict[int, Follow] = field(default_factory=dict)
    fixed: dict[int, float] = field(default_factory=dict)
    passive: list[int] = field(default_factory=list)
    dropped: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class ModelConstraints:
    """Motors and constraints of a model's joints.

    Attributes:
        motors: The actuators.
        fixed: Positions of joints that are held.
        lines: Rigid linear couplings.
        springs: Linear couplings by springs.
        curves: Polynomial couplings.
        loops: Constraints that are solved numerically.
        cords: Spatial tendons with springs, whose levers change with the posture.
        notes: Sentences about the choices made.
    """

    motors: list[Motor]
    fixed: dict[int, float] = field(default_factory=dict)
    lines: list[LinearCoupling] = field(default_factory=list)
    springs: list[LinearCoupling] = field(default_factory=list)
    curves: list[PolynomialCoupling] = field(default_factory=list)
    loops: list[Loop] = field(default_factory=list)
    cords: list[int] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return a joint's name, or one made of its number."""
    return str(model.joint(joint).name) or f"joint_{joint}"


def tendon_factors(model: mujoco.MjModel, tendon: int) -> dict[int, float] | None:
    """Return a fixed tendon's factors by joint; ``None`` if the tendon is spatial."""
    first, number = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    factors: dict[int, float] = {}
    for i in range(first, first + number):
        if model.wrap_type[i] != mujoco.mjtWrap.mjWRAP_JOINT:
            return None
        joint = int(model.wrap_objid[i])
        # Added up, since a tendon may name a joint several times.
        factors[joint] = factors.get(joint, 0.0) + float(model.wrap_prm[i])
    return factors


def motor_factors(model: mujoco.MjModel, motor: Motor) -> dict[int, float] | None:
    """Return the factors by joint of a motor's position; ``None`` if its tendon is spatial."""
    if motor.joint is not None:
        return {motor.joint: 1.0}
    assert motor.tendon is not None  # noqa: S101 - a motor moves one of both
    return tendon_factors(model, motor.tendon)


def motor_joints(model: mujoco.MjModel, motor: Motor) -> frozenset[int]:
    """Return the joints that a motor moves or whose tendon it pulls."""
    if motor.tendon is not None:
        return tendon_joints(model, motor.tendon)
    return frozenset(motor_factors(model, motor) or ())


def resting_length(model: mujoco.MjModel, factors: Mapping[int, float]) -> float:
    """Return a motor's position or a fixed tendon's length in the model's posture [rad | m]."""
    return sum(factor * float(model.qpos0[joint]) for joint, factor in factors.items())


def constraints_of(model: mujoco.MjModel) -> ModelConstraints:
    """Return the motors and constraints of a model.

    Raises:
        ModelError: if an actuator moves something other than a joint or tendon.
    """
    constraints = ModelConstraints(_motors(model))
    for i in range(model.neq):
        if model.eq_active0[i]:
            _add_equality(model, i, constraints)
    for tendon in range(model.ntendon):
        factors, stiffness = tendon_factors(model, tendon), float(model.tendon_stiffness[tendon])
        if factors is not None and stiffness > 0.0:
            lower, upper = model.tendon_lengthspring[tendon]
            # Such a spring may have a dead band, which its middle represents.
            value = 0.5 * (float(lower) + float(upper)) - resting_length(model, factors)
            constraints.springs.append(LinearCoupling(factors, value, stiffness))
        elif stiffness > 0.0:
            constraints.cords.append(tendon)
        _add_limited_tendon(model, tendon, constraints)
    for motor in constraints.motors:
        if motor_factors(model, motor) is None:
            joints = motor_joints(model, motor)
            constraints.loops.append(Loop(f"spatial tendon of '{motor.name}'", joints))
    for joint in range(model.njnt):
        stiffness = float(model.jnt_stiffness[joint])
        if stiffness > 0.0:
            away = float(model.qpos_spring[joint] - model.qpos0[joint])
            constraints.springs.append(LinearCoupling({joint: 1.0}, away, stiffness))
    return constraints


def _add_limited_tendon(model: mujoco.MjModel, tendon: int, constraints: ModelConstraints) -> None:
    """Add a coupling of the joints of a fixed tendon whose limits hardly let it move.

    The coupling is a stiff spring, by which a joint without a motor follows, but which motors and
    equalities override.
    """
    factors = tendon_factors(model, tendon)
    moved = {joint for motor in constraints.motors for joint in motor_joints(model, motor)}
    if not model.tendon_limited[tendon] or factors is None or not factors.keys() - moved:
        return
    spans = {joint: np.subtract(*joint_range(model, joint)[::-1]) for joint in factors}
    travel = sum(abs(factor) * float(spans[joint]) for joint, factor in factors.items())
    lower, upper = (float(end) for end in model.tendon_range[tendon])
    if len(factors) < 2 or not math.isfinite(travel) or upper - lower > _NARROW * travel:
        return
    largest = max(map(abs, factors.values()))
    value = (0.5 * (lower + upper) - resting_length(model, factors)) / largest
    line = {joint: factor / largest for joint, factor in factors.items()}
    constraints.springs.append(LinearCoupling(line, value, _RIGID))
    constraints.notes.append(
        f"tendon '{model.tendon(tendon).name}' can move by only {upper - lower:g}, so joints "
        f"{names_of(model, factors)} count as coupled"
    )


def _motors(model: mujoco.MjModel) -> list[Motor]:
    motors: dict[tuple[int | None, int | None], Motor] = {}
    kinds = mujoco.mjtTrn
    for i in range(model.nu):
        kind, target = kinds(int(model.actuator_trntype[i])), int(model.actuator_trnid[i, 0])
        name = str(model.actuator(i).name) or f"actuator_{i}"
        if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            joint, tendon = target, None
        elif kind == kinds.mjTRN_TENDON:
            joint, tendon = None, target
        else:
            raise ModelError(
                f"actuator '{name}' moves neither a joint nor a tendon, so rtee cannot command it"
            )
        # Joints and tendons use the first of the six numbers.
        gear = float(model.actuator_gear[i, 0])
        # With a gear of 0, the motor has no effect on the joint.
        if abs(gear) < TINY:
            continue
        motor = Motor(
            name, joint, tendon, *_targets(model, i, gear), _effort(model, i, joint, gear)
        )
        earlier = motors.get((joint, tendon))
        if earlier is not None:
            # A joint may have a position and a velocity actuator, of which one has the limits.
            motor = replace(
                earlier,
                lower=max(earlier.lower, motor.lower),
                upper=min(earlier.upper, motor.upper),
                effort=max(earlier.effort, motor.effort),
            )
        motors[joint, tendon] = motor
    return list(motors.values())


def _targets(model: mujoco.MjModel, i: int, gear: float) -> tuple[float, float]:
    """Return the limits of a position actuator's targets as positions or lengths [rad | m]."""
    gain, slope = float(model.actuator_gainprm[i, 0]), float(model.actuator_biasprm[i, 1])
    servo = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and slope < 0.0 < gain
    limited, targets = model.actuator_ctrllimited[i], model.actuator_ctrlrange[i]
    # If the controls are velocities (intvelocity), the target is their integral.
    if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR:
        limited, targets = model.actuator_actlimited[i], model.actuator_actrange[i]
    if not (servo and limited):
        return -math.inf, math.inf
    # At rest, gain · target = -slope · (gear · length), which gives the length for a target.
    ends = sorted(float(end) * gain / -slope / gear for end in targets)
    return ends[0], ends[1]


def _effort(model: mujoco.MjModel, i: int, joint: int | None, gear: float) -> float:
    limits = []
    if model.actuator_forcelimited[i]:
        # The larger side, since rtee has one limit for both directions.
        limits.append(float(np.abs(model.actuator_forcerange[i]).max()) * abs(gear))
    # The force is the control times the gain only without a bias, unlike that of a servo.
    elif model.actuator_ctrllimited[i] and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE:
        gain = abs(float(model.actuator_gainprm[i, 0]) * gear)
        limits.append(float(np.abs(model.actuator_ctrlrange[i]).max()) * gain)
    if joint is not None and model.jnt_actfrclimited[joint]:
        limits.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
    return min(limits, default=0.0)


def _add_equality(model: mujoco.MjModel, i: int, constraints: ModelConstraints) -> None:
    kinds, data = mujoco.mjtEq, model.eq_data[i]
    first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    polynomial = tuple(float(c) for c in data[:5])
    kind = kinds(int(model.eq_type[i]))
    match kind:
        case kinds.mjEQ_JOINT if second < 0:
            constraints.fixed[first] = polynomial[0]
        case kinds.mjEQ_JOINT:
            constraints.curves.append(PolynomialCoupling(first, second, polynomial, i))
        case kinds.mjEQ_TENDON:
            factors = tendon_factors(model, first)
            others = tendon_factors(model, second) if second >= 0 else {}
            if factors is None or others is None or (second >= 0 and any(polynomial[2:])):
                joints = tendon_joints(model, first)
                if second >= 0:
                    joints |= tendon_joints(model, second)
                constraints.loops.append(Loop(f"tendon '{model.tendon(first).name}'", joints, i))
                return
            total = dict(factors)
            for joint, factor in others.items():
                total[joint] = total.get(joint, 0.0) - polynomial[1] * factor
            constraints.lines.append(LinearCoupling(total, polynomial[0], equality=i))
        case kinds.mjEQ_CONNECT | kinds.mjEQ_WELD:
            word = "connect" if kind == kinds.mjEQ_CONNECT else "weld"
            name = str(model.eq(i).name) or f"number {i + 1}"
            constraints.loops.append(Loop(f"<{word}> {name}", _between(model, i), i))


def _between(model: mujoco.MjModel, i: int) -> frozenset[int]:
    """Return the joints on the path between the two bodies of an equality."""
    ends = [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
    if model.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE:
        ends = [int(model.site_bodyid[end]) for end in ends]
    # Leave out joints above both bodies, which move them together and do not change the loop.
    return frozenset(_joints_to(model, ends[0]) ^ _joints_to(model, ends[1]))


def _joints_to(model: mujoco.MjModel, body: int) -> set[int]:
    """Return the joints between the world and a body."""
    joints: set[int] = set()
    while body > 0:
        first = int(model.body_jntadr[body])
        joints |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return joints


def tendon_joints(model: mujoco.MjModel, tendon: int) -> frozenset[int]:
    """Return the joints that may change a tendon's length."""
    factors = tendon_factors(model, tendon)
    if factors is not None:
        return frozenset(factors)
    carriers: list[set[int]] = []
    first = int(model.tendon_adr[tendon])
    for i in range(first, first + int(model.tendon_num[tendon])):
        obj, kind = int(model.wrap_objid[i]), mujoco.mjtWrap(int(model.wrap_type[i]))
        if kind == mujoco.mjtWrap.mjWRAP_SITE:
            carriers.append(_joints_to(model, int(model.site_bodyid[obj])))
        elif kind in (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER):
            carriers.append(_joints_to(model, int(model.geom_bodyid[obj])))
    if not carriers:
        return frozenset()
    # A joint that carries all of the tendon does not change its length.
    return frozenset(carriers[0].union(*carriers) - carriers[0].intersection(*carriers))


def joint_range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Return a joint's limits [rad | m]; infinite if it has none."""
    if not model.jnt_limited[joint]:
        return -math.inf, math.inf
    lower, upper = model.jnt_range[joint] - model.qpos0[joint]
    return float(lower), float(upper)


def null_space(matrix: FloatArray, least: float | None = None) -> FloatArray:
    """Return an orthonormal basis ``(n, k)`` of the null space of a matrix ``(m, n)``.

    Singular values up to ``least`` count as 0; by default `TINY` times the largest, but at
    least `TINY`.
    """
    if not matrix.size:
        return np.eye(matrix.shape[1])
    _, sizes, directions = np.linalg.svd(matrix)
    if least is None:
        least = TINY * max(1.0, float(sizes[0]))
    return np.asarray(directions[int(np.sum(sizes > least)) :].T)


def names_of(model: mujoco.MjModel, joints: Iterable[int]) -> str:
    """Return the names of joints for a message."""
    names = [f"'{joint_name(model, joint)}'" for joint in sorted(joints)]
    return ", ".join(names[:6]) + (", …" if len(names) > 6 else "")


def rounded(value: float) -> float:
    """Return a number without its last digits, which are rounding errors of the solution."""
    return float(f"{value:.13g}") if abs(value) > 1e-13 else 0.0  # infinity stays infinity


def bare(model: mujoco.MjModel, joint: int) -> bool:
    """Return whether a joint's body has neither shapes nor child bodies."""
    body = int(model.jnt_bodyid[joint])
    return model.body_geomnum[body] == 0 and body not in model.body_parentid[1:]
