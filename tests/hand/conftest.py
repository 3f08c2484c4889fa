from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from hand.models import GRIPPER, SRDF, YAML
from rtee.hand.load import load_model
from rtee.hand.model import Hand

MODELS = (
    "dagana",
    "heri_II",
    "heri_II_linear",
    "onrobot_3fg15",
    "qbhand",
    "robotiq_2f_140",
    "robotiq_2f_85",
    "robotiq_3f",
    "schunk",
    "test_ee",
    "test_ee_spread",
    "two_finger",
    "two_finger_mimic",
)


@pytest.fixture(params=MODELS)
def real(request: pytest.FixtureRequest, shared: Path) -> Path:
    """The folder of a real hand."""
    return shared / "hands" / str(request.param)


@pytest.fixture
def real_hand(real: Path) -> Hand:
    """A real hand."""
    return load_model(real / f"{real.name}.urdf", real / f"{real.name}.srdf")


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Hand]:
    """Load a gripper from the given texts."""

    def load_texts(urdf: str = GRIPPER, srdf: str | None = SRDF, **options: object) -> Hand:
        (tmp_path / "gripper.urdf").write_text(urdf)
        if srdf is not None:
            (tmp_path / "gripper.srdf").write_text(srdf)
        return load_model(
            tmp_path / "gripper.urdf",
            None if srdf is None else tmp_path / "gripper.srdf",
            **options,  # type: ignore[arg-type]
        )

    return load_texts


@pytest.fixture
def configured(tmp_path: Path) -> Path:
    """A folder of hands with one gripper in it."""
    folder = tmp_path / "config" / "gripper"
    folder.mkdir(parents=True)
    (folder / "gripper.urdf").write_text(GRIPPER)
    (folder / "gripper.srdf").write_text(SRDF)
    (folder / "hand.yaml").write_text(YAML)
    return folder.parent
