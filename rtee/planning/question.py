"""Ask a separate process for a plan; needs neither Pinocchio nor Coal."""

from __future__ import annotations

import base64
import json
import math
import os
import subprocess
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from numbers import Integral
from pathlib import Path
from typing import Any, Final

from rtee import child
from rtee.errors import ConfigError, RequestRejected
from rtee.hand.meshes import FORMATS
from rtee.objects.shape import Table, vector
from rtee.values import number

LONGEST: Final = 60_000
"""Longest mesh that is sent over the network [bytes]; a request has 64 KiB at most."""

_PATIENCE: Final = 60.0
"""Longest time for a plan on a busy computer [s]; a second or two are usual."""

_NICE: Final = 10
"""Nice value of planning above that of an ordinary program, see nice(2)."""

_MOST_CONTACTS: Final = 10
"""Most contacts of a grasp: hands have five fingers."""

_LONGEST_SHAPE: Final = 500
"""Longest text that may name a shape [characters]: real ones have up to forty."""


@dataclass(frozen=True, slots=True)
class Question:
    """The request for a plan.

    Attributes:
        object: The object as on the command line; the mesh's name where there is one.
        mesh: Content of its mesh file, or nothing.
        format: Suffix of that file.
        mass: Its mass [kg].
        friction: Coefficient of friction.
        scale: Brings the mesh to metres.
        weight_axis: Direction of its weight in the hand's base frame; empty: along its reach.
        top: How many grasps are wanted.
        table: The table on which it stands.
    """

    object: str
    mesh: bytes = b""
    format: str = ""
    mass: float = 0.1
    friction: float = 0.5
    scale: float = 1.0
    weight_axis: tuple[float, ...] = ()
    top: int = 5
    table: Table | None = None

    def check(self) -> None:
        """Validate the question; raises `ConfigError`. Checks that need the object come later."""
        # NaN for anything but a number: it fails every comparison.
        sizes = [_or_nan(each) for each in (self.mass, self.friction, self.scale)]
        if not all(0.0 < each < math.inf for each in sizes):
            raise ConfigError("mass, friction and scale of an object must be finite and above 0")
        if self.weight_axis:
            vector(self.weight_axis, "the weight axis")
        if self.mesh and self.format not in FORMATS:
            raise ConfigError(
                f"the mesh has the unknown format '{self.format[:20]}'; valid: {', '.join(FORMATS)}"
            )
        if len(self.mesh) > LONGEST:
            raise ConfigError(
                f"the mesh has {len(self.mesh) / 1e3:.1f} kB; at most {LONGEST / 1e3:.0f} kB can "
                "be sent to a hand; simplify it, or plan with its files by rtee grasp-plan"
            )
        if not 0 < len(self.object) <= _LONGEST_SHAPE:
            raise ConfigError("which object? give its shape, such as sphere:0.03")
        top: object = self.top
        if isinstance(top, bool) or not isinstance(top, Integral) or top < 1:
            raise ConfigError(f"at least one grasp must be wanted, not {top!r:.100}")
        if not isinstance(self.table, Table | None):
            raise ConfigError(f"a table is a Table(…), not {self.table!r:.100}")

    def words(self) -> dict[str, Any]:
        """Return the question as plain data, ready for JSON."""
        mesh = base64.b64encode(self.mesh).decode("ascii")
        return asdict(self) | {"top": int(self.top), "mesh": mesh}


