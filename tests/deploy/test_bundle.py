"""The offline bundle: pinned wheels for another computer, and an installation without a network."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

WHEEL = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: {tag}\n"
HERE = f"{sys.version_info.major}.{sys.version_info.minor}"


@pytest.fixture(scope="module")
def bundle(repository: Path) -> ModuleType:
    path = repository / "deploy" / "bundle.py"
    spec = importlib.util.spec_from_file_location("rtee_bundle", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def write_wheel(
    folder: Path, name: str, version: str, *requires: str, tag: str = "py3-none-any", code: str = ""
) -> Path:
    path = folder / f"{name}-{version}-{tag}.whl"
    info = f"{name}-{version}.dist-info"
    lines = [f"Name: {name}", f"Version: {version}", *(f"Requires-Dist: {r}" for r in requires)]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.py", code)
        archive.writestr(f"{info}/METADATA", "\n".join(["Metadata-Version: 2.1", *lines, ""]))
        archive.writestr(
            f"{info}/WHEEL", f"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: {tag}\n"
        )
        archive.writestr(f"{info}/entry_points.txt", f"[console_scripts]\n{name} = {name}:main\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


@pytest.fixture
def index(tmp_path: Path) -> Path:
    """A folder in the place of the package index."""
    folder = tmp_path / "index"
    folder.mkdir()
    write_wheel(folder, "pure", "1.5", "old; python_version < '3.12'", "more; extra == 'more'")
    write_wheel(folder, "pure", "1.6")
    write_wheel(folder, "old", "1.0")
    write_wheel(folder, "more", "1.0", "pure[more]")  # a circle
    write_wheel(folder, "only_intel", "2.0")
    for machine in ("x86_64", "aarch64"):
        for python in ("cp311", "cp313"):
            tag = f"{python}-{python}-manylinux_2_28_{machine}"
            write_wheel(folder, "fast", "3.0", tag=tag)
    return folder


PINS = {"pure": "1.5", "old": "1.0", "more": "1.0", "fast": "3.0", "only-intel": "2.0"}


def collected(
    bundle: ModuleType, index: Path, folder: Path, python: str, machine: str, **pins: str
) -> set[str]:
    folder.mkdir(exist_ok=True)
    wheel = write_wheel(
        folder,
        "rtee",
        "0.1.0",
        "fast>=2; extra == 'extract'",
        "pure[more]",
        "only-intel; platform_machine == 'x86_64'",
        code="def main():\n    print('rtee 0.1.0')\n",
    )
    target = bundle.Target(python, machine)
    options = ["--no-index", "--find-links", str(index)]
    bundle.collect(wheel, ["extract"], PINS | pins, target, folder, options)
    return {path.name for path in folder.glob("*.whl")} - {wheel.name}


@pytest.mark.heavy
def test_the_wheels_are_those_of_the_other_computer(
    bundle: ModuleType, index: Path, tmp_path: Path
) -> None:
    """Markers count as they would there: pip takes those of the computer that it runs on."""
    pure = {"pure-1.5-py3-none-any.whl", "more-1.0-py3-none-any.whl"}
    assert collected(bundle, index, tmp_path / "arm", "3.13", "aarch64") == {
        *pure,
        "fast-3.0-cp313-cp313-manylinux_2_28_aarch64.whl",
    }
    assert collected(bundle, index, tmp_path / "intel", "3.11", "x86_64") == {
        *pure,
        "fast-3.0-cp311-cp311-manylinux_2_28_x86_64.whl",
        "old-1.0-py3-none-any.whl",
        "only_intel-2.0-py3-none-any.whl",
    }


@pytest.mark.heavy
def test_what_is_missing_is_named(bundle: ModuleType, index: Path, tmp_path: Path) -> None:
    with pytest.raises(bundle.Problem, match=r"fast==3\.0"):
        collected(bundle, index, tmp_path / "later", "3.14", "aarch64")
    (index / "pure-1.5-py3-none-any.whl").unlink()
    write_wheel(index, "pure", "1.5", "unheard-of")
    with pytest.raises(bundle.Problem, match=r"constraints\.txt pins no unheard-of"):
        collected(bundle, index, tmp_path / "unpinned", "3.13", "x86_64")


def test_every_requirement_of_rtee_is_pinned(bundle: ModuleType, repository: Path) -> None:
    import tomllib

    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    names = {canonicalize_name(Requirement(text).name) for text in project["dependencies"]}
    assert names <= set(bundle.pins((repository / "constraints.txt").read_text()))


def install(folder: Path, target: Path, *before: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*before, str(folder / "install.sh"), str(target)],
        env=os.environ | {"PYTHON": sys.executable, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
    )


def without_network() -> list[str]:
    """Return what runs a command in a namespace that has no network, where that is allowed."""
    words = ["unshare", "--net"]
    if shutil.which("unshare") and subprocess.run([*words, "true"], stderr=-3).returncode == 0:
        return words
    return []


@pytest.mark.heavy
def test_it_installs_without_a_network_and_refuses_what_is_damaged(
    bundle: ModuleType, index: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "bundle"
    folder.mkdir()
    target = bundle.Target(HERE, platform.machine())
    pins = {"pure": "1.6"}  # so that nothing is for one Python or processor only
    for path in index.glob("fast-*"):
        path.unlink()
    write_wheel(index, "fast", "3.0")
    collected(bundle, index, folder / "wheels", HERE, platform.machine(), **pins)
    bundle.finish(folder, target, ["extract"])
    environment = tmp_path / "opt"
    done = install(folder, environment, *without_network())
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("rtee 0.1.0\n")
    damaged = folder / "wheels" / "fast-3.0-py3-none-any.whl"
    damaged.write_bytes(damaged.read_bytes() + b"!")
    done = install(folder, tmp_path / "other")
    assert (done.returncode, (tmp_path / "other").exists()) == (1, False)
    assert "the bundle is damaged" in done.stderr
    # Whoever mends the list of checksums, too, meets pip's own check.
    sums = subprocess.run(
        ["sha256sum", "requirements.txt", *(f"wheels/{p.name}" for p in damaged.parent.iterdir())],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    (folder / "SHA256SUMS").write_text(sums.stdout)
    done = install(folder, environment)
    assert done.returncode == 0, "what is installed already is not installed again"
    remove = [environment / "bin" / "python", "-m", "pip", "uninstall", "--quiet", "--yes", "fast"]
    subprocess.run(remove, check=True)
    done = install(folder, environment)
    assert done.returncode != 0
    assert "HASH" in done.stderr.upper()


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="needs OpenSSH")
def test_a_signature_tells_a_forged_bundle(bundle: ModuleType, tmp_path: Path) -> None:
    """Who changes the bundle changes its checksums, too, and nobody noticed."""
    key, archive = tmp_path / "key", tmp_path / "rtee.tar"
    made = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)]
    subprocess.run(made, check=True)
    archive.write_bytes(b"wheels and checksums")
    signature = bundle.sign(archive, key)
    signers = tmp_path / "signers"
    signers.write_text(f"bundle {(tmp_path / 'key.pub').read_text()}")

    def verified() -> bool:
        words = [
            "-Y",
            "verify",
            "-f",
            signers,
            "-I",
            "bundle",
            "-n",
            "rtee-bundle",
            "-s",
            signature,
        ]
        with archive.open("rb") as file:
            done = subprocess.run(["ssh-keygen", *words], stdin=file, capture_output=True)
        return done.returncode == 0

    assert verified()
    archive.write_bytes(b"wheels and checksums of another")
    assert not verified()
    with pytest.raises(bundle.Problem, match="cannot sign"):
        bundle.sign(archive, tmp_path / "none")


@pytest.mark.parametrize(
    ("python", "machine", "reason"),
    [("3.99", platform.machine(), "is for Python 3.99"), (HERE, "riscv128", "is for riscv128")],
)
def test_another_computer_is_told(
    bundle: ModuleType, tmp_path: Path, python: str, machine: str, reason: str
) -> None:
    (tmp_path / "wheels").mkdir()
    bundle.finish(tmp_path, bundle.Target(python, machine), [])
    done = install(tmp_path, tmp_path / "opt")
    assert done.returncode == 1
    assert reason in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(
    not os.environ.get("RTEE_WHEELS"),
    reason="fetches wheels, minutes long: make wheels",
)
def test_a_hand_runs_from_the_bundle(bundle: ModuleType, tmp_path: Path) -> None:
    bundle.bundle(bundle.Target("3.11", "aarch64"), [], tmp_path / "arm")
    bundle.bundle(bundle.Target(HERE, platform.machine()), [], tmp_path / "here")
    [script] = (tmp_path / "here").glob("*/install.sh")
    done = install(script.parent, tmp_path / "opt", *without_network())
    assert done.returncode == 0, done.stderr
    run = ["run", "robotiq_2f_85", "--driver", "devices", "--emulated", "--duration", "0.5"]
    done = subprocess.run(
        [str(tmp_path / "opt" / "bin" / "rtee"), *run],
        cwd=tmp_path,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
