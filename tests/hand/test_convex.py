"""A mesh in one piece with a hole is divided, so that the hole stays free."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest


def test_a_ring_in_one_piece_keeps_its_hole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("coacd")
    pytest.importorskip("mujoco")
    import coal

    from rtee.drivers.mujoco.objects import solid_parts
    from rtee.planning.objects import read_object

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = str(tmp_path / "ring.stl")
    trimesh.creation.annulus(0.025, 0.035, 0.01, sections=12).export(file)
    ring = read_object(file)
    ball, here = coal.Sphere(0.02), coal.Transform3s(np.eye(3), np.zeros(3))
    gaps = [
        coal.distance(ball, here, piece.shape, here, coal.DistanceRequest(), coal.DistanceResult())
        for piece in ring.pieces
    ]
    assert min(gaps) > 1e-3
    assert ring.notes == ()
    # The simulation reads the file in a way of its own, and finds the same pieces, kept.
    monkeypatch.setattr("rtee.hand.convex._divided", None)
    assert len(solid_parts(file)) == len(ring.pieces)

    monkeypatch.setitem(sys.modules, "coacd", None)
    (hull,) = read_object(file).pieces
    assert hull.shape.computeVolume() > 2.0 * sum(p.shape.computeVolume() for p in ring.pieces)
