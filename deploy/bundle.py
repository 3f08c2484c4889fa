"""Make a bundle that installs rtee where there is no network.

    python deploy/bundle.py [--python 3.12] [--platform aarch64] [--extras ethercat,gui] [--out DIR]
        [--sign KEY]

It holds the wheel of this checkout, the wheels of exactly the versions in constraints.txt for the
wanted Python and processor (glibc 2.28 or newer), and `install.sh`, which makes an environment from
them without an index and checks every file's SHA-256. `make bundle` runs this.

Whoever can change a bundle can change its checksums, too. So the digest of the archive is printed,
to be compared where it arrives, and with `--sign` an SSH key signs the archive.
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from email.parser import HeaderParser
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename

ROOT = Path(__file__).resolve().parents[1]
PLATFORMS = ("x86_64", "aarch64")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
GLIBC = (5, *range(12, 29))
"""Minor versions of glibc 2 whose wheels run on glibc 2.28, as Debian 10 and Ubuntu 20.04 have."""
MEGA = 1e6
NAMESPACE = "rtee-bundle"
"""What a signature is for: one of the same key for another purpose is worth nothing here."""


class Problem(Exception):
    """Why there is no bundle, in a sentence."""


@dataclass(frozen=True)
class Target:
    """The computer that a bundle is for.

    Attributes:
        python: Its Python, ``3.12``.
        machine: Its processor, as ``uname -m`` says.
    """

    python: str
    machine: str

    def environment(self, extra: str) -> dict[str, str]:
        """Return what markers of requirements are evaluated with; pip would take this computer."""
        return {
            "python_version": self.python,
            "python_full_version": f"{self.python}.0",
            "implementation_name": "cpython",
            "platform_python_implementation": "CPython",
            "platform_machine": self.machine,
            "platform_system": "Linux",
            "sys_platform": "linux",
            "os_name": "posix",
            "extra": extra,
        }

    def options(self) -> list[str]:
        """Return what pip is to be asked for."""
        # The largest first, as pip prefers them.
        tags = [f"manylinux_2_{minor}_{self.machine}" for minor in reversed(GLIBC)]
        tags += [f"manylinux2014_{self.machine}", f"manylinux2010_{self.machine}"]
        words = ["--implementation", "cp", "--python-version", self.python]
        return words + [word for tag in tags for word in ("--platform", tag)]


def pins(text: str) -> dict[str, str]:
    """Return the versions in a file of constraints, by canonical name."""
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    found = (line.partition("==") for line in lines if line)
    return {canonicalize_name(name): version for name, _, version in found}


def requirements(wheel: Path, extras: Iterable[str], target: Target) -> list[Requirement]:
    """Return what a wheel requires on a computer."""
    with zipfile.ZipFile(wheel) as archive:
        [name] = [each for each in archive.namelist() if each.endswith(".dist-info/METADATA")]
        metadata = HeaderParser().parsestr(archive.read(name).decode())
    wanted = [Requirement(text) for text in metadata.get_all("Requires-Dist") or ()]
    environments = [target.environment(extra) for extra in ("", *extras)]
    return [
        each
        for each in wanted
        if each.marker is None or any(map(each.marker.evaluate, environments))
    ]


def collect(
    wheel: Path,
    extras: Sequence[str],
    pinned: Mapping[str, str],
    target: Target,
    folder: Path,
    options: Sequence[str] = (),
) -> None:
    """Fetch all that a wheel requires into the folder where it is.

    Args:
        wheel: The wheel.
        extras: Which of its extras are wanted.
        pinned: The versions, by canonical name.
        target: The computer that they are for.
        folder: Where to.
        options: Further options of pip.

    Raises:
        Problem: if a version is not pinned, or has no wheel for the computer.
    """
    done: set[tuple[str, frozenset[str]]] = set()
    own = canonicalize_name(parse_wheel_filename(wheel.name)[0])
    waiting = [(own, frozenset(extras))]
    files = {own: wheel}
    while waiting:
        missing = {name for name, _ in waiting} - set(files)
        if unknown := sorted(missing - set(pinned)):
            raise Problem(f"constraints.txt pins no {', '.join(unknown)}")
        if missing:
            asked = [f"{name}=={pinned[name]}" for name in sorted(missing)]
            _pip("download", "--no-deps", "--only-binary=:all:", "--dest", str(folder),
                 *target.options(), *options, *asked)  # fmt: skip
            found = {canonicalize_name(parse_wheel_filename(p.name)[0]): p for p in _wheels(folder)}
            files |= {name: found[name] for name in missing}
        done |= set(waiting)
        waiting = [
            (canonicalize_name(each.name), frozenset(each.extras))
            for name, wanted in waiting
            for each in requirements(files[name], wanted, target)
        ]
        waiting = [each for each in dict.fromkeys(waiting) if each not in done]


def finish(folder: Path, target: Target, extras: Sequence[str]) -> None:
    """Write what is installed, with checksums, and the script that does it."""
    wheels = folder / "wheels"
    lines = []
    for path in _wheels(wheels):
        name, version, *_ = parse_wheel_filename(path.name)
        marked = f"[{','.join(extras)}]" if name == "rtee" and extras else ""
        lines.append(f"{name}{marked}=={version} --hash=sha256:{_digest(path)}")
    (folder / "requirements.txt").write_text("\n".join(lines) + "\n")
    script = (ROOT / "deploy" / "install.sh").read_text()
    script = script.replace("@PYTHON@", target.python).replace("@MACHINE@", target.machine)
    (folder / "install.sh").write_text(script)
    (folder / "install.sh").chmod(0o755)
    files = [folder / "install.sh", folder / "requirements.txt", *_wheels(wheels)]
    sums = [f"{_digest(path)}  {path.relative_to(folder)}" for path in files]
    (folder / "SHA256SUMS").write_text("\n".join(sums) + "\n")


def _wheels(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.whl"), key=lambda path: path.name.lower())


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _pip(*words: str) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *words]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if "ERROR" in line] or [done.stderr]
        raise Problem(said[0].strip())


def sign(archive: Path, key: Path) -> Path:
    """Sign an archive with an SSH key, which may be one of an agent, and return the signature.

    Raises:
        Problem: if there is no OpenSSH, or no such key.
    """
    signature = archive.with_name(f"{archive.name}.sig")
    signature.unlink(missing_ok=True)
    command = ["ssh-keygen", "-Y", "sign", "-q", "-f", str(key), "-n", NAMESPACE, str(archive)]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    except FileNotFoundError:
        raise Problem("--sign needs ssh-keygen, which is a part of OpenSSH") from None
    if done.returncode or not signature.is_file():
        said = done.stderr.strip().splitlines() or ["no signature"]
        raise Problem(f"{key} cannot sign: {said[-1]}")
    return signature


def bundle(target: Target, extras: Sequence[str], out: Path) -> Path:
    """Make a bundle and return its archive.

    Raises:
        Problem: if a part of it can't be had, or it is there already.
    """
    staging = out / "rtee-bundle"
    if staging.exists():
        raise Problem(f"{staging} is there already; remove it first")
    wheels = staging / "wheels"
    wheels.mkdir(parents=True)
    _pip("wheel", "--no-deps", "--wheel-dir", str(wheels), str(ROOT))
    [wheel] = _wheels(wheels)
    collect(wheel, extras, pins((ROOT / "constraints.txt").read_text()), target, wheels)
    finish(staging, target, extras)
    version = parse_wheel_filename(wheel.name)[1]
    name = f"rtee-{version}-python{target.python}-{target.machine}"
    whole = staging.rename(out / name)
    archive = out / f"{name}.tar"  # wheels are compressed already
    with tarfile.open(archive, "w") as tar:
        tar.add(whole, name)
    for path in _wheels(whole / "wheels"):
        print(f"{path.stat().st_size / MEGA:8.2f} MB  {path.name}")
    count = len(_wheels(whole / "wheels"))
    print(f"{archive.stat().st_size / MEGA:8.2f} MB  {archive}: {count} wheels")
    print(
        f"SHA-256 {_digest(archive)}; compare it with `sha256sum {archive.name}` where it arrives"
    )
    return archive


def main() -> int:
    """Make a bundle and print what is in it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    parser.add_argument("--python", choices=PYTHONS, default=here)
    parser.add_argument("--platform", choices=PLATFORMS, default=platform.machine())
    parser.add_argument("--extras", default="", help="extras of rtee, with commas")
    parser.add_argument("--out", type=Path, default=Path("dist"), help="folder (default: dist)")
    parser.add_argument("--sign", type=Path, metavar="KEY", help="SSH key that signs the archive")
    given = parser.parse_args()
    extras = [extra for extra in given.extras.split(",") if extra]
    try:
        archive = bundle(Target(given.python, given.platform), extras, given.out)
        if given.sign is not None:
            print(f"{sign(archive, given.sign)}: signed")
    except Problem as problem:
        print(f"bundle: {problem}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