@dataclass(frozen=True, slots=True)
class ReachQuestion:
    """Request to reach another planner's grasp: contacts, or a gripper's pose and width.

    Attributes:
        points: Points of the contacts, three numbers each [m]; none for a gripper's pose.
        normals: Their normals into the object, three numbers each; or none.
        fingers: The finger for each contact, or none; for a pose, the fingers to grasp with.
        width: Width of the object, for a pose [m].
        pose: 16 numbers, row by row: of the gripper, or of the palm for contacts; or none.
        approach: Direction in which the palm approaches; or none.
        retreat: Distance of the palm along it before the approach [m].
        tolerance: Farthest that a fingertip may be from its contact [m].
        object: Shape of the object, to look for collisions with it; or empty.
        object_pose: 16 numbers, row by row: its pose; or none.
    """

    points: tuple[float, ...] = ()
    normals: tuple[float, ...] = ()
    fingers: tuple[str, ...] = ()
    width: float = 0.0
    pose: tuple[float, ...] = ()
    approach: tuple[float, ...] = ()
    retreat: float = 0.1
    tolerance: float = 0.003
    object: str = ""
    object_pose: tuple[float, ...] = ()

    def check(self) -> None:
        """Validate the question; raises `ConfigError`. Checks that need the hand come later."""
        numbers = (*self.points, *self.normals, *self.pose, *self.approach, *self.object_pose)
        if not all(map(math.isfinite, (*numbers, self.width, self.retreat, self.tolerance))):
            raise ConfigError("a grasp to reach must consist of finite numbers")
        if len(self.points) % 3 or len(self.points) > 3 * _MOST_CONTACTS:
            raise ConfigError(
                f"a grasp may have at most {_MOST_CONTACTS} contacts, of three numbers each"
            )
        if self.normals and len(self.normals) != len(self.points):
            raise ConfigError("give a normal for each contact, or for none")
        if len(self.fingers) > _MOST_CONTACTS or (
            self.points and self.fingers and 3 * len(self.fingers) != len(self.points)
        ):
            raise ConfigError("give a finger for each contact, or for none")
        poses = (self.pose, self.object_pose)
        if any(len(each) not in (0, 16) for each in poses) or len(self.approach) not in (0, 3):
            raise ConfigError("a pose must have 16 numbers (4 by 4), and an approach 3")
        if not self.points and not self.pose:
            raise ConfigError("give contacts, or a gripper's pose and a width")
        if len(self.object) > _LONGEST_SHAPE:
            raise ConfigError("the object must be a shape, such as box:0.04x0.04x0.1")

    def words(self) -> dict[str, Any]:
        """Return the question as plain data, ready for JSON."""
        return {"reach": asdict(self)}


def _or_nan(value: object) -> float:
    plain = number(value)
    return math.nan if plain is None else plain


def question_about(obj: str, **options: Any) -> Question:
    """Return the question about an object, with the content of a mesh.

    Args:
        obj: A shape, or the path of a mesh, as text or as a path.
        options: Other fields of `Question`.

    Raises:
        ConfigError: if the question is invalid.
    """
    if not isinstance(obj, str | os.PathLike):
        raise ConfigError(f"an object is a shape, such as sphere:0.03, not {obj!r:.100}")
    path = Path(obj)
    if path.suffix.lower() in FORMATS:
        try:
            mesh = path.read_bytes()
        except OSError:
            raise ConfigError("no such mesh", path=path) from None
        question = Question(path.name, mesh, path.suffix.lower(), **options)
    else:
        question = Question(str(obj), **options)
    question.check()
    return question


def ask(
    folder: Path,
    question: Question | ReachQuestion,
    started: Callable[[subprocess.Popen[str]], object],
) -> str:
    """Return the answer as JSON; the ``from_document`` of `result` or `grasp_solution` reads it.

    Args:
        folder: The hand's folder.
        question: The request.
        started: Called with the process, which may be killed.

    Raises:
        ConfigError: if the question is invalid.
        RequestRejected: if there is no answer, with the reason.
    """
    question.check()
    words = {**question.words(), "hand": str(folder)}
    process = subprocess.Popen(
        child.python("-m", "rtee.planning"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=child.environment(),
        text=True,
    )
    _make_ordinary(process.pid)
    started(process)
    try:
        said, _ = process.communicate(json.dumps(words), timeout=_PATIENCE)
        found = json.loads(said)
    except subprocess.TimeoutExpired:
        process.kill()
        # Collects the exit status: otherwise a zombie stays.
        process.wait()
        raise RequestRejected(f"planning did not end within {_PATIENCE:g} s") from None
    except ValueError:
        raise RequestRejected(
            f"planning ended with exit status {process.returncode}; see rtee grasp-plan"
        ) from None
    if "error" in found:
        raise RequestRejected(found["error"])
    return json.dumps(found["answer"])


def _make_ordinary(process: int) -> None:
    """Let a process run like a background program, on all CPUs that the system lets it use.

    It would otherwise have the real-time priority and the one CPU of a loop that starts it.
    """
    if not hasattr(os, "sched_setscheduler"):
        return
    with suppress(OSError):  # it may have ended already
        os.sched_setscheduler(process, os.SCHED_OTHER, os.sched_param(0))
        os.setpriority(
            os.PRIO_PROCESS, process, max(_NICE, os.getpriority(os.PRIO_PROCESS, process))
        )
        os.sched_setaffinity(process, range(os.cpu_count() or 1))
