"""Links that are not lost because a busy computer lets their threads wait."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rtee.remote import session

HAND = "robotiq_2f_85"


def patient_gripper(config: Path, repository: Path) -> Path:
    """Copy the gripper into a folder of hands, with a long deadline; return its hand.yaml."""
    shutil.copytree(repository / "config" / HAND, config / HAND)
    return be_patient(config / HAND / "hand.yaml")


def be_patient(file: Path) -> Path:
    """Give the gripper of a hand.yaml a long deadline; return the file.

    The 31 ms that follow from its wire may pass on a busy computer before a thread runs.
    """
    text = file.read_text()
    assert text.count("    driver: robotiq_2f\n") == 1
    file.write_text(
        text.replace("    driver: robotiq_2f\n", "    driver: robotiq_2f\n    deadline: 60.0\n")
    )
    return file


@pytest.fixture(autouse=True)
def lease(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clients and hands wait for 30 s for each other to say that they live."""
    monkeypatch.setitem(session._COMMON, "transport/link/tx/lease", 30_000)
