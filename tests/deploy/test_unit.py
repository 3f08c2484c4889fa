"""The systemd unit: what systemd says of it, and a hand under its restrictions."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

MOST_EXPOSED = 2.0
"""What `systemd-analyze security` may find: 0 is locked up, 10 open."""


@pytest.fixture(scope="module")
def unit(repository: Path) -> Path:
    return repository / "deploy" / "rtee@.service"


@pytest.fixture(scope="module")
def directives(unit: Path) -> list[str]:
    return unit.read_text().splitlines()


@pytest.fixture(scope="module")
def analyze() -> str:
    found = shutil.which("systemd-analyze")
    if found is None:
        pytest.skip("there is no systemd-analyze on this computer")
    return found


def test_systemd_finds_it_well_protected(analyze: str, unit: Path) -> None:
    done = subprocess.run(
        [analyze, "security", "--offline=true", "--no-pager", str(unit)],
        capture_output=True,
        text=True,
    )
    level = re.search(r"exposure level for \S+: ([\d.]+)", done.stdout)
    assert level, done.stdout + done.stderr
    assert float(level[1]) <= MOST_EXPOSED, done.stdout


def test_systemd_understands_every_line(analyze: str, unit: Path, tmp_path: Path) -> None:
    copy = tmp_path / unit.name
    copy.write_text(unit.read_text().replace("/opt/rtee/bin/rtee", shutil.which("true") or ""))
    done = subprocess.run([analyze, "verify", str(copy)], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    "line",
    [
        "Type=notify",
        "WatchdogSec=2",
        "WatchdogSignal=SIGABRT",
        "KillSignal=SIGINT",
        "Restart=on-failure",
        "RestartPreventExitStatus=2",
        "User=rtee",
        "NoNewPrivileges=true",
        "CapabilityBoundingSet=",
        "ProtectSystem=strict",
        "ProtectHome=true",
        "MemoryDenyWriteExecute=true",
        "DevicePolicy=closed",
        "IPAddressDeny=any",
        "SystemCallFilter=@system-service",
        "LimitRTPRIO=90",
        "LimitMEMLOCK=infinity",
    ],
)
def test_it_says_what_protects_and_what_ends_it(directives: list[str], line: str) -> None:
    """Also where there is no systemd to ask."""
    assert directives.count(line) == 1


SANDBOX = """
import ctypes, os, sys
libc = ctypes.CDLL(None, use_errno=True)
seccomp = ctypes.CDLL("libseccomp.so.2")
seccomp.seccomp_init.restype = ctypes.c_void_p
seccomp.seccomp_rule_add.argtypes = [
    ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int, ctypes.c_uint]
seccomp.seccomp_load.argtypes = [ctypes.c_void_p]
PR_SET_NO_NEW_PRIVS, PR_SET_MDWE, REFUSE_EXEC_GAIN = 38, 65, 1
assert libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
if libc.prctl(PR_SET_MDWE, REFUSE_EXEC_GAIN, 0, 0, 0) != 0:
    print("this kernel has no MDWE", file=sys.stderr)  # Linux 6.3 and later have it
SCMP_ACT_ERRNO, EPERM, SCMP_ACT_ALLOW = 0x00050000, 1, 0x7FFF0000
context = seccomp.seccomp_init(SCMP_ACT_ERRNO | EPERM)
for name in sys.argv[1].split(","):
    number = seccomp.seccomp_syscall_resolve_name(name.encode())
    if number >= 0:
        seccomp.seccomp_rule_add(context, SCMP_ACT_ALLOW, number, 0)
assert seccomp.seccomp_load(context) == 0
os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
"""
"""Runs Python without system calls that are not named, and without memory to write and execute."""


def system_calls(analyze: str, directives: list[str]) -> set[str]:
    """Return the system calls that the unit allows, its lines read in their order."""
    allowed: set[str] = set()
    for line in directives:
        name, _, value = line.partition("=")
        if name == "SystemCallFilter":
            named = set().union(*(members(analyze, word) for word in value.lstrip("~").split()))
            allowed = allowed - named if value.startswith("~") else allowed | named
    return allowed


def members(analyze: str, word: str) -> set[str]:
    if not word.startswith("@"):
        return {word}
    done = subprocess.run(
        [analyze, "syscall-filter", word], capture_output=True, text=True, check=True
    )
    inside = [line.strip() for line in done.stdout.splitlines()[1:]]
    words = [line for line in inside if line and not line.startswith("#")]
    return set().union(*(members(analyze, each) for each in words))


def test_a_hand_runs_under_its_restrictions(
    analyze: str, directives: list[str], tmp_path: Path, repository: Path
) -> None:
    try:
        ctypes.CDLL("libseccomp.so.2")
    except OSError:
        pytest.skip("there is no libseccomp on this computer")
    allowed = system_calls(analyze, directives)
    assert {"read", "sched_setscheduler", "mlockall"} <= allowed
    assert not {"mount", "ptrace", "reboot", "bpf", "setrlimit"} & allowed
    rtee = ["-m", "rtee", "run", "robotiq_2f_85", "schunk_svh", "--driver", "devices"]
    options = ["--emulated", "--realtime", "--duration", "0.5"]
    done = subprocess.run(
        [sys.executable, "-c", SANDBOX, ",".join(sorted(allowed)), *rtee, *options],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(repository), *sys.path])},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "robotiq_2f_85: 0 goals" in done.stdout
    assert "Operation not permitted" not in done.stderr
    assert len(list((tmp_path / "logs").glob("*_000.mcap"))) == 2
