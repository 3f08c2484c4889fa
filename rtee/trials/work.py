"""The work of a sweep's worker, on any computer: one task, whose answer names its versions."""

from __future__ import annotations

import base64
import gc
import hashlib
import importlib.metadata
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtee.actions.fingerprints import Fingerprints
from rtee.drivers.mujoco.options import SimOptions
from rtee.errors import RteeError
from rtee.hand.meshes import FORMATS
from rtee.hand.validation import validated
from rtee.objects.shape import is_shape
from rtee.planning.objects import read_object
from rtee.planning.plan import plan_grasps
from rtee.planning.planner import FRICTION
from rtee.planning.result import Ranking
from rtee.trials.bench import TrialBench, bench
from rtee.trials.headless import HeadlessHand
from rtee.trials.store import METHOD
from rtee.trials.trial import Trial, TrialResult, run_trial

_LIBRARIES: Final = (
    "mujoco",
    "numpy",
    "scipy",
    "pin",
    "coal",
    "libcoal",
    "coacd",
    "ruckig",
    "trimesh",
)
"""Packages whose version may change a digit of a result."""

_PORTRAIT: Final = (240, 200)
"""Width and height of a picture [pixels]: a cell of a table."""

_PACKAGE: Final = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True)
class Planning:
    """A request to the planner: which actions hold an object; see `plan_grasps`."""

    object: str
    mass: float = 0.1
    friction: float = FRICTION


@dataclass(frozen=True, slots=True)
class Planned:
    """The planner's answer: a ranking, or why there is none."""

    ranking: Ranking | None
    refused: str = ""


@dataclass(frozen=True, slots=True)
class Portrait:
    """A request for a picture of a trial's hand that has lifted its object.

    Attributes:
        trial: The trial, without variations.
        places: How many places were tried until it was held.
    """

    trial: Trial
    places: int


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG file in base64; empty where the object was not lifted."""

    png: str


Task = Trial | Planning | Portrait
Answer = TrialResult | Planned | Picture
_KINDS: Final[Mapping[str, tuple[Any, Any]]] = {
    "trial": (Trial, TrialResult),
    "planning": (Planning, Planned),
    "portrait": (Portrait, Picture),
}


def kind_of(task: Task) -> str:
    """Return the name of a task's kind."""
    return next(word for word, (kind, _) in _KINDS.items() if isinstance(task, kind))


def to_text(task: Task) -> str:
    """Return a task as JSON, the same for equal tasks."""
    return json.dumps({kind_of(task): asdict(task)}, sort_keys=True)


def from_text(text: str) -> Task:
    """Return the task that `to_text` wrote."""
    ((word, plain),) = json.loads(text).items()
    task: Task = validated(_KINDS[word][0], plain)
    return task


def answer_of(task: Task, plain: Mapping[str, Any]) -> Answer:
    """Return the answer to a task from plain data."""
    answer: Answer = validated(_KINDS[kind_of(task)][1], plain)
    if isinstance(answer, TrialResult) and isinstance(task, Trial):
        # The object's path was another one where it was tried.
        return replace(answer, trial=task)
    return answer


def with_object(task: Task, name: str) -> Task:
    """Return a task with the object by another name."""
    if isinstance(task, Portrait):
        return replace(task, trial=replace(task.trial, object=name))
    return replace(task, object=name)


def object_of(task: Task) -> str:
    """Return a task's object, as on the command line."""
    return task.trial.object if isinstance(task, Portrait) else task.object


