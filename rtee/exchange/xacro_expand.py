"""Expand xacro files in a separate process.

A xacro file is a program whose expressions are Python. xacro hides the usual functions from them,
but this does not protect against a malicious file: the process has the user's rights. Limits on its
memory, time and output stop a file that runs without end by mistake.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import subprocess
import sys
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rtee import child
from rtee.errors import ConfigError, ModelError, needing_extra
from rtee.hand.files import MAX_SIZE, read_bytes
from rtee.hand.meshes import find_package

_TIME: Final = 60.0
"""Longest time of an expansion [s]; large robots take 2 s."""

_MEMORY: Final = 2_000_000_000
"""Most address space of an expansion [bytes]; large robots take 200 MB."""

_FAILED: Final = 3
"""Exit status of the process when xacro refuses the file."""

_ANSWER: Final = ".json"
"""Suffix of the file with the reason, beside the URDF, since expressions may print to stdout."""


def arguments_of(words: Sequence[str]) -> dict[str, str]:
    """Return xacro arguments given as ``NAME:=VALUE``.

    Raises:
        ConfigError: if a word has another form, or a name is given twice.
    """
    arguments: dict[str, str] = {}
    for word in words:
        name, sign, value = (part.strip() for part in word.partition(":="))
        if not (sign and name):
            raise ConfigError(f"'{word}' should be NAME:=VALUE, an argument of a xacro file")
        if name in arguments:
            raise ConfigError(f"the xacro argument '{name}' is given twice")
        arguments[name] = value
    return arguments


def expand(
    path: Path, target: Path, arguments: Mapping[str, str], package_dirs: Sequence[Path] = ()
) -> None:
    """Write the URDF that a xacro file expands to.

    Args:
        path: The xacro file, whose expressions are run.
        target: Path of the URDF.
        arguments: Its arguments, by name.
        package_dirs: Folders to look packages up in, before those of the environment.

    Raises:
        MissingExtra: if the extra ``xacro`` is not installed.
        ModelError: if xacro refuses the file, or the expansion exceeds a limit.
    """
    with needing_extra("expanding xacro files", "xacro"):
        import xacro  # noqa: F401 - only the other process uses it
    read_bytes(path, "xacro file", ModelError)  # fails before a process is started
    task = {
        "path": str(path.absolute()),
        "target": str(target),
        "arguments": dict(arguments),
        "package_dirs": [str(Path(folder).absolute()) for folder in package_dirs],
    }
    # A new session, so that processes started by the file end with it. Its output is dropped, since
    # expressions may print anything.
    process = subprocess.Popen(
        child.python("-m", __name__),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=child.environment(),
        start_new_session=True,
    )
    try:
        process.communicate(json.dumps(task).encode(), timeout=_TIME)
    except subprocess.TimeoutExpired:
        raise ModelError(f"xacro did not end within {_TIME:g} s", path=path) from None
    finally:
        # Also on Ctrl-C, whose signal does not reach a process in another session.
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if process.returncode == _FAILED:
        raise _refusal(target.with_suffix(_ANSWER), path)
    # Any other status means that a limit ended the process.
    if process.returncode != 0 or not target.is_file():
        raise ModelError(
            f"xacro was stopped: the file computes for more than {_TIME:g} s, or writes more than "
            f"{MAX_SIZE // 1_000_000} MB",
            path=path,
        )


def _refusal(answer: Path, path: Path) -> ModelError:
    try:
        refusal = json.loads(read_bytes(answer, "reason"))
        message, place, line = str(refusal["message"]), Path(refusal["path"]), refusal["line"]
    except (ConfigError, ValueError, KeyError, TypeError):
        message, place, line = "it gave no reason", path, None
    text = " ".join(message.split())
    return ModelError(
        f"xacro refuses it: {text[:400]}", path=place, line=line if isinstance(line, int) else None
    )


def _limit() -> None:
    """Limit the resources of this process."""
    for kind, most in (
        (resource.RLIMIT_AS, _MEMORY),
        (resource.RLIMIT_CPU, int(_TIME)),
        (resource.RLIMIT_FSIZE, MAX_SIZE),
        (resource.RLIMIT_CORE, 0),  # the signal of the time limit would write the memory to a file
    ):
        hard = resource.getrlimit(kind)[1]
        # Raising a hard limit needs rights that this process should not have.
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


def _offer_packages(folder: Path, package_dirs: Sequence[Path]) -> None:
    """Provide the ROS 2 module, missing on PyPI, that xacro uses to find package folders."""

    def share(name: str) -> str:
        package = find_package(name, folder, package_dirs)
        if package is None:
            raise LookupError(
                f"package '{name}' is not found; give its folder, or the folder above it, with "
                "--package-dir"
            )
        return str(package)

    packages = types.ModuleType("ament_index_python.packages")
    packages.get_package_share_directory = share  # type: ignore[attr-defined]
    sys.modules["ament_index_python"] = types.ModuleType("ament_index_python")
    sys.modules["ament_index_python.packages"] = packages


def _reason(error: BaseException) -> str:
    """Return the message of the innermost error that has one."""
    inner = error
    while isinstance(getattr(inner, "exc", None), BaseException):
        inner = inner.exc  # type: ignore[attr-defined]
    if isinstance(inner, MemoryError):
        return f"it needs more than {_MEMORY // 1_000_000} MB of memory"
    if isinstance(inner, LookupError) and "package '" in str(inner):
        return str(inner.args[0])
    text = str(error) or type(error).__name__
    # xacro's messages begin with the type: "<class 'ValueError'>: …".
    return re.sub(r"^<class '[\w.]*'>:\s*", "", text)


def _main() -> int:
    task: dict[str, Any] = json.loads(sys.stdin.read())
    _limit()
    path = Path(task["path"])
    _offer_packages(path.parent, [Path(folder) for folder in task["package_dirs"]])
    import xacro

    xacro.verbosity = 0  # no warnings and no locations on stdout
    try:
        document = xacro.process_file(str(path), mappings=task["arguments"])
        Path(task["target"]).write_text(document.toprettyxml(indent="  "), encoding="utf-8")
    # The file's own expressions may raise anything.
    except Exception as error:
        stack = getattr(xacro, "filestack", None) or [str(path)]
        line = getattr(error, "lineno", None)
        refusal = {"message": _reason(error), "path": str(stack[-1] or path), "line": line}
        Path(task["target"]).with_suffix(_ANSWER).write_text(json.dumps(refusal))
        return _FAILED
    return 0


if __name__ == "__main__":
    sys.exit(_main())
