"""One model, one result: other processors' kernels and joint origins a nanometre off."""

from __future__ import annotations

import ast
import json
import os
import platform
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtee.actions.types import Primitive
from rtee.extract.extraction import extract
from rtee.hand.load import load_hand
from rtee.hand.model import Hand

ROOT = Path(__file__).resolve().parents[2]

KERNELS = {
    "OpenBLAS SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "OpenBLAS Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "OpenBLAS Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "OpenBLAS Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "NumPy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL"},
    "glibc without FMA": {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2_Usable,-FMA_Usable,-AVX2,-FMA,-FMA4"
    },
}
"""Settings under which numerical libraries compute as on other x86-64 processors."""

RELATED = ("OpenBLAS Haswell", "OpenBLAS Zen")
"""Those between SkylakeX and Nehalem, whose kernels are for the most part one another's."""

CPU = Path("/proc/cpuinfo")
if CPU.exists() and "avx512f" not in CPU.read_text():
    # Its kernels are instructions that this processor does not have.
    del KERNELS["OpenBLAS SkylakeX"]

OFFLINE = [
    *(p for p in (ROOT / "rtee" / "extract").glob("*.py") if not p.name.startswith("report")),
    *(ROOT / "rtee" / "hand" / f"{n}.py" for n in ("geometry", "halton", "kinematics", "linalg")),
]
"""What decides which primitives are found, and what is written about them."""

ALLOWED = {
    ("geometry", "eigvalsh"): "decides whether a mesh is flat, by a factor of 10,000",
    ("geometry", "cov"): "the same",
    ("surface", "arctan2"): "a winding number is compared with one half",
}


def depths(primitives: list[Primitive]) -> dict[str, list[float]]:
    return {
        f"{p.name} {' '.join(p.elements)}": [e.depth for e in p.evidence]
        for p in primitives
        if p.evidence
    }


@pytest.mark.timeout(300)
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the settings are those of x86-64")
@pytest.mark.heavy
@pytest.mark.parametrize(
    ("name", "kernels"),
    [
        ("dagana", {k: v for k, v in KERNELS.items() if k not in RELATED}),
        ("robotiq_3f", {k: v for k, v in KERNELS.items() if k not in RELATED}),
        ("robotiq_3f", {k: v for k, v in KERNELS.items() if k in RELATED}),
        ("leap_hand", KERNELS),
    ],
    ids=["dagana", "robotiq_3f", "robotiq_3f-related", "leap_hand"],
)
def test_another_kernel_writes_the_same_files(
    name: str, kernels: dict[str, dict[str, str]]
) -> None:
    command = [sys.executable, "-m", "rtee", "extract", str(ROOT / "config" / name), "--json"]
    running = [
        subprocess.Popen(
            [*command, "--jobs", "1"],
            env={**os.environ, **setting},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for setting in ({}, *kernels.values())
    ]
    found = []
    for process in running:
        out, errors = process.communicate()
        assert process.returncode == 0, errors
        found.append({**json.loads(out), "seconds": None})
    for label, other in zip(kernels, found[1:], strict=True):
        assert other == found[0], label


def moved(hand: Hand, random: np.random.Generator) -> Hand:
    """Return the hand with all joint origins moved by 1e-12 to 1e-9 m."""
    joints = {}
    for name, joint in hand.urdf.joints.items():
        step = 10.0 ** random.uniform(-12.0, -9.0) * random.choice((-1.0, 1.0), 3)
        x, y, z = (a + float(b) for a, b in zip(joint.xyz, step, strict=True))
        joints[name] = replace(joint, xyz=(x, y, z))
    return replace(hand, urdf=replace(hand.urdf, joints=joints))


@pytest.mark.samples("robotiq_2f_85")
@pytest.mark.parametrize("name", ["robotiq_3f", "qb_softhand", "dagana", "robotiq_2f_85"])
def test_a_nanometre_does_not_decide_what_is_found(name: str) -> None:
    hand = load_hand(ROOT / "config" / name)
    before = {(p.name, p.elements): p for p in extract(hand).primitives if p.evidence}
    random = np.random.default_rng(1)
    for _ in range(3):
        after = {
            (p.name, p.elements): p for p in extract(moved(hand, random)).primitives if p.evidence
        }
        assert after.keys() == before.keys()
        for key, primitive in before.items():
            one, other = primitive.evidence[0], after[key].evidence[0]
            assert other.depth == pytest.approx(one.depth, rel=0.02), key
            assert (other.clear, other.path_clear) == (one.clear, one.path_clear), key


def calls(path: Path) -> set[str]:
    """Return the names of functions called in a module whose results depend on the processor."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            found.add("@")
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            of = ast.unparse(node.func.value)
            if of == "np.linalg" or (of != "linalg" and node.func.attr in {"dot", "matmul"}):
                found.add(node.func.attr)
            if of == "np" and node.func.attr in {"einsum", "cov", "inner", "vdot", "tensordot"}:
                found.add(node.func.attr)
            if of == "np" and node.func.attr in {"sin", "cos", "tan", "arctan2", "exp", "log"}:
                found.add(node.func.attr)
    return found


@pytest.mark.parametrize("path", OFFLINE, ids=lambda path: path.stem)
def test_no_kernel_is_asked_whose_last_digits_depend_on_the_processor(path: Path) -> None:
    assert {name for name in calls(path) if (path.stem, name) not in ALLOWED} == set()