@dataclass(frozen=True, slots=True)
class MadeWith:
    """The versions that an answer depends on: equal tasks with equal versions have equal answers.

    Attributes:
        model: Fingerprint of the hand's model, configuration and meshes.
        actions: Fingerprint of the trial's action; for the planner, of all actions.
        mesh: Fingerprint of the object's mesh; empty for a shape.
        settings: Fingerprint of the loop's and the simulation's settings.
        versions: rtee, with a fingerprint of its modules, and the libraries that compute.
        method: How trials are made; see `rtee.trials.store.METHOD`.
    """

    model: str
    actions: str
    mesh: str
    settings: str
    versions: str
    method: int = METHOD

    @classmethod
    def of(cls, hand: str, task: Task) -> MadeWith:
        """Return the versions with which this process makes a task of a hand, by name or folder."""
        ready, prints, meshes = _loaded(hand)
        tried = task.trial if isinstance(task, Portrait) else task
        actions = prints.files if isinstance(tried, Planning) else prints.actions.get(tried.what)
        shape = object_of(task)
        mesh = "" if is_shape(shape) else _content(shape)
        settings = _digest(repr((ready.settings, SimOptions())).encode())
        return cls(prints.model + meshes, actions or "", mesh, settings, versions())

    def difference(self, other: MadeWith) -> str:
        """Describe how another one differs from this one; empty if it does not."""
        differing = [f for f in fields(self) if getattr(self, f.name) != getattr(other, f.name)]
        return "; ".join(
            f"other {f.name}: {getattr(other, f.name)} instead of {getattr(self, f.name)}"
            for f in differing
        )


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


@lru_cache(maxsize=1000)
def _content(path: str) -> str:
    return _digest(Path(path).read_bytes()) if Path(path).is_file() else ""


@lru_cache(maxsize=8)
def _loaded(name: str) -> tuple[TrialBench, Fingerprints, str]:
    """Return a hand with its fingerprints, and one of its meshes."""
    ready = bench(name)
    meshes = [p for p in sorted(ready.folder.rglob("*")) if p.suffix.lower() in FORMATS]
    content = b"".join(p.read_bytes() for p in meshes)
    return ready, Fingerprints.of(ready.folder, ready.library), _digest(content)


@lru_cache(maxsize=1)
def versions() -> str:
    """Return the versions of rtee and of the libraries that compute, in this process."""
    # Two checkouts may have the same version and differ all the same.
    code = b"".join(path.read_bytes() for path in sorted(_PACKAGE.rglob("*.py")))
    found = [f"rtee {importlib.metadata.version('rtee')} ({_digest(code)})"]
    for name in _LIBRARIES:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return ", ".join(found)


def attempt(name: str, trial: Trial) -> TrialResult:
    """Run one trial of a hand; the result of a trial that cannot be run says why."""
    ready = bench(name)
    try:
        return run_trial(ready, trial)
    except RteeError as error:
        return TrialResult(trial, False, str(error))


def _planned(name: str, task: Planning) -> Planned:
    ready = bench(name)
    try:
        obj = read_object(task.object, task.mass)
        return Planned(plan_grasps(ready.hand, ready.library, obj, friction=task.friction))
    except RteeError as error:
        return Planned(None, str(error))


def _portrait(name: str, task: Portrait) -> Picture:
    from rtee.trials.pictures import SimulationRenderer

    ready, taken = bench(name), [b""]

    def watch(moment: str, headless: HeadlessHand[Any]) -> None:
        if moment == "lift":
            still = np.zeros((1, 3))
            renderer = SimulationRenderer(headless.simulation, ready.hand, still, size=_PORTRAIT)
            taken[0] = renderer.picture()

    skip = max(0, task.places - 1)
    try:
        run_trial(ready, task.trial, watch=watch, skip=skip)
    except RteeError:
        return Picture("")
    return Picture(base64.b64encode(taken[0]).decode())


@lru_cache(maxsize=8)
def _freeze_loaded(name: str) -> None:
    """Exclude all present objects from garbage collection, once a hand is loaded.

    It stays anyway, and looking through all modules again and again takes 6 % of a trial's time.
    """
    bench(name)
    gc.freeze()


def perform(name: str, text: str) -> str:
    """Do a task of a hand, by name or folder; return its answer and versions as JSON.

    Raises:
        UserError: for every mistake in the hand's files.
    """
    task = from_text(text)
    match task:
        case Trial():
            answer: Answer = attempt(name, task)
        case Planning():
            answer = _planned(name, task)
        case Portrait():
            answer = _portrait(name, task)
    made_with = asdict(MadeWith.of(name, task))
    said = {"worker": f"process {os.getpid()}", "made_with": made_with, "answer": asdict(answer)}
    return json.dumps(said)


def perform_apart(name: str, text: str) -> str:
    """Do the same as `perform` in a process that does nothing else."""
    _freeze_loaded(name)
    return perform(name, text)
