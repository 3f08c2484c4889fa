"""Arguments of another type in the Python API: a sentence, never an error from inside."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import UserError
from rtee.objects.shape import Table, parse_object
from rtee.planning.question import question_about

DO = rtee.Named("Grasp")


@pytest.fixture(scope="module")
def library() -> ActionLibrary:
    return rtee.load_actions("robotiq_2f_85")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: rtee.Goal(DO, speed="fast"), "the speed must be a number, not 'fast'"),
        (lambda: rtee.Goal(DO, timeout=[3]), r"the timeout must be a number, not \[3\]"),
        (lambda: rtee.Goal(DO, effort=3), "'effort' must be a mapping by name, not 3"),
        (lambda: rtee.Goal(DO, effort=None), "'effort' must be a mapping by name, not None"),
        (lambda: rtee.Goal(DO, on_contact="hold"), "'on_contact' must be a mapping by name"),
        (lambda: rtee.Goal(DO, "open"), r"'to' must be an Intensity\(…\), .*, not 'open'"),
        (lambda: rtee.Intensity("60%"), "the intensity must be a number, not '60%'"),
        (lambda: rtee.Intensity(tolerance=None), "the tolerance must be a number, not None"),
        (lambda: rtee.Intensity(Fraction(3, 2)), "the intensity must be 0 to 1, not 1.5"),
        (lambda: rtee.Goal(DO, speed=Fraction(2)), "the speed must be above 0 and at most 1"),
        (lambda: rtee.Force(2.0, Fraction(1)), "must be at least the force, 2 N, not 1"),
        (lambda: rtee.Opening("30mm"), "the opening must be a number, not '30mm'"),
        (lambda: rtee.Around(0.03, wider="5mm"), "the tolerance 'wider' must be a number"),
        (lambda: rtee.TipSpeed("fast"), "the speed must be a number, not 'fast'"),
        (lambda: rtee.Force(3.0, most="5N"), "the largest force must be a number, not '5N'"),
        (lambda: rtee.load_hand(3), "a hand is given by its name or the path of its folder, not 3"),
        (lambda: rtee.load_actions([]), "a hand is given by its name or the path of its folder"),
        (
            lambda: rtee.load_hand("robotiq_2f_85", config_dirs="config"),
            "the folders of hands must be a list of paths, not 'config'",
        ),
        (lambda: rtee.Trial("Grasp", mass=-1.0), "the mass of a trial must be from 1e-06 to 100"),
        (lambda: rtee.Trial("Grasp", places="x"), "the places of a trial must be at least 1, not"),
        (lambda: rtee.Trial("Grasp", places=1.5), "places of a trial must be whole, not 1.5"),
        (lambda: rtee.Trial("Grasp", mass=None), "the mass of a trial must be from .*, not None"),
        (lambda: rtee.Trial("Grasp", seed=None), "seed of a trial must be at least 0, not None"),
        (lambda: rtee.Trial("Grasp", intensity=math.nan), "the intensity of a trial must be from"),
        (lambda: parse_object(3, ()), "an object is a shape, such as sphere:0.03, not 3"),
        (lambda: Table(3), "a table's normal must be three finite numbers, not 3"),
        (lambda: Table(height="1 m"), "a table's height must be a finite number, not '1 m'"),
        (lambda: question_about(3), "an object is a shape, such as sphere:0.03, not 3"),
        (lambda: question_about("drill", mass="1 kg"), "must be finite and above 0"),
        (lambda: question_about("drill", weight_axis=(1, 2)), "must be three finite numbers"),
        (lambda: question_about("drill", table=3), r"a table is a Table\(…\), not 3"),
    ],
)
def test_a_value_says_what_it_needs(make: Callable[[], Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        make()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda lib: lib.find(3), "an action and its elements must be names, not 3"),
        (lambda lib: lib.find("Grasp", 3), "the elements must be a list of names, .*, not 3"),
        (lambda lib: lib.find("Grasp", "index"), "the elements must be a list of names"),
        (lambda lib: lib.find("Grasp", kind=3), "an action and its elements must be names, not 3"),
        (lambda lib: lib.all(name=3), "an action and its elements must be names, not 3"),
        (lambda lib: lib.partners("PinchTight", 3), "an action and its elements must be names"),
        (lambda lib: lib.compose("x", 3), "the parts of a composed action must be a list, .*not 3"),
        (lambda lib: lib.compose("x", "Grasp"), "the parts of a composed action must be a list"),
        (lambda lib: lib.compose(3, ["Grasp"]), "action name 3 is not a text"),
        (lambda lib: lib.sequence("x", 3), "must be a StepPlan, such as .*, not 3"),
        (lambda lib: lib.add("Grasp"), "an action is what a library returns, not 'Grasp'"),
    ],
)
def test_a_library_says_what_it_needs(
    library: ActionLibrary, call: Callable[[ActionLibrary], Any], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        call(library)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"object": 3}, "an object is a shape, such as sphere:0.03, not 3"),
        ({"mass": "1 kg"}, "the mass of an object must be above 0 and at most 100 kg, not '1 kg'"),
        ({"friction": "high"}, "a friction must be above 0 and at most 10, not 'high'"),
        ({"weight_axis": "z"}, "the weight axis must be three finite numbers, not 'z'"),
        ({"table": 3}, r"a table is a Table\(…\), not 3"),
    ],
)
def test_a_plan_says_what_it_needs(options: dict[str, Any], said: str) -> None:
    pytest.importorskip("coal", reason="needs the extra extract")
    with pytest.raises(UserError, match=said):
        rtee.grasp_plan("robotiq_2f_85", **{"object": "sphere:0.03", **options})


def test_a_trial_takes_numbers_of_numpy() -> None:
    trial = rtee.Trial("Grasp", mass=np.float32(0.5), seed=np.int64(3), places=2.0)
    assert json.loads(json.dumps(asdict(trial)))["seed"] == 3, "it is sent as JSON"
    assert trial == rtee.Trial("Grasp", mass=0.5, seed=3, places=2)


@pytest.mark.parametrize(
    ("trials", "options", "said"),
    [
        (3, {}, r"trials are a list of Trial\(…\), not 3"),
        (["Grasp"], {}, r"trials are a list of Trial\(…\)"),
        ([rtee.Trial("Grasp")], {"jobs": "all"}, "the number of processes must be 1 or more"),
        ([rtee.Trial("Grasp")], {"on_result": 3}, "on_result must be a function, not 3"),
    ],
)
def test_a_batch_says_what_it_needs(trials: Any, options: dict[str, Any], said: str) -> None:
    pytest.importorskip("mujoco", reason="needs the extra sim")
    with pytest.raises(UserError, match=said):
        rtee.run_trials(Path("config/robotiq_2f_85"), trials, **options)
